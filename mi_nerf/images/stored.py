"""Pixels as files hold them, and as numbers to compute with.

An 8-bit picture takes a quarter of the memory that its pixels need as floats, so that is
how it is kept until someone looks at it:

==================  ==========================================
type of the values  what they are
==================  ==========================================
``uint8, uint16``   straight RGBA over the full range, as read
``float16, 32``     premultiplied RGBA
==================  ==========================================
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import aligned_empty


def is_stored(dtype: np.dtype[Any]) -> bool:
    """Whether pixels may be of this type."""
    return dtype.kind == "f" or dtype in (np.uint8, np.uint16)


def premultiplied(stored: NDArray[Any]) -> NDArray[np.float32]:
    """Stored pixels, (…, 4), as premultiplied floats; those that are such already, no copy."""
    if stored.dtype.kind == "f":
        return stored.astype(np.float32, copy=False)
    pixels = stored.astype(np.float32)
    pixels /= np.float32(np.iinfo(stored.dtype).max)
    pixels[..., :3] *= pixels[..., 3:]
    return pixels


def with_alpha(values: NDArray[Any]) -> NDArray[Any]:
    """Integers, (H, W, 3 or 4), with an opaque fourth channel where they have none."""
    if values.shape[2] == 4:
        return values
    pixels = np.full((*values.shape[:2], 4), np.iinfo(values.dtype).max, values.dtype)
    pixels[..., :3] = values
    return pixels


def empty_stack(shape: tuple[int, int, int, int], dtype: Any) -> NDArray[Any]:
    """Room for (N, H, W, 4) pixels, which Dr.Jit can use where it lies on the CPU."""
    return aligned_empty(shape, dtype)
