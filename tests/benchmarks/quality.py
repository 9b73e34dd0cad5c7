"""PSNR and SSIM after a given training time, over several seeds.

    MI_NERF_DATA=… python -m tests.benchmarks.quality --seconds 120 --seeds 3

Trains lego_200 at half its size (100x100) through the command line, evaluates all views
of the validation split by the nerf2020 protocol, prints a line a seed and the mean, and writes
it to docs/results/quality.json.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerf.base.variants import choose_variant
from tests.benchmarks import data_folder, machine
from tests.benchmarks.results import TRAINING, Protocol, Row, add_options, mean_of, save

_UNITS = {
    "psnr": "dB",
    "ssim": "",
    "steps": "",
    "queries_per_ray": "",
    "seconds_per_view": "s",
    "restarts": "",
}


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
    data = data_folder(options.data)
    print(machine())
    print(
        f"{options.data}, downscale {options.downscale}, split {options.split}, "
        f"preset {options.preset} {' '.join(options.set)}, {options.seconds:g} s of training, "
        f"{options.views or 'all'} views"
    )
    results = []
    for seed in range(options.first_seed, options.first_seed + options.seeds):
        with tempfile.TemporaryDirectory() as folder:
            results.append(_train_and_evaluate(data, Path(folder), seed, options))
        print(f"seed {seed}: {_line(results[-1])}", flush=True)
    mean = {key: float(np.mean([r[key] for r in results])) for key in _UNITS}
    print(f"mean of {options.seeds}: {_line(mean)}")
    save("quality", [_row(results, options)], options, choose_variant(), TRAINING)


def _row(results: list[dict[str, Any]], options: argparse.Namespace) -> Row:
    width, height = results[0]["size"]
    return Row(
        {
            "data": options.data,
            "preset": " ".join([options.preset, *options.set]),
            "size": f"{width}×{height}",
            "time": f"{options.seconds:g} s",
        },
        {key: mean_of([r[key] for r in results], unit) for key, unit in _UNITS.items()},
        Protocol(options.data, options.split, results[0]["views"], (width, height)),
        tuple(range(options.first_seed, options.first_seed + options.seeds)),
    )


def _train_and_evaluate(
    data: Path, folder: Path, seed: int, options: argparse.Namespace
) -> dict[str, Any]:
    run, record = folder / "run", folder / "eval.json"
    command = [sys.executable, "-m", "mi_nerf.cli"]
    train = ["train", str(data), "--out", str(run), "--seed", str(seed)]
    train += ["--max-seconds", str(options.seconds), "--downscale", str(options.downscale)]
    train += ["--preset", options.preset]
    if options.set:
        train += ["--set", *options.set]
    subprocess.run(command + train, check=True, stdout=subprocess.DEVNULL)
    evaluate = ["eval", str(run), "--split", options.split, "--json", str(record)]
    if options.views:
        evaluate += ["--views", str(options.views)]
    subprocess.run(command + evaluate, check=True, stdout=subprocess.DEVNULL)
    result = json.loads(record.read_text())
    log = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    return {
        "size": result["size"],
        "views": result["views"],
        "psnr": result["mean"]["psnr"],
        "ssim": result["mean"]["ssim"],
        "steps": log[-1]["step"],
        "queries_per_ray": result["queries_per_ray"],
        "seconds_per_view": result["seconds_per_view"],
        "restarts": sum(line.get("event") == "restart" for line in log),
    }


def _line(result: dict[str, float]) -> str:
    return (
        f"{result['psnr']:.2f} dB, SSIM {result['ssim']:.4f}, {result['steps']:.0f} steps, "
        f"{result['queries_per_ray']:.1f} queries a ray, "
        f"{result['seconds_per_view']:.3f} s a view, "
        f"{result['restarts']:g} restarts"
    )


if __name__ == "__main__":
    main()
