"""Directions in which fields may shine: towards points in the volume of their boxes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..base.arrays import upload
from ..base.box import Corner, corners
from ..march.intervals import box_interval
from .placement import Matrix, PlacedField
from .sampled import SampledField

# Every field is taken for having this share of the mean power at least.
_LEAST_SHARE = 0.05


class FieldLight:
    """Samples directions from points of the scene to its fields.

    A field is chosen with the probability q_k, which follows what arrives from it, and a point
    evenly in the box around its occupied cells. Of all points, so in a direction that enters
    box k at the distance a_k and leaves it at b_k, there are per solid angle

        p(ω) = Σ_k q_k ∫ r² dr / V_k = Σ_k q_k (b_k³ − a_k³) / (3 V_k),

    finite everywhere, inside of boxes too. With the power P_k of a field, the distance of its
    centre and half the diagonal R_k of its box, q_k ~ P_k / (distance² + R_k²).
    """

    def __init__(self, fields: list[SampledField], powers: list[float] | None = None) -> None:
        """Fields in normalised device coordinates have no box in the scene: none is made.

        Args:
            powers: of the fields; all the same if unknown.
        """
        found = [
            (box_of(m.placed), power)
            for m, power in zip(fields, powers or [1.0] * len(fields), strict=True)
            if m.field.ndc is None
        ]
        self._boxes = [box for box, _ in found if box is not None]
        columns = [box.from_unit()[:3].T.ravel() for box in self._boxes]
        self._points = upload(mi.Float, np.concatenate(columns)) if columns else None
        known = np.array([power for box, power in found if box is not None])
        # Powers were estimated, and may have grown since: every field is sampled now and then.
        count, total = max(len(known), 1), max(float(known.sum()), 1e-30)
        self._powers = np.maximum(known / total, _LEAST_SHARE / count)

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
        box, below = mi.UInt32(0), mi.Float(0)
        for q in self._chances(origin)[:-1]:
            below += q
            box += dr.select(which >= below, mi.UInt32(1), 0)
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
        for box, q in zip(self._boxes, self._chances(origin), strict=True):
            o, d, scale = box.placed.to_local(origin, direction)
            near, far, hit = box_interval(o, d, box.lower, box.upper)
            a, b = near / scale, far / scale
            share = (b - a) * (b * b + a * b + a * a)  # b³ − a³ without cancellation
            weight = dr.opaque(mi.Float, 1 / (3 * box.volume()))
            total += dr.select(hit, q * share * weight, 0)
        return total

    def _chances(self, origin: Any) -> list[Any]:
        """How likely each box is chosen from N points."""
        if self.boxes == 1:
            return [mi.Float(1)]
        weights = []
        for box, power in zip(self._boxes, self._powers, strict=True):
            center, size = box.bounds()
            away = dr.squared_norm(origin - mi.Point3f(*(dr.opaque(mi.Float, c) for c in center)))
            weights.append(dr.opaque(mi.Float, power) / (away + dr.opaque(mi.Float, size**2)))
        total = sum(weights[1:], weights[0])
        return [w / total for w in weights]


@dataclass(frozen=True)
class FieldBox:
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

    def bounds(self) -> tuple[list[float], float]:
        """Its centre and half its diagonal, in the world."""
        matrix = self.from_unit()
        points = corners(np.zeros(3), np.ones(3)) @ matrix[:3, :3].T + matrix[:3, 3]
        center = points.mean(axis=0)
        return center.tolist(), float(np.linalg.norm(points - center, axis=1).max())

    def surface(self) -> float:
        """Its area in the world."""
        x, y, z = self.from_unit()[:3, :3].T
        sides = (np.cross(x, y), np.cross(y, z), np.cross(z, x))
        return 2 * float(sum(np.linalg.norm(side) for side in sides))

    def volume(self) -> float:
        """In the world."""
        return abs(float(np.linalg.det(self.from_unit()[:3, :3])))


def box_of(placed: PlacedField) -> FieldBox | None:
    """The box around the occupied cells of a field; ``None`` if there is none."""
    field, grid = placed.medium.field, placed.medium.occupancy
    if grid is None:
        return FieldBox(placed, field.lower, field.upper)
    cells = np.argwhere(grid.mask())
    if not len(cells):
        return None
    lower = np.asarray(grid.lower) + cells.min(axis=0) * grid.cell_size
    upper = np.asarray(grid.lower) + (cells.max(axis=0) + 1) * grid.cell_size
    return FieldBox(placed, tuple(lower.tolist()), tuple(upper.tolist()))
