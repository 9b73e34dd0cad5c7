"""Schemas of the JSON objects in files: every key by name, and since which version it is there.

A file bears the lowest version that knows all of its keys: a key that came later is left out
where it says what its absence means, so that older programs go on reading what they can.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .errors import InputError

Number = int | float


@dataclass(frozen=True)
class Key:
    """A key of an object."""

    kind: Any  # of its value: a type, a union of types, or the Record of an object
    absent: Any = ...  # what it means where it is missing, or null; ``...``: it has to be there
    since: int = 1  # the first version with this key; later ones need an ``absent``


@dataclass(frozen=True)
class Record:
    """An object in a file, and what is made of it: keys are named as attributes and arguments."""

    make: Callable[..., Any]
    keys: dict[str, Key]

    def write(self, value: Any) -> dict[str, Any]:
        """The object that stands for ``value``."""
        result = {}
        for name, key, item in self._written(value):
            nested = isinstance(key.kind, Record) and item is not None
            result[name] = key.kind.write(item) if nested else item
        return result

    def version(self, value: Any) -> int:
        """The version of a file that holds ``value``."""
        versions = [1]
        for _, key, item in self._written(value):
            versions.append(key.since)
            if isinstance(key.kind, Record) and item is not None:
                versions.append(key.kind.version(item))
        return max(versions)

    def _written(self, value: Any) -> list[tuple[str, Key, Any]]:
        items = [(name, key, getattr(value, name)) for name, key in self.keys.items()]
        return [(n, key, item) for n, key, item in items if key.since == 1 or item != key.absent]

    def read(self, data: Any, where: str = "") -> Any:
        """What an object stands for; ``where`` it is goes before the names of its keys.

        Raises:
            ValueError: if a key is missing or unknown, or its value not of its kind.
        """
        if not isinstance(data, dict):
            raise ValueError(f"{where.rstrip('.')} is {data!r}, expected an object")
        if unknown := sorted(data.keys() - self.keys.keys()):
            raise ValueError(f"unknown key '{where}{unknown[0]}'")
        values = {}
        for name, key in self.keys.items():
            value = data.get(name, key.absent)
            if value is ...:
                raise ValueError(f"'{where}{name}' is missing")
            if isinstance(key.kind, Record) and not (value is None and key.absent is None):
                value = key.kind.read(value, f"{where}{name}.")
            elif not isinstance(key.kind, Record) and not _fits(value, key.kind):
                expected = getattr(key.kind, "__name__", key.kind)
                raise ValueError(f"'{where}{name}' is {value!r}, expected {expected}")
            values[name] = tuple(value) if isinstance(value, list) else value
        return self.make(**values)


def _fits(value: Any, kind: Any) -> bool:
    return isinstance(value, kind) and (kind is bool or not isinstance(value, bool))


def check_version(path: str | Path, what: str, found: Any, newest: int, oldest: int = 1) -> None:
    """Tells files of versions that this program cannot read.

    Raises:
        InputError: if ``found`` is no version, or not one from ``oldest`` to ``newest``.
    """
    if not isinstance(found, int) or isinstance(found, bool) or found < 1:
        raise InputError(f"{path}: damaged {what}: its format version is {found!r}")
    if found > newest:
        raise InputError(
            f"{path}: newer than this program: {what} of format version {found}, this mi_nerf "
            f"reads up to {newest}; update mi_nerf"
        )
    if found < oldest:
        raise InputError(f"{path}: {what} of format version {found}, expected {oldest} or newer")
