"""The number of octaves L against error, scene by scene.

    mi-nerf generate arches arches --train 50 --val 8 --test 8 --size 100 100 --spp 64
    MI_NERF_DATA=… python -m tests.benchmarks.octaves --data lego_200 arches --steps 400

Trains preset nerf with every L, evaluates views held out by the nerf2020 protocol, and writes a
row a scene to docs/results/octaves.json: PSNR with each L, and the L that follows from the images
where none is given. ``mi-nerf ablate --rows L=2 L=4 …`` does the same for the paper's model.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from mi_nerf.base.variants import choose_variant
from mi_nerf.data import load_dataset
from mi_nerf.tasks.evaluate import evaluate
from mi_nerf.training import run as training
from mi_nerf.training.config import with_settings
from mi_nerf.training.presets import preset
from mi_nerf.training.scaling import resolved, resolved_octaves
from tests.benchmarks import data_folder
from tests.benchmarks.results import TRAINING, Figure, Protocol, Row, add_options, mean_of, save


def main() -> None:
    """Trains scene by scene."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", nargs="+", default=["lego_200"])
    parser.add_argument("--split", default="val")
    parser.add_argument("--views", type=int, help="evaluate so many views, evenly spread")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--octaves", type=int, nargs="+", default=[2, 4, 6, 8, 10])
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--seeds", type=int, default=1, help="how many")
    parser.add_argument("--set", nargs="*", default=[])
    add_options(parser)
    options = parser.parse_args()
    rows = [_row(data_folder(name), options) for name in options.data]
    for row in rows:
        print(f"{', '.join(row.labels.values())}: {row.figures}")
    save("octaves", rows, options, choose_variant(), TRAINING)


def _row(data: Path, options: argparse.Namespace) -> Row:
    """One scene, with every L and seed."""
    figures: dict[str, Figure] = {}
    for octaves in options.octaves:
        found = [_quality(data, octaves, seed, options) for seed in range(options.seeds)]
        figures[f"L{octaves}"] = mean_of([quality["mean"]["psnr"] for quality in found], "dB")
        print(f"{data.name}, L = {octaves}: {figures[f'L{octaves}'].value:.2f} dB", flush=True)
    dataset = load_dataset(data, "train", downscale=options.downscale)
    box = resolved(preset("nerf"), dataset).box
    assert box is not None  # any more
    figures["resolved"] = Figure(resolved_octaves(dataset, box[:3], box[3:]))
    width, height = found[0]["size"]
    model = " ".join(["nerf", *options.set])
    return Row(
        {
            "data": data.name,
            "size": f"{width}×{height}",
            "preset": model,
            "steps": str(options.steps),
        },
        figures,
        Protocol(data.name, options.split, found[0]["views"], (width, height)),
        tuple(range(options.seeds)),
    )


def _quality(data: Path, octaves: int, seed: int, options: argparse.Namespace) -> dict[str, Any]:
    """What ``mi-nerf eval`` says of one run."""
    settings = [*options.set, f"position.frequencies={octaves}"]
    config = replace(with_settings(preset("nerf"), settings), steps=options.steps, seed=seed)
    config = replace(config, downscale=options.downscale)
    variant = choose_variant()
    with tempfile.TemporaryDirectory() as out:
        run = training.start(data, Path(out) / "run", config, variant)
        run.train(show_bar=False)
        if run.interrupted:
            sys.exit("interrupted: nothing is written")
        return evaluate(Path(out) / "run", variant, split=options.split, views=options.views)


if __name__ == "__main__":
    main()
