"""Where cubes put their fields, recovered from the corners in single precision."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.plugins.placement import cubes_to_world

# Half sizes from the origin, powers of two: on either side of these, rounding is not the same.
AFAR = [2.0**10, 2.0**13, 2.0**16]


def placed(distance: float, half: float = 1.0) -> Any:
    """Turned, somewhat stretched, and as far away as that in units of its half size."""
    away = np.array([0.5, -1.0, 0.25]) * distance * half
    transform = mi.ScalarTransform4f().translate(away.tolist())
    return transform.rotate([1, 2, 0.5], 37).scale([half, 1.5 * half, 0.7 * half])


def bent(cube: Any, by: float, corner: int = 0) -> Any:
    """The same mesh with one of its eight corners moved along x."""
    params = mi.traverse(cube)
    points = np.array(params["vertex_positions"]).reshape(-1, 3)
    same = (points == points[corner]).all(axis=1)
    points[same, 0] += by
    params["vertex_positions"] = mi.Float(points.ravel())
    params.update()
    return cube


@pytest.mark.parametrize("half", [2.0**-10, 1.0, 48.0])
@pytest.mark.parametrize("distance", AFAR)
def test_a_cube_far_from_the_origin_is_one(variant: str, distance: float, half: float) -> None:
    for angle in range(0, 90, 10):
        transform = placed(distance, half).rotate([1, -1, 3], angle)
        _recovered(transform, distance, half)


def _recovered(transform: Any, distance: float, half: float) -> None:
    found = cubes_to_world(mi.load_dict({"type": "cube", "to_world": transform}))
    expected = np.array(transform.matrix, np.float64).reshape(4, 4)
    rounding = 5e-7 * distance * half
    np.testing.assert_allclose(found, [expected], atol=rounding + 1e-6 * half)


@pytest.mark.parametrize("distance", [0.0, *AFAR])
def test_what_is_no_cube_is_refused_near_and_far(variant: str, distance: float) -> None:
    cube = mi.load_dict({"type": "cube", "to_world": placed(distance)})
    with pytest.raises(InputError, match="expected a 'cube'"):
        cubes_to_world(bent(cube, 0.5))


def test_little_is_tolerated_near_the_origin(variant: str) -> None:
    with pytest.raises(InputError, match="expected a 'cube'"):
        cubes_to_world(bent(mi.load_dict({"type": "cube"}), 2e-3))


def test_sheared_cubes_are_affine_images(variant: str) -> None:
    shear = np.array([[1, 0.4, 0.2, 3], [0, 1, -0.3, -2], [0.1, 0, 1, 4], [0, 0, 0, 1.0]])
    cube = mi.load_dict({"type": "cube", "to_world": mi.ScalarTransform4f(shear)})
    np.testing.assert_allclose(cubes_to_world(cube), [shear], atol=1e-5)
