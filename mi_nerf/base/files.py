"""Writing files so that nothing half-written ever lies under its final name."""

from __future__ import annotations

import json
import os
import re
import secrets
import stat
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from .errors import InputError

_TEMPORARY = re.compile(r"\..+-[0-9a-f]{16}(\.\w+)?")  # the names that replacing makes


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path beside ``path`` that takes its place if the block succeeds.

    The temporary name keeps the suffix, so writers that choose a format by it work.

    Raises:
        InputError: if the folder cannot be written to.
    """
    target = Path(path)
    temporary = target.parent / f".{target.stem}-{secrets.token_hex(8)}{target.suffix}"
    try:
        # The system applies the umask, which cannot be read without changing it for all threads.
        handle = os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
    except OSError as error:
        raise InputError(f"{target}: cannot be written: {error.strerror}") from error
    mode = stat.S_IMODE(os.fstat(handle).st_mode)
    os.close(handle)
    try:
        yield temporary
        os.chmod(temporary, mode)  # some writers put a file of their own there
        _sync(temporary)
        os.replace(temporary, target)
        with suppress(OSError):  # not every system can do that to a folder
            _sync(target.parent)
    except OSError as error:
        raise InputError(f"{target}: cannot be written: {error.strerror}") from error
    finally:
        temporary.unlink(missing_ok=True)


def remove_leftovers(folder: str | os.PathLike[str]) -> None:
    """Removes what processes that were killed inside of :func:`replacing` have left in a folder.

    Nobody may be writing there.
    """
    for path in Path(folder).iterdir():
        if _TEMPORARY.fullmatch(path.name):
            path.unlink(missing_ok=True)


def _sync(path: Path) -> None:
    """Waits until a file or folder is on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_text(path: str | os.PathLike[str], lines: Iterable[str]) -> None:
    """Writes lines, each with its end."""
    with replacing(path) as temporary:
        temporary.write_text("".join(f"{line}\n" for line in lines))


def write_json(path: str | os.PathLike[str], data: Any) -> None:
    """Writes ``data`` as indented JSON."""
    write_text(path, [json.dumps(data, indent=2)])


def read_json(path: str | os.PathLike[str], expected: str) -> Any:
    """Reads a JSON file; ``expected`` says in the error message what it should be.

    Raises:
        InputError: if it is missing or not JSON.
    """
    return _read(Path(path), expected, lambda p: json.loads(p.read_text()))


def _read(path: Path, expected: str, load: Callable[[Path], Any]) -> Any:
    try:
        return load(path)
    except FileNotFoundError:
        raise InputError(f"{path}: not found, expected {expected}") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as {expected}: {error}") from error


def make_folder(path: str | os.PathLike[str]) -> Path:
    """Creates an output folder and its parents, and checks that it can be written to.

    Raises:
        InputError: if that fails.
    """
    folder = Path(path)
    check_folder(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be created: {error.strerror}") from error
    return folder


def check_folder(path: str | os.PathLike[str]) -> None:
    """Checks that :func:`make_folder` would succeed, and leaves nothing behind.

    For output that is written only after hours of work.

    Raises:
        InputError: if the folder cannot be created or written to.
    """
    folder = Path(path)
    existing = folder
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if not existing.is_dir():
        which = "this" if existing == folder else str(existing)
        raise InputError(f"{folder}: expected an output folder, but {which} is a file")
    try:
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from error


def check_file(path: str | os.PathLike[str]) -> None:
    """Checks that an output file could be written, its folder being created if need be.

    Raises:
        InputError: if it could not, or is a folder.
    """
    file = Path(path)
    if file.is_dir():
        raise InputError(f"{file}: expected an output file, this is a folder")
    check_folder(file.parent)
