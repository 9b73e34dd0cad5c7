"""Camera poses: conventions of axes, and poses made of other things."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.errors import InputError

# ---- Axis conventions --------------------------------------------------------

# Changing the convention flips two of the camera's axes, that is, two columns.
_FLIP_YZ = np.array([1.0, -1.0, -1.0, 1.0])
_FLIP_XZ = np.array([-1.0, 1.0, -1.0, 1.0])
_FLIP_XY = np.array([-1.0, -1.0, 1.0, 1.0])

# How far the columns of a rotation may be from orthonormal. Files written from
# float32 are within 1e-6; matrices that hold a scale or a shear are far outside.
_RIGID_TOLERANCE = 1e-3


def opengl_from_opencv(c2w: ArrayLike) -> NDArray[np.float64]:
    """OpenCV camera-to-world matrices (..., 4, 4) in OpenGL's axes, and the other way round."""
    return _flip(c2w, _FLIP_YZ)


def mitsuba_from_opengl(c2w: ArrayLike) -> NDArray[np.float64]:
    """OpenGL camera-to-world matrices (..., 4, 4) in Mitsuba's axes, and the other way round."""
    return _flip(c2w, _FLIP_XZ)


def mitsuba_from_opencv(c2w: ArrayLike) -> NDArray[np.float64]:
    """OpenCV camera-to-world matrices (..., 4, 4) in Mitsuba's axes, and the other way round."""
    return _flip(c2w, _FLIP_XY)


# A flip undoes itself.
opencv_from_opengl = opengl_from_opencv
opengl_from_mitsuba = mitsuba_from_opengl
opencv_from_mitsuba = mitsuba_from_opencv


def _flip(c2w: ArrayLike, signs: NDArray[np.float64]) -> NDArray[np.float64]:
    matrices = np.asarray(c2w, np.float64)
    if matrices.shape[-2:] != (4, 4):
        raise ValueError(f"expected poses of shape (..., 4, 4), got {matrices.shape}")
    return np.multiply(matrices, signs)


def is_rigid(c2w: ArrayLike) -> bool:
    """Whether a matrix, (4, 4), is a rotation and a translation, up to rounding.

    Scale, shear, mirroring, NaN and infinity make it something else.
    """
    matrix = np.asarray(c2w, np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        return False
    rotation, bottom = matrix[:3, :3], matrix[3]
    deviation = max(
        np.abs(rotation.T @ rotation - np.eye(3)).max(), np.abs(bottom - [0, 0, 0, 1]).max()
    )
    return bool(deviation <= _RIGID_TOLERANCE and np.linalg.det(rotation) > 0)


def look_at(
    origin: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)
) -> NDArray[np.float64]:
    """The OpenGL camera-to-world matrix of a camera that looks at a point.

    Args:
        origin: Position of the camera in world space, (3,).
        target: The point that it looks at, (3,).
        up: World direction that appears upright in the image, (3,).

    Returns:
        The matrix, (4, 4).

    Raises:
        InputError: ``target`` coincides with ``origin``, or ``up`` is parallel
            to the view direction, so that no such camera exists.
    """
    position = np.asarray(origin, np.float64)
    back = position - np.asarray(target, np.float64)
    distance = np.linalg.norm(back)
    if not distance > 0:
        raise InputError(f"look_at: origin and target must differ, both are {position.tolist()}")
    back = back / distance
    upwards = np.asarray(up, np.float64)
    right = np.cross(upwards, back)
    sine = np.linalg.norm(right)
    # Relative to |up|: the length of `up` means nothing.
    if not sine > 1e-9 * np.linalg.norm(upwards):
        raise InputError(
            f"look_at: up {upwards.tolist()} must not be parallel to the view direction"
        )
    right = right / sine
    c2w = np.eye(4)
    c2w[:3] = np.stack([right, np.cross(back, right), back, position], axis=1)
    return c2w


def average_pose(c2w: ArrayLike) -> NDArray[np.float64]:
    """The camera in the middle of others: mean position, mean backward and upward axes.

    Args:
        c2w: OpenGL camera-to-world matrices, (N, 4, 4).

    Returns:
        The matrix, (4, 4).

    Raises:
        InputError: The axes cancel or are parallel.
    """
    _, up, back, position = (np.asarray(c2w, np.float64)[:, :3, i].mean(axis=0) for i in range(4))
    return look_at(position, position - back, up)
