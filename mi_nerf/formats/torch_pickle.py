"""Reads the pickles in PyTorch checkpoints without unpickling them.

A pickle is a program: ``pickle.load`` imports and calls whatever its author chose. Here
it is only decoded (by ``pickletools``) and interpreted: numbers, strings and containers
are built, names of functions stay names, and the three calls that tensors need are
carried out by the code below. Any other name or instruction is refused.
"""

from __future__ import annotations

import pickletools
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np


class PickleError(ValueError):
    """A pickle that is damaged, or asks for more than tensors and plain containers."""


@dataclass(frozen=True)
class Storage:
    """A block of numbers that lies elsewhere in the checkpoint."""

    key: str
    dtype: np.dtype[Any]
    size: int  # in numbers


@dataclass(frozen=True)
class StoredTensor:
    """A tensor as a view of a storage; offset and strides count numbers."""

    storage: Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


@dataclass(frozen=True)
class _Name:
    """Something the pickle refers to by module and name; never imported."""

    text: str


_STORAGES = {
    f"torch.{name}Storage": np.dtype(code)
    for name, code in (
        ("Double", "<f8"),
        ("Float", "<f4"),
        ("Half", "<f2"),
        ("BFloat16", "<V2"),  # read past, but not understood
        ("Long", "<i8"),
        ("Int", "<i4"),
        ("Short", "<i2"),
        ("Char", "i1"),
        ("Byte", "u1"),
        ("Bool", "?"),
    )
}
_DICT = "collections.OrderedDict"
_TENSORS = ("torch._utils._rebuild_tensor_v2", "torch._utils._rebuild_tensor")
_PARAMETER = "torch._utils._rebuild_parameter"
_ALLOWED = {*_STORAGES, _DICT, *_TENSORS, _PARAMETER}

_IGNORED = {"PROTO", "FRAME", "STOP"}
_LITERALS = {
    *("BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT"),
    *("BINUNICODE", "SHORT_BINUNICODE"),
}
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}


def parse_pickle(stream: BinaryIO) -> tuple[Any, dict[str, Storage]]:
    """Interprets one pickle, and leaves the stream behind it.

    Returns:
        What it describes, with a :class:`StoredTensor` in place of each tensor, and the
        storages that its tensors refer to.

    Raises:
        PickleError: if it is damaged or asks for anything else.
    """
    machine = _Machine()
    try:
        for opcode, argument, _ in pickletools.genops(stream):
            machine.step(opcode.name, argument)
        (result,) = machine.stack
    except PickleError:
        raise
    except (ValueError, TypeError, LookupError) as error:
        raise PickleError(f"its pickle is damaged: {error}") from error
    return result, machine.storages


class _Machine:
    """The stack machine that a pickle is written for, with few instructions."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self.storages: dict[str, Storage] = {}
        self._below: list[list[Any]] = []  # stacks under the marks
        self._memo: dict[int, Any] = {}

    def step(self, name: str, argument: Any) -> None:
        """Carries out one instruction."""
        if name in _LITERALS:
            self.stack.append(argument)
        elif name in _CONSTANTS:
            self.stack.append(_CONSTANTS[name])
        elif name in _TUPLES:
            self.stack[-_TUPLES[name] :] = [tuple(self.stack[-_TUPLES[name] :])]
        elif name == "MARK":
            self._below.append(self.stack)
            self.stack = []
        elif name in ("BINPUT", "LONG_BINPUT", "MEMOIZE"):
            self._memo[len(self._memo) if argument is None else argument] = self.stack[-1]
        elif name in ("BINGET", "LONG_BINGET"):
            self.stack.append(self._memo[argument])
        elif name not in _IGNORED:
            self._build(name, argument)

    def _build(self, name: str, argument: Any) -> None:
        """Instructions that make or fill containers, or call something."""
        stack = self.stack
        if name == "EMPTY_DICT":
            stack.append({})
        elif name == "EMPTY_LIST":
            stack.append([])
        elif name == "TUPLE":
            self._to_mark(lambda below, items: below.append(tuple(items)))
        elif name == "APPENDS":
            self._to_mark(lambda below, items: _list(below[-1]).extend(items))
        elif name == "SETITEMS":
            self._to_mark(lambda below, items: _fill(below[-1], items))
        elif name == "APPEND":
            value = stack.pop()
            _list(stack[-1]).append(value)
        elif name == "SETITEM":
            value, key = stack.pop(), stack.pop()
            _fill(stack[-1], [key, value])
        else:
            self._refer(name, argument)

    def _refer(self, name: str, argument: Any) -> None:
        """Instructions that would reach outside the pickle."""
        stack = self.stack
        if name == "GLOBAL":
            stack.append(_name(*argument.split(" ", 1)))
        elif name == "STACK_GLOBAL":
            attribute, module = stack.pop(), stack.pop()
            stack.append(_name(module, attribute))
        elif name == "REDUCE":
            arguments, function = stack.pop(), stack.pop()
            stack.append(_call(function, arguments))
        elif name == "BUILD":  # attributes of a state dict: versions of layers
            stack.pop()
            _fill(stack[-1], [])
        elif name == "BINPERSID":
            storage = _storage(stack.pop())
            self.storages[storage.key] = storage
            stack.append(storage)
        else:
            raise PickleError(f"its pickle uses the instruction {name}, which no tensor needs")

    def _to_mark(self, use: Any) -> None:
        """Hands the stack below the last mark, and what lies above it, to ``use``."""
        items, self.stack = self.stack, self._below.pop()
        use(self.stack, items)


def _name(module: str, attribute: str) -> _Name:
    text = f"{module}.{attribute}"
    if text not in _ALLOWED:
        raise PickleError(f"its pickle asks for {text}, expected tensors and plain containers only")
    return _Name(text)


def _call(function: Any, arguments: Any) -> Any:
    if not isinstance(function, _Name) or not isinstance(arguments, tuple):
        raise PickleError("its pickle calls something that is no function")
    if function.text == _DICT:
        pairs = arguments[0] if arguments else []
        return {key: value for key, value in pairs if _is_key(key)}
    if function.text == _PARAMETER:
        return arguments[0]
    if function.text in _TENSORS:
        return _tensor(*arguments[:4])
    raise PickleError(f"its pickle calls {function.text}")


def _tensor(storage: Any, offset: Any, shape: Any, strides: Any) -> StoredTensor:
    """Checked, so that a view of the storage needs no more memory than the storage."""
    numbers = (offset, *shape, *strides)
    whole = all(isinstance(n, int) and n >= 0 for n in numbers)
    if not (isinstance(storage, Storage) and whole and len(shape) == len(strides) <= 8):
        raise PickleError("its pickle describes a tensor wrongly")
    # In Python's integers, which do not overflow.
    count, last = 1, offset
    for size, stride in zip(shape, strides, strict=True):
        count, last = count * size, last + (size - 1) * stride
    if count > storage.size or (count and last >= storage.size):
        raise PickleError(f"a tensor of shape {shape} reaches beyond its {storage.size} numbers")
    return StoredTensor(storage, offset, tuple(shape), tuple(strides))


def _storage(reference: Any) -> Storage:
    """('storage', type, key, device, number of elements), then in old files a view or None."""
    kind, dtype, key, _, size, *view = reference
    known = isinstance(dtype, _Name) and dtype.text in _STORAGES
    whole = isinstance(size, int) and size >= 0
    if kind != "storage" or not (known and isinstance(key, str) and whole):
        raise PickleError("its pickle describes a storage wrongly")
    if any(v is not None for v in view):
        raise PickleError("its storages overlap, which is not supported")
    return Storage(key, _STORAGES[dtype.text], size)


def _list(target: Any) -> list[Any]:
    if not isinstance(target, list):
        raise PickleError("its pickle fills something that is no list")
    return target


def _fill(target: Any, items: list[Any]) -> None:
    """Puts keys and values, in turn, into a dictionary."""
    if not isinstance(target, dict):
        raise PickleError("its pickle fills something that is no dictionary")
    for key, value in zip(items[::2], items[1::2], strict=True):
        if _is_key(key):
            target[key] = value


def _is_key(key: Any) -> bool:
    if not isinstance(key, (str, int)):
        raise PickleError("its pickle has a key that is neither text nor number")
    return True
