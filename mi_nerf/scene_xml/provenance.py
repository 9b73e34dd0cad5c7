"""What a scene is made of: a digest of all that it reads, wherever that lies."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError

_DIGITS = 6  # of matrices, which are products of what the XML says, computed by the machine


def files_of(state: Any) -> list[Path]:
    """The XML files of a scene and those that its plugins name, in their order.

    To be called while the scene's own search path is in force. Not among them are files that
    Mitsuba forgets once it has read them: spectra, and included files with nothing but defaults.
    """
    import mitsuba as mi

    files = [Path(str(file)) for file in state.files]
    for name, _, value in _properties(state):
        if isinstance(value, str):
            found = Path(str(mi.file_resolver().resolve(value)))
            if name == "filename" or (_looks_like_a_file(value) and found.is_file()):
                files.append(found)
    return list(dict.fromkeys(files))


def digest(state: Any, parameters: Mapping[str, str]) -> str:
    """SHA-256 over a parsed scene, its parameters and the content of all its files.

    What was read while it was parsed is there in two ways: as the bytes of files whose names are
    known, and as what was made of them: numbers, words, spectra. Where files lie and what
    the working directory is does not count.

    Args:
        state: A ``mi.parser.ParserState`` as it was parsed; its search path is in force.

    Raises:
        InputError: if a file cannot be read.
    """
    total = hashlib.sha256()
    for name, value in sorted(parameters.items()):
        total.update(f"{name}={value}\n".encode())
    for file in files_of(state):
        total.update(_digest_of(file))
    for name, kind, value in _properties(state):
        if (told := _told(kind, value)) is not None:
            total.update(json.dumps([name, told]).encode())
    return total.hexdigest()


def _properties(state: Any) -> Iterator[tuple[str, Any, Any]]:
    """Names, types and values of all that is set in a scene."""
    for node in state.nodes:
        for key in node.props.keys():  # noqa: SIM118
            yield key, node.props.type(key), node.props[key]


def _told(kind: Any, value: Any) -> Any:
    """A value as JSON knows it, the same on every machine; ``None`` for references."""
    import mitsuba as mi

    types = mi.Properties.Type
    if kind in (types.Bool, types.Integer, types.Float, types.String):
        return value
    if kind in (types.Vector, types.Color):
        return [float(number) for number in value]
    if kind == types.Spectrum:
        return [list(value.wavelengths), list(value.values)]
    if kind == types.Transform:
        return [f"{number:.{_DIGITS}g}" for number in np.ravel(value.matrix)]
    return None


def _looks_like_a_file(value: str) -> bool:
    """Whether a text may be the name of a file, rather than a word such as ``nearest``."""
    return bool(Path(value).suffix) or "/" in value


def _digest_of(file: Path) -> bytes:
    found = hashlib.sha256()
    try:
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                found.update(block)
        return found.digest()
    except OSError as error:
        raise InputError(f"{file}: cannot be read: {error.strerror}") from error
