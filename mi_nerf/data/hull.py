"""What the silhouettes of a dataset already say about where its scene can be.

A ray through a fully transparent pixel crosses nothing, so a cell that any view sees
entirely against transparent pixels is empty (the visual hull, Laurentini 1994).
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from ..base.box import Corner, grid_shape
from ..base.machine import cores
from ..cameras.pinhole import Intrinsics
from ..cameras.trajectory import look_center
from . import Dataset

# The eight parts of a block, along each axis the lower or the upper.
_PARTS = np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=-1)
# Of an array with axes (X, 2, 2, 2, Y, 2, 2, 2, Z, 2, 2, 2), halves of halves of halves: to those
# of the blocks' numbers, (X, Y, Z, 2, 2, 2, …).
_BY_NUMBER = np.arange(12).reshape(3, 4).T.ravel()


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
    blocks = _Blocks(np.asarray(lower), np.asarray(upper), shape)
    with ThreadPoolExecutor(cores()) as pool:

        def look(view: int) -> None:
            alpha, pose = dataset.images[view, ..., 3], dataset.cam_to_world[view]
            blocks.carve(alpha, dataset.intrinsics, pose)

        # Views only ever take away: in whichever order they come, the same cells are left.
        list(pool.map(look, range(len(dataset))))
    return blocks.cells()


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


class _Blocks:
    """The cells of a box in blocks of 8³, which fall into blocks of 4³, those of 2³, and cells.

    A cell is judged by the sphere around it. So that few need to be, each view begins with the
    blocks: the sphere around a block holds those of its parts, and the rectangle of pixels that
    it may touch holds theirs (by the bound of :func:`_covered`). Hence a block against transparent
    pixels alone is empty, and in a block against none of them this view empties nothing.

    Blocks of one size are numbered so that those with numbers 8b … 8b + 7 are the parts of b.
    """

    def __init__(
        self,
        lower: np.ndarray[Any, Any],
        upper: np.ndarray[Any, Any],
        shape: tuple[int, int, int],
    ) -> None:
        self._lower, self._size = lower, (upper - lower) / np.asarray(shape)
        self._shape = shape
        self._outer = tuple(-(-count // 8) for count in shape)  # blocks of 8³ along the axes
        inside = np.zeros([8 * count for count in self._outer], bool)
        inside[: shape[0], : shape[1], : shape[2]] = True
        numbered = inside.reshape(*(n for count in self._outer for n in (count, 2, 2, 2)))
        cells = numbered.transpose(_BY_NUMBER).reshape(-1)
        # Of each size, the largest first: whether no view so far shows that they are empty.
        self._kept: list[np.ndarray[Any, Any]] = [
            np.any(cells.reshape(-1, 8**k), axis=1) for k in (3, 2, 1, 0)
        ]

    def cells(self) -> np.ndarray[Any, Any]:
        """(X, Y, Z) booleans: the cells that are left."""
        kept = self._kept[0]
        for parts in self._kept[1:]:
            kept = parts & kept.repeat(8)
        kept = kept.reshape(*self._outer, *(2,) * 9).transpose(np.argsort(_BY_NUMBER))
        x, y, z = self._shape
        return kept.reshape([8 * count for count in self._outer])[:x, :y, :z].copy()

    def carve(
        self, alpha: np.ndarray[Any, Any], intrinsics: Intrinsics, pose: np.ndarray[Any, Any]
    ) -> None:
        """Takes away what one view shows to be empty."""
        seen = alpha > 0
        sums = np.zeros((seen.shape[0] + 1, seen.shape[1] + 1), np.int32)
        np.cumsum(np.cumsum(seen, axis=0, dtype=np.int32), axis=1, out=sums[1:, 1:])
        # Of a copy: what another thread changes between its two passes, NumPy does not forgive.
        blocks = np.flatnonzero(self._kept[0].copy())
        where = np.stack(np.unravel_index(blocks, self._outer), axis=-1)
        centers = self._lower + (where + 0.5) * (8 * self._size)
        # In the axes of Mitsuba's cameras but for the first: x to the right, y down, z ahead.
        axes = pose[:3, :3] * (1, -1, -1)
        local = ((centers - pose[:3, 3]) @ axes).T
        offsets = ((_PARTS - 0.5) * self._size) @ axes  # of the parts of a block of 2³
        radius = float(np.linalg.norm(self._size)) / 2
        for kept, factor in zip(self._kept, (8, 4, 2, 1), strict=True):
            if factor < 8:
                blocks = (8 * blocks[:, None] + np.arange(8)).ravel()
                here = np.flatnonzero(kept[blocks])
                blocks = blocks[here]
                local = [
                    (along[:, None] + factor * offsets[:, i]).ravel()[here]
                    for i, along in enumerate(local)
                ]
            judged, covered, area = _covered(sums, local, factor * radius, intrinsics)
            kept[blocks[judged & (covered == 0)]] = False
            mixed = ~judged | ((covered > 0) & (covered < area))
            if factor == 2:  # their centre is a point of the spheres around all eight cells
                mixed &= ~_seen_at(seen, local, intrinsics)
            left = np.flatnonzero(mixed)
            blocks, local = blocks[left], [along[left] for along in local]


def _seen_at(
    seen: np.ndarray[Any, Any], local: Sequence[np.ndarray[Any, Any]], intrinsics: Intrinsics
) -> np.ndarray[Any, Any]:
    """Whether points, as :func:`_covered` takes them, appear in a pixel that is true."""
    height, width = seen.shape
    with np.errstate(divide="ignore", invalid="ignore"):
        x = np.floor(intrinsics.cx + intrinsics.fx * local[0] / local[2])
        y = np.floor(intrinsics.cy + intrinsics.fy * local[1] / local[2])
    inside = (local[2] > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    x, y = (np.where(inside, v, 0).astype(np.intp) for v in (x, y))
    return inside & seen.ravel()[y * width + x]


def _covered(
    sums: np.ndarray[Any, Any],
    local: Sequence[np.ndarray[Any, Any]],
    radius: float,
    intrinsics: Intrinsics,
) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """What spheres touch of a picture.

    Args:
        sums: pixels that are not fully transparent in the first rows and columns, (H+1, W+1).
        local: the centres: to the right of the camera, below it, ahead of it; scene units.

    Returns:
        Whether a sphere lies before the camera and within the picture; how many pixels it may
        touch that are not fully transparent; and how many in all.
    """
    height, width = sums.shape[0] - 1, sums.shape[1] - 1
    near = local[2] - radius
    judged = near > 1e-6 * radius
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        reach = radius / near
        ends = []
        for along, f, c, size in (
            (local[0], intrinsics.fx, intrinsics.cx, width),
            (local[1], intrinsics.fy, intrinsics.cy, height),
        ):
            # How far q can lie from the image of c, |q − c| ≤ r: away from the optical axis
            # perspective stretches a sphere. |q_x/q_z − c_x/c_z| ≤ r·√(1 + (c_x/c_z)²)/(c_z − r).
            from_axis = f * along / local[2]
            extent = reach * np.sqrt(f * f + from_axis * from_axis) + 1
            first, last = np.floor(c + from_axis - extent), np.ceil(c + from_axis + extent)
            # A sphere that leaves the picture, or lies behind the camera, is not judged.
            judged &= (first >= 0) & (last <= size)
            ends += [first, last]
    x0, x1, y0, y1 = (np.where(judged, end, 0).astype(np.intp) for end in ends)
    table, above, below = sums.ravel(), y0 * (width + 1), y1 * (width + 1)
    covered = table[below + x1] - table[above + x1] - table[below + x0] + table[above + x0]
    return judged, covered, (x1 - x0) * (y1 - y0)


def _corner(v: np.ndarray[Any, Any]) -> Corner:
    return float(v[0]), float(v[1]), float(v[2])
