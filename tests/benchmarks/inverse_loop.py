"""What it costs that the occupancy grid follows the weights in a loop of inverse rendering.

    python -m tests.benchmarks.inverse_loop
    python -m tests.benchmarks.inverse_loop --field runs/lego/field.safetensors

Trains a field of the preset ``fast`` on lego_200 (below MI_NERF_DATA) at half size, or loads
one, and then fits all of its weights to a darker picture of itself by mi.render, dr.backward
and mi.ad.Adam: once with the grid of the file held, which is wrong as soon as a cell fills,
and once with the grid that follows. Iterations of both take turns, so that whatever else the
machine does weighs on both. Prints the mean seconds of each after the first two, their ratio,
the share of cells sampled at the end, and how many kernels the second half has compiled.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerf.base.variants import choose_variant
from mi_nerf.cameras.pinhole import Intrinsics, sensor_dict
from mi_nerf.cameras.poses import look_at
from mi_nerf.cli import main as command
from tests.benchmarks import data_folder, machine
from tests.benchmarks.results import RENDERING, Figure, Row, add_options, mean_of, save
from tests.support.fields import weight_keys

_WARM_UP = 2  # iterations that may wait for the compiler


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--field", type=Path, help="a field file, instead of training one")
    parser.add_argument("--seconds", type=float, default=90.0, help="of training")
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--size", type=int, default=100)
    parser.add_argument("--spp", type=int, default=4)
    parser.add_argument("--lr", type=float, default=1e-3)
    parser.add_argument("--variant")
    add_options(parser)
    options = parser.parse_args()
    variant = choose_variant(options.variant)
    mi.set_variant(variant)
    print(f"{machine()}, {variant}")
    with tempfile.TemporaryDirectory() as folder:
        path = options.field or _trained(Path(folder), options.seconds)
        loops = {held: Loop(path, options, held) for held in (True, False)}
    seconds: dict[bool, list[float]] = {True: [], False: []}
    compiled = {True: 0, False: 0}
    for step in range(options.iterations):
        for held, loop in loops.items():
            dr.kernel_history_clear()
            with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
                start = time.perf_counter()
                loop.step(step)
                dr.sync_thread()
                seconds[held].append(time.perf_counter() - start)
                if step >= options.iterations // 2:
                    compiled[held] += sum(k.get("cache_hit") == 0 for k in dr.kernel_history())
    means = {held: float(np.mean(times[_WARM_UP:])) for held, times in seconds.items()}
    for held, loop in loops.items():
        print(
            f"{'grid held' if held else 'grid that follows'}: {means[held]:.3f} s an iteration, "
            f"loss {loop.losses[0]:.2e} to {loop.losses[-1]:.2e}, "
            f"{loop.medium.occupancy.fraction():.1%} of the cells, {compiled[held]} kernels "
            "compiled in the second half"
        )
    print(f"ratio {means[False] / means[True]:.3f}")
    row = Row(
        {"what": f"an iteration of inverse rendering, {options.size}×{options.size}"},
        {
            "grid held": mean_of(seconds[True][_WARM_UP:], "s"),
            "grid that follows": mean_of(seconds[False][_WARM_UP:], "s"),
            "ratio": Figure(means[False] / means[True]),
        },
    )
    save("inverse_loop", [row], options, variant, RENDERING)


def _trained(folder: Path, seconds: float) -> Path:
    data, out = data_folder("lego_200"), folder / "run"
    options = ["--preset", "fast", "--downscale", "2", "--max-seconds", str(seconds)]
    if command(["train", str(data), "--out", str(out), *options]):
        raise SystemExit("training failed")
    return out / "field.safetensors"


class Loop:
    """One optimisation of all weights of a field."""

    def __init__(self, path: Path, options: argparse.Namespace, held: bool) -> None:
        camera = Intrinsics.from_angle_x(options.size, options.size, 0.6911)
        self._scene: Any = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "nerf"},
                "sensor": sensor_dict(camera, look_at((2.0, -3.0, 1.8), (0, 0, 0))),
                "box": {
                    "type": "cube",
                    "bsdf": {"type": "null"},
                    "interior": {"type": "nerfmedium", "filename": str(path)},
                },
            }
        )
        self.medium: Any = self._scene.shapes()[0].interior_medium()
        self.losses: list[float] = []
        self._spp, self._held = options.spp, held
        self._target = 0.7 * mi.render(self._scene, seed=0, spp=4 * self._spp)
        dr.eval(self._target)
        self._params = mi.traverse(self._scene)
        self._optimizer = mi.ad.Adam(lr=options.lr)
        for key in weight_keys(self._params):
            self._optimizer[key] = self._params[key]

    def step(self, number: int) -> None:
        """One iteration."""
        self._params.update(self._optimizer)
        if self._held:
            self.medium._stale = False
        image = mi.render(self._scene, self._params, seed=number, spp=self._spp)
        loss = dr.mean(dr.square(image - self._target), axis=None)
        dr.backward(loss)
        self._optimizer.step()
        self.losses.append(float(loss.array[0]))


if __name__ == "__main__":
    main()
