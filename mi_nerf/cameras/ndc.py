"""Normalised device coordinates for forward-facing captures (NeRF, appendix C).

The camera that all views resemble sits at the origin and looks along −z. OpenGL's
projection, with near plane n and the far plane at infinity, carries what lies before
it, z ≤ −n, into the box [−1, 1]³: straight lines stay straight, z' = −1 is the near
plane, z' = 1 is infinity, and even steps in z' are even steps in disparity. The frustum
of a shifted camera leaves the box at the sides.

A ray o + t·d becomes o' + t'·d' with t' = 0 at the near plane and t' → 1 at infinity.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..base.arrays import vector3_type

# Unit directions that descend less than this along −z meet no plane within reach.
_LEAST_SLOPE = 1e-6
# 1 − t' below this counts as this: distances stay finite.
_LEAST_DISPARITY = 1e-6


@dataclass(frozen=True)
class Ndc:
    """The projection, one for all views of a capture.

    Raises:
        ValueError: A number is not positive.
    """

    scale_x: float  # f / (W/2), focal length and film size of the average camera
    scale_y: float  # f / (H/2)
    near: float = 1.0  # z-depth of the near plane, scene units

    def __post_init__(self) -> None:
        for name in ("scale_x", "scale_y", "near"):
            if not 0 < getattr(self, name) < float("inf"):
                raise ValueError(f"ndc: {name}={getattr(self, name)}, expected a number above 0")

    def matrix(self) -> NDArray[np.float64]:
        """The 4×4 projection matrix (appendix C with the far plane f → ∞)."""
        return np.array(
            [
                [self.scale_x, 0, 0, 0],
                [0, self.scale_y, 0, 0],
                [0, 0, -1, -2 * self.near],
                [0, 0, -1, 0],
            ]
        )

    def rays(self, o: Any, d: Any) -> NdcRays:
        """Rays in normalised device coordinates (NeRF, appendix C).

        Origins are moved to the near plane first, as the appendix advises.

        Args:
            o, d: R origins and unit directions in the capture's coordinates.
        """
        float_type = type(o[0])
        near = dr.opaque(float_type, self.near)
        scale_x, scale_y = (dr.opaque(float_type, s) for s in (self.scale_x, self.scale_y))
        facing = d[2] < -_LEAST_SLOPE
        slope = dr.select(facing, d[2], -1)

        # ---- The origin, moved to where its ray meets the near plane ----
        t = -(near + o[2]) / slope
        x, y, z = dr.fma(t, d[0], o[0]), dr.fma(t, d[1], o[1]), -near

        # ---- o' and d' as the appendix has them ----
        vector3 = vector3_type(float_type)
        ndc_o = vector3(-scale_x * x / z, -scale_y * y / z, 1 + 2 * near / z)
        ndc_d = vector3(
            -scale_x * (d[0] / slope - x / z), -scale_y * (d[1] / slope - y / z), -2 * near / z
        )
        length = dr.norm(ndc_d)
        rays = NdcRays(ndc_o, ndc_d / length, length, facing, near, o[2], slope)
        dr.eval(rays.o, rays.d, rays.length, rays.facing, rays.start, rays.slope)
        return rays


@dataclass
class NdcRays:
    """R rays o' + s·d', and how their length s = t'·|d'| relates to distance before."""

    o: Any  # R origins on the near plane, z' = −1
    d: Any  # R unit directions d'/|d'|
    length: Any  # |d'|: the value of s at infinity
    facing: Any  # whether the ray ever meets the near plane; the others mean nothing
    near: Any  # z-depth of the near plane
    start: Any  # o_z and
    slope: Any  # d_z of the rays before projection

    def from_distance(self, t: Any) -> Any:
        """s at distance t ≥ 0 along the original ray: t' = 1 + n / (o_z + t·d_z) (appendix C).

        0 up to the near plane; infinity is welcome.
        """
        z = self.start + t * self.slope
        ahead = z < -self.near
        return dr.select(ahead, 1 + self.near / dr.select(ahead, z, -self.near), 0) * self.length

    def to_distance(self, s: Any) -> Any:
        """Distance along the original ray, in scene units; finite for s up to |d'| and beyond."""
        disparity = dr.maximum(1 - s / self.length, _LEAST_DISPARITY)
        return (self.near / disparity + self.start) / -self.slope

    def bounds(self, near: Any = None, far: Any = None) -> tuple[Any, Any]:
        """Bounds of s for bounds of the distance, as numbers, arrays or ``None``.

        Nothing behind the camera is seen, even where it has passed the near plane.
        """
        upper = None if far is None else self.from_distance(self._as_array(far))
        return self.from_distance(self._as_array(0 if near is None else near)), upper

    def _as_array(self, t: Any) -> Any:
        number = isinstance(t, int | float)
        return dr.opaque(type(self.length), float(t)) if number else t
