"""The folder of a run: what its files are called, and how they are read back."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..base.errors import InputError
from ..base.files import read_json, replacing
from ..base.schema import check_version
from .config import TrainConfig, from_json

CONFIG, CHECKPOINT, FIELD, LOG = (
    "config.json",
    "checkpoint.safetensors",
    "field.safetensors",
    "log.jsonl",
)


# Version of config.json: a setting or key that is added needs the next one. 0.1.0 wrote none.
FORMAT: dict[str, Any] = {"kind": "mi_nerf.run", "version": 2}


def read_config(folder: Path) -> tuple[TrainConfig, dict[str, Any]]:
    """The configuration of a run, and all that ``config.json`` records.

    Raises:
        InputError: as :func:`read_record`, or if this program does not know the settings.
    """
    record = read_record(folder)
    return from_json(record["settings"], str(folder / CONFIG)), record


def read_record(folder: Path) -> dict[str, Any]:
    """All that ``config.json`` records; its settings need not be known to this program.

    Raises:
        InputError: if it is missing, damaged, or newer than this program.
    """
    path = folder / CONFIG
    record = read_json(path, "the config.json of a run")
    if not isinstance(record, dict) or not isinstance(record.get("settings"), dict):
        raise InputError(f"{path}: no 'settings', expected the config.json of a run")
    file_format = record.get("format", FORMAT)
    if not isinstance(file_format, dict) or file_format.get("kind") != FORMAT["kind"]:
        raise InputError(f"{path}: format {file_format!r}, expected the config.json of a run")
    check_version(path, "config.json", file_format.get("version"), FORMAT["version"])
    data = record.get("data")
    if not isinstance(data, dict) or not {"path", "views", "size"} <= data.keys():
        raise InputError(f"{path}: no 'data', expected the config.json of a run")
    return record


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
    with replacing(path) as temporary:
        temporary.write_text("".join(line + "\n" for line in kept))
