"""Finds the Dr.Jit types that belong with an array.

The mathematical modules never name a backend or a Mitsuba variant: they take
their types from their arguments, so that the same code runs in single precision
on LLVM and CUDA and, in the tests, in double precision.

Layout convention used throughout the package:

- *per ray* arrays hold one value for each of R rays;
- *per sample* arrays hold R·S values, ray-major: sample ``s`` of ray ``r`` lies
  at ``r * S + s``;
- tensors that enter or leave a network are ``(features, N)``: one column a query.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any, TypeAlias

import drjit as dr
import numpy as np

# Dr.Jit's types depend on backend and precision, so these say to readers what a value is:
Floats: TypeAlias = Any  # numbers, one each of rays, samples or queries
Vectors: TypeAlias = Any  # 3-vectors, likewise
Mask: TypeAlias = Any  # truth values, likewise
Indices: TypeAlias = Any  # unsigned numbers of rays, samples or cells, likewise
Tensor: TypeAlias = Any  # (features, N) activations, or a parameter of any shape

Image: TypeAlias = np.ndarray[Any, Any]  # (height, width, channels) numbers

_CACHE_LINE = 64  # bytes


def upload(array_type: Any, values: Any) -> Any:
    """Copies a NumPy array into memory of Dr.Jit's own.

    On the CPU Dr.Jit otherwise borrows NumPy's memory, and compiles another kernel, be it
    for a copy, where that happens not to be aligned.
    """
    result = array_type(_aligned(np.asarray(values)))
    flat = result.array if dr.is_tensor_v(array_type) else result
    if len(flat) == 0:
        return result
    nothing = -0.0 if dr.is_float_v(flat) else 0  # −0 + 0 would be +0
    copy = flat + dr.opaque(type(flat), nothing)
    dr.eval(copy)
    return array_type(copy, shape=result.shape) if dr.is_tensor_v(array_type) else copy


def _aligned(values: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """A contiguous copy whose memory starts at a multiple of a cache line."""
    copy = aligned_empty(values.shape, values.dtype)
    copy[...] = values
    return copy


def aligned_empty(shape: tuple[int, ...], dtype: Any) -> np.ndarray[Any, Any]:
    """A contiguous array, not initialised, whose memory starts at a multiple of a cache line."""
    count = int(np.prod(shape)) * np.dtype(dtype).itemsize
    memory = np.empty(count + _CACHE_LINE, np.uint8)
    start = -memory.ctypes.data % _CACHE_LINE
    return memory[start : start + count].view(dtype).reshape(shape)


def borrow(array_type: Any, values: np.ndarray[Any, Any]) -> Any:
    """Flat ``values`` where they lie, if Dr.Jit can use them there, or else a copy.

    On the CPU, memory from :func:`aligned_empty` is shared: it must not change any more.
    """
    shared = values.flags.c_contiguous and values.ctypes.data % _CACHE_LINE == 0
    return array_type(values) if shared else upload(array_type, values)


def vector3_type(float_type: type) -> Any:
    """The 3-vector of ``float_type``, e.g. ``drjit.llvm.ad.Array3f``."""
    return _array("Array3", float_type)


def array_type(float_type: type) -> Any:
    """The array of any number of ``float_type``, e.g. ``drjit.llvm.ad.ArrayXf``."""
    return _array("ArrayX", float_type)


def _array(kind: str, float_type: type) -> Any:
    suffix = "f64" if dr.type_v(float_type) == dr.VarType.Float64 else "f"
    return getattr(sys.modules[float_type.__module__], kind + suffix)


def taken(values: Any, index: Indices) -> Any:
    """Entries of an array; one of a single value, which is the same for all, stays as it is."""
    return values if len(values) == 1 else dr.gather(type(values), values, index)


def gather_vector3(source: Vectors, index: Indices) -> Vectors:
    """Gathers the three components of ``source`` at ``index``, as an ``Array3``."""
    float_type = type(source[0])
    return vector3_type(float_type)(*(dr.gather(float_type, source[i], index) for i in range(3)))


def joined(kind: Any, parts: Sequence[Any]) -> Any:
    """Arrays of a kind, vectors too, one after the other, evaluated.

    ``dr.concat`` would compile kernels for their lengths.
    """
    uint = dr.uint32_array_t(kind if dr.depth_v(kind) == 1 else dr.value_t(kind))
    total, start = dr.zeros(kind, sum(map(dr.width, parts))), 0
    dr.make_opaque(total)
    for part in filter(dr.width, parts):  # Dr.Jit adds nothing to an empty array
        count = dr.width(part)
        dr.scatter(total, part, dr.arange(uint, count) + dr.opaque(uint, start))
        start += count
    dr.eval(total)
    return total
