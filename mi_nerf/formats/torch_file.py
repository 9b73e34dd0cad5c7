"""PyTorch checkpoints as NumPy arrays: both formats of ``torch.save``, without PyTorch.

Since version 1.6 a checkpoint is an uncompressed ZIP archive of one pickle and a file for
each storage; before, it was a sequence of pickles followed by the storages. The pickles
are interpreted by :mod:`mi_nerf.formats.torch_pickle`, which runs nothing that they contain.
"""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError
from .torch_pickle import PickleError, Storage, StoredTensor, parse_pickle

# The pickle of the number that opens a file of the older format.
_OLD_MAGIC = b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19."
_OLD_VERSION = 1001


@dataclass(frozen=True)
class Checkpoint:
    """What ``torch.save`` was given, with a :class:`StoredTensor` for each tensor."""

    path: Path
    content: dict[Any, Any]
    storages: dict[str, bytes]

    def array(self, tensor: StoredTensor) -> np.ndarray[Any, Any]:
        """A copy of a tensor.

        Raises:
            InputError: if its storage is missing or of another size.
        """
        storage = tensor.storage
        raw = self.storages.get(storage.key, b"")
        if len(raw) != storage.size * storage.dtype.itemsize:
            raise InputError(
                f"{self.path}: damaged checkpoint: storage '{storage.key}' has {len(raw)} bytes, "
                f"expected {storage.size} numbers of type {storage.dtype}"
            )
        flat = np.frombuffer(raw, storage.dtype)[tensor.offset :]
        strides = [stride * storage.dtype.itemsize for stride in tensor.strides]
        return np.lib.stride_tricks.as_strided(flat, tensor.shape, strides).copy()


def read_checkpoint(path: str | Path) -> Checkpoint:
    """Reads a checkpoint.

    Raises:
        InputError: if it is missing, damaged, no checkpoint, or its pickle asks for anything
            but tensors and plain containers.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: not found, expected a PyTorch checkpoint")
    try:
        with open(path, "rb") as file:
            old = file.read(len(_OLD_MAGIC)) == _OLD_MAGIC
        if not old and not zipfile.is_zipfile(path):
            raise InputError(f"{path}: not a checkpoint of PyTorch, or cut off")
        content, storages = _read_old(path) if old else _read_zip(path)
    except PickleError as error:
        raise InputError(f"{path}: refused as a checkpoint: {error}") from error
    except (zipfile.BadZipFile, RuntimeError, ValueError, EOFError) as error:
        raise InputError(f"{path}: damaged checkpoint: {error}") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: holds no dictionary, expected state dicts by name")
    return Checkpoint(path, content, storages)


def _read_zip(path: Path) -> tuple[Any, dict[str, bytes]]:
    with zipfile.ZipFile(path) as archive:
        files = archive.infolist()
        if any(file.compress_type != zipfile.ZIP_STORED for file in files):
            raise ValueError("it is compressed, which torch.save never does")
        if sum(file.file_size for file in files) > path.stat().st_size:
            raise ValueError("its files overlap")
        names = {file.filename for file in files}
        roots = [name[: -len("data.pkl")] for name in names if name.endswith("/data.pkl")]
        if len(roots) != 1:
            raise ValueError("a ZIP archive without the one data.pkl of a checkpoint")
        root = roots[0]
        if f"{root}byteorder" in names and archive.read(f"{root}byteorder") != b"little":
            raise ValueError("its numbers are big-endian, expected little-endian ones")
        content, found = parse_pickle(io.BytesIO(archive.read(f"{root}data.pkl")))
        present = [key for key in found if f"{root}data/{key}" in names]
        return content, {key: archive.read(f"{root}data/{key}") for key in present}


def _read_old(path: Path) -> tuple[Any, dict[str, bytes]]:
    stream = io.BytesIO(path.read_bytes()[len(_OLD_MAGIC) :])
    version, system = parse_pickle(stream)[0], parse_pickle(stream)[0]
    if version != _OLD_VERSION:
        raise ValueError(f"version {version}, expected {_OLD_VERSION}")
    if not (isinstance(system, dict) and system.get("little_endian") is True):
        raise ValueError("its numbers are not said to be little-endian")
    content, found = parse_pickle(stream)
    keys = parse_pickle(stream)[0]
    if not isinstance(keys, list):
        raise ValueError("the list of its storages is missing")
    return content, {key: _old_storage(stream, found, key) for key in keys}


def _old_storage(stream: io.BytesIO, found: dict[str, Storage], key: Any) -> bytes:
    """A count of 8 bytes, then the numbers."""
    if key not in found:
        raise ValueError(f"storage {key!r} is not described")
    count = int.from_bytes(stream.read(8), "little")
    expected = found[key].size
    raw = stream.read(expected * found[key].dtype.itemsize)
    if count != expected or len(raw) != expected * found[key].dtype.itemsize:
        raise ValueError(f"storage '{key}' is cut off, expected {expected} numbers")
    return raw
