"""Seconds of a training step of the published model: two networks of 8x256.

    python -m tests.benchmarks.published_step
    python -m tests.benchmarks.published_step --rays 4096 --steps 2

One step of so many rays, with 64 queries of the coarse network and 192 of the fine one each:
forward, backward, Adam. Prints the median of some steps after a warm-up, the arithmetic rate
(3.49 MFLOP a query), and the rate of a plain matrix product of the same shape for comparison.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import drjit as dr
import numpy as np

from mi_nerf.base.variants import array_module, choose_variant
from mi_nerf.cameras.pinhole import Intrinsics
from mi_nerf.cameras.poses import look_at
from mi_nerf.data import Dataset
from mi_nerf.report.arithmetic import drjit_product_rate, numpy_product_rate, training_flop
from mi_nerf.training.config import with_settings
from mi_nerf.training.presets import preset
from mi_nerf.training.trainer import Trainer
from tests.benchmarks import machine, resident_megabytes
from tests.benchmarks.results import TRAINING, Figure, Row, add_options, median_of, save


def synthetic_views() -> Dataset:
    """Noise seen by cameras whose rays all cross the box."""
    camera = Intrinsics.from_angle_x(64, 64, 0.3)
    poses = np.stack([look_at((4 * np.cos(a), 4 * np.sin(a), 1), (0, 0, 0)) for a in range(6)])
    images = np.random.default_rng(0).random((6, 64, 64, 4)).astype(np.float32)
    images[..., 3] = 1
    return Dataset(Path("."), "train", tuple("abcdef"), images, "srgb", True, poses, camera)


def main() -> None:
    """Times the step."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=5)
    parser.add_argument("--rays", type=int, default=1024)
    parser.add_argument("--variant")
    add_options(parser)
    options = parser.parse_args()
    variant = choose_variant(options.variant)
    backend = array_module(variant)
    settings = [f"sampling.rays={options.rays}", "box=-1,-1,-1,1,1,1"]
    trainer = Trainer(with_settings(replace(preset("paper")), settings), synthetic_views(), backend)
    seconds = []
    for step in range(options.steps + 1):
        start = time.perf_counter()
        result = trainer.step(5e-4)
        dr.sync_thread()
        if step:  # the first one compiles
            seconds.append(time.perf_counter() - start)
    queries = result.queries
    rate = queries * training_flop(trainer.field_config) / np.median(seconds) / 1e9
    print(machine())
    weights = trainer.field_config.parameter_count()
    print(f"{result.rays} rays, {queries} queries, 2 x {weights} weights")
    print(
        f"step: median {np.median(seconds):.2f} s, {min(seconds):.2f} to {max(seconds):.2f} s, "
        f"{rate:.0f} GFLOP/s, {resident_megabytes() / 1e3:.1f} GB resident"
    )
    ours, numpy = drjit_product_rate(backend), numpy_product_rate()
    print(
        f"plain matrix product 256x256x16384: {ours:.0f} GFLOP/s in Dr.Jit, "
        f"{numpy:.0f} in NumPy on the CPU"
    )
    what = f"a training step of the published model, {result.rays} rays × (64 + 192) queries"
    figures = {
        "seconds": median_of(seconds, "s"),
        "rate": Figure(rate, "GFLOP/s"),
        "product in Dr.Jit": Figure(ours, "GFLOP/s"),
        "product in NumPy": Figure(numpy, "GFLOP/s"),
        "memory": Figure(resident_megabytes() / 1e3, "GB"),
    }
    save("published_step", [Row({"what": what}, figures)], options, variant, TRAINING)


if __name__ == "__main__":
    main()
