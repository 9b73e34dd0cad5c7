"""Finds the radiance fields of a scene and where their cubes put them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..base.arrays import upload
from ..base.errors import InputError

Matrix = np.ndarray[Any, Any]

_CORNERS = 24  # vertices of Mitsuba's cube: four for each face
_ROUNDING = 4 * float(np.finfo(np.float32).eps)  # of a corner, relative to where it is


@dataclass
class PlacedField:
    """A medium with a field, the cube that holds it, and where they put the field."""

    medium: Any
    shape: Any
    number: int  # of the cube among those that Mitsuba has merged into the shape
    to_world: Matrix  # (4, 4), affine: from field to world coordinates

    @property
    def moves(self) -> bool:
        """Whether gradients with respect to the place are wanted."""
        with dr.resume_grad():
            history = self.medium.to_world.matrix, _vertices(self.shape, self.number)
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
        points = _vertices(self.shape, self.number)
        columns = [upload(mi.Float, column) for column in _from_corners().T]
        outer = [[dr.sum(points[i] * column) for column in columns] for i in range(3)]
        inner = self.medium.to_world.matrix
        matrix = _product(outer, [[inner[i, j] for j in range(4)] for i in range(4)])
        change = [[dr.detach(x) - x for x in row] for row in matrix]
        last = [mi.Float(x) for x in (0, 0, 0, 1)]
        return _product(_product([row[:3] for row in inverse], change), [*inverse, last])


def find_fields(scene: mi.Scene, *, least: int = 1, others: bool = False) -> list[PlacedField]:
    """The radiance fields of a scene, in the alphabetical order of their cubes' ids.

    Cubes that Mitsuba has merged follow each other in their order.

    Args:
        least: 0 if there need not be any.
        others: whether media of other kinds may stand beside them.

    Raises:
        InputError: if there is none, one is not in a cube or squashed flat, several include
            one in normalised device coordinates, or the scene holds a medium of another kind
            that may not.
    """
    found = []
    for shape in sorted(scene.shapes(), key=lambda shape: str(shape.id())):
        for medium in (shape.interior_medium(), shape.exterior_medium()):
            if not others and medium is not None and not is_field(medium):
                raise InputError(
                    f"nerf: shape '{shape.id()}' holds a medium of type '{medium.class_name()}', "
                    "expected no medium but 'nerfmedium', or the integrator 'nerf' with 'volpath', "
                    "'volpathmis' or 'prbvolpath' nested in it"
                )
        medium = shape.interior_medium()
        if medium is not None and is_field(medium):
            if shape.is_emitter():
                raise InputError(
                    f"nerfmedium: the cube '{shape.id()}' is a light source, "
                    "expected one that only holds a field"
                )
            medium.check_finite()
            inner = np.array(medium.to_world.matrix, np.float64).reshape(4, 4)
            _check_volume(inner, "the medium's to_world")
            for number, outer in enumerate(cubes_to_world(shape)):
                found.append(PlacedField(medium, shape, number, outer @ inner))
    if len(found) < least:
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


def cubes_to_world(shape: mi.Shape) -> list[Matrix]:
    """The ``to_world`` of a ``cube``, or of each of several, recovered from their corners.

    Mitsuba merges cubes that share medium and BSDF into one mesh when it loads a scene.

    Raises:
        InputError: if the shape is no cube, or one is squashed flat.
    """
    kind = shape.class_name()
    no_cube = InputError(f"nerfmedium: inside a shape of type '{kind}', expected a 'cube'")
    count, rest = divmod(shape.vertex_count() if shape.is_mesh() else 0, _CORNERS)
    if rest or not count:
        raise no_cube
    found = []
    for number in range(count):
        points = np.array(_vertices(shape, number), np.float64).reshape(3, -1)
        to_world = np.eye(4)
        to_world[:3] = points @ _from_corners()
        _check_volume(to_world, "the cube's to_world")
        misfit = np.abs(to_world[:3] @ _unit_corners() - points).max()
        size = np.abs(points - points.mean(axis=1, keepdims=True)).max()
        if misfit > 1e-4 * size + _ROUNDING * np.abs(points).max():
            raise no_cube
        found.append(to_world)
    return found


def _check_volume(matrix: Matrix, what: str) -> None:
    if not np.isfinite(matrix).all():
        raise InputError(f"nerfmedium: {what} is NaN or infinite, expected finite numbers")
    stretch = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if not stretch[-1] > 1e-6 * stretch[0]:
        raise InputError(f"nerfmedium: {what} is singular, expected a volume")


@lru_cache(maxsize=1)
def _unit_corners() -> Matrix:
    """(4, 24): homogeneous corners of a cube that was not moved, three times each."""
    points = np.array(_vertices(mi.load_dict({"type": "cube"}), 0), np.float64).reshape(3, -1)
    return np.concatenate([points, np.ones((1, _CORNERS))])


@lru_cache(maxsize=1)
def _from_corners() -> Matrix:
    """(24, 4): what turns the corners of a moved cube into its matrix, by least squares."""
    return np.linalg.pinv(_unit_corners())


def _vertices(shape: mi.Shape, number: int) -> Any:
    """The corners of one of a mesh's cubes as one array of points, with their history."""
    first = dr.opaque(mi.UInt32, number * _CORNERS)
    return shape.vertex_position(dr.arange(mi.UInt32, _CORNERS) + first)


def _product(a: list[list[Any]], b: list[list[Any]]) -> list[list[Any]]:
    return [[sum(x * y[j] for x, y in zip(row, b, strict=True)) for j in range(4)] for row in a]


def _apply(rows: list[list[Any]], v: Any, w: float) -> Any:
    return mi.Vector3f(
        *(r[0] * v[0] + r[1] * v[1] + r[2] * v[2] + (r[3] if w else 0) for r in rows)
    )
