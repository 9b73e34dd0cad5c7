"""Seconds from the start of the process until the first training step has been computed.

    MI_NERF_DATA=… python -m tests.benchmarks.startup --against ../before
    MI_NERF_DATA=… python -m tests.benchmarks.startup --data lego_800 --downscale 1

Starts `mi-nerf train DATA --preset PRESET --steps 1`, DATA below MI_NERF_DATA, in processes of
their own: with an empty cache of kernels, then with what that has left there. The log says when
the step's results had been read. With --against, the checkout of another version takes turns, so
that whatever else the machine does weighs on both. Medians of all repetitions (with seeds 0, 1,
…) and their range; beside them the processes' CPU seconds, which a busy machine changes less,
and which saving the run and leaving are part of.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from mi_nerf.base.variants import choose_variant
from mi_nerf.data import load_dataset
from mi_nerf.training.run_folder import LOG
from tests.benchmarks import checkout, data_folder, machine
from tests.benchmarks.results import TRAINING, Figure, Row, add_options, median_of, save

# Everything that is imported on the way.
PARTS = tuple(sorted({*TRAINING, "base", "commands", "fields", "formats", "tasks"}))
Seconds = tuple[float, float]  # of the clock, and of the CPU


def main() -> None:
    """Times all presets."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", default="lego_200", help="a folder below MI_NERF_DATA")
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--presets", nargs="*", default=["fast", "nerf"])
    parser.add_argument("--repeat", type=int, default=3)
    checkout.add_options(parser)
    add_options(parser)
    options = parser.parse_args()
    data = data_folder(options.data).resolve()
    size = load_dataset(data, "train", downscale=options.downscale, limit=1).intrinsics
    images = f"{options.data}, {size.width}×{size.height}"
    print(f"{machine()}; {images}")
    for preset in options.presets:
        _compare(preset, data, images, options)


def _compare(preset: str, data: Path, images: str, options: argparse.Namespace) -> None:
    """Starts one preset with all checkouts in turns, and saves their rows."""
    places = checkout.versions(options)
    found: dict[tuple[str, str], list[Seconds]] = {}  # of a version and a state of the cache
    train = [str(data), "--preset", preset, "--downscale", str(options.downscale)]
    for seed in range(options.repeat):
        for version, folder in places.items():
            with tempfile.TemporaryDirectory() as home:
                for cache in ("empty", "warm"):
                    seconds = first_step(folder, [*train, "--seed", str(seed)], Path(home))
                    found.setdefault((version, cache), []).append(seconds)
    for (version, cache), pairs in found.items():
        wall, cpu = (median_of(values, "s") for values in zip(*pairs, strict=True))
        figures = {"seconds": wall, "cpu_seconds": cpu}
        if version == "this" and len(places) > 1:
            before = [seconds for seconds, _ in found[options.against_name, cache]]
            figures["ratio"] = Figure(wall.value / median_of(before).value)
        print(
            f"{preset}, {cache} cache, {version}: "
            + ", ".join(f"{name} {figure.value:.2f}" for name, figure in figures.items()),
            flush=True,
        )
        labels = {"images": images, "preset": preset, "cache": cache, "version": version}
        row = Row(labels, figures, seeds=tuple(range(options.repeat)))
        save("startup", [row], options, choose_variant(), PARTS, checkout=places[version])


def first_step(tree: Path, train: list[str], home: Path) -> Seconds:
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
            env={**os.environ, "HOME": str(home), "PYTHONPATH": str(tree)},
            stdout=subprocess.DEVNULL,
            check=True,
        )
        line = json.loads((out / LOG).read_text().splitlines()[0])
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert line["step"] == 1
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return float(line["seconds"]), cpu


if __name__ == "__main__":
    main()
