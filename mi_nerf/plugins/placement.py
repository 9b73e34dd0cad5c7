"""Finds the radiance fields of a scene and where their cubes put them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays import upload
from ..errors import InputError

Matrix = np.ndarray[Any, Any]


@dataclass
class PlacedField:
    """A medium with a field, the cube that holds it, and where they put the field."""

    medium: Any
    shape: Any
    to_world: Matrix  # (4, 4), affine: from field to world coordinates

    @property
    def moves(self) -> bool:
        """Whether gradients with respect to the place are wanted."""
        with dr.resume_grad():
            history = self.medium.to_world.matrix, _vertices(self.shape)
            return bool(dr.grad_enabled(history))

    def to_local(self, o: Any, d: Any, *, moving: bool = False) -> tuple[Any, Any, Any]:
        """Rays in field coordinates: origin, unit direction, local length per world length.

        Args:
            moving: whether the result shall carry gradients of the cube's vertices and of
                the medium's ``to_world``.
        """
        inverse = np.linalg.inv(self.to_world)
        rows = [[dr.opaque(mi.Float, float(x)) for x in row] for row in inverse[:3]]
        if moving:
            change = self._change_of_inverse(rows)
            rows = [[rows[i][j] + change[i][j] for j in range(4)] for i in range(3)]
            dr.eval(rows)
        local_o = _apply(rows, o, 1.0)
        local_d = _apply(rows, d, 0.0)
        scale = dr.norm(local_d)
        return local_o, local_d / scale, scale

    def normal_to_world(self, gradient: list[Any]) -> list[Any]:
        """Unit vectors against N gradients in field coordinates; 0 where these vanish."""
        inverse = np.linalg.inv(self.to_world[:3, :3])
        columns = [[dr.opaque(mi.Float, -float(x)) for x in column] for column in inverse.T]
        n = [sum(x * g for x, g in zip(column, gradient, strict=True)) for column in columns]
        length = dr.norm(mi.Vector3f(*n))
        return [dr.select(length > 0, v / length, 0) for v in n]

    def _change_of_inverse(self, inverse: list[list[Any]]) -> list[list[Any]]:
        """Zeros whose derivatives are those of the inverse M⁻¹: −M⁻¹ dM M⁻¹."""
        matrix = _product(_cube_matrix(self.shape), _rows(self.medium.to_world.matrix))
        change = [[dr.detach(x) - x for x in row] for row in matrix]
        last = [mi.Float(x) for x in (0, 0, 0, 1)]
        return _product(_product([row[:3] for row in inverse], change), [*inverse, last])


def find_fields(scene: mi.Scene) -> list[PlacedField]:
    """The radiance fields of a scene, in the alphabetical order of their cubes' ids.

    Raises:
        InputError: if there is none, one is not in a cube or squashed flat, several include
            one in normalised device coordinates, or the scene holds a medium of another kind.
    """
    found = []
    for shape in sorted(scene.shapes(), key=lambda shape: str(shape.id())):
        for medium in (shape.interior_medium(), shape.exterior_medium()):
            if medium is not None and not is_field(medium):
                raise InputError(
                    f"nerf: shape '{shape.id()}' holds a medium of type '{medium.class_name()}', "
                    "expected no medium but 'nerfmedium'"
                )
        medium = shape.interior_medium()
        if medium is not None:
            if shape.is_emitter():
                raise InputError(
                    f"nerfmedium: the cube '{shape.id()}' is a light source, "
                    "expected one that only holds a field"
                )
            found.append(PlacedField(medium, shape, field_to_world(shape, medium)))
    if not found:
        raise InputError("nerf: the scene holds no 'nerfmedium', expected at least one, in a cube")
    if len(found) > 1 and any(placed.medium.field.ndc is not None for placed in found):
        raise InputError(
            f"nerf: {len(found)} fields, one of them in normalised device coordinates, "
            "where samples reach to infinity: expected it to be alone"
        )
    return found


def is_field(medium: Any) -> bool:
    """Whether a medium is a ``nerfmedium``, of whatever variant."""
    return hasattr(medium, "field") and hasattr(medium, "march")


def field_to_world(shape: mi.Shape, medium: Any) -> Matrix:
    """Field to world coordinates: the medium's ``to_world``, then that of its cube.

    Raises:
        InputError: as :func:`cube_to_world`, or for a singular ``to_world`` of the medium.
    """
    inner = np.array(medium.to_world.matrix, np.float64).reshape(4, 4)
    _check_volume(inner, "the medium's to_world")
    return cube_to_world(shape) @ inner


def cube_to_world(shape: mi.Shape) -> Matrix:
    """The ``to_world`` of a ``cube``, recovered from its corners.

    Raises:
        InputError: if the shape is no cube, or is squashed flat.
    """
    if shape.class_name() != "Cube":
        raise InputError(
            f"nerfmedium: inside a shape of type '{shape.class_name()}', expected a 'cube'"
        )
    points = np.array(_vertices(shape), np.float64).reshape(3, -1)
    to_world = np.eye(4)
    to_world[:3] = points @ _from_corners()
    _check_volume(to_world, "the cube's to_world")
    return to_world


def _check_volume(matrix: Matrix, what: str) -> None:
    stretch = np.linalg.svd(matrix[:3, :3], compute_uv=False) if np.isfinite(matrix).all() else [0]
    if not stretch[-1] > 1e-6 * stretch[0]:
        raise InputError(f"nerfmedium: {what} is singular, expected a volume")


@lru_cache(maxsize=1)
def _from_corners() -> Matrix:
    """(24, 4): what turns the corners of a moved cube into its matrix, by least squares."""
    points = np.array(_vertices(mi.load_dict({"type": "cube"})), np.float64).reshape(3, -1)
    return np.linalg.pinv(np.concatenate([points, np.ones((1, points.shape[1]))]))


def _vertices(shape: mi.Shape) -> Any:
    """The corners of a mesh as one array of points, with their history."""
    return shape.vertex_position(dr.arange(mi.UInt32, shape.vertex_count()))


def _cube_matrix(shape: mi.Shape) -> list[list[Any]]:
    """:func:`cube_to_world` with the history of the vertices: three rows of four."""
    points = _vertices(shape)
    columns = [upload(mi.Float, column) for column in _from_corners().T]
    return [[dr.sum(points[i] * column) for column in columns] for i in range(3)]


def _rows(matrix: Any) -> list[list[Any]]:
    return [[matrix[i, j] for j in range(4)] for i in range(4)]


def _product(a: list[list[Any]], b: list[list[Any]]) -> list[list[Any]]:
    return [[sum(x * y[j] for x, y in zip(row, b, strict=True)) for j in range(4)] for row in a]


def _apply(rows: list[list[Any]], v: Any, w: float) -> Any:
    return mi.Vector3f(
        *(r[0] * v[0] + r[1] * v[1] + r[2] * v[2] + (r[3] if w else 0) for r in rows)
    )
