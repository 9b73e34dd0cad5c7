"""Camera positions: on the sphere, evenly spread, the same for a seed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerf.generation.viewpoints import around, forward, horizontal_axes, unit_square

AXES = [np.array(v, float) for v in ((1, 0, 0), (0, 1, 0), (0, 0, 1), (0, -1, 0))]
axes = st.sampled_from(AXES)
numbers = st.floats(-5, 5)


@pytest.mark.slow
@given(
    st.integers(1, 40),
    st.sampled_from(["train", "val", "test"]),
    st.integers(0, 1 << 31),
    st.sampled_from(["hemisphere", "sphere"]),
    axes,
    st.tuples(numbers, numbers, numbers),
    st.floats(0.01, 100),
)
def test_cameras_stand_on_the_sphere_and_look_inwards(
    count: int, split: str, seed: int, cameras: str, up: np.ndarray, center: tuple, radius: float
) -> None:
    poses = around(
        count, split, seed, cameras=cameras, up=up, center=np.array(center), radius=radius
    )
    assert poses.shape == (count, 4, 4)
    rotation = poses[:, :3, :3]
    assert rotation.transpose(0, 2, 1) @ rotation == pytest.approx(
        np.broadcast_to(np.eye(3), (count, 3, 3)), abs=1e-9
    )
    assert np.linalg.det(rotation) == pytest.approx(1)
    offset = (poses[:, :3, 3] - center) / radius
    assert np.linalg.norm(offset, axis=1) == pytest.approx(1)
    assert rotation[:, :, 2] == pytest.approx(offset, abs=1e-9)  # backwards is outwards
    assert (rotation[:, :, 1] @ up > 0).all()  # upright
    if cameras == "hemisphere":
        assert (offset @ up > 0).all()


@given(st.floats(-80, 80), st.floats(0, 40), st.sampled_from(["hemisphere", "sphere"]))
def test_elevation_is_between_two_angles(low: float, more: float, cameras: str) -> None:
    """Whatever part of the sphere was asked for; the horizontal angle is as without."""
    high = min(low + more, 80.0)
    options = {"cameras": cameras, "up": AXES[1], "center": np.ones(3), "radius": 2.0}
    poses = around(30, "train", 3, **options, elevation=(low, high))
    offset = (poses[:, :3, 3] - 1) / 2
    angle = np.degrees(np.arcsin(offset @ AXES[1]))
    assert (angle >= low - 1e-6).all() and (angle <= high + 1e-6).all()
    assert np.ptp(angle) >= 0.8 * (high - low) - 1e-6
    side, front = horizontal_axes(AXES[1])
    free = (around(30, "train", 3, **options)[:, :3, 3] - 1) / 2
    turns = [np.arctan2(at @ front, at @ side) for at in (offset, free)]
    assert np.cos(turns[0] - turns[1]) == pytest.approx(1)


@given(st.integers(0, 1000), st.integers(1, 60))
def test_fewer_are_the_first_of_more(seed: int, count: int) -> None:
    more = unit_square(100, seed, 0)
    assert (unit_square(count, seed, 0) == more[:count]).all()
    assert ((more >= 0) & (more < 1)).all()


def test_seeds_and_splits_differ() -> None:
    options = {"cameras": "sphere", "up": AXES[2], "center": np.zeros(3), "radius": 4.0}
    sets = [around(5, s, seed, **options) for s in ("train", "val", "test") for seed in (0, 1)]
    for i in range(6):
        for j in range(i):
            assert np.abs(sets[i] - sets[j]).max(axis=(1, 2)).min() > 1e-3


@pytest.mark.parametrize("count", [25, 100, 479])
def test_area_is_covered_evenly(count: int) -> None:
    """By height, which is uniform on a sphere, and much more evenly than at random."""
    poses = around(count, "train", 3, cameras="sphere", up=AXES[2], center=np.zeros(3), radius=1.0)
    heights = np.sort(poses[:, 2, 3]) / 0.98
    discrepancy = np.abs((heights + 1) / 2 - (np.arange(count) + 0.5) / count).max()
    assert discrepancy < 4 / count
    d = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=-1)
    nearest = (d + 9 * np.eye(count)).min(axis=1)
    ideal = np.sqrt(8 * np.pi / np.sqrt(3) / count)  # hexagonal packing of the sphere
    assert nearest.min() > 0.35 * ideal


@pytest.mark.parametrize("up", AXES)
def test_horizontal_axes(up: np.ndarray) -> None:
    side, front = horizontal_axes(up)
    frame = np.stack([side, front, up], axis=1)
    assert frame.T @ frame == pytest.approx(np.eye(3))
    assert np.linalg.det(frame) == pytest.approx(1)


def test_forward_views_share_their_direction() -> None:
    pose = around(1, "train", 0, cameras="sphere", up=AXES[2], center=np.ones(3), radius=2.0)[0]
    poses = forward(30, 5, pose, 0.25)
    assert (poses[:, :3, :3] == pose[:3, :3]).all()
    offset = (poses[:, :3, 3] - pose[:3, 3]) @ pose[:3, :3]
    assert (np.abs(offset).max(axis=0) <= np.array([0.25, 0.25 * 2 / 3, 1e-12]) + 1e-12).all()
    assert np.ptp(offset[:, 0]) > 0.4 and np.ptp(offset[:, 1]) > 0.25
