"""Named arrays with a JSON description, in safetensors files of a known kind and version.

Nothing here executes code from a file: safetensors holds plain bytes, and the
description is JSON.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from .errors import InputError
from .files import replacing
from .schema import check_version

Arrays = dict[str, "np.ndarray[Any, Any]"]


def write_tensors(
    path: str | Path, arrays: Arrays, *, kind: str, version: int, description: dict[str, Any]
) -> None:
    """Writes arrays and a JSON-able description, atomically."""
    metadata = {
        "format": f"mi_nerf.{kind}",
        "version": str(version),
        "description": json.dumps(description),
    }
    with replacing(path) as temporary:
        save_file({n: np.asarray(a, order="C") for n, a in arrays.items()}, temporary, metadata)


def read_tensors(
    path: str | Path, *, kind: str, newest: int, oldest: int = 1
) -> tuple[Arrays, dict[str, Any]]:
    """Reads what :func:`write_tensors` wrote, in a version from ``oldest`` to ``newest``.

    Raises:
        InputError: if the file is missing, damaged, of another kind or version.
    """
    metadata = read_metadata(path)
    found, wanted = metadata.get("format", "no format"), f"mi_nerf.{kind}"
    if found != wanted:
        raise InputError(f"{path}: holds '{found}', expected '{wanted}'")
    version = metadata.get("version", "missing")
    found_version = int(version) if version.isdecimal() else version
    check_version(path, f"{kind} file", found_version, newest, oldest)
    try:
        with safe_open(path, framework="numpy") as file:
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        description = json.loads(metadata.get("description", ""))
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(f"{path}: damaged {kind} file: {error}") from error
    if not isinstance(description, dict):
        raise InputError(f"{path}: damaged {kind} file: its description is no JSON object")
    return arrays, description


def prefixed(arrays: Arrays, prefix: str) -> Arrays:
    """The arrays whose names begin with ``prefix``, without it."""
    return {n.removeprefix(prefix): a for n, a in arrays.items() if n.startswith(prefix)}


def read_metadata(path: str | Path) -> dict[str, str]:
    """The metadata of any safetensors file.

    Raises:
        InputError: if the file is missing or not a complete safetensors file.
    """
    if not Path(path).is_file():
        raise InputError(f"{path}: not found, expected a .safetensors file")
    try:
        with safe_open(path, framework="numpy") as file:
            return dict(file.metadata() or {})
    except (SafetensorError, OSError) as error:
        raise InputError(
            f"{path}: not a complete safetensors file (truncated or another format): {error}"
        ) from error
