"""The published model at a reduced size, trained to the end of its schedule.

    MI_NERF_DATA=… python -m tests.benchmarks.reduced_paper
    python -m tests.benchmarks.reduced_paper --scene kettle --seconds 300 --set network.width=128

Structure and schedule are those of the preset ``paper``: eight layers with a skip, a coarse and a
fine network, L = 10 and 4, a learning rate that falls from 5e-4 to a tenth over the run. Smaller
are the images (lego_200 at half its size, 100x100, or a scene path-traced for this), the widths
(64 and 32), the samples (32 + 64) and the rays (256): ten minutes on two CPU cores by default,
from process start on, compilation included. Then held-out views are measured by the nerf2020
protocol. How long the published model itself would take with these images is measured, too.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from mi_nerf import generation
from mi_nerf.base.machine import machine, machine_line
from mi_nerf.base.variants import array_module, choose_variant
from mi_nerf.data import load_dataset, split_to_measure
from mi_nerf.scene_xml.library import find_scene
from mi_nerf.tasks.evaluate import evaluate
from mi_nerf.training import run as training
from mi_nerf.training.config import with_settings
from mi_nerf.training.forecast import PUBLISHED_STEPS, duration, step_seconds
from mi_nerf.training.presets import preset
from mi_nerf.training.run_folder import LOG
from tests.benchmarks import data_folder
from tests.benchmarks.gpu import write_result
from tests.benchmarks.results import commit

REDUCED = ["network.width=64", "network.view_width=32", "sampling.rays=256"]
REDUCED += ["sampling.samples=32", "sampling.fine=64", "sampling.render_samples=32"]


def main() -> None:
    """Trains every seed to its end, and prints a line each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default="lego_200", help="in the folder MI_NERF_DATA names")
    parser.add_argument("--scene", help="path-trace this one instead, 60 views of 100x100")
    parser.add_argument("--downscale", type=int, help="default: 2, of a scene 1")
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--steps", type=int, help="of the schedule, in place of seconds")
    parser.add_argument("--seeds", type=int, default=1, help="how many")
    parser.add_argument("--views", type=int, default=25)
    parser.add_argument("--set", nargs="*", default=[], help="changes, as of mi-nerf train")
    parser.add_argument("--variant")
    parser.add_argument("--out", type=Path, help="a JSON file of what was found")
    options = parser.parse_args()
    variant = choose_variant(options.variant)
    record: dict[str, Any] = {
        "command": " ".join(["python -m tests.benchmarks.reduced_paper", *sys.argv[1:]]),
        "commit": commit(),
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "machine": machine(variant),
        "settings": [*REDUCED, *options.set],
        "runs": [],
    }
    budget = f"{options.steps} steps" if options.steps else f"{options.seconds:g} s"
    print(f"{machine_line(record['machine'])}; {' '.join(record['settings'])}; {budget} a run")
    with tempfile.TemporaryDirectory() as folder:
        data = _data(options, Path(folder), variant)
        record["published"] = _published(data, options, variant)
        for seed in range(options.seeds):
            found = _trained(data, Path(folder) / f"run_{seed}", seed, options, variant)
            record["runs"].append(found)
            print(f"seed {seed}: {_line(found)}", flush=True)
            if options.out:
                write_result(options.out, record)


def _data(options: argparse.Namespace, folder: Path, variant: str) -> Path:
    """The images, path-traced if a scene was named."""
    if options.scene is None:
        options.downscale = options.downscale or 2
        return data_folder(options.data)
    options.downscale = options.downscale or 1
    views = generation.Options(train=60, val=0, test=10, size=(100, 100), spp=64)
    place = folder / options.scene
    generation.generate(find_scene(options.scene), place, variant, views, show=False)
    return place


def _published(data: Path, options: argparse.Namespace, variant: str) -> dict[str, Any]:
    """What the whole preset would take with these images."""
    dataset = load_dataset(data, "train", downscale=options.downscale, limit=10)
    seconds = step_seconds(preset("paper"), dataset, array_module(variant))
    steps = PUBLISHED_STEPS["paper"]
    print(
        f"the published model: {seconds:.3g} s a step, {steps:,} steps would take about "
        f"{duration(seconds * steps)}",
        flush=True,
    )
    return {"step_seconds": seconds, "steps": steps, "seconds": seconds * steps}


def _trained(
    data: Path, folder: Path, seed: int, options: argparse.Namespace, variant: str
) -> dict[str, Any]:
    """One run and its quality."""
    config = with_settings(preset("paper"), [*REDUCED, *options.set])
    config = replace(config, seed=seed, downscale=options.downscale)
    limit = None if options.steps else options.seconds
    config = replace(config, steps=options.steps, max_seconds=limit)
    run = training.start(data, folder, config, variant)
    run.train(show_bar=False)
    split = split_to_measure(data, None)
    measured = evaluate(run, split=split, views=options.views)
    log = [json.loads(line) for line in (folder / LOG).read_text().splitlines()]
    return {
        "seed": seed,
        "split": split,
        "views": len(measured["images"]),
        "psnr": measured["mean"]["psnr"],
        "ssim": measured["mean"]["ssim"],
        "steps": run.trainer.step_count,
        "seconds": run.seconds,
        "learning_rate": log[-1]["learning_rate"],
        "parameters": run.field_file().parameter_count(),
        "queries_per_ray": measured["queries_per_ray"],
        "seconds_per_view": measured["seconds_per_view"],
        "restarts": sum(line.get("event") == "restart" for line in log),
    }


def _line(found: dict[str, Any]) -> str:
    return (
        f"{found['psnr']:.2f} dB, SSIM {found['ssim']:.4f} ({found['views']} views of "
        f"{found['split']}), {found['steps']} steps in {duration(found['seconds'])}, learning rate "
        f"{found['learning_rate']:.2g} at the end, {found['parameters']} parameters, "
        f"{found['restarts']} restarts"
    )


if __name__ == "__main__":
    main()
