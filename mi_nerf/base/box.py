"""Axis-aligned boxes, and grids of cells in them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Box = tuple[tuple[float, float, float], tuple[float, float, float]]


Corner = tuple[float, float, float]


def corners(lower: ArrayLike, upper: ArrayLike) -> NDArray[np.float64]:
    """The eight corners of a box, (8, 3), the last coordinate varying fastest."""
    ends = np.stack([np.asarray(lower, float), np.asarray(upper, float)], axis=1)
    return np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1).reshape(-1, 3)


def grid_shape(lower: Corner, upper: Corner, resolution: int) -> tuple[int, int, int]:
    """Nearly cubic cells, ``resolution`` of them along the longest side."""
    size = np.asarray(upper, float) - np.asarray(lower, float)
    shape = np.maximum(1, np.rint(resolution * size / size.max())).astype(int)
    return int(shape[0]), int(shape[1]), int(shape[2])
