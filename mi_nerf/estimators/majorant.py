"""Densities that a field is compared with, cell by cell: where tracked rays collide.

They need not bound the field for tracking (:mod:`mi_nerf.estimators.tracking`) to be unbiased,
only to reach it more or less: what was seen at a few points of every cell will do.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from ..base.arrays import Floats, Vectors, upload
from ..base.box import grid_shape
from ..fields.protocol import Field
from ..march.occupancy import OccupancyGrid, greatest_around

# Cells along the longest side of the box of a field without an occupancy grid.
_RESOLUTION = 32
# Points of every cell that are looked at, together up to _MOST_LOOKS.
_LOOKS, _MOST_LOOKS = 8, 1 << 20
# A ray through the whole box meets this many collisions, even if the field is thinner.
_LEAST_DEPTH = 1.0


class Majorants:
    """Cells of an axis-aligned box with a density each; 0 where nothing is to be found."""

    def __init__(
        self, lower: Any, upper: Any, values: np.ndarray[Any, Any], float_type: Any
    ) -> None:
        """
        Args:
            lower, upper: corners of the box, in scene units.
            values: (X, Y, Z) densities, 1/scene unit.
            float_type: ``Float`` of the backend, e.g. ``mi.Float``.
        """
        self.lower = np.asarray(lower, float)
        self.shape = values.shape
        self.size = (np.asarray(upper, float) - self.lower) / np.asarray(self.shape)
        self._float, self._uint = float_type, dr.uint32_array_t(float_type)
        # Bit patterns of numbers ≥ 0 ascend as they do, and every backend has their maximum.
        bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
        self._bits = upload(self._uint, bits.ravel())

    @classmethod
    def constant(
        cls, field: Field, density: float, occupancy: OccupancyGrid | None, float_type: Any
    ) -> Majorants:
        """The same density wherever ``occupancy`` says that there may be something."""
        cells = np.ones((1, 1, 1)) if occupancy is None else occupancy.mask()
        return cls(field.lower, field.upper, density * cells, float_type)

    @classmethod
    def seen(
        cls, field: Field, occupancy: OccupancyGrid | None, float_type: Any, seed: int = 0
    ) -> Majorants:
        """The greatest density seen at random points of every cell that may hold something.

        At least half of what was seen in cells around it, so that a corner of a surface that
        no point hit is not taken for nothing, and never less than makes one collision per
        diagonal of the box: thin fog is found by many rays then.
        """
        shape = grid_shape(field.lower, field.upper, _RESOLUTION)
        cells = np.ones(shape, bool) if occupancy is None else occupancy.mask()
        grid = OccupancyGrid.surveyed(
            field, cells, float_type, looks=_LOOKS, most=_MOST_LOOKS, seed=seed
        )
        densities = np.where(cells, grid.values(), 0)
        densities = np.maximum(densities, 0.5 * greatest_around(densities))
        densities = np.maximum(densities, least_majorant(field))
        return cls(field.lower, field.upper, np.where(cells, densities, 0), float_type)

    def values(self) -> np.ndarray[Any, Any]:
        """(X, Y, Z) densities, 1/scene unit."""
        return np.array(self._bits).view(np.float32).reshape(self.shape)

    def raise_to(self, cell: Any, density: Floats) -> None:
        """Brings cells up to densities that were met in them."""
        bits = dr.reinterpret_array(self._uint, dr.maximum(density, 0))
        dr.scatter_reduce(dr.ReduceOp.Max, self._bits, bits, cell)
        dr.eval(self._bits)

    def collide(
        self, o: Vectors, d: Vectors, t: Floats, far: Floats, depth: Floats
    ) -> tuple[Any, Any, Any]:
        """Where rays have passed an optical depth of the majorants (Amanatides & Woo 1987).

        Args:
            o, d: N origins and directions.
            t, far: where on them to begin and to end.
            depth: N optical depths > 0.

        Returns:
            ``(t, density, cell)``: the place, the majorant and its cell. Where the ray ends
            before, the density is 0.
        """
        float_type, uint = self._float, self._uint
        int_type = dr.int32_array_t(float_type)
        forward = [d[i] >= 0 for i in range(3)]
        parallel = [dr.abs(d[i]) < dr.smallest(float_type) for i in range(3)]
        rate = [1 / dr.select(parallel[i], 1, d[i]) for i in range(3)]
        start = []
        for i, last in enumerate(self.shape):
            along = dr.floor((dr.fma(t, d[i], o[i]) - self.lower[i]) * float(1 / self.size[i]))
            start.append(int_type(dr.clip(along, 0, last - 1)))

        def leave(cell: tuple[Any, ...], i: int) -> Any:
            """Where the ray leaves the cell along one axis."""
            face = float_type(cell[i] + dr.select(forward[i], 1, 0))
            edge = dr.fma(face, float(self.size[i]), float(self.lower[i]))
            return dr.select(parallel[i], dr.inf, (edge - o[i]) * rate[i])

        def body(
            t: Floats, depth: Floats, density: Floats, flat: Any, going: Any, *cell: Any
        ) -> tuple[Any, ...]:
            ends = [leave(cell, i) for i in range(3)]
            first = dr.minimum(dr.minimum(ends[0], ends[1]), ends[2])
            end = dr.maximum(dr.minimum(first, far), t)
            flat = uint((cell[0] * self.shape[1] + cell[1]) * self.shape[2] + cell[2])
            density = dr.reinterpret_array(float_type, dr.gather(uint, self._bits, flat, going))
            left = depth - density * (end - t)
            hit = (left <= 0) & (density > 0)
            place = dr.select(hit, t + depth / dr.select(hit, density, 1), end)
            moved, crossed = [], dr.mask_t(float_type)(False)
            for i in range(3):
                step = ~crossed & (ends[i] == first)  # through one face at a time
                moved.append(cell[i] + dr.select(step, dr.select(forward[i], 1, -1), 0))
                crossed |= step
            inside = dr.mask_t(float_type)(True)
            for c, size in zip(moved, self.shape, strict=True):
                inside &= (c >= 0) & (c < size)
            going = ~hit & inside & (end < far)
            return (place, left, dr.select(hit, density, 0), flat, going, *moved)

        state = dr.while_loop(
            state=(t, depth, float_type(0), uint(0), t < far, *start),
            cond=lambda t, depth, density, flat, going, *cell: going,
            body=body,
        )
        return state[0], state[2], state[3]


def least_majorant(field: Field) -> float:
    """The density that makes one collision per diagonal of a field's box."""
    return _LEAST_DEPTH / float(np.linalg.norm(np.subtract(field.upper, field.lower)))
