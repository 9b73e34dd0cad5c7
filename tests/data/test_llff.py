"""The reader of forward-facing captures, on tiny synthetic folders."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.cameras.pinhole import Intrinsics, project
from mi_nerf.cameras.poses import average_pose
from mi_nerf.data import available_splits, load_dataset
from mi_nerf.generation.output import poses_bounds
from tests.support.datasets import (
    forward_poses,
    orbit_poses,
    random_images,
    write_blender_dataset,
    write_llff_dataset,
)

FOCAL = 60.0


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """18 views of 24x16 pixels, of films of 48x32."""
    images = random_images(18, 16, 24, 3)
    return write_llff_dataset(tmp_path / "capture", images, forward_poses(18), FOCAL, reduced=2)


def edit(folder: Path, change: Callable[[np.ndarray], object]) -> None:
    """Rewrites the array after ``change`` has altered it in place."""
    rows = np.load(folder / "poses_bounds.npy")
    change(rows)
    np.save(folder / "poses_bounds.npy", rows)


# ---- What is read ------------------------------------------------------------


def test_every_eighth_view_is_for_testing(capture: Path) -> None:
    assert available_splits(capture) == ("train", "test")
    train, test = (load_dataset(capture, split) for split in ("train", "test"))
    assert test.names == ("IMG_0000", "IMG_0008", "IMG_0016")
    assert set(train.names) | set(test.names) == {f"IMG_{i:04d}" for i in range(18)}
    assert len(train) == 15 and train.split == "train" and not train.has_alpha
    expected = random_images(18, 16, 24, 3)[::8] / 255
    assert np.allclose(test.premultiplied()[..., :3], expected, atol=1e-6)
    limited = load_dataset(capture, "test", limit=2)
    assert limited.names == ("IMG_0000", "IMG_0008")
    assert np.array_equal(limited.cam_to_world, test.cam_to_world[:2])


def test_cameras_follow_the_size_of_the_images(capture: Path) -> None:
    camera = load_dataset(capture, "train").intrinsics
    assert camera == Intrinsics(24, 16, FOCAL / 2, FOCAL / 2, 12.0, 8.0)
    smaller = load_dataset(capture, "train", downscale=3)
    assert smaller.intrinsics == camera.downscale(3)
    assert smaller.images.shape == (15, 5, 8, 4)
    # Cropping a remainder does not change the space in which fields are trained.
    assert smaller.ndc == load_dataset(capture, "train").ndc
    assert smaller.box == load_dataset(capture, "train").box


def test_the_frame_of_the_average_camera(capture: Path) -> None:
    """Up to one similarity for all, the poses are those that were written."""
    given = forward_poses(18)
    train, test = (load_dataset(capture, split) for split in ("train", "test"))
    poses = np.empty_like(given)
    poses[::8] = test.cam_to_world
    poses[[i for i in range(18) if i % 8]] = train.cam_to_world
    scale = 1 / (0.75 * 2.0)
    assert train.near == pytest.approx(4 / 3) and train.far == pytest.approx(20 * scale)
    assert np.allclose(average_pose(poses), np.eye(4), atol=1e-12)
    moved = given.copy()
    moved[:, :3, 3] *= scale
    similarity = poses[0] @ np.linalg.inv(moved[0])
    assert np.allclose(similarity @ moved, poses, atol=1e-12)
    assert np.allclose(similarity[:3, :3] @ similarity[:3, :3].T, np.eye(3), atol=1e-12)


def test_the_average_of_mirrored_poses() -> None:
    """Two cameras that lean to either side: the average is upright, between them."""
    angle = 0.3
    turn = np.eye(4)
    turn[0, 0] = turn[2, 2] = np.cos(angle)
    turn[0, 2] = np.sin(angle)
    turn[2, 0] = -np.sin(angle)
    other = turn.T.copy()
    turn[:3, 3], other[:3, 3] = (1, 2, 3), (-1, 2, 5)
    expected = np.eye(4)
    expected[:3, 3] = (0, 2, 4)
    assert np.allclose(average_pose(np.stack([turn, other])), expected)


def test_the_box_holds_what_all_views_see(capture: Path) -> None:
    """Points on the rays of all pixels project into the box, and come close to its faces."""
    dataset = load_dataset(capture, "train")
    assert dataset.ndc is not None and dataset.box is not None
    lower, upper = np.array(dataset.box)
    film = dataset.intrinsics
    seen = []
    for split in ("train", "test"):
        for pose in load_dataset(capture, split).cam_to_world:
            x, y = np.meshgrid([0, film.width], [0, film.height])
            local = np.stack([(x - film.cx) / film.fx, (film.cy - y) / film.fy, 0 * x - 1], -1)
            d = local.reshape(-1, 3) @ pose[:3, :3].T
            for z in (-1.0, -1.5, -4.0, -1e6):
                seen.append(pose[:3, 3] + (z - pose[2, 3]) / d[:, 2:] * d)
    points = np.concatenate(seen)
    clip = np.c_[points, np.ones(len(points))] @ dataset.ndc.matrix().T
    ndc = clip[:, :3] / clip[:, 3:]
    assert (ndc >= lower - 1e-9).all() and (ndc <= upper + 1e-9).all()
    assert np.allclose(ndc.min(axis=0), lower, atol=1e-5)
    assert np.allclose(ndc.max(axis=0), upper, atol=1e-5)


def test_what_generate_writes(tmp_path: Path) -> None:
    """Its rows mean the same poses as those of the tests."""
    poses = forward_poses(9)
    images = random_images(9, 8, 8, 3)
    folder = write_llff_dataset(tmp_path, images, poses, FOCAL)
    rows = poses_bounds(poses, Intrinsics(8, 8, FOCAL, FOCAL, 4, 4), np.tile((2.0, 20.0), (9, 1)))
    assert np.allclose(np.load(folder / "poses_bounds.npy"), rows)


def test_llff_wins_over_transforms(capture: Path) -> None:
    """A folder in both layouts is a forward-facing capture."""
    poses = orbit_poses(2)
    write_blender_dataset(capture, random_images(2, 16, 24, 3), poses, 0.6, "train")
    assert load_dataset(capture, "train").ndc is not None
    assert available_splits(capture) == ("train", "test")


@pytest.mark.parametrize(
    ("folders", "read"),
    [(["images", "images_4"], "images"), (["images_16", "images_4", "images_x"], "images_4")],
)
def test_which_images_are_read(folders: list[str], read: str, tmp_path: Path) -> None:
    poses = forward_poses(3)
    for i, name in enumerate(folders):
        images = random_images(3, 8, 12, 3, seed=i)
        write_llff_dataset(tmp_path, images, poses, FOCAL, subfolder=name)
    (tmp_path / read / "notes.txt").write_text("not an image")
    expected = random_images(3, 8, 12, 3, seed=folders.index(read))
    assert np.allclose(load_dataset(tmp_path, "test").image(0)[..., :3], expected[0] / 255)


# ---- What is refused ---------------------------------------------------------


def refusal(folder: Path, split: str = "train", **options: int) -> str:
    """The message, one line, with which a capture is refused."""
    with pytest.raises(InputError) as caught:
        load_dataset(folder, split, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows[3].fill(np.nan), "row 3: expected finite numbers"),
        (lambda rows: rows[2].__setitem__(15, 0), "row 2: expected depths 0 < near < far"),
        (lambda rows: rows[2].__setitem__(16, 1), "row 2: .* got 2 and 1"),
        (lambda rows: rows[1].__setitem__(0, 5), "row 1: expected a rotation"),
        (lambda rows: rows[5].__setitem__(14, 61), "row 5: expected the camera of row 0"),
        (lambda rows: rows[:, 14].fill(-1), "fx must be positive"),
        (lambda rows: rows[:, 4].fill(31.5), "height must be a whole number"),
        (lambda rows: rows[:, 4].fill(64), "proportions of 48x64, they are 24x16"),
    ],
)
def test_broken_rows(change: Callable[[np.ndarray], object], message: str, capture: Path) -> None:
    edit(capture, change)
    text = refusal(capture)
    assert "poses_bounds.npy" in text and re.search(message, text)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (np.zeros((4, 15)), r"shape \(N, 17\), got \(4, 15\)"),
        (np.zeros((0, 17)), r"shape \(N, 17\), got \(0, 17\)"),
        (np.array(["a"]), "expected an array of numbers"),
        (np.array([None]), "expected a NumPy array"),
        (b"\x93NUMPY", "expected a NumPy array"),
        (b"", "expected a NumPy array"),
    ],
)
def test_other_arrays(content: np.ndarray | bytes, message: str, capture: Path) -> None:
    file = capture / "poses_bounds.npy"
    if isinstance(content, bytes):
        file.write_bytes(content)
    else:
        np.save(file, content, allow_pickle=True)
    assert re.search(message, refusal(capture))


def test_missing_images(capture: Path) -> None:
    (capture / "images" / "IMG_0003.png").unlink()
    assert "expected 18 images" in refusal(capture) and "got 17" in refusal(capture)
    (capture / "images").rename(capture / "pictures")
    assert "expected a folder images or images_K" in refusal(capture)


def test_splits_and_scales_that_there_are_not(capture: Path, tmp_path: Path) -> None:
    assert "no split 'val', expected train or test" in refusal(capture, "val")
    assert "downscale must be" in refusal(capture, downscale=0)
    assert "downscale 17 leaves no pixel" in refusal(capture, downscale=17)
    one = write_llff_dataset(tmp_path / "one", random_images(1, 8, 8, 3), forward_poses(1), FOCAL)
    assert "expected at least 2 views" in refusal(one)


def test_captures_that_do_not_face_forward(tmp_path: Path) -> None:
    around = write_llff_dataset(
        tmp_path / "around", random_images(8, 8, 8, 3), orbit_poses(8), FOCAL
    )
    assert "expected a forward-facing capture" in refusal(around)
    # One corner of one film suffices: the axis of the last view is within 90 degrees.
    poses = forward_poses(9, spread=0.0)
    angle = np.radians(88)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0]])
    poses[8, :3, :3] = np.vstack([turn, [0, 0, 1]]) @ poses[8, :3, :3]
    leaning = write_llff_dataset(tmp_path / "leaning", random_images(9, 8, 8, 3), poses, 8.0)
    message = refusal(leaning)
    assert "view IMG_0008 sees" in message and "expected less than 90" in message


# ---- A capture of a real scene -----------------------------------------------


@pytest.mark.data
@pytest.mark.skipif("MI_NERF_DATA" not in os.environ, reason="needs the datasets")
def test_fern() -> None:
    """The published capture: its near plane is before all that is seen, its poses look ahead."""
    folder = Path(os.environ["MI_NERF_DATA"]) / "fern_8"
    train, test = (load_dataset(folder, split, downscale=2) for split in ("train", "test"))
    assert (len(train), len(test)) == (17, 3)
    assert train.images.shape == (17, 189, 252, 4) and train.color_space == "srgb"
    assert test.names == ("image000", "image008", "image016")
    center = np.array([0, 0, -3.0])
    for pose in train.cam_to_world:
        pixel, depth = project(center, train.intrinsics, pose)
        assert depth > 2 and (pixel > 0).all() and (pixel < (252, 189)).all()
