"""How many runs collapse, restart or fail, over seeds, datasets and presets.

    python -m tests.benchmarks.robustness --out robustness

Path-traces small datasets of scenes that come with mi_nerf (or takes folders with --data),
trains each of them with every preset and seed for a few seconds, and writes
docs/results/robustness.json. A run has failed if it stops with an error, or if its held-out
views are not ``--margin`` decibels better than images of one even colour. Everything is kept in
``--out``: calling the command again goes on where it stopped, and adds presets and seeds.
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerf.base.files import write_json
from mi_nerf.base.variants import choose_variant
from mi_nerf.data import load_dataset
from mi_nerf.generation import Options, generate
from mi_nerf.images.metrics import psnr
from mi_nerf.scene_xml.library import find_scene
from mi_nerf.tasks.evaluate import evaluate, reference_image
from mi_nerf.tasks.target import open_target
from mi_nerf.training import run as training
from mi_nerf.training.config import with_settings
from mi_nerf.training.presets import preset
from mi_nerf.training.run_folder import LOG
from tests.benchmarks import machine
from tests.benchmarks.results import TRAINING, Figure, Protocol, Row, add_options, mean_of, save

RESULTS = "results.json"


def main() -> None:
    """Trains what is missing, then sums up."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scenes", nargs="*", default=["arches", "kettle", "bonsai"])
    parser.add_argument("--data", nargs="*", type=Path, default=[], help="folders besides")
    parser.add_argument("--presets", nargs="+", default=["nerf", "fast"])
    parser.add_argument("--seeds", type=int, default=10, help="how many")
    parser.add_argument("--seconds", type=float, default=7.0, help="of training, for each run")
    parser.add_argument("--size", type=int, default=50, help="of generated images, in pixels")
    parser.add_argument("--limit", type=float, default=np.inf, help="seconds until it stops")
    parser.add_argument("--margin", type=float, default=3.0, help="dB above one even colour")
    parser.add_argument("--set", nargs="*", default=[])
    parser.add_argument("--variant")
    add_options(parser)
    options = parser.parse_args()
    variant, end = choose_variant(options.variant), time.monotonic() + options.limit
    options.out.mkdir(parents=True, exist_ok=True)
    data = {
        name: _generated(options.out / name, name, options.size, variant) for name in options.scenes
    } | {path.name: path for path in options.data}
    file = options.out / RESULTS
    results: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {}
    for seed in range(options.seeds):
        for name, folder in data.items():
            for preset_name in options.presets:
                key = " ".join([name, preset_name, str(seed), f"{options.seconds:g}", *options.set])
                if key not in results and time.monotonic() < end:
                    results[key] = _outcome(folder, options, preset_name, seed, variant)
                    write_json(file, results)
                    print(f"{key}: {results[key]}", flush=True)
    print(f"{machine()}, {variant}, {options.seconds:g} s a run {' '.join(options.set)}\n")
    rows = list(_rows(results, data, options))
    for row in rows:
        print(f"{', '.join(row.labels.values())}: {row.figures}")
    save("robustness", rows, options, variant, TRAINING)


def _generated(folder: Path, scene: str, size: int, variant: str) -> Path:
    """The dataset of a scene, made where it is not there yet."""
    views = Options(train=40, val=0, test=5, size=(size, size), spp=64)
    if not (folder / "transforms_test.json").exists():
        generate(find_scene(scene), folder, variant, views, resume=folder.exists())
    return folder


def _outcome(
    data: Path, options: argparse.Namespace, preset_name: str, seed: int, variant: str
) -> dict[str, Any]:
    """One run: its PSNR and what went wrong."""
    config = replace(preset(preset_name), seed=seed, max_seconds=options.seconds)
    folder = options.out / "run"
    shutil.rmtree(folder, ignore_errors=True)
    run = training.start(data, folder, with_settings(config, options.set), variant)
    error = ""
    try:
        run.train(show_bar=False)
    except training.TrainingError as problem:
        error = str(problem)
    log = [json.loads(line) for line in (folder / LOG).read_text().splitlines()]
    result = {
        "steps": run.trainer.step_count,
        "restarts": sum(line.get("event") == "restart" for line in log),
        "skipped": max((line.get("skipped", 0) for line in log), default=0),
        "error": error,
        "psnr": None,
    }
    if not error:
        result["psnr"] = evaluate(open_target(folder), variant)["mean"]["psnr"]
    return result


def _even_psnr(data: Path) -> float:
    """Mean PSNR of the held-out views against the best images of one colour."""
    dataset = load_dataset(data, "test")
    images = [reference_image(dataset, k) for k in range(len(dataset))]
    return float(np.mean([psnr(np.broadcast_to(i.mean((0, 1)), i.shape), i) for i in images]))


def _rows(
    results: dict[str, Any], data: dict[str, Path], options: argparse.Namespace
) -> Iterator[Row]:
    for name, folder in data.items():
        even, views = _even_psnr(folder), load_dataset(folder, "test")
        for preset_name in options.presets:
            runs = [
                result
                for key, result in results.items()
                if key.split()[:2] == [name, preset_name]
                and key.split()[3:] == [f"{options.seconds:g}", *options.set]
                and int(key.split()[2]) < options.seeds
            ]
            quality = [r["psnr"] for r in runs if r["psnr"] is not None]
            if not runs:
                continue
            good = [q for q in quality if q > even + options.margin]
            yield Row(
                {"data": name, "preset": preset_name},
                {
                    "runs": Figure(len(runs)),
                    "restarted": Figure(sum(r["restarts"] > 0 for r in runs)),
                    "skipped": Figure(sum(r["skipped"] for r in runs)),
                    "failed": Figure(len(runs) - len(good)),
                    **({"psnr": mean_of(quality, "dB")} if quality else {}),
                    "even": Figure(even, "dB"),
                    "steps": Figure(float(np.median([r["steps"] for r in runs]))),
                },
                Protocol(
                    name, "test", len(views), (views.intrinsics.width, views.intrinsics.height)
                ),
                tuple(range(options.seeds)),
            )


if __name__ == "__main__":
    main()
