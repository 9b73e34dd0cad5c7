"""What the silhouettes of a dataset already say about where its scene can be.

A ray through a fully transparent pixel crosses nothing, so a cell that any view sees
entirely against transparent pixels is empty (the visual hull, Laurentini 1994).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..base.box import Corner, grid_shape
from ..cameras.pinhole import Intrinsics, project
from ..cameras.trajectory import look_center
from . import Dataset


def view_box(dataset: Dataset) -> tuple[Corner, Corner]:
    """The box of the dataset, or the cube that its cameras have in common view.

    The centre is the point nearest to all optical axes (least squares); the cube
    reaches as far as a typical camera sees at that distance.
    """
    if dataset.box is not None:
        return dataset.box
    origin = dataset.cam_to_world[:, :3, 3]
    center = look_center(dataset.cam_to_world)
    distance = float(np.median(np.linalg.norm(origin - center, axis=1)))
    i = dataset.intrinsics
    half = 1.05 * distance * max(i.width / i.fx, i.height / i.fy) / 2
    if half <= 1e-9 * np.abs(origin).max():  # one camera, or several in one place: anything
        half = 1.0
    return _corner(center - half), _corner(center + half)


def carve(dataset: Dataset, lower: Corner, upper: Corner, resolution: int) -> np.ndarray[Any, Any]:
    """Cells of the box that no view shows to be empty.

    Returns:
        Booleans in the shape of :func:`mi_nerf.base.box`; all true for a
        dataset without alpha, or in normalised device coordinates.
    """
    shape = grid_shape(lower, upper, resolution)
    if not dataset.has_alpha or dataset.ndc is not None:
        return np.ones(shape, bool)
    size = (np.asarray(upper) - np.asarray(lower)) / np.asarray(shape)
    cells = np.arange(int(np.prod(shape)))
    for image, pose in zip(dataset.images, dataset.cam_to_world, strict=True):
        where = np.stack(np.unravel_index(cells, shape), axis=-1)
        points = np.asarray(lower) + (where + 0.5) * size
        radius = float(np.linalg.norm(size)) / 2
        cells = cells[_may_be_seen(image[..., 3], points, radius, dataset.intrinsics, pose)]
    mask = np.zeros(shape, bool)
    mask.ravel()[cells] = True
    return mask


def tighten(
    dataset: Dataset, lower: Corner, upper: Corner, resolution: int = 64
) -> tuple[Corner, Corner]:
    """Shrinks a box to the hull's bounding box; the same box where nothing is carved."""
    mask = carve(dataset, lower, upper, resolution)
    if mask.all() or not mask.any():
        return lower, upper
    size = (np.asarray(upper) - np.asarray(lower)) / np.asarray(mask.shape)
    occupied = np.argwhere(mask)
    first, last = occupied.min(0), occupied.max(0) + 1
    return _corner(np.asarray(lower) + first * size), _corner(np.asarray(lower) + last * size)


def _may_be_seen(
    alpha: np.ndarray[Any, Any],
    points: np.ndarray[Any, Any],
    radius: float,
    intrinsics: Intrinsics,
    pose: np.ndarray[Any, Any],
) -> np.ndarray[Any, Any]:
    """Whether spheres around ``points`` touch any pixel that is not fully transparent."""
    pixel, depth = project(points, intrinsics, pose)
    height, width = alpha.shape
    sums = np.zeros((height + 1, width + 1), np.int64)
    sums[1:, 1:] = np.cumsum(np.cumsum(alpha > 0, axis=0), axis=1)
    near = depth - radius
    ahead = near > 1e-6 * radius
    reach = radius / np.where(ahead, near, 1)
    with np.errstate(invalid="ignore", over="ignore"):
        # How far q can lie from the image of c, |q − c| ≤ r: away from the optical axis
        # perspective stretches a sphere. |q_x/q_z − c_x/c_z| ≤ r·√(1 + (c_x/c_z)²)/(c_z − r).
        extent_x = reach * np.hypot(intrinsics.fx, pixel[:, 0] - intrinsics.cx) + 1
        extent_y = reach * np.hypot(intrinsics.fy, pixel[:, 1] - intrinsics.cy) + 1
        x0, x1 = np.floor(pixel[:, 0] - extent_x), np.ceil(pixel[:, 0] + extent_x)
        y0, y1 = np.floor(pixel[:, 1] - extent_y), np.ceil(pixel[:, 1] + extent_y)
        # A sphere that leaves the picture, or lies behind the camera, is not judged.
        judged = ahead & (x0 >= 0) & (y0 >= 0) & (x1 <= width) & (y1 <= height)
    x0, x1, y0, y1 = (np.where(judged, v, 0).astype(int) for v in (x0, x1, y0, y1))
    covered = sums[y1, x1] - sums[y0, x1] - sums[y1, x0] + sums[y0, x0]
    return ~judged | (covered > 0)


def _corner(v: np.ndarray[Any, Any]) -> Corner:
    return float(v[0]), float(v[1]), float(v[2])
