"""Resident memory: over many training steps, of one large frame, and of derivatives.

    python -m tests.benchmarks.memory

Prints resident megabytes every 200 of 2000 steps of the preset ``nerf``, the number of
kernels compiled in the last 1000 of them, and the peak while Mitsuba renders 800x800
pixels of the published 8x256 network with 16 samples a ray. Then the peak of
``render_backward`` at 256x256, of a field before a wall under ``prb``, with 4, 16, 64 and 256
samples a pixel, each in a process of its own.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

import mi_nerf
from mi_nerf.base.variants import array_module, choose_variant
from mi_nerf.cameras.pinhole import Intrinsics, sensor_dict
from mi_nerf.cameras.poses import look_at
from mi_nerf.fields.network import initial_weights
from mi_nerf.march.settings import MarchSettings
from mi_nerf.training.presets import preset
from mi_nerf.training.trainer import Trainer
from tests.benchmarks import machine, resident_megabytes
from tests.benchmarks.published_step import synthetic_views
from tests.benchmarks.results import (
    RENDERING,
    TRAINING,
    Figure,
    Row,
    add_options,
    median_of,
    save,
)


def main() -> None:
    """Prints both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--size", type=int, default=800)
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--spp", type=int, nargs="*", default=[4, 16, 64, 256])
    parser.add_argument("--variant")
    add_options(parser)
    options = parser.parse_args()
    variant = choose_variant(options.variant)
    print(machine())
    rows = []
    if options.steps:
        rows.append(_training(variant, options.steps))
    if options.size:
        rows.append(_frame(variant, options.size, options.samples))
    if len(options.spp) == 1:
        rows.append(_gradient(variant, options.spp[0]))
    if rows:
        save("memory", rows, options, variant, tuple(sorted({*TRAINING, *RENDERING})))
    for spp in options.spp if len(options.spp) > 1 else ():
        command = [sys.executable, "-m", "tests.benchmarks.memory", "--steps", "0", "--size", "0"]
        command += ["--variant", variant, "--spp", str(spp), "--results", str(options.results)]
        command += ["--no-write"] if options.no_write else []
        subprocess.run(command, check=True)


def _training(variant: str, steps: int) -> Row:
    trainer = Trainer(preset("nerf"), synthetic_views(), array_module(variant))
    misses, resident = 0, []
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    for step in range(1, steps + 1):
        trainer.step(1e-3)
        history = dr.kernel_history()
        if step > steps // 2:
            misses += sum(k.get("cache_hit") == 0 for k in history)
        if step % max(1, steps // 10) == 0:
            dr.sync_thread()
            resident.append(resident_megabytes())
            print(f"step {step}: {resident[-1]:.0f} MB", flush=True)
    dr.set_flag(dr.JitFlag.KernelHistory, False)
    print(f"kernels compiled in the last {steps - steps // 2} steps: {misses}")
    return Row(
        {"what": f"resident memory, looked at ten times in {steps} steps of nerf"},
        {
            "memory": median_of(resident, "MB"),
            "kernels compiled in the second half": Figure(misses),
        },
    )


def _frame(variant: str, size: int, samples: int) -> Row:
    mi.set_variant(variant)
    config = mi_nerf.NeuralFieldConfig()
    contents = mi_nerf.FieldFile(
        config, initial_weights(config.shapes(), 0), march=MarchSettings(samples=samples)
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "field.safetensors"
        mi_nerf.save_field(path, contents)
        camera = Intrinsics.from_angle_x(size, size, 0.6911)
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "nerf"},
                "sensor": sensor_dict(camera, look_at((0, -4, 1), (0, 0, 0))),
                "box": {
                    "type": "cube",
                    "interior": {"type": "nerfmedium", "filename": str(path)},
                },
            }
        )
    before = resident_megabytes()
    start = time.perf_counter()
    image = np.array(mi.render(scene, spp=1))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(
        f"{size}x{size}, {samples} samples a ray, 8x256: {time.perf_counter() - start:.0f} s, "
        f"peak {peak:.0f} MB resident ({before:.0f} MB before), "
        f"mean alpha {image[..., 3].mean():.2f}"
    )
    what = f"{size}×{size} pixels, {samples} samples a ray, of the 8×256 network by mi.render"
    return Row({"what": what}, {"peak memory": Figure(peak, "MB")})


def _gradient(variant: str, spp: int) -> Row:
    mi.set_variant(variant)
    camera = Intrinsics.from_angle_x(256, 256, 0.6911)
    wall = mi.ScalarTransform4f().translate([0, 1.5, 0]).rotate([1, 0, 0], 90).scale(3)
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "nerf", "samples": 16, "nested": {"type": "prb"}},
            "sensor": sensor_dict(camera, look_at((0, -5, 0), (0, 0, 0))),
            "wall": {"type": "rectangle", "to_world": wall},
            "sky": {"type": "constant"},
            "box": {"type": "cube", "interior": {"type": "nerfmedium", "field": "gaussian"}},
        }
    )
    params = mi.traverse(scene)
    key = "box.interior_medium.peak"
    dr.enable_grad(params[key])
    params.update()
    start = time.perf_counter()
    pull = dr.ones(mi.TensorXf, (256, 256, 4))
    scene.integrator().render_backward(scene, params, pull, seed=1, spp=spp)
    gradient = float(np.ravel(dr.grad(params[key]))[0])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(
        f"render_backward of 256x256 with {spp} samples a pixel: peak {peak:.0f} MB resident, "
        f"{time.perf_counter() - start:.1f} s, gradient {gradient:.1f}"
    )
    what = f"render_backward of 256×256, {spp} samples a pixel, a field before a wall under prb"
    return Row({"what": what}, {"peak memory": Figure(peak, "MB")})


if __name__ == "__main__":
    main()
