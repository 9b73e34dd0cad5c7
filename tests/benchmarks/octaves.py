"""The number of octaves L against error, scene by scene.

    mi-nerf generate arches arches --train 50 --val 8 --test 8 --size 100 100 --spp 64
    MI_NERF_DATA=… python -m tests.benchmarks.octaves --data lego_200 arches --steps 400

Trains preset nerf with every L, evaluates views held out by the nerf2020 protocol, and writes a
row a scene to docs/results/octaves.json: PSNR with each L, and the L that follows from the images
where none is given. ``mi-nerf ablate --rows L=2 L=4 …`` does the same for the paper's model.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

from mi_nerf.base.variants import choose_variant
from mi_nerf.data import load_dataset
from mi_nerf.tasks.evaluate import evaluate
from mi_nerf.training.presets import preset
from mi_nerf.training.scaling import resolved, resolved_octaves
from tests.benchmarks import data_folder
from tests.benchmarks.results import TRAINING, Figure, Protocol, Row, mean_of, save
from tests.benchmarks.trained import for_steps, options_of_steps


def main() -> None:
    """Trains scene by scene."""
    parser = options_of_steps(__doc__, 400)
    parser.add_argument("--octaves", type=int, nargs="+", default=[2, 4, 6, 8, 10])
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
    settings, variant = [f"position.frequencies={octaves}"], choose_variant()
    with tempfile.TemporaryDirectory() as out:
        folder = Path(out) / "run"
        for_steps(data, folder, "nerf", seed, options, variant, settings)
        return evaluate(folder, variant, split=options.split, views=options.views)


if __name__ == "__main__":
    main()
