"""Writes checkpoints as ``torch.save`` does, instruction by instruction, without PyTorch.

``Raw`` puts instructions of one's own into a pickle, for the tests of what is refused.
"""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

_TYPES = {"f2": "Half", "f4": "Float", "f8": "Double", "i8": "Long"}
_SYSTEM = {"protocol_version": 1001, "little_endian": True, "type_sizes": {"int": 4}}


class Raw(bytes):
    """Instructions to be taken over as they are."""


class State(dict[str, Any]):
    """An ordered dictionary with an attribute, as a state dict is one."""


class Transposed:
    """A tensor stored in column-major order, seen through its strides."""

    def __init__(self, array: np.ndarray) -> None:
        self.array = array


class Pickler:
    """Makes one pickle of protocol 2; keeps the arrays that it refers to."""

    def __init__(self) -> None:
        self.storages: list[np.ndarray] = []

    def dump(self, value: Any) -> bytes:
        return b"\x80\x02" + self.write(value) + b"."

    def write(self, value: Any) -> bytes:
        """The instructions that leave ``value`` on the stack."""
        if isinstance(value, Raw):
            return bytes(value)
        if isinstance(value, (np.ndarray, Transposed)):
            return self._tensor(value)
        if isinstance(value, dict):
            items = b"".join(self.write(k) + self.write(v) for k, v in value.items())
            if isinstance(value, State):
                attributes = self.write({"_metadata": {"": {"version": 1}}})
                return b"ccollections\nOrderedDict\n)R(" + items + b"u" + attributes + b"b"
            return b"}(" + items + b"u"
        if isinstance(value, list):
            return b"](" + b"".join(map(self.write, value)) + b"e"
        if isinstance(value, tuple):
            return b"(" + b"".join(map(self.write, value)) + b"t"
        if isinstance(value, str):
            return b"X" + struct.pack("<I", len(value.encode())) + value.encode()
        if value is None or isinstance(value, bool):
            return {None: b"N", True: b"\x88", False: b"\x89"}[value]
        if isinstance(value, int):
            return b"J" + struct.pack("<i", value)
        return b"G" + struct.pack(">d", value)

    def _tensor(self, value: Any) -> bytes:
        array = value.array if isinstance(value, Transposed) else value
        flat = array.ravel(order="F" if isinstance(value, Transposed) else "C")
        like = np.empty(array.shape, array.dtype, order="F" if value is not array else "C")
        strides = tuple(s // array.itemsize for s in like.strides)
        kind = Raw(f"ctorch\n{_TYPES[array.dtype.str[1:]]}Storage\n".encode())
        key = str(100 + len(self.storages))
        self.storages.append(flat)
        storage = self.write(("storage", kind, key, "cuda:0", flat.size, None)) + b"Q"
        hooks = Raw(b"ccollections\nOrderedDict\n)R")
        arguments = (Raw(storage), 0, array.shape, strides, False, hooks)
        return b"ctorch._utils\n_rebuild_tensor_v2\n" + self.write(arguments) + b"R"


def write_old(path: Path, content: Any) -> Path:
    """The format before PyTorch 1.6."""
    pickler = Pickler()
    body = pickler.dump(content)
    keys = [str(100 + i) for i in range(len(pickler.storages))]
    magic = b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19."
    with open(path, "wb") as file:
        file.write(magic + b"\x80\x02M\xe9\x03." + Pickler().dump(_SYSTEM) + body)
        file.write(Pickler().dump(keys))
        for flat in pickler.storages:
            file.write(struct.pack("<q", flat.size) + flat.tobytes())
    return path


def write_zip(path: Path, content: Any, **files: bytes) -> Path:
    """The format since PyTorch 1.6; ``files`` are added to the archive."""
    pickler = Pickler()
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", pickler.dump(content))
        for i, flat in enumerate(pickler.storages):
            archive.writestr(f"archive/data/{100 + i}", flat.tobytes())
        for name, data in files.items():
            archive.writestr(f"archive/{name}", data)
    return path


WRITERS = {"old": write_old, "zip": write_zip}
