"""Preset auto beside fast, after equally many steps: error, bytes, and what was taken out.

    mi-nerf generate arches arches --train 50 --val 8 --test 8 --size 100 100 --spp 64
    MI_NERF_DATA=… python -m tests.benchmarks.shape --data arches --steps 600

Quality after so many steps does not depend on how busy the machine is; what a step costs is
measured apart, by the time that processors spent on it. Evaluates views held out by the nerf2020
protocol and writes a row a scene to docs/results/shape.json.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from mi_nerf.base.variants import choose_variant
from mi_nerf.tasks.evaluate import evaluate
from mi_nerf.training.run_folder import FIELD
from tests.benchmarks import data_folder
from tests.benchmarks.results import TRAINING, Figure, Protocol, Row, mean_of, save
from tests.benchmarks.trained import for_steps, options_of_steps


@dataclass(frozen=True)
class Outcome:
    """What one run came to."""

    psnr: float
    field_bytes: float  # of the field file
    seconds: float  # of processors, training and what it asks included
    entries: int  # log2 of those of a level
    directions: bool
    views: int
    size: tuple[int, int]


def main() -> None:
    """Trains scene by scene."""
    options = options_of_steps(__doc__, 600).parse_args()
    for name in options.data:
        row = _row(data_folder(name), options)
        print(f"{', '.join(row.labels.values())}: {row.figures}", flush=True)
        save("shape", [row], options, choose_variant(), TRAINING)


def _row(data: Path, options: argparse.Namespace) -> Row:
    """One scene: both presets with every seed."""
    seeds = range(options.seeds)
    fast, auto = ([_outcome(data, name, s, options) for s in seeds] for name in ("fast", "auto"))
    gains = [a.psnr - f.psnr for a, f in zip(auto, fast, strict=True)]
    figures = {
        "gain": mean_of(gains, "dB"),
        "entries": mean_of([a.entries for a in auto]),
        "directions": Figure(sum(a.directions for a in auto)),
    }
    for name, runs in (("fast", fast), ("auto", auto)):
        figures |= {
            name: mean_of([run.psnr for run in runs], "dB"),
            f"{name}_bytes": mean_of([run.field_bytes / 1e6 for run in runs], "MB"),
            f"{name}_seconds": mean_of([run.seconds for run in runs], "s"),
        }
    (width, height), views = fast[0].size, fast[0].views
    return Row(
        {
            "data": data.name,
            "size": f"{width}×{height}",
            "steps": str(options.steps),
            "settings": " ".join(options.set),
        },
        figures,
        Protocol(data.name, options.split, views, (width, height)),
        tuple(seeds),
    )


def _outcome(data: Path, name: str, seed: int, options: argparse.Namespace) -> Outcome:
    variant = choose_variant()
    with tempfile.TemporaryDirectory() as out:
        folder = Path(out) / "run"
        before = time.process_time()
        run = for_steps(data, folder, name, seed, options, variant)
        seconds = time.process_time() - before
        for decision in run.decisions:
            print(f"{data.name}, seed {seed}: {decision}", flush=True)
        found = evaluate(folder, variant, split=options.split, views=options.views)
        grid = run.config.grid
        return Outcome(
            found["mean"]["psnr"],
            (folder / FIELD).stat().st_size,
            seconds,
            0 if grid is None else grid.most_entries.bit_length() - 1,
            run.config.network.view_dependent,
            found["views"],
            (found["size"][0], found["size"][1]),
        )


if __name__ == "__main__":
    main()
