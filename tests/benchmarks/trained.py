"""What trainings came to, in the same words for every benchmark that trains models."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mi_nerf.training import run as training
from mi_nerf.training.config import with_settings
from mi_nerf.training.presets import preset
from mi_nerf.training.run_folder import LOG
from tests.benchmarks.results import Protocol, Row, add_options, mean_of

UNITS = {
    "psnr": "dB",
    "ssim": "",
    "steps": "",
    "parameters": "",
    "queries_per_ray": "",
    "seconds_per_view": "s",
    "seconds": "s",
    "learning_rate": "",  # of the last step
    "restarts": "",
}


def outcome(run: Path, measured: Mapping[str, Any]) -> dict[str, Any]:
    """The figures of :data:`UNITS`, "split", "views" and "size".

    Args:
        run: the folder.
        measured: what ``mi_nerf.evaluate`` has found.
    """
    log = [json.loads(line) for line in (run / LOG).read_text().splitlines()]
    same = ("split", "views", "size", "parameters", "queries_per_ray", "seconds_per_view")
    return {
        **{key: measured[key] for key in same},
        **measured["mean"],
        "steps": log[-1]["step"],
        "seconds": measured["train_seconds"],
        "learning_rate": log[-1]["learning_rate"],
        "restarts": sum(line.get("event") == "restart" for line in log),
    }


def by_command(
    data: Path, folder: Path, train: Sequence[str], evaluate: Sequence[str]
) -> dict[str, Any]:
    """Trains and evaluates in processes of their own, with these options; its outcome."""
    run, record = folder / "run", folder / "eval.json"
    program = [sys.executable, "-m", "mi_nerf.cli"]
    for command in (
        ["train", str(data), "--out", str(run), *train],
        ["eval", str(run), "--json", str(record), *evaluate],
    ):
        subprocess.run([*program, *command], check=True, stdout=subprocess.DEVNULL)
    return outcome(run, json.loads(record.read_text()))


def options_of_steps(description: str | None, steps: int) -> argparse.ArgumentParser:
    """Options of a benchmark that trains on scenes for equally many steps."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", nargs="+", default=["lego_200"])
    parser.add_argument("--split", default="val")
    parser.add_argument("--views", type=int, help="evaluate so many views, evenly spread")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--steps", type=int, default=steps)
    parser.add_argument("--seeds", type=int, default=1, help="how many")
    parser.add_argument("--set", nargs="*", default=[])
    add_options(parser)
    return parser


def for_steps(
    data: Path,
    folder: Path,
    name: str,
    seed: int,
    options: argparse.Namespace,
    variant: str,
    settings: Sequence[str] = (),
) -> training.Run:
    """Trains a preset for as many steps as the options say; ends the process if interrupted."""
    config = with_settings(preset(name), [*options.set, *settings])
    config = replace(config, steps=options.steps, seed=seed, downscale=options.downscale)
    run = training.start(data, folder, config, variant)
    run.train(show_bar=False)
    if run.interrupted:
        sys.exit("interrupted: nothing is written")
    return run


def row(
    labels: Mapping[str, str], runs: Sequence[Mapping[str, Any]], data: str, seeds: Sequence[int]
) -> Row:
    """Means of the runs, one a seed, on a dataset of that name."""
    first = runs[0]
    width, height = first["size"]
    return Row(
        labels,
        {key: mean_of([run[key] for run in runs], unit) for key, unit in UNITS.items()},
        Protocol(data, first["split"], first["views"], (width, height)),
        tuple(seeds),
    )


def line(found: Mapping[str, Any]) -> str:
    """An outcome, for people."""
    return (
        f"{found['psnr']:.2f} dB, SSIM {found['ssim']:.4f}, {found['steps']:.0f} steps, "
        f"{found['queries_per_ray']:.1f} queries a ray, {found['seconds_per_view']:.3f} s a view, "
        f"{found['restarts']:g} restarts"
    )
