"""How the colour of a surface point changes over held-out views, against the truth's own change.

The points come from the exact distances of a view i. Seen from another view j, where nothing
hides it, a point x has colours R_j(x) in the reconstruction and T_j(x) in the truth (sRGB on
white, between four pixels). Over all pairs of a point of view i and another view that sees it,

    color_change       = mean of |R_j − R_i|,
    color_change_truth = mean of |T_j − T_i|,
    consistency        = mean of |(R_j − R_i) − (T_j − T_i)|,

with |·| the mean over channels. The last is 0 where the reconstruction changes just as the truth
does: a matt surface not at all, a mirror as it should.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..base.arrays import Image
from ..cameras.pinhole import Intrinsics, film_directions, project
from ..data.surfaces import Surfaces

MOST_VIEWS = 64  # that are compared, evenly spread: their pictures are kept
OTHERS = 8  # views that each is compared with, evenly spread
POINTS = 4096  # of each view, at most, evenly spread
_TOUCH = 1e-3  # of the distance: how far off a point may be from the surface that a view sees
_ALIKE = 0.05  # of the distance: beyond, four neighbouring pixels see several surfaces


def color_changes(
    pictures: Sequence[Image],
    truths: Sequence[Image],
    surfaces: Sequence[Surfaces | None],
    camera: Intrinsics,
    poses: Image,
) -> list[dict[str, float] | None]:
    """The three figures of every view; NaN where no other view sees any of its points.

    Args:
        pictures, truths: (H, W, 3) sRGB on white of every view: 8 bits, or floats in [0, 1].
        surfaces: exact ones; the figures of views without are ``None``, and so are all those
            of pictures of a single row or column.
        camera: of the pictures.
        poses: (V, 4, 4), OpenGL axes.
    """
    changes: list[dict[str, float] | None] = []
    if min(camera.width, camera.height) < 2:  # no point lies between four pixels
        return [None for _ in surfaces]
    for i, own in enumerate(surfaces):
        if own is None:
            changes.append(None)
            continue
        points = _points(own, poses[i])
        here = project(points, camera, poses[i])[0]
        mine, true = _colors(pictures[i], here), _colors(truths[i], here)
        found = []
        for j in _others(i, len(surfaces)):
            other = surfaces[j]
            if other is None:
                continue
            seen = points_seen(points, other, poses[j])
            there = project(points[seen], camera, poses[j])[0]
            change = _colors(pictures[j], there) - mine[seen]
            change_of_truth = _colors(truths[j], there) - true[seen]
            off = change - change_of_truth
            found.append(np.abs([change, change_of_truth, off]).mean(axis=-1))
        values = np.concatenate(found, axis=1) if found else np.empty((3, 0))
        means = values.mean(axis=1) if values.size else np.full(3, np.nan)
        names = ("color_change", "color_change_truth", "consistency")
        changes.append(dict(zip(names, means.tolist(), strict=True)))
    return changes


def points_seen(points: Image, surfaces: Surfaces, pose: Image) -> Image:
    """Which of the world-space points, (N, 3), a view sees: N booleans.

    The four pixels around the point all see a surface, within 5 % of one distance, and the
    point's own distance lies among theirs, up to 0.1 %.
    """
    pixels, depth = project(points, surfaces.camera, pose)
    column, row, within = _cell(pixels, surfaces.depth.shape)
    around = np.stack([surfaces.depth[row + y, column + x] for y in (0, 1) for x in (0, 1)])
    nearest, farthest = around.min(axis=0), around.max(axis=0)
    distance = np.linalg.norm(points - pose[:3, 3], axis=-1)
    alike = (nearest > 0) & (farthest <= (1 + _ALIKE) * nearest)
    touches = (distance >= (1 - _TOUCH) * nearest) & (distance <= (1 + _TOUCH) * farthest)
    seen: Image = within & (depth > 0) & alike & touches
    return seen


def _points(surfaces: Surfaces, pose: Image) -> Image:
    """Some of the world-space points that a view sees well, (N, 3)."""
    row, column = np.nonzero(surfaces.depth > 0)
    local = film_directions(column + 0.5, row + 0.5, surfaces.camera)
    rays = local / np.linalg.norm(local, axis=-1, keepdims=True)
    points = pose[:3, 3] + (rays * surfaces.depth[row, column][:, None]) @ pose[:3, :3].T
    points = points[points_seen(points, surfaces, pose)]  # not at silhouettes
    few = np.arange(min(POINTS, len(points))) * len(points) // max(1, min(POINTS, len(points)))
    some: Image = points[few]
    return some


def _others(view: int, count: int) -> list[int]:
    """Evenly spread views other than this one."""
    number = min(OTHERS, count - 1)
    return [(view + (m + 1) * count // (number + 1)) % count for m in range(number)]


def _colors(picture: Image, pixels: Image) -> Image:
    """(N, 3) colours in [0, 1] at points of the film, between the centres of four pixels."""
    column, row, _ = _cell(pixels, picture.shape)
    right = np.clip(pixels[:, 0] - 0.5 - column, 0, 1)[:, None]
    down = np.clip(pixels[:, 1] - 0.5 - row, 0, 1)[:, None]
    full = 255.0 if picture.dtype == np.uint8 else 1.0
    upper, lower = (
        picture[row + y, column] * (1 - right) + picture[row + y, column + 1] * right
        for y in (0, 1)
    )
    colors: Image = (upper * (1 - down) + lower * down) / full
    return colors


def _cell(pixels: Image, shape: tuple[int, ...]) -> tuple[Image, Image, Image]:
    """Column and row of the upper left of the four pixels around points, and whether all are
    in a picture of this shape; those that are not get others, which are."""
    height, width = shape[:2]
    with np.errstate(invalid="ignore"):
        corner = np.floor(np.nan_to_num(pixels, nan=-1e9, posinf=-1e9, neginf=-1e9) - 0.5)
    most = np.array([width - 2, height - 2])
    # A centre in the last row or column, or by rounding beyond it, has its four pixels, too.
    within = np.all((pixels >= 0.5 - 1e-3) & (pixels <= most + 1.5 + 1e-3), axis=-1)
    clipped = np.clip(corner, 0, np.maximum(most, 0)).astype(np.intp)
    return clipped[:, 0], clipped[:, 1], within & bool((most >= 0).all())
