"""Camera paths around what given cameras look at, against geometry."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mi_nerf.cameras.trajectory import look_center, orbit, orbit_like, spiral_like
from mi_nerf.data import load_dataset
from tests.support.datasets import orbit_poses


def assert_looks_at(poses: np.ndarray, center: np.ndarray, up: np.ndarray) -> None:
    """Rigid, upright OpenGL poses with ``center`` in the middle of the picture."""
    for pose in poses:
        rotation = pose[:3, :3]
        assert rotation.T @ rotation == pytest.approx(np.eye(3), abs=1e-9)
        assert np.linalg.det(rotation) == pytest.approx(1)
        assert pose[3].tolist() == [0, 0, 0, 1]
        ahead = center - pose[:3, 3]
        assert -rotation[:, 2] == pytest.approx(ahead / np.linalg.norm(ahead), abs=1e-9)
        assert rotation[:, 1] @ up > 0
        assert rotation[:, 0] @ up == pytest.approx(0, abs=1e-9)  # a level horizon


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (1, 0, 0)])
@pytest.mark.parametrize("height", [-0.6, 0.0, 0.8])
def test_orbit(up: tuple[int, int, int], height: float) -> None:
    center, axis = np.array([1.0, -2.0, 3.0]), np.array(up, float)
    poses = orbit(center, axis, 2.5, height, 12)
    assert poses.shape == (12, 4, 4)
    assert_looks_at(poses, center, axis)
    offset = poses[:, :3, 3] - center
    assert np.linalg.norm(offset, axis=1) == pytest.approx(np.full(12, 2.5))
    assert offset @ axis == pytest.approx(np.full(12, 2.5 * height))
    steps = np.linalg.norm(np.roll(offset, -1, axis=0) - offset, axis=1)
    assert steps == pytest.approx(np.full(12, steps[0]))  # even, and once around


@pytest.mark.parametrize("up", [0, 1, 2])
def test_orbit_like_given_cameras(up: int) -> None:
    """The circle of the cameras themselves, whichever axis points up."""
    shift = np.array([0.5, 0.2, -0.3])
    poses = orbit_poses(7, radius=3.0, height=1.2)
    order = np.roll(np.eye(4)[[2, 0, 1, 3]], 0, axis=0) if up == 0 else np.eye(4)
    if up == 1:
        order = np.eye(4)[[1, 2, 0, 3]]
    poses = order @ poses
    poses[:, :3, 3] += shift
    axis = order[:3, 2]
    assert look_center(poses) == pytest.approx(shift, abs=1e-4)
    found = orbit_like(poses, 9)
    assert_looks_at(found, look_center(poses), axis)
    offset = found[:, :3, 3] - shift
    assert np.linalg.norm(offset, axis=1) == pytest.approx(np.full(9, np.hypot(3.0, 1.2)), abs=1e-3)
    assert offset @ axis == pytest.approx(np.full(9, 1.2), abs=1e-3)


def test_spiral_rises_in_two_turns() -> None:
    poses = np.concatenate([orbit_poses(9, 3.0, h) for h in (0.2, 1.0, 2.0)])
    poses[:, :3, 3] *= 3 / np.linalg.norm(poses[:, :3, 3], axis=1, keepdims=True)
    found = spiral_like(poses, 40)
    center = look_center(poses)
    assert center == pytest.approx(np.zeros(3), abs=1e-4)
    assert_looks_at(found, center, np.array([0.0, 0.0, 1.0]))
    assert np.linalg.norm(found[:, :3, 3] - center, axis=1) == pytest.approx(np.full(40, 3.0))
    heights = found[:, 2, 3]
    assert (np.diff(heights) > 0).all()
    assert poses[:, 2, 3].min() - 1e-3 <= heights[0] < heights[-1] <= poses[:, 2, 3].max() + 1e-3
    angles = np.unwrap(np.arctan2(found[:, 1, 3], found[:, 0, 3]))
    assert abs(angles[-1] - angles[0]) == pytest.approx(4 * np.pi * 39 / 40)


@pytest.mark.parametrize("path", [orbit_like, spiral_like])
def test_paths_around_two_cameras(path: Callable[..., np.ndarray]) -> None:
    """Two axes meet in the point that both cameras look at, which is the paths' centre."""
    poses = orbit_poses(3, radius=3.0, height=1.2)[:2]
    assert look_center(poses) == pytest.approx(np.zeros(3), abs=1e-5)
    assert_looks_at(path(poses, 5), look_center(poses), np.array([0.0, 0.0, 1.0]))
    distance = np.linalg.norm(path(poses, 5)[:, :3, 3], axis=1)
    assert distance == pytest.approx(np.full(5, np.hypot(3.0, 1.2)), abs=1e-4)


@pytest.mark.parametrize("path", [orbit_like, spiral_like])
def test_a_path_around_one_camera_turns_on_the_spot(path: Callable[..., np.ndarray]) -> None:
    """Nothing tells how far away the thing is that the camera looks at."""
    (pose,) = orbit_poses(1)
    found = path(pose[None], 5)
    assert found[:, :3, 3] == pytest.approx(np.tile(pose[:3, 3], (5, 1)), abs=1e-6)
    for turned in found[:, :3, :3]:
        assert turned.T @ turned == pytest.approx(np.eye(3), abs=1e-9)
        assert turned[:, 1] @ [0, 0, 1] > 0


def test_one_frame(blob: Path) -> None:
    poses = load_dataset(blob, "train").cam_to_world
    assert orbit_like(poses, 1).shape == spiral_like(poses, 1).shape == (1, 4, 4)
