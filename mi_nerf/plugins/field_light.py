"""Directions in which fields may shine: towards points in the volume of their boxes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..base.arrays import upload
from ..base.box import Corner
from ..march.intervals import box_interval
from .placement import Matrix, PlacedField
from .sampled import SampledField


class FieldLight:
    """Samples directions from points of the scene to its fields.

    A field is chosen, each as likely, and a point evenly in the box around its occupied
    cells. Of all points, so in a direction that enters box k at the distance a_k and leaves
    it at b_k, there are per solid angle

        p(ω) = 1/K Σ_k ∫ r² dr / V_k = 1/K Σ_k (b_k³ − a_k³) / (3 V_k),

    finite everywhere, inside of boxes too.
    """

    def __init__(self, fields: list[SampledField]) -> None:
        """Fields in normalised device coordinates have no box in the scene: none is made."""
        found = [_box(m.placed) for m in fields if m.field.ndc is None]
        self._boxes = [box for box in found if box is not None]
        columns = [box.from_unit()[:3].T.ravel() for box in self._boxes]
        self._points = upload(mi.Float, np.concatenate(columns)) if columns else None

    @property
    def boxes(self) -> int:
        """K; without any, there is nothing to sample."""
        return len(self._boxes)

    def sample(self, origin: Any, which: Any, where: Any) -> Any:
        """Unit directions from N points.

        Args:
            which: N numbers in [0, 1), for the choice of a field.
            where: N points of the unit cube, for the place in its box.
        """
        box = dr.fmin(mi.UInt32(which * self.boxes), self.boxes - 1)
        x, y, z, corner = (
            mi.Vector3f(
                *(dr.gather(mi.Float, self._points, 12 * box + 3 * j + i) for i in range(3))
            )
            for j in range(4)
        )
        target = corner + where.x * x + where.y * y + where.z * z
        return dr.normalize(target - origin)

    def pdf(self, origin: Any, direction: Any) -> Any:
        """How dense the samples are in N directions, per solid angle."""
        total = mi.Float(0)
        for box in self._boxes:
            o, d, scale = box.placed.to_local(origin, direction)
            near, far, hit = box_interval(o, d, box.lower, box.upper)
            a, b = near / scale, far / scale
            share = (b - a) * (b * b + a * b + a * a)  # b³ − a³ without cancellation
            weight = dr.opaque(mi.Float, 1 / (3 * box.volume() * self.boxes))
            total += dr.select(hit, share * weight, 0)
        return total


@dataclass(frozen=True)
class _Box:
    """Where a field may hold anything."""

    placed: PlacedField
    lower: Corner  # in field coordinates
    upper: Corner

    def from_unit(self) -> Matrix:
        """From the unit cube to the world."""
        matrix = np.eye(4)
        matrix[:3, :3] = np.diag(np.subtract(self.upper, self.lower))
        matrix[:3, 3] = self.lower
        return self.placed.to_world @ matrix

    def volume(self) -> float:
        """In the world."""
        return abs(float(np.linalg.det(self.from_unit()[:3, :3])))


def _box(placed: PlacedField) -> _Box | None:
    """The box around the occupied cells of a field; ``None`` if there is none."""
    field, grid = placed.medium.field, placed.medium.occupancy
    if grid is None:
        return _Box(placed, field.lower, field.upper)
    cells = np.argwhere(grid.mask())
    if not len(cells):
        return None
    lower = np.asarray(grid.lower) + cells.min(axis=0) * grid.cell_size
    upper = np.asarray(grid.lower) + (cells.max(axis=0) + 1) * grid.cell_size
    return _Box(placed, tuple(lower.tolist()), tuple(upper.tolist()))
