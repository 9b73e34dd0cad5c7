"""What derivatives of light paths cost: time beside a picture, and memory by depth and samples.

    python -m tests.benchmarks.path_gradient

A field given by a formula, an untrained network, four layers of 64, and a trained one, the vase of
the example scenes, between a matt floor and a mirror below a lamp. Prints the median time of
``render_backward`` (of the weights of the field, a colour and the lamp) over that of a picture with
as many samples, repeated in turns after a first pair that compiles, by the clock and in CPU time,
which other work disturbs less; then the peak of resident memory of one ``render_backward``, each
in a process of its own.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

import mi_nerf
from mi_nerf.base.variants import choose_variant
from mi_nerf.fields.network import NetworkConfig, initial_weights
from mi_nerf.march.settings import MarchSettings
from tests.benchmarks import machine
from tests.benchmarks.results import RENDERING, ROOT, Figure, Row, add_options, median_of, save
from tests.support.composed import place, rgb
from tests.support.fields import camera_dict

_COLOR, _LAMP = "floor.bsdf.reflectance.value", "lamp.emitter.radiance.value"
_TRAINED = ROOT / "scenes" / "fields" / "vase.safetensors"
_CASES = ((2, 4), (16, 4), (2, 256), (16, 256))  # depth of paths, samples a pixel


def main() -> None:
    """Prints both tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--size", type=int, default=32)
    parser.add_argument("--case", type=int, nargs=2, help="depth and samples: memory of one")
    parser.add_argument("--variant")
    add_options(parser)
    options = parser.parse_args()
    variant = choose_variant(options.variant)
    mi.set_variant(variant)
    if options.case:
        _memory_of(options.size, *options.case)
        return
    print(f"{machine()}, {variant}, {options.size}x{options.size} pixels")
    with tempfile.TemporaryDirectory() as folder:
        rows = [
            _time("gaussian", {"field": "gaussian"}, options),
            _time("a network 64 wide", {"filename": str(_network(Path(folder)))}, options),
            _time("a trained field", {"filename": str(_TRAINED)}, options),
        ]
    rows += [_memory(depth, spp, options) for depth, spp in _CASES]
    save("path_gradient", rows, options, variant, RENDERING)


def _scene(medium: dict[str, Any], size: int, depth: int) -> tuple[Any, Any]:
    """The scene, and its parameters with gradients enabled."""
    view = place().look_at(origin=[0.3, -4.0, 0.8], target=[0, 0, -0.2], up=[0, 0, 1])
    down = place().translate([0.3, 0, 3]).rotate([1, 0, 0], 180).scale(0.7)
    tinted = {"type": "conductor", "specular_reflectance": rgb((0.9, 0.8, 0.7))}
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "nerf_path", "max_depth": depth, "rr_depth": 100},
            "sensor": camera_dict(view, size=(size, size)),
            "floor": {
                "type": "rectangle",
                "to_world": place().translate([0, 0, -1]).scale(4),
                "bsdf": {"type": "diffuse", "reflectance": rgb((0.6, 0.5, 0.4))},
            },
            "mirror": {
                "type": "rectangle",
                "to_world": place().translate([0, 2.2, 0]).rotate([1, 0, 0], 90).scale(2),
                "bsdf": tinted,
            },
            "lamp": {
                "type": "rectangle",
                "to_world": down,
                "emitter": {"type": "area", "radiance": rgb((9, 8, 7))},
            },
            "box": {
                "type": "cube",
                "to_world": place().scale(0.8),
                "interior": {"type": "nerfmedium", **medium},
            },
        }
    )
    params = mi.traverse(scene)
    weights = [k for k in params.keys() if k.startswith("box.interior_medium")]  # noqa: SIM118
    for key in (_COLOR, _LAMP, *weights):
        if not key.endswith("to_world"):
            dr.enable_grad(params[key])
    params.update()
    return scene, params


def _network(folder: Path) -> Path:
    path = folder / "field.safetensors"
    network = NetworkConfig(depth=4, width=64, skip=2, view_width=32)
    config = mi_nerf.NeuralFieldConfig(network=network)
    march = MarchSettings(samples=32)
    weights = initial_weights(config.shapes(), 0)
    mi_nerf.save_field(path, mi_nerf.FieldFile(config, weights, march=march))
    return path


def _backward(scene: Any, params: Any, size: int, spp: int, seed: int) -> None:
    pull = dr.ones(mi.TensorXf, (size, size, 4))
    scene.integrator().render_backward(scene, params, pull, seed=seed, spp=spp)
    dr.eval(dr.grad(params[_COLOR]))
    dr.sync_thread()


def _time(name: str, medium: dict[str, Any], options: argparse.Namespace) -> Row:
    scene, params = _scene(medium, options.size, 6)
    taken: dict[str, list[tuple[float, float]]] = {"picture": [], "derivative": []}
    for seed in range(1, options.repeats + 2):
        with dr.suspend_grad(), _timed(taken["picture"]):
            dr.eval(mi.render(scene, spp=4, seed=seed))
            dr.sync_thread()
        with _timed(taken["derivative"]):
            _backward(scene, params, options.size, 4, seed)
    picture, derivative = (np.array(times[1:]) for times in taken.values())
    times, of_cpu = (derivative / picture).T
    print(
        f"{name}: a picture {np.median(picture[:, 0]):.3f} s, its derivative "
        f"{np.median(derivative[:, 0]):.3f} s, {np.median(times):.2f} times; in CPU time "
        f"{np.median(of_cpu):.2f} times",
        flush=True,
    )
    return Row(
        {"what": f"a derivative of light paths, {name}"},
        {
            "picture": median_of(picture[:, 0].tolist(), "s"),
            "derivative": median_of(derivative[:, 0].tolist(), "s"),
            "times": median_of(times.tolist()),
            "times in CPU time": median_of(of_cpu.tolist()),
        },
    )


@contextmanager
def _timed(taken: list[tuple[float, float]]) -> Iterator[None]:
    """Appends the seconds of a piece of work by the clock and in CPU time."""
    start = time.perf_counter(), time.process_time()
    yield
    taken.append((time.perf_counter() - start[0], time.process_time() - start[1]))


def _memory(depth: int, spp: int, options: argparse.Namespace) -> Row:
    command = [sys.executable, "-m", "tests.benchmarks.path_gradient"]
    command += ["--size", str(2 * options.size), "--case", str(depth), str(spp)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    peak = float(done.stdout.split()[-2])
    print(f"depth {depth}, {spp} samples a pixel: peak {peak:.0f} MB", flush=True)
    what = f"a derivative of light paths, depth {depth}, {spp} samples a pixel"
    return Row({"what": what}, {"peak memory": Figure(peak, "MB")})


def _memory_of(size: int, depth: int, spp: int) -> None:
    scene, params = _scene({"field": "gaussian"}, size, depth)
    _backward(scene, params, size, spp, 1)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(f"{peak:.0f} MB")


if __name__ == "__main__":
    main()
