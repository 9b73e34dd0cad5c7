"""The pixels of all training images on the device, in as many bytes as their files hold.

The images of a coarse level are means over blocks of premultiplied pixels. They are not
kept: a ray through a coarse pixel reads its block and averages it, which costs a step less
than its samples do and no memory, and is exact.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Floats, Indices, borrow
from ..base.errors import InputError, Option
from ..data import Dataset

MOST_VALUES = 1 << 32  # which an index of 32 bits cannot tell apart any more


class Pixels:
    """Premultiplied RGBA at any pixel of any view, as floats."""

    def __init__(self, dataset: Dataset, float_type: Any) -> None:
        """On the CPU, images are used where the dataset has them: they must not change.

        Raises:
            InputError: for more values of pixels than 32 bits can number.
        """
        images = dataset.images
        _require_indices(dataset, images)
        self._float, self._uint = float_type, dr.uint32_array_t(float_type)
        self._kind = images.dtype.type
        if images.dtype.kind == "u":  # whole pixels, or halves of them, of 32 bits
            words = np.ascontiguousarray(images).reshape(-1).view(np.uint32)
            self._values = borrow(self._uint, words)
        elif images.dtype == np.float16:
            self._values = borrow(dr.float16_array_t(float_type), images.reshape(-1))
        else:
            self._values = borrow(float_type, images.reshape(-1).astype(np.float32, copy=False))
        self.width = dataset.intrinsics.width

    @property
    def nbytes(self) -> int:
        """Memory that they take."""
        return len(self._values) * int(dr.itemsize_v(self._values))

    def at(self, index: Indices) -> list[Floats]:
        """Red, green, blue and alpha of pixels, numbered row by row, view after view."""
        if self._kind is np.uint8:
            word = dr.gather(self._uint, self._values, index)
            return self._decoded([(word >> shift) & 255 for shift in (0, 8, 16, 24)], 255)
        if self._kind is np.uint16:
            words = [dr.gather(self._uint, self._values, index * 2 + i) for i in range(2)]
            return self._decoded([half for w in words for half in (w & 65535, w >> 16)], 65535)
        kind = type(self._values)
        return [self._float(dr.gather(kind, self._values, index * 4 + i)) for i in range(4)]

    def _decoded(self, straight: list[Any], most: int) -> list[Floats]:
        full = dr.opaque(self._float, most)  # by a literal, Dr.Jit would not quite divide
        *color, alpha = (self._float(value) / full for value in straight)
        return [*(c * alpha for c in color), alpha]

    def mean(self, first: Indices, side: Indices) -> list[Floats]:
        """Means over blocks of ``side``×``side`` pixels, whose upper left ones are ``first``."""
        width = dr.opaque(self._uint, self.width)
        side = dr.maximum(side, 1)  # of lanes beyond the last: dividing by 0 ends the process
        count = side * side

        def add(i: Any, *sums: Any) -> tuple[Any, ...]:
            row = i // side
            pixel = self.at(first + row * width + (i - row * side))
            return i + 1, *(s + p for s, p in zip(sums, pixel, strict=True))

        zero = dr.zeros(self._float, len(first))
        start = (dr.zeros(self._uint, len(first)), zero, zero, zero, zero)
        _, *sums = dr.while_loop(start, lambda i, *_: i < count, add, label="block of pixels")
        return [s / self._float(count) for s in sums]


def _require_indices(dataset: Dataset, images: NDArray[Any]) -> None:
    """Refuses more values than there are indices, before Dr.Jit does it without advice."""
    size = dataset.intrinsics
    words = {np.uint8: 4, np.uint16: 2}.get(images.dtype.type, 1)
    count = images.size // words
    if count >= MOST_VALUES:
        raise InputError(
            "{}: {} views of {}x{} hold {} values, expected less than {} by a larger {}",
            dataset.path,
            len(dataset),
            size.width,
            size.height,
            count,
            MOST_VALUES,
            Option("downscale"),
        )
