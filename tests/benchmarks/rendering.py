"""What skipping empty space and ending rays early save and cost, and how fast a field renders.

    MI_NERF_DATA=… python -m tests.benchmarks.rendering --preset fast --seconds 120

Trains lego_200 at half its size, then measures held-out views of the same field three times:
everywhere in the visual hull, with the occupancy grid, and with rays that end early, too.
At last Mitsuba renders the field at 200x200 pixels through mi.render, again and again.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

import mi_nerf  # noqa: F401  (registers the plugins)
from mi_nerf.base.variants import array_module, choose_variant
from mi_nerf.cameras.pinhole import sensor_dict
from mi_nerf.data import load_dataset
from mi_nerf.images.metrics import psnr, to_8bit
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.occupancy import OccupancyGrid
from mi_nerf.march.view import display_image, render_view
from mi_nerf.tasks.evaluate import reference_image
from mi_nerf.training import run as training
from mi_nerf.training.presets import preset
from mi_nerf.training.run_folder import FIELD
from tests.benchmarks import data_folder, machine
from tests.benchmarks.results import (
    RENDERING,
    TRAINING,
    Figure,
    Protocol,
    Row,
    add_options,
    mean_of,
    median_of,
    save,
)


def main() -> None:
    """Trains, then prints both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default="lego_200")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--views", type=int, default=25)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--variant")
    add_options(parser)
    options = parser.parse_args()
    variant = choose_variant(options.variant)
    mi.set_variant(variant)
    print(f"{machine()}, {variant}")
    print(f"{options.data} at half its size, preset {options.preset}, {options.seconds:g} s")
    config = replace(preset(options.preset), max_seconds=options.seconds, downscale=2)
    with tempfile.TemporaryDirectory() as folder:
        data = data_folder(options.data)
        run = training.start(data, Path(folder) / "run", config, variant)
        run.train(show_bar=False)
        rows = _quality(run, data, options.views)
        rows.append(_speed(Path(folder) / "run" / FIELD, data, options))
    save("rendering", rows, options, variant, tuple(sorted({*TRAINING, *RENDERING})))


def _quality(run: training.Run, data: Path, views: int) -> list[Row]:
    trainer, backend = run.trainer, array_module(run.variant)
    march, field = run.field_file().march, trainer.field
    hull = OccupancyGrid(field.lower, field.upper, trainer._hull, backend.Float)
    ways: dict[str, tuple[Any, Any]] = {
        "visual hull": (hull, replace(march, stop=0.0)),
        "occupancy grid": (trainer.occupancy, replace(march, stop=0.0)),
        "and early termination": (trainer.occupancy, march),
    }
    dataset = load_dataset(data, "val", downscale=2, limit=views)
    rows = []
    for name, (grid, settings) in ways.items():
        found, queries = [], 0
        for k, pose in enumerate(dataset.cam_to_world):
            view = render_view(
                MarchedField(field, settings, grid), dataset.intrinsics, pose, backend
            )
            image = to_8bit(display_image(view, field.color_space))
            found.append(psnr(image, reference_image(dataset, k)))
            queries += view.queries
        rays = len(dataset) * dataset.intrinsics.width * dataset.intrinsics.height
        print(f"{name}: {np.mean(found):.3f} dB, {queries / rays:.1f} queries a ray")
        size = (dataset.intrinsics.width, dataset.intrinsics.height)
        rows.append(
            Row(
                {"what": name, "preset": run.config.preset},
                {"psnr": mean_of(found, "dB"), "queries_per_ray": Figure(queries / rays)},
                Protocol(data.name, "val", len(dataset), size),
                (run.config.seed,),
            )
        )
    return rows


def _speed(field: Path, data: Path, options: argparse.Namespace) -> Row:
    dataset = load_dataset(data, "val", limit=5)
    pose = dataset.cam_to_world[0]
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "nerf"},
            "sensor": sensor_dict(dataset.intrinsics, pose),
            "box": {"type": "cube", "interior": {"type": "nerfmedium", "filename": str(field)}},
        }
    )
    seconds = []
    for seed in range(options.repeats + 1):
        start = time.perf_counter()
        dr.eval(mi.render(scene, spp=1, seed=seed))
        dr.sync_thread()
        seconds.append(time.perf_counter() - start)
    size = dataset.intrinsics
    first, *rest = seconds
    print(
        f"mi.render, {size.width}x{size.height}, 1 sample a pixel: median "
        f"{np.median(rest):.3f} s of {len(rest)} ({min(rest):.3f} to {max(rest):.3f}), "
        f"the first {first:.2f} s"
    )
    what = f"a frame by mi.render, {size.width}×{size.height}"
    return Row(
        {"what": what, "preset": options.preset},
        {"seconds": median_of(rest, "s"), "first": Figure(first, "s")},
    )


if __name__ == "__main__":
    main()
