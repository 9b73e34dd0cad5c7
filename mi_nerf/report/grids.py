"""Occupancy grids of any resolution and threshold for a field that is already trained."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.box import grid_shape
from ..fields.protocol import Field
from ..march.occupancy import OccupancyGrid

Cells = NDArray[np.bool_]

_LOOKS, _MOST_LOOKS = 32, 1 << 21  # at random points of each cell, unless there are too many


class Grids:
    """Looks at a field once for each resolution, and draws the line at any threshold."""

    def __init__(self, field: Field, own: OccupancyGrid | None, float_type: Any) -> None:
        """With a grid of its ``own``, nothing is looked for outside of that."""
        self._field, self._own, self._float = field, own, float_type
        self._seen: dict[int, OccupancyGrid] = {}

    def at(self, resolution: int, threshold: float) -> OccupancyGrid:
        """The grid whose cells were seen to be thicker than ``threshold``, optically.

        Args:
            resolution: cells along the longest side of the box.
        """
        if resolution not in self._seen:
            self._seen[resolution] = self._look(resolution)
        grid = self._seen[resolution]
        grid.draw_line(threshold)
        return OccupancyGrid(grid.lower, grid.upper, grid.mask(), self._float)

    def _look(self, resolution: int) -> OccupancyGrid:
        field = self._field
        shape = grid_shape(field.lower, field.upper, resolution)
        cells = np.ones(shape, bool) if self._own is None else resampled(self._own.mask(), shape)
        return OccupancyGrid.surveyed(field, cells, self._float, looks=_LOOKS, most=_MOST_LOOKS)


def resampled(cells: Cells, shape: tuple[int, int, int]) -> Cells:
    """Cells of another size over the same box: those that overlap any of ``cells``."""
    for axis, new in enumerate(shape):
        old = cells.shape[axis]
        parts = [
            cells.take(range(i * old // new, -(-(i + 1) * old // new)), axis).any(axis)
            for i in range(new)
        ]
        cells = np.stack(parts, axis)
    return cells
