"""The folder of a run: what its files are called, and how they are read back."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..base.errors import InputError
from ..base.files import read_json
from .config import TrainConfig, from_json

CONFIG, CHECKPOINT, FIELD, LOG = (
    "config.json",
    "checkpoint.safetensors",
    "field.safetensors",
    "log.jsonl",
)


def read_config(folder: Path) -> tuple[TrainConfig, dict[str, Any]]:
    """The configuration of a run, and all that ``config.json`` records.

    Raises:
        InputError: if it is missing or not of this version.
    """
    path = folder / CONFIG
    record = read_json(path, "the config.json of a run")
    if not isinstance(record, dict) or "settings" not in record:
        raise InputError(f"{path}: no 'settings', expected the config.json of a run")
    data = record.get("data")
    if not isinstance(data, dict) or not {"path", "views", "size"} <= data.keys():
        raise InputError(f"{path}: no 'data', expected the config.json of a run")
    return from_json(record["settings"], str(path)), record


def cut_log(path: Path, step: int) -> None:
    """Drops lines of steps that the checkpoint has not seen."""
    if not path.exists():
        return
    kept = []
    for line in path.read_text().splitlines():
        try:
            if json.loads(line)["step"] <= step:
                kept.append(line)
        except (ValueError, KeyError):  # a line cut short when the run was killed
            continue
    path.write_text("".join(line + "\n" for line in kept))
