"""An occupancy grid that keeps up with a field that is trained, at the cost of training."""

from __future__ import annotations

from typing import Any

import drjit as dr

from ..base.arrays import Floats
from ..fields.protocol import Field
from .occupancy import THRESHOLD, OccupancyGrid
from .samples import Samples

# As the presets have it (mi_nerf.training.config): a refresh every so many changes of the
# weights, from that change on, of so many cells for each along the box; what densities fade by.
_EVERY, _START = 16, 256
_QUERIES_PER_CELL = 128
_DECAY = 0.9
# Samples behind this optical depth of what has always been dense are left out of derivatives.
HIDDEN = 5.0


class TrainedGrid(OccupancyGrid):
    """The cells of a grid in which training takes place; the others stay empty for good."""

    def __init__(self, grid: OccupancyGrid, float_type: Any) -> None:
        super().__init__(grid.lower, grid.upper, grid.mask(), float_type)
        self._rng = dr.rng(seed=dr.opaque(dr.uint64_array_t(float_type), 0))
        self._changes = 0

    def follow(self, field: Field) -> None:
        """Counts a change of the weights; looks at some cells again where that is due."""
        self._changes += 1
        if self._changes < _START or self._changes % _EVERY:
            return
        self.refresh(
            field,
            self._rng,
            self._changes // _EVERY,
            queries=_QUERIES_PER_CELL * max(self.shape),
            threshold=THRESHOLD,
            decay=_DECAY,
        )

    def witness(self, samples: Samples, density: Floats) -> None:
        """See :meth:`OccupancyGrid.witness`; what is seen before the first look says nothing."""
        if self._changes >= _START:
            super().witness(samples, density)
