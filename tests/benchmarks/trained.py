"""What trainings came to, in the same words for every benchmark that trains models."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mi_nerf.training.run_folder import LOG
from tests.benchmarks.results import Protocol, Row, mean_of

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
