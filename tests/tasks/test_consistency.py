"""Changes of colour over views, of a ball whose points are known, and by loops."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mi_nerf.cameras.pinhole import Intrinsics, project
from mi_nerf.data.surfaces import Surfaces
from mi_nerf.tasks import consistency
from mi_nerf.tasks.consistency import color_changes, points_seen
from tests.support.datasets import exact_rays, orbit_poses

CAMERA = Intrinsics.from_angle_x(40, 36, 0.5)
RADIUS = 0.8


def ball(pose: np.ndarray, camera: Intrinsics = CAMERA) -> tuple[Surfaces, np.ndarray]:
    """The surface of a ball around the origin, and its points, (H, W, 3)."""
    o, d = exact_rays(camera, pose)
    b = d @ o
    square = RADIUS**2 - (o @ o - b * b)
    depth = np.where(square > 0, -b - np.sqrt(np.maximum(square, 0)), 0)
    return Surfaces(camera, depth.astype(np.float32), None), o + depth[..., None] * d


def painted(points: np.ndarray, surfaces: Surfaces, slope: float = 0.3) -> np.ndarray:
    """A matt ball whose colour is linear in space, on white."""
    color = 0.5 + slope * points / RADIUS
    return np.where(surfaces.depth[..., None] > 0, color, 1.0)


def scene(n: int = 4) -> tuple[list[Surfaces], list[np.ndarray], np.ndarray]:
    poses = orbit_poses(n, height=1.0)
    found = [ball(pose) for pose in poses]
    return [s for s, _ in found], [painted(p, s) for s, p in found], poses


def test_a_matt_ball_hardly_changes() -> None:
    surfaces, truths, poses = scene(8)
    for change in color_changes(truths, truths, surfaces, CAMERA, poses):
        assert change is not None
        # What is left is that between pixels colour is not quite linear.
        assert 0 < change["color_change"] == change["color_change_truth"] < 2e-3
        assert change["consistency"] == 0


def test_colours_that_depend_on_the_view() -> None:
    """View j is brighter by b_j all over: a point changes by b_j − b_i and what the truth does."""
    surfaces, truths, poses = scene(8)
    bright = np.array([0.0, 0.05, 0.2, 0.0, 0.1, 0.05, 0.3, 0.15])
    pictures = [truth + b for truth, b in zip(truths, bright, strict=True)]
    changes = color_changes(pictures, truths, surfaces, CAMERA, poses)
    for i, change in enumerate(changes):
        assert change is not None
        pairs = []
        for j in consistency._others(i, 8):
            seen = points_seen(consistency._points(surfaces[i], poses[i]), surfaces[j], poses[j])
            pairs += [abs(bright[j] - bright[i])] * int(seen.sum())
        assert change["consistency"] == pytest.approx(np.mean(pairs), abs=1e-9)
        assert change["color_change"] == pytest.approx(np.mean(pairs), abs=2e-3)
    # A truth that changes in the same way is no fault.
    for change in color_changes(pictures, pictures, surfaces, CAMERA, poses):
        assert change is not None and change["consistency"] == 0 < change["color_change"]


def test_pairs_by_loops() -> None:
    """Point by point and view by view, with pictures of noise."""
    surfaces, _, poses = scene(8)
    surfaces, poses = surfaces[:3], poses[:3]
    rng = np.random.default_rng(0)
    pictures, truths = (list(rng.random((3, 36, 40, 3))) for _ in range(2))
    changes = color_changes(pictures, truths, surfaces, CAMERA, poses)

    def between(image: np.ndarray, x: float, y: float) -> np.ndarray:
        column, row = math.floor(x - 0.5), math.floor(y - 0.5)
        u, v = x - 0.5 - column, y - 0.5 - row
        upper, lower = (
            image[line, column] * (1 - u) + image[line, column + 1] * u for line in (row, row + 1)
        )
        color: np.ndarray = upper * (1 - v) + lower * v
        return color

    sums = []
    for point in consistency._points(surfaces[0], poses[0]):
        (x, y), _ = project(point, CAMERA, poses[0])
        mine, true = between(pictures[0], x, y), between(truths[0], x, y)
        for j in (1, 2):
            (x, y), depth = project(point, CAMERA, poses[j])
            # Of a ball: its own front hides all that looks away from the camera.
            to_camera = poses[j][:3, 3] - point
            if to_camera @ point <= 0 or depth <= 0:
                continue
            if not points_seen(point[None], surfaces[j], poses[j])[0]:
                continue
            there, there_true = between(pictures[j], x, y), between(truths[j], x, y)
            a, b = there - mine, there_true - true
            sums.append([np.abs(a).mean(), np.abs(b).mean(), np.abs(a - b).mean()])
    assert len(sums) > 100
    names = ("color_change", "color_change_truth", "consistency")
    assert changes[0] == pytest.approx(dict(zip(names, np.mean(sums, axis=0), strict=True)))


def test_what_a_view_sees() -> None:
    """Points of a ball that face the camera, and no others."""
    surfaces, _, poses = scene(6)
    rng = np.random.default_rng(1)
    points = rng.normal(size=(4000, 3))
    points *= RADIUS / np.linalg.norm(points, axis=1, keepdims=True)
    to_camera = poses[2][:3, 3] - points
    facing = np.sum(to_camera * points, axis=1) / np.linalg.norm(to_camera, axis=1) / RADIUS
    seen = points_seen(points, surfaces[2], poses[2])
    assert not seen[facing < 0].any()
    assert seen[facing > 0.5].all()
    # The same directions further in or out are hidden, or hang in the air.
    assert not points_seen(0.9 * points[facing > 0.5], surfaces[2], poses[2]).any()
    assert not points_seen(1.1 * points[facing > 0.7], surfaces[2], poses[2]).any()


def test_eight_bits_count_as_numbers_up_to_one() -> None:
    surfaces, truths, poses = scene()
    rounded = [np.rint(255 * truth).astype(np.uint8) for truth in truths]
    numbers = [image / 255 for image in rounded]
    eight = color_changes(rounded, rounded, surfaces, CAMERA, poses)
    floats = color_changes(numbers, numbers, surfaces, CAMERA, poses)
    for a, b in zip(eight, floats, strict=True):
        assert a == pytest.approx(b)


def test_views_with_nothing_to_compare() -> None:
    surfaces, truths, poses = scene(2)  # opposite sides: no point is seen by both
    for change in color_changes(truths, truths, surfaces, CAMERA, poses):
        assert change is not None and all(math.isnan(v) for v in change.values())
    alone = color_changes(truths[:1], truths[:1], surfaces[:1], CAMERA, poses[:1])
    assert alone[0] is not None and math.isnan(alone[0]["consistency"])
    some = color_changes(truths, truths, [None, surfaces[1]], CAMERA, poses)
    assert some[0] is None and some[1] is not None
    empty = Surfaces(CAMERA, 0 * surfaces[0].depth, None)
    found = color_changes(truths, truths, [empty, surfaces[1]], CAMERA, poses)
    assert found[0] is not None and math.isnan(found[0]["consistency"])


def test_pictures_of_one_row() -> None:
    row = Intrinsics.from_angle_x(40, 1, 0.5)
    surfaces, points = ball(orbit_poses(2)[0], row)
    picture = painted(points, surfaces)
    assert color_changes([picture], [picture], [surfaces], row, orbit_poses(2)[:1]) == [None]


@pytest.mark.parametrize("count", [1, 2, 5, 9, 10, 64, 200])
def test_other_views(count: int) -> None:
    for view in range(min(count, 20)):
        others = consistency._others(view, count)
        assert len(others) == len(set(others)) == min(8, count - 1) and view not in others
