"""Finds the radiance fields of a scene and where their cubes put them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import InputError


@dataclass
class PlacedField:
    """A medium with a field, and the affine map from field to world coordinates."""

    medium: Any
    to_world: np.ndarray[Any, Any]  # (4, 4)

    def to_local(self, o: Any, d: Any) -> tuple[Any, Any, Any]:
        """Rays in field coordinates: origin, unit direction, local length per world length."""
        inverse = np.linalg.inv(self.to_world)
        local_o = _apply(inverse, o, 1.0)
        local_d = _apply(inverse, d, 0.0)
        scale = dr.norm(local_d)
        return local_o, local_d / scale, scale


def find_field(scene: mi.Scene) -> PlacedField:
    """The radiance field of a scene.

    Raises:
        InputError: if the scene holds none, several, or one that is not in a cube.
    """
    found = []
    for shape in scene.shapes():
        medium = shape.interior_medium()
        if hasattr(medium, "field") and hasattr(medium, "march"):
            found.append(PlacedField(medium, cube_to_world(shape)))
    if len(found) != 1:
        raise InputError(
            f"nerf: the scene holds {len(found)} shapes with a 'nerfmedium', expected exactly one"
        )
    return found[0]


def cube_to_world(shape: mi.Shape) -> np.ndarray[Any, Any]:
    """The ``to_world`` of a ``cube``, recovered from its corners.

    Raises:
        InputError: if the shape is no cube, or is squashed flat.
    """
    if shape.class_name() != "Cube":
        raise InputError(
            f"nerfmedium: inside a shape of type '{shape.class_name()}', expected a 'cube'"
        )
    solution, *_ = np.linalg.lstsq(_unit_corners(), _corners(shape)[:, :3], rcond=None)
    to_world = np.eye(4)
    to_world[:3] = solution.T
    stretch = np.linalg.svd(to_world[:3, :3], compute_uv=False)
    if not stretch[-1] > 1e-6 * stretch[0]:  # also catches NaN
        raise InputError("nerfmedium: the cube's to_world is singular, expected a volume")
    return to_world


@lru_cache(maxsize=1)
def _unit_corners() -> np.ndarray[Any, Any]:
    """The corners of a cube that was not moved, in the order of Mitsuba's vertices."""
    return _corners(mi.load_dict({"type": "cube"}))


def _corners(shape: mi.Shape) -> np.ndarray[Any, Any]:
    """Homogeneous positions of all vertices, (24, 4)."""
    index = dr.arange(mi.UInt32, shape.vertex_count())
    points = np.array(shape.vertex_position(index), np.float64).reshape(3, -1)
    return np.concatenate([points.T, np.ones((points.shape[1], 1))], axis=1)


def _apply(matrix: np.ndarray[Any, Any], v: Any, w: float) -> Any:
    rows = [[dr.opaque(mi.Float, float(x)) for x in row] for row in matrix[:3]]
    return mi.Vector3f(
        *(r[0] * v[0] + r[1] * v[1] + r[2] * v[2] + (r[3] if w else 0) for r in rows)
    )
