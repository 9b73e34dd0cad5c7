"""Exact surfaces beside the images of a dataset, and images of either kind."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.cameras.pinhole import Intrinsics
from mi_nerf.cameras.poses import look_at
from mi_nerf.data import load_dataset
from mi_nerf.generation.output import poses_bounds
from tests.support.datasets import orbit_poses, random_images, write_blender_dataset, write_exr

ANGLE = 0.6


def write_views(folder: Path, n: int = 3, height: int = 9, width: int = 11) -> np.ndarray:
    """Pictures, radiance, distances and normals as ``generate`` writes them; the distances."""
    poses = orbit_poses(n)
    write_blender_dataset(folder, random_images(n, height, width), poses, ANGLE)
    rng = np.random.default_rng(0)
    distances = rng.uniform(1, 5, (n, height, width)).astype(np.float32)
    for i in range(n):
        write_geometry(folder / "train" / f"r_{i}", distances[i])
        radiance = rng.uniform(0, 30, (4, height, width)).astype(np.float32)
        write_exr(folder / "train" / f"r_{i}.exr", **dict(zip("RGBA", radiance, strict=True)))
    return distances


def write_geometry(stem: Path, distance: np.ndarray) -> None:
    write_exr(stem.with_name(stem.name + "_depth.exr"), Y=distance)
    normal = np.zeros((3, *distance.shape), np.float32)
    normal[2] = 1
    write_exr(stem.with_name(stem.name + "_normal.exr"), **dict(zip("RGB", normal, strict=True)))


# ---- Which pixels -----------------------------------------------------------------


@pytest.mark.parametrize("downscale", [1, 2, 3, 4])
def test_one_pixel_of_each_block_and_its_own_ray(downscale: int, tmp_path: Path) -> None:
    distances = write_views(tmp_path)
    dataset = load_dataset(tmp_path, "train", downscale=downscale)
    full = load_dataset(tmp_path, "train").intrinsics
    found = dataset.surfaces(1)
    assert found is not None
    height, width = 9 // downscale, 11 // downscale
    assert found.depth.shape == (height, width) and found.normal is not None
    for row in range(height):
        for column in range(width):
            y, x = downscale * row + downscale // 2, downscale * column + downscale // 2
            assert found.depth[row, column] == distances[1, y, x]
            right = (column + 0.5 - found.camera.cx) / found.camera.fx
            down = (row + 0.5 - found.camera.cy) / found.camera.fy
            assert right == pytest.approx((x + 0.5 - full.cx) / full.fx, abs=1e-12)
            assert down == pytest.approx((y + 0.5 - full.cy) / full.fy, abs=1e-12)


def test_surfaces_go_with_their_views(tmp_path: Path) -> None:
    distances = write_views(tmp_path)
    (tmp_path / "train" / "r_1_depth.exr").unlink()
    dataset = load_dataset(tmp_path, "train")
    some = dataset.subset([2, 1])
    assert some.surfaces(1) is None
    assert np.array_equal(some.surfaces(0).depth, distances[2])  # type: ignore[union-attr]


def test_distances_without_normals_and_nothing_at_all(tmp_path: Path) -> None:
    write_views(tmp_path, n=1)
    (tmp_path / "train" / "r_0_normal.exr").unlink()
    found = load_dataset(tmp_path, "train").surfaces(0)
    assert found is not None and found.normal is None
    (tmp_path / "train" / "r_0_depth.exr").unlink()
    assert load_dataset(tmp_path, "train").surfaces(0) is None


@pytest.mark.parametrize("end", ["depth", "normal"])
def test_surfaces_of_another_size(end: str, tmp_path: Path) -> None:
    write_views(tmp_path, n=1)
    small = np.full((4, 5), 1, np.float32)
    write_exr(tmp_path / "train" / f"r_0_{end}.exr", R=0 * small, G=0 * small, B=small, Y=small)
    dataset = load_dataset(tmp_path, "train")
    with pytest.raises(InputError, match=rf"r_0_{end}\.exr: expected 11x9 pixels .* got 5x4"):
        dataset.surfaces(0)


# ---- Which images -----------------------------------------------------------------


@pytest.mark.parametrize("listed", ["./train/r_{}", "train/r_{}.png", "train/r_{}.exr"])
def test_either_kind_of_image(listed: str, tmp_path: Path) -> None:
    write_views(tmp_path)
    file = tmp_path / "transforms_train.json"
    meta = json.loads(file.read_text())
    for i, frame in enumerate(meta["frames"]):
        frame["file_path"] = listed.format(i)
    file.write_text(json.dumps(meta))
    radiance = load_dataset(tmp_path, "train", images="exr")
    assert radiance.color_space == "linear" and radiance.images.dtype == np.float32
    assert radiance.images.max() > 29 and radiance.names == ("r_0", "r_1", "r_2")
    pictures = load_dataset(tmp_path, "train", images="png")
    assert pictures.color_space == "srgb" and pictures.images.dtype == np.uint8
    named = load_dataset(tmp_path, "train")
    assert named.color_space == ("linear" if listed.endswith(".exr") else "srgb")
    for dataset in (radiance, pictures, named):
        assert dataset.surfaces(2) is not None


def test_names_with_dots(tmp_path: Path) -> None:
    write_views(tmp_path, n=1)
    for file in (tmp_path / "train").iterdir():
        file.rename(file.with_name(file.name.replace("r_0", "r.0")))
    file = tmp_path / "transforms_train.json"
    file.write_text(file.read_text().replace("r_0", "r.0"))
    dataset = load_dataset(tmp_path, "train", images="exr")
    assert dataset.names == ("r.0",) and dataset.surfaces(0) is not None


@pytest.mark.parametrize("kind", ["exr", "png"])
def test_images_of_a_kind_that_are_not_there(kind: Any, tmp_path: Path) -> None:
    write_views(tmp_path, n=2)
    (tmp_path / "train" / f"r_1.{kind}").unlink()
    message = rf"r_1\.{kind}: no such image, expected by images='{kind}'"
    with pytest.raises(InputError, match=message):
        load_dataset(tmp_path, "train", images=kind)
    with pytest.raises(InputError, match="images='jpg': expected png or exr"):
        load_dataset(tmp_path, "train", images="jpg")  # type: ignore[arg-type]


def test_radiance_of_another_size(tmp_path: Path) -> None:
    write_views(tmp_path, n=2)
    small = np.full((4, 5), 1, np.float32)
    write_exr(tmp_path / "train" / "r_1.exr", R=small, G=small, B=small)
    with pytest.raises(InputError, match=r"agree in size: .*r_0\.exr is 11x9, .*r_1\.exr is 5x4"):
        load_dataset(tmp_path, "train", images="exr")


# ---- Forward-facing captures -------------------------------------------------------


@pytest.fixture
def forward(tmp_path: Path) -> Path:
    """A capture as ``generate`` writes it: views 0, 8, … test, the files of either in order."""
    poses = np.stack(
        [look_at((0.1 * i, 0.02 * i, 4), (0.1 * i, 0, 0), (0, 1, 0)) for i in range(9)]
    )
    camera = Intrinsics.from_angle_x(12, 8, ANGLE)
    bounds = np.tile((2.0, 6.0), (9, 1))
    np.save(tmp_path / "poses_bounds.npy", poses_bounds(poses, camera, bounds))
    images = random_images(9, 8, 12)
    (tmp_path / "images").mkdir()
    for split, members in (("test", [0, 8]), ("train", list(range(1, 8)))):
        write_blender_dataset(tmp_path, images[members], poses[members], ANGLE, split)
        for k, i in enumerate(members):
            stem = tmp_path / split / f"r_{k}"
            light = np.full((8, 12), 10.0 + i, np.float32)
            write_exr(stem.with_suffix(".exr"), R=light, G=light, B=light, A=light / light)
            write_geometry(stem, np.full((8, 12), 3.0 + i, np.float32))
            shutil.copy(stem.with_suffix(".png"), tmp_path / "images" / f"view_{i:03d}.png")
    return tmp_path


@pytest.mark.parametrize("images", [None, "png", "exr"])
def test_forward_captures_know_radiance_and_distances(forward: Path, images: Any) -> None:
    dataset = load_dataset(forward, "train", images=images)
    assert dataset.ndc is not None
    assert dataset.names == tuple(f"view_{i:03d}" for i in range(1, 8))
    assert dataset.color_space == ("linear" if images == "exr" else "srgb")
    if images == "exr":
        assert dataset.images[:, 0, 0, 0].tolist() == [10.0 + i for i in range(1, 8)]
    for k in range(7):
        found = dataset.surfaces(k)
        assert found is not None and found.normal is None
        # Lengths are divided by three quarters of the smallest near depth.
        assert found.depth == pytest.approx((3.0 + k + 1) / (0.75 * 2.0), rel=1e-6)


def test_radiance_in_the_folder_of_images(forward: Path) -> None:
    light = np.full((8, 12), 3.0, np.float32)
    for i in range(9):
        write_exr(forward / "images" / f"view_{i:03d}.exr", R=light, G=light, B=light)
    dataset = load_dataset(forward, "test", images="exr")
    assert dataset.names == ("view_000", "view_008")
    assert np.all(dataset.images[..., :3] == 3)


def test_forward_captures_without_radiance(forward: Path) -> None:
    for file in forward.glob("transforms_*.json"):
        file.unlink()
    with pytest.raises(InputError, match="images: no OpenEXR images in it, expected by images='ex"):
        load_dataset(forward, "train", images="exr")
    assert load_dataset(forward, "train").surfaces(0) is None
    (forward / "transforms_train.json").write_text("damaged")
    assert load_dataset(forward, "train").surfaces(0) is None
