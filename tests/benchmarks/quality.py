"""PSNR and SSIM after a given training time, over several seeds.

    MI_NERF_DATA=… python -m tests.benchmarks.quality --seconds 120 --seeds 3

Trains lego_200 at half its size (100x100) through the command line, evaluates all views
of the validation split by the nerf2020 protocol, prints a line a seed and the mean, and writes
it to docs/results/quality.json.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from mi_nerf.base.variants import choose_variant
from tests.benchmarks import data_folder, machine, trained
from tests.benchmarks.results import TRAINING, add_options, save


def main() -> None:
    """Runs all seeds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default="lego_200")
    parser.add_argument("--split", default="val")
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--seeds", type=int, default=3, help="how many")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--views", type=int, help="evaluate so many views, evenly spread")
    parser.add_argument("--preset", default="nerf")
    parser.add_argument("--set", nargs="*", default=[])
    add_options(parser)
    options = parser.parse_args()
    data, preset = data_folder(options.data), " ".join([options.preset, *options.set])
    print(machine())
    print(
        f"{options.data}, downscale {options.downscale}, split {options.split}, preset {preset}, "
        f"{options.seconds:g} s of training, {options.views or 'all'} views"
    )
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    evaluate = ["--split", options.split]
    evaluate += ["--views", str(options.views)] if options.views else []
    runs = []
    for seed in seeds:
        train = ["--preset", options.preset, "--seed", str(seed)]
        train += ["--max-seconds", str(options.seconds), "--downscale", str(options.downscale)]
        train += ["--set", *options.set] if options.set else []
        with tempfile.TemporaryDirectory() as folder:
            runs.append(trained.by_command(data, Path(folder), train, evaluate))
        print(f"seed {seed}: {trained.line(runs[-1])}", flush=True)
    width, height = runs[0]["size"]
    labels = {
        "data": options.data,
        "preset": preset,
        "size": f"{width}×{height}",
        "time": f"{options.seconds:g} s",
    }
    row = trained.row(labels, runs, options.data, seeds)
    means = {name: figure.value for name, figure in row.figures.items()}
    print(f"mean of {options.seeds}: {trained.line(means)}")
    save("quality", [row], options, choose_variant(), TRAINING)


if __name__ == "__main__":
    main()
