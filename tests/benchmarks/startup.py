"""Seconds from the start of the process until the first training step has been computed.

    python -m tests.benchmarks.startup
    python -m tests.benchmarks.startup --data lego_800 --downscale 1
    python -m tests.benchmarks.startup --against ../0.1.0

Starts `mi-nerf train DATA --preset PRESET --steps 1`, DATA below MI_NERF_DATA, in processes of
their own: with an empty cache of kernels, then with what that has left there. The log says when
the step's results had been read. With --against, the checkout of another version takes turns, so
that whatever else the machine does weighs on both. Prints the medians of all repetitions (with
seeds 0, 1, …) and their range; below them the processes' CPU seconds, which a busy machine
changes less, and which saving the run and leaving are part of.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from tests.benchmarks import data_folder, machine

HERE = Path(__file__).parents[2]


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Prints the table; returns its figures by version, preset and state of the cache."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", default="lego_200", help="a folder below MI_NERF_DATA")
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--presets", nargs="*", default=["fast", "nerf"])
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--against", type=Path, help="a checkout of another version")
    options = parser.parse_args(arguments)
    data = data_folder(options.data).resolve()
    trees = {"this": HERE} | ({"other": options.against.resolve()} if options.against else {})
    result: dict[str, Any] = {"data": options.data, "downscale": options.downscale}
    print(f"{machine()}; {options.data}, downscale {options.downscale}")
    for preset in options.presets:
        found: dict[str, dict[str, list[tuple[float, float]]]] = {}
        for seed in range(options.repeat):
            for name, tree in trees.items():
                with tempfile.TemporaryDirectory() as home:
                    train = [str(data), "--preset", preset, "--downscale", str(options.downscale)]
                    for cache in ("empty", "warm"):
                        first = first_step(tree, [*train, "--seed", str(seed)], Path(home))
                        found.setdefault(name, {}).setdefault(cache, []).append(first)
        for name, caches in found.items():
            for cache, pairs in caches.items():
                figures = _summary(pairs)
                result.setdefault(name, {}).setdefault(preset, {})[cache] = figures
                low, high = figures["range"]
                print(
                    f"{name} version, {preset}, {cache} cache: {figures['seconds']:.2f} s "
                    f"({low:.2f} to {high:.2f}), {figures['cpu_seconds']:.2f} s of CPU",
                    flush=True,
                )
        for cache in ("empty", "warm") if options.against else ():
            mine, other = (result[name][preset][cache]["seconds"] for name in ("this", "other"))
            print(f"this / other, {preset}, {cache} cache: {mine / other:.2f}")
    return result


def first_step(tree: Path, train: list[str], home: Path) -> tuple[float, float]:
    """Wall-clock seconds until the first step's results were read; CPU seconds of it all.

    Args:
        tree: a checkout of mi_nerf.
        train: arguments of ``mi-nerf train`` but for the folder of the run.
        home: below which Dr.Jit keeps its kernels.
    """
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        command = [sys.executable, "-m", "mi_nerf.cli", "train", *train, "--out", str(out)]
        subprocess.run(
            [*command, "--steps", "1"],
            cwd=tree,
            env={**os.environ, "HOME": str(home)},
            stdout=subprocess.DEVNULL,
            check=True,
        )
        line = json.loads((out / "log.jsonl").read_text().splitlines()[0])
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert line["step"] == 1
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return float(line["seconds"]), cpu


def _summary(pairs: list[tuple[float, float]]) -> dict[str, Any]:
    """Of several repetitions, (wall-clock, CPU) seconds each."""
    wall = [seconds for seconds, _ in pairs]
    return {
        "seconds": statistics.median(wall),
        "range": [min(wall), max(wall)],
        "cpu_seconds": statistics.median(cpu for _, cpu in pairs),
        "repetitions": len(pairs),
    }


if __name__ == "__main__":
    main()
