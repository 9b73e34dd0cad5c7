"""What silhouettes say: never that something is empty which is not."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from mi_nerf.cameras.pinhole import Intrinsics, project
from mi_nerf.cameras.poses import look_at
from mi_nerf.data import Dataset
from mi_nerf.data.hull import carve, tighten, view_box

LOWER, UPPER = (-1.0, -1.2, -0.8), (1.1, 1.0, 1.3)


def cameras(rng: np.random.Generator, count: int, distance: float, target: np.ndarray):
    """Poses all around, at various distances, that look near ``target``."""
    origins = rng.normal(size=(count, 3))
    origins *= (
        distance
        * rng.uniform(0.8, 1.2, (count, 1))
        / np.linalg.norm(origins, axis=1, keepdims=True)
    )
    aims = target + rng.uniform(-0.1, 0.1, (count, 3))
    return np.stack(
        [look_at(o + target, a, (0.3, 0.5, 0.8)) for o, a in zip(origins, aims, strict=True)]
    )


def silhouettes(
    spheres: np.ndarray, poses: np.ndarray, camera: Intrinsics, *, has_alpha: bool = True
) -> Dataset:
    """Views of opaque spheres (x, y, z, radius): alpha is 1 where a pixel's centre ray hits."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    local = np.stack(
        [(x - camera.cx) / camera.fx, (camera.cy - y) / camera.fy, -np.ones_like(x)], axis=-1
    )
    images = np.zeros((len(poses), camera.height, camera.width, 4), np.float32)
    for image, pose in zip(images, poses, strict=True):
        d = local @ pose[:3, :3].T
        d /= np.linalg.norm(d, axis=-1, keepdims=True)
        for *center, radius in spheres:
            offset = np.array(center) - pose[:3, 3]
            along = d @ offset
            image[(offset @ offset - along**2 < radius**2) & (along > 0)] = 1
    return Dataset(
        path=Path("nowhere"),
        split="train",
        names=tuple(f"r_{i}" for i in range(len(poses))),
        images=images,
        color_space="srgb",
        has_alpha=has_alpha,
        cam_to_world=poses,
        intrinsics=camera,
    )


def inside_spheres(rng: np.random.Generator, spheres: np.ndarray, count: int) -> np.ndarray:
    """Random points in the spheres and on their surfaces."""
    out = rng.normal(size=(len(spheres), count, 3))
    out /= np.linalg.norm(out, axis=-1, keepdims=True)
    depth = np.minimum(1, rng.uniform(0.5, 1.5, (len(spheres), count, 1)))
    return (spheres[:, None, :3] + out * depth * spheres[:, None, 3:] * 0.9999).reshape(-1, 3)


def cells_of(points: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    size = (np.array(UPPER) - LOWER) / shape
    cells = np.floor((points - LOWER) / size).astype(int)
    assert (cells >= 0).all() and (cells < shape).all()
    return cells


def random_spheres(rng: np.random.Generator, count: int = 4) -> np.ndarray:
    centers = rng.uniform(-0.5, 0.6, (count, 3))
    return np.concatenate([centers, rng.uniform(0.08, 0.25, (count, 1))], axis=1)


# ---- Carving ---------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("resolution", [7, 40])
@pytest.mark.parametrize(("angle", "distance"), [(0.7, 4.0), (1.9, 1.6)])
def test_nothing_opaque_is_carved(
    seed: int, resolution: int, angle: float, distance: float
) -> None:
    rng = np.random.default_rng(seed)
    spheres = random_spheres(rng)
    camera = dataclasses.replace(Intrinsics.from_angle_x(120, 90, angle), cx=66.0, cy=40.0)
    poses = cameras(rng, 10, distance, np.array([0.05, -0.1, 0.2]))
    mask = carve(silhouettes(spheres, poses, camera), LOWER, UPPER, resolution)
    assert max(mask.shape) == resolution
    x, y, z = cells_of(inside_spheres(rng, spheres, 2000), mask.shape).T
    assert mask[x, y, z].all()


@pytest.mark.slow
def test_cells_at_the_edge_of_a_wide_picture_reach_far() -> None:
    """Perspective stretches what lies away from the axis: a cell's corners must not get lost."""
    rng = np.random.default_rng(2)
    camera = Intrinsics.from_angle_x(300, 300, 2.3)
    pose = look_at((0, 0, 0), (0, 0, -1), (0, 1, 0))[None]
    dataset = silhouettes(np.zeros((0, 4)), pose, camera)
    judged = 0
    for _ in range(200):
        lower = rng.uniform((-1.6, -1.6, -1.2), (1.4, 1.4, -0.9))
        upper = lower + rng.uniform(0.05, 0.3, 3)
        box = tuple(lower.tolist()), tuple(upper.tolist())
        dataset.images[:] = 0
        if carve(dataset, *box, 1).any():
            continue  # it leaves the picture
        judged += 1
        corners = np.where(rng.integers(0, 2, (8, 3)), lower, upper)
        pixels, _ = project(corners, camera, pose[0])
        for x, y in np.floor(pixels).astype(int):
            dataset.images[0, y, x] = 1
            assert carve(dataset, *box, 1).all()
            dataset.images[0, y, x] = 0
    assert judged > 60


def cell_by_cell(
    dataset: Dataset, lower: np.ndarray, upper: np.ndarray, shape: tuple[int, ...]
) -> np.ndarray:
    """The same cells, each judged against each view by itself: no blocks, no order, no sums."""
    size = (upper - lower) / np.asarray(shape)
    centers = (lower + (np.argwhere(np.ones(shape, bool)) + 0.5) * size).reshape(-1, 3)
    radius, camera = float(np.linalg.norm(size)) / 2, dataset.intrinsics
    kept = np.ones(len(centers), bool)
    for image, pose in zip(dataset.images, dataset.cam_to_world, strict=True):
        pixels, depths = project(centers, camera, pose)
        for cell, ((x, y), depth) in enumerate(zip(pixels, depths, strict=True)):
            if depth - radius <= 1e-6 * radius:
                continue
            reach_x = radius / (depth - radius) * np.hypot(camera.fx, x - camera.cx) + 1
            reach_y = radius / (depth - radius) * np.hypot(camera.fy, y - camera.cy) + 1
            x0, x1 = math.floor(x - reach_x), math.ceil(x + reach_x)
            y0, y1 = math.floor(y - reach_y), math.ceil(y + reach_y)
            if x0 >= 0 and y0 >= 0 and x1 <= camera.width and y1 <= camera.height:
                kept[cell] &= bool((image[y0:y1, x0:x1, 3] > 0).any())
    return kept.reshape(shape)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("angle", "distance"), [(0.7, 4.0), (1.9, 1.6)])
def test_blocks_leave_the_cells_that_are_left_one_by_one(
    seed: int, angle: float, distance: float
) -> None:
    """Boxes of any proportions, whole blocks or not; cameras that see all of it, or stand in it."""
    rng = np.random.default_rng(seed)
    camera = dataclasses.replace(Intrinsics.from_angle_x(90, 70, angle), cx=47.0, cy=33.0)
    poses = cameras(rng, 6, distance, np.array([0.05, -0.1, 0.2]))
    dataset = silhouettes(random_spheres(rng), poses, camera)
    lower = np.array(LOWER) * rng.uniform(0.3, 1.0, 3)
    upper = np.array(UPPER) * rng.uniform(0.3, 1.0, 3)
    box = tuple(lower.tolist()), tuple(upper.tolist())
    mask = carve(dataset, *box, int(rng.choice([8, 13, 16, 21])))
    assert 0.01 < mask.mean() < 0.999
    np.testing.assert_array_equal(mask, cell_by_cell(dataset, lower, upper, mask.shape))


@pytest.mark.parametrize("side", [1, 2, 7, 8, 9])
def test_the_smallest_grids(side: int) -> None:
    rng = np.random.default_rng(side)
    camera = Intrinsics.from_angle_x(60, 60, 0.9)
    dataset = silhouettes(random_spheres(rng, 2), cameras(rng, 9, 4.0, np.zeros(3)), camera)
    mask = carve(dataset, LOWER, UPPER, side)
    np.testing.assert_array_equal(
        mask, cell_by_cell(dataset, np.array(LOWER), np.array(UPPER), mask.shape)
    )


def test_most_empty_space_is_carved() -> None:
    rng = np.random.default_rng(3)
    spheres = np.array([[0.0, 0.0, 0.0, 0.4]])
    camera = Intrinsics.from_angle_x(200, 200, 0.9)
    poses = cameras(rng, 30, 4.0, np.zeros(3))
    mask = carve(silhouettes(spheres, poses, camera), LOWER, UPPER, 42)
    size = (np.array(UPPER) - LOWER) / mask.shape
    centers = LOWER + (np.argwhere(np.ones_like(mask)) + 0.5) * size
    distance = np.linalg.norm(centers, axis=1).reshape(mask.shape)
    assert mask[distance < 0.4].all()
    assert mask[distance > 0.7].mean() < 0.002
    assert mask.mean() < 2.5 * (4 / 3 * np.pi * 0.4**3) / np.prod(np.array(UPPER) - LOWER)


def test_each_view_only_takes_away() -> None:
    rng = np.random.default_rng(4)
    spheres, camera = random_spheres(rng), Intrinsics.from_angle_x(80, 80, 0.8)
    dataset = silhouettes(spheres, cameras(rng, 8, 4.0, np.zeros(3)), camera)
    before = np.ones((30, 31, 30), bool)
    for count in range(1, 9):
        mask = carve(dataset.subset(range(count)), LOWER, UPPER, 31)
        assert not (mask & ~before).any()
        before = mask
    assert before.mean() < 0.2


def test_what_no_view_shows_is_kept() -> None:
    """Cells beside the picture or behind the camera are not judged."""
    camera = Intrinsics.from_angle_x(60, 60, 0.5)
    pose = look_at((0.0, -0.3, 0.0), (0, 1, 0))[None]  # within the box
    mask = carve(silhouettes(np.zeros((0, 4)), pose, camera), LOWER, UPPER, 40)
    size = (np.array(UPPER) - LOWER) / mask.shape
    centers = LOWER + (np.argwhere(np.ones_like(mask)) + 0.5) * size
    pixel, depth = project(centers, camera, pose[0])
    seen = (depth > 0) & (pixel > 0).all(axis=1) & (pixel < 60).all(axis=1)
    assert mask.ravel()[~seen].all()
    assert 0.2 < mask.ravel()[seen].mean() < 0.9  # some of it is near the edges


def test_images_without_alpha_carve_nothing() -> None:
    rng = np.random.default_rng(5)
    camera = Intrinsics.from_angle_x(40, 40, 0.8)
    poses = cameras(rng, 5, 4.0, np.zeros(3))
    dataset = silhouettes(random_spheres(rng), poses, camera, has_alpha=False)
    assert carve(dataset, LOWER, UPPER, 20).all()
    assert tighten(dataset, LOWER, UPPER) == (LOWER, UPPER)


def test_the_faintest_alpha_counts() -> None:
    camera = Intrinsics.from_angle_x(40, 40, 0.8)
    poses = cameras(np.random.default_rng(6), 5, 4.0, np.zeros(3))
    dataset = silhouettes(np.zeros((0, 4)), poses, camera)
    assert not carve(dataset, (-0.2,) * 3, (0.2,) * 3, 8).any()
    dataset.images[..., 3] = 1 / 255
    assert carve(dataset, (-0.2,) * 3, (0.2,) * 3, 8).all()


# ---- Boxes ---------------------------------------------------------------------------


def test_view_box_is_what_the_cameras_see() -> None:
    center = np.array([3.0, -1.0, 2.0])
    poses = cameras(np.random.default_rng(7), 40, 4.0, center)
    camera = Intrinsics.from_angle_x(80, 60, 0.7)
    dataset = silhouettes(np.zeros((0, 4)), poses, camera)
    lower, upper = np.array(view_box(dataset))
    assert (lower + upper) / 2 == pytest.approx(center, abs=0.05)
    side = upper - lower
    assert side == pytest.approx(np.full(3, side[0]))
    distance = np.median(np.linalg.norm(poses[:, :3, 3] - center, axis=1))
    # As wide as the picture at the centre, and a little more.
    assert side[0] == pytest.approx(2 * distance * np.tan(0.35), rel=0.1)


def test_view_box_of_the_dataset_wins() -> None:
    poses = cameras(np.random.default_rng(8), 4, 4.0, np.zeros(3))
    dataset = silhouettes(np.zeros((0, 4)), poses, Intrinsics.from_angle_x(8, 8, 0.7))
    assert view_box(dataclasses.replace(dataset, box=(LOWER, UPPER))) == (LOWER, UPPER)


def test_view_box_of_cameras_in_one_place() -> None:
    """Nothing to go by, but still a box of some size."""
    pose = look_at((1, 2, 3), (0, 0, 0))[None].repeat(3, axis=0)
    dataset = silhouettes(np.zeros((0, 4)), pose, Intrinsics.from_angle_x(8, 8, 0.7))
    lower, upper = np.array(view_box(dataset))
    assert np.isfinite([lower, upper]).all() and (lower < upper).all()


@pytest.mark.parametrize("seed", range(4))
def test_tight_boxes_hold_everything(seed: int) -> None:
    rng = np.random.default_rng(seed)
    spheres = random_spheres(rng, 3)
    poses = cameras(rng, 25, 4.0, np.zeros(3))
    dataset = silhouettes(spheres, poses, Intrinsics.from_angle_x(160, 160, 0.8))
    lower, upper = np.array(tighten(dataset, LOWER, UPPER))
    least = (spheres[:, :3] - spheres[:, 3:]).min(axis=0)
    most = (spheres[:, :3] + spheres[:, 3:]).max(axis=0)
    assert (lower <= least).all() and (most <= upper).all()
    assert (lower >= LOWER).all() and (upper <= UPPER).all()
    assert (least - lower < 0.3).all() and (upper - most < 0.3).all()


def test_an_empty_hull_keeps_the_box() -> None:
    poses = cameras(np.random.default_rng(9), 12, 6.0, np.zeros(3))
    dataset = silhouettes(np.zeros((0, 4)), poses, Intrinsics.from_angle_x(60, 60, 0.8))
    assert not carve(dataset, LOWER, UPPER, 16).any()
    assert tighten(dataset, LOWER, UPPER) == (LOWER, UPPER)
