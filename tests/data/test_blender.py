"""The dataset readers on tiny synthetic folders."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image

from mi_nerf.base.errors import InputError
from mi_nerf.cameras.pinhole import Intrinsics
from mi_nerf.cameras.poses import mitsuba_from_opengl
from mi_nerf.data import Dataset, available_splits, evenly_spread_indices, load_dataset
from mi_nerf.images.read import average_blocks, read_image
from mi_nerf.images.stored import premultiplied
from tests.support.datasets import orbit_poses, random_images, write_blender_dataset, write_exr

ANGLE = 0.8


def slow_premultiplied(images: np.ndarray) -> np.ndarray:
    """Straight integer RGBA to premultiplied float64."""
    straight = images / float(np.iinfo(images.dtype).max)
    return np.concatenate([straight[..., :3] * straight[..., 3:], straight[..., 3:]], axis=-1)


def slow_block_means(image: np.ndarray, k: int) -> np.ndarray:
    height, width = image.shape[0] // k, image.shape[1] // k
    means = np.empty((height, width, image.shape[2]))
    for i in range(height):
        for j in range(width):
            means[i, j] = image[k * i : k * i + k, k * j : k * j + k].mean(axis=(0, 1))
    return means


def edit_json(file: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Rewrites a JSON file after ``change`` has altered its content in place."""
    meta = json.loads(file.read_text())
    change(meta)
    file.write_text(json.dumps(meta))


def list_files(folder: Path, paths: list[str]) -> None:
    """Makes ``paths`` the files of the training frames."""

    def change(meta: dict[str, Any]) -> None:
        for frame, path in zip(meta["frames"], paths, strict=True):
            frame["file_path"] = path

    edit_json(folder / "transforms_train.json", change)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A valid dataset: three 6x5 training views."""
    write_blender_dataset(tmp_path, random_images(3, 5, 6), orbit_poses(3), ANGLE)
    return tmp_path


# ---- What is read ------------------------------------------------------------


def test_values(tmp_path: Path) -> None:
    images, poses = random_images(4, 5, 6), orbit_poses(4)
    write_blender_dataset(tmp_path, images, poses, ANGLE, "val")
    dataset = load_dataset(tmp_path, "val")
    assert (dataset.path, dataset.split, len(dataset)) == (tmp_path, "val", 4)
    assert dataset.names == ("r_0", "r_1", "r_2", "r_3")
    assert dataset.images.dtype == np.uint8 and np.array_equal(dataset.images, images)
    assert dataset.premultiplied() == pytest.approx(slow_premultiplied(images), abs=1e-7)
    assert (dataset.color_space, dataset.has_alpha) == ("srgb", True)
    assert np.array_equal(dataset.cam_to_world, poses)
    assert dataset.intrinsics == Intrinsics.from_angle_x(6, 5, ANGLE)
    assert (dataset.near, dataset.far, dataset.box) == (None, None, None)


def test_opaque_pixels_are_exact(tmp_path: Path) -> None:
    images = random_images(1, 16, 16)
    images[..., 3] = 255
    write_blender_dataset(tmp_path, images, orbit_poses(1), ANGLE)
    expected = images[..., :3].astype(np.float32) / np.float32(255)
    assert np.array_equal(load_dataset(tmp_path, "train").composited(), expected)


def test_rgb_images_are_opaque(tmp_path: Path) -> None:
    images = random_images(2, 5, 6, channels=3)
    write_blender_dataset(tmp_path, images, orbit_poses(2), ANGLE)
    dataset = load_dataset(tmp_path, "train")
    assert not dataset.has_alpha
    assert (dataset.premultiplied()[..., 3] == 1).all()
    assert dataset.premultiplied()[..., :3] == pytest.approx(images / 255, abs=1e-7)


def test_images_of_the_split_may_differ_in_alpha(scene: Path) -> None:
    Image.fromarray(random_images(1, 5, 6, channels=3)[0]).save(scene / "train" / "r_0.png")
    dataset = load_dataset(scene, "train")
    assert dataset.has_alpha
    assert (dataset.image(0)[..., 3] == 1).all()
    assert (dataset.image(1)[..., 3] < 1).any()


@pytest.mark.parametrize("channels", [3, 4])
def test_16_bit_png(tmp_path: Path, channels: int) -> None:
    mi = pytest.importorskip("mitsuba")  # an encoder that has nothing to do with Pillow
    rng = np.random.default_rng(0)
    smooth = np.cumsum(rng.integers(0, 3000, (9, 13, channels)), axis=1)  # uses all row filters
    values = np.clip(smooth, 0, 65535).astype(np.uint16)
    bitmap = mi.Bitmap(values)
    bitmap.set_srgb_gamma(True)
    bitmap.write(str(tmp_path / "image.png"))
    image = read_image(tmp_path / "image.png")
    if channels == 3:
        values = np.concatenate([values, np.full((9, 13, 1), 65535, np.uint16)], axis=-1)
    assert image.has_alpha == (channels == 4)
    assert image.pixels.dtype == np.uint16
    assert premultiplied(image.pixels) == pytest.approx(slow_premultiplied(values), abs=2e-7)


def test_palettes(tmp_path: Path) -> None:
    colors = random_images(1, 4, 4, channels=3)[0] // 64 * 64
    picture = Image.fromarray(colors).quantize(64)
    picture.save(tmp_path / "opaque.png")
    picture.save(tmp_path / "key.png", transparency=int(np.asarray(picture)[1, 2]))
    opaque, key = read_image(tmp_path / "opaque.png"), read_image(tmp_path / "key.png")
    assert not opaque.has_alpha and key.has_alpha
    assert np.array_equal(opaque.pixels[..., :3], np.asarray(picture.convert("RGB")))
    assert (premultiplied(key.pixels)[1, 2] == 0).all()
    assert key.pixels[..., 3].max() == 255


def test_exr_is_linear_and_already_premultiplied(scene: Path) -> None:
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0, 20, (3, 5, 6, 4)).astype(np.float32)
    for i, image in enumerate(pixels):
        planes = {name: np.ascontiguousarray(image[..., c]) for c, name in enumerate("RGBA")}
        write_exr(scene / "train" / f"r_{i}.exr", **planes, depth=planes["R"])
    edit_json(
        scene / "transforms_train.json",
        lambda meta: [
            frame.update(file_path=frame["file_path"] + ".exr") for frame in meta["frames"]
        ],
    )
    dataset = load_dataset(scene, "train")
    assert (dataset.color_space, dataset.has_alpha) == ("linear", True)
    assert dataset.names == ("r_0", "r_1", "r_2")
    assert np.array_equal(dataset.images, pixels)


def test_exr_half_precision_without_alpha(tmp_path: Path) -> None:
    plane = np.linspace(0, 4, 30).reshape(5, 6).astype(np.float16)
    write_exr(tmp_path / "image.exr", R=plane, G=2 * plane, B=3 * plane)
    image = read_image(tmp_path / "image.exr")
    assert not image.has_alpha
    assert image.pixels.dtype == np.float16
    assert np.array_equal(image.pixels[..., 1], 2 * plane)
    assert (image.pixels[..., 3] == 1).all()


@pytest.mark.parametrize(
    ("stored", "listed"),
    [
        ("train/view.png", "train/view"),
        ("train/view.png", "./train/view.png"),
        ("train/view.1.png", "train/view.1"),
        ("view.PNG", "view.PNG"),
    ],
)
def test_extensions(tmp_path: Path, stored: str, listed: str) -> None:
    write_blender_dataset(tmp_path, random_images(1, 5, 6), orbit_poses(1), ANGLE)
    (tmp_path / "train" / "r_0.png").rename(tmp_path / stored)
    list_files(tmp_path, [listed])
    assert load_dataset(tmp_path, "train").names == (Path(stored).stem,)


def test_names_of_images_in_several_folders(scene: Path) -> None:
    (scene / "more").mkdir()
    (scene / "train" / "r_1.png").rename(scene / "more" / "r_0.png")
    list_files(scene, ["train/r_0", "more/r_0", "train/r_2"])
    assert load_dataset(scene, "train").names == ("train_r_0", "more_r_0", "r_2")


def test_optional_keys(tmp_path: Path) -> None:
    write_blender_dataset(
        tmp_path,
        random_images(1, 5, 6),
        orbit_poses(1),
        ANGLE,
        near=2,
        far=6.5,
        aabb=[[-1, -2, -3], [1, 2, 3.5]],
        aabb_scale=4,
    )
    dataset = load_dataset(tmp_path, "train")
    assert (dataset.near, dataset.far) == (2.0, 6.5)
    assert dataset.box == ((-1, -2, -3), (1, 2, 3.5))


def test_focal_length_in_pixels(scene: Path) -> None:
    file = scene / "transforms_train.json"
    edit_json(file, lambda meta: meta.update(fl_x=7.0))
    assert load_dataset(scene, "train").intrinsics == Intrinsics(6, 5, 7.0, 7.0, 3.0, 2.5)
    edit_json(file, lambda meta: meta.update(fl_y=8.0, cx=2.0, cy=1.5, w=6, h=5.0, k1=0.0))
    edit_json(file, lambda meta: meta.pop("camera_angle_x"))
    assert load_dataset(scene, "train").intrinsics == Intrinsics(6, 5, 7.0, 8.0, 2.0, 1.5)


def test_poses_in_mitsuba_axes(tmp_path: Path) -> None:
    poses = orbit_poses(2)
    write_blender_dataset(
        tmp_path, random_images(2, 5, 6), mitsuba_from_opengl(poses), ANGLE, from_mitsuba=True
    )
    assert np.array_equal(load_dataset(tmp_path, "train").cam_to_world, poses)


def test_available_splits(tmp_path: Path) -> None:
    for split in ("test", "extra", "train"):
        write_blender_dataset(tmp_path, random_images(1, 2, 2), orbit_poses(1), ANGLE, split)
    assert available_splits(tmp_path) == ("train", "test", "extra")


# ---- Downscaling ---------------------------------------------------------------


@pytest.mark.slow
@given(
    image=arrays(
        np.float32,
        st.tuples(*[st.integers(1, 12)] * 2, st.just(4)),
        elements=st.floats(0, 4, width=32),
    ),
    data=st.data(),
)
def test_average_blocks_against_slow_means(image: np.ndarray, data: st.DataObject) -> None:
    k = data.draw(st.integers(1, min(image.shape[:2])))
    means = average_blocks(image, k)
    assert means.dtype == np.float32
    assert means == pytest.approx(
        slow_block_means(image.astype(np.float64), k), rel=1e-5, abs=1e-30
    )


def test_downscale_averages_premultiplied_and_crops(tmp_path: Path) -> None:
    images = random_images(2, 7, 9)
    write_blender_dataset(tmp_path, images, orbit_poses(2), ANGLE)
    dataset = load_dataset(tmp_path, "train", downscale=2)
    expected = [slow_block_means(image, 2) for image in slow_premultiplied(images)]
    assert dataset.premultiplied() == pytest.approx(np.stack(expected), abs=1e-6)
    assert dataset.intrinsics == Intrinsics.from_angle_x(9, 7, ANGLE).downscale(2)
    assert (dataset.intrinsics.width, dataset.intrinsics.height) == (4, 3)


def test_one_pixel_is_enough(tmp_path: Path) -> None:
    write_blender_dataset(tmp_path, random_images(1, 3, 3), orbit_poses(1), ANGLE)
    assert load_dataset(tmp_path, "train", downscale=3).images.shape == (1, 1, 1, 4)


# ---- Choosing views --------------------------------------------------------------


@given(count=st.integers(1, 300), n=st.integers(1, 320))
def test_evenly_spread_indices(count: int, n: int) -> None:
    indices = evenly_spread_indices(count, n)
    assert len(indices) == min(n, count)
    assert indices[0] == 0 and indices[-1] < count
    steps = np.diff(indices)
    assert not len(steps) or steps.min() >= 1
    assert not len(steps) or steps.max() - steps.min() <= 1
    assert indices == [math.floor(i * count / len(indices) + 1e-9) for i in range(len(indices))]


def test_subset_and_evenly_spread(tmp_path: Path) -> None:
    write_blender_dataset(tmp_path, random_images(5, 2, 3), orbit_poses(5), ANGLE, near=1)
    dataset = load_dataset(tmp_path, "train")
    some = dataset.subset([3, 1])
    assert some.names == ("r_3", "r_1")
    assert np.array_equal(some.images, dataset.images[[3, 1]])
    assert np.array_equal(some.cam_to_world, dataset.cam_to_world[[3, 1]])
    assert (some.near, some.intrinsics) == (1, dataset.intrinsics)
    assert dataset.evenly_spread(3).names == ("r_0", "r_1", "r_3")
    assert dataset.evenly_spread(9).names == dataset.names
    with pytest.raises(IndexError):
        dataset.subset([5])
    with pytest.raises(InputError, match="number of views"):
        dataset.evenly_spread(0)


def test_limit_reads_only_the_views_it_keeps(tmp_path: Path) -> None:
    write_blender_dataset(tmp_path, random_images(5, 2, 3), orbit_poses(5), ANGLE)
    spread = load_dataset(tmp_path, "train").evenly_spread(2)
    (tmp_path / "train" / "r_1.png").unlink()
    limited = load_dataset(tmp_path, "train", limit=2)
    assert limited.names == spread.names == ("r_0", "r_2")
    assert np.array_equal(limited.images, spread.images)
    assert np.array_equal(limited.cam_to_world, spread.cam_to_world)
    with pytest.raises(InputError, match="number of views"):
        load_dataset(tmp_path, "train", limit=0)


def test_progress(scene: Path) -> None:
    calls: list[tuple[int, int]] = []
    load_dataset(scene, "train", progress=lambda done, total: calls.append((done, total)))
    assert calls == [(1, 3), (2, 3), (3, 3)]


# ---- Compositing -------------------------------------------------------------------


@pytest.mark.parametrize("background", [1.0, 0.0, (0.2, 0.4, 0.8)])
def test_composited(scene: Path, background: Any) -> None:
    dataset = load_dataset(scene, "train")
    images = random_images(3, 5, 6) / 255
    rgb, alpha = images[..., :3], images[..., 3:]
    expected = rgb * alpha + (1 - alpha) * np.array(background)
    composited = dataset.composited(background)
    assert composited.dtype == np.float32
    assert composited == pytest.approx(expected, abs=3e-7)


def test_fields_must_agree(scene: Path) -> None:
    good = load_dataset(scene, "train")
    fields = {name: getattr(good, name) for name in good.__dataclass_fields__}
    Dataset(**fields)
    for change in (
        {"names": ("a", "b")},
        {"images": good.images[..., :3]},
        {"cam_to_world": good.cam_to_world[:2]},
        {"intrinsics": good.intrinsics.downscale(2)},
    ):
        with pytest.raises(ValueError, match="views"):
            Dataset(**{**fields, **change})


# ---- Errors: the folder and the JSON file ----------------------------------------------


def expect_error(folder: Path, *parts: str, split: str = "train", **options: Any) -> None:
    """Loading fails with one line that contains all ``parts``."""
    with pytest.raises(InputError) as caught:
        load_dataset(folder, split, **options)
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message


def test_missing_folder(tmp_path: Path) -> None:
    expect_error(tmp_path / "nowhere", "nowhere", "no such dataset folder")
    (tmp_path / "file").touch()
    expect_error(tmp_path / "file", "file", "expected a dataset folder")
    with pytest.raises(InputError, match="nowhere"):
        available_splits(tmp_path / "nowhere")


def test_missing_split(scene: Path) -> None:
    write_blender_dataset(scene, random_images(1, 5, 6), orbit_poses(1), ANGLE, "val")
    expect_error(scene, "transforms_test.json", "train, val", split="test")


def test_folder_that_is_no_dataset(tmp_path: Path) -> None:
    expect_error(tmp_path, "transforms_train.json", "none")
    with pytest.raises(InputError, match="transforms_"):
        available_splits(tmp_path)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{", "valid JSON"),
        ("\xff\xfe", "valid JSON"),
        ("[]", '"frames"'),
        ("{}", '"frames"'),
        ('{"frames": 3}', '"frames"'),
        ('{"frames": [1]}', '"frames"'),
        ('{"frames": []}', "the split is empty"),
        ('{"frames": [{}]}', '"file_path"'),
        ('{"frames": [{"file_path": 3}]}', '"file_path"'),
    ],
)
def test_broken_json(scene: Path, text: str, expected: str) -> None:
    (scene / "transforms_train.json").write_bytes(text.encode("latin-1"))
    expect_error(scene, "transforms_train.json", expected)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"camera_angle_x": None}, ['"camera_angle_x" or "fl_x"']),
        ({"camera_angle_x": 3.5}, ["camera_angle_x", "3.5"]),
        ({"camera_angle_x": "wide"}, ["camera_angle_x", "wide"]),
        ({"camera_angle_x": math.nan}, ["camera_angle_x", "nan"]),
        ({"camera_angle_x": True}, ["camera_angle_x", "True"]),
        ({"camera_angle_x": 10**400}, ["camera_angle_x"]),
        ({"fl_x": -1}, ["fx", "-1"]),
        ({"w": 12}, ["12x5", "6x5"]),
        ({"near": -1}, ["near", "-1"]),
        ({"near": 3, "far": 2}, ["far", "2"]),
        ({"aabb": [[0, 0, 0], [1, 0, 1]]}, ["aabb"]),
        ({"aabb": [[0, 0, 0], [1, 1]]}, ["aabb"]),
        ({"aabb": [[0, 0, 0], [1, 1, math.inf]]}, ["aabb"]),
        ({"k1": 0.1}, ["distortion", "k1"]),
        ({"camera_model": "OPENCV_FISHEYE"}, ["camera_model", "OPENCV_FISHEYE"]),
    ],
)
def test_unusable_values(scene: Path, changes: dict[str, Any], expected: list[str]) -> None:
    edit_json(scene / "transforms_train.json", lambda meta: meta.update(changes))
    expect_error(scene, "transforms_train.json", *expected)


def test_intrinsics_of_single_frames(scene: Path) -> None:
    edit_json(scene / "transforms_train.json", lambda meta: meta["frames"][1].update(fl_x=9))
    expect_error(scene, "transforms_train.json", "train/r_1", "fl_x")


def _scaled() -> np.ndarray:
    return orbit_poses(1)[0] * [[2, 2, 2, 1]]


def _sheared() -> np.ndarray:
    return orbit_poses(1)[0] @ (np.eye(4) + 0.1 * np.eye(4, k=1))


@pytest.mark.parametrize(
    ("matrix", "expected"),
    [
        (None, "4x4"),
        (np.eye(3).tolist(), "4x4"),
        ([[1, 0, 0, 0], [0, 1]], "4x4"),
        ([["a"] * 4] * 4, "4x4"),
        ((np.eye(4) * math.nan).tolist(), "NaN"),
        ((np.eye(4) + [0, 0, 0, math.inf]).tolist(), "NaN or inf"),
        (_scaled().tolist(), "rigid"),
        (_sheared().tolist(), "rigid"),
        (np.diag([1.0, 1, -1, 1]).tolist(), "rigid"),
        (np.diag([1.0, 1, 1, 2]).tolist(), "rigid"),
        (np.zeros((4, 4)).tolist(), "rigid"),
    ],
)
def test_unusable_poses(scene: Path, matrix: Any, expected: str) -> None:
    edit_json(
        scene / "transforms_train.json",
        lambda meta: meta["frames"][1].update(transform_matrix=matrix),
    )
    expect_error(scene, "transforms_train.json", "./train/r_1", expected)


def test_poses_may_be_rounded_to_single_precision(tmp_path: Path) -> None:
    poses = orbit_poses(3).astype(np.float32)
    write_blender_dataset(tmp_path, random_images(3, 2, 2), poses, ANGLE)
    assert np.array_equal(load_dataset(tmp_path, "train").cam_to_world, poses)


# ---- Errors: the images ------------------------------------------------------------------


def test_missing_image(scene: Path) -> None:
    (scene / "train" / "r_1.png").unlink()
    expect_error(scene, "r_1.png", "no such image", "transforms_train.json")


@pytest.mark.parametrize("suffix", [".png", ".exr"])
def test_truncated_image(tmp_path: Path, suffix: str) -> None:
    """Wherever the file ends: an error, or all of the pixels."""
    path = tmp_path / f"image{suffix}"
    if suffix == ".exr":
        plane = np.random.default_rng(0).uniform(size=(6, 7)).astype(np.float32)
        write_exr(path, R=plane, G=plane, B=plane)
    else:
        Image.fromarray(random_images(1, 6, 7)[0]).save(path)
    content, whole = path.read_bytes(), read_image(path)
    errors = 0
    for length in range(len(content)):
        path.write_bytes(content[:length])
        try:
            assert np.array_equal(read_image(path).pixels, whole.pixels)
        except InputError as error:
            assert f"image{suffix}: corrupt" in str(error)
            errors += 1
    assert errors > 0.8 * len(content)


def test_damaged_image(scene: Path) -> None:
    path = scene / "train" / "r_2.png"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    expect_error(scene, "r_2.png", "corrupt")
    path.write_text("not an image")
    expect_error(scene, "r_2.png", "corrupt")


@pytest.mark.parametrize(("mode", "channels"), [("L", 1), ("1", 1), ("I;16", 1), ("LA", 2)])
def test_grey_images(scene: Path, mode: str, channels: int) -> None:
    Image.new(mode, (6, 5)).save(scene / "train" / "r_1.png")
    expect_error(scene, "r_1.png", "expected RGB or RGBA", f"{channels} channel")


def test_grey_exr(tmp_path: Path) -> None:
    write_exr(tmp_path / "image.exr", Y=np.ones((5, 6), np.float32))
    with pytest.raises(InputError, match="image.exr: expected channels R, G, B.* Y"):
        read_image(tmp_path / "image.exr")


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_exr_with_unusable_values(tmp_path: Path, value: float) -> None:
    plane = np.ones((5, 6), np.float32)
    broken = plane.copy()
    broken[1, 2] = value
    write_exr(tmp_path / "image.exr", R=plane, G=broken, B=plane)
    with pytest.raises(InputError, match=r"image.exr.* 1 pixel"):
        read_image(tmp_path / "image.exr")


def test_mixed_sizes(scene: Path) -> None:
    Image.fromarray(random_images(1, 5, 7)[0]).save(scene / "train" / "r_2.png")
    expect_error(scene, "r_0.png is 6x5", "r_2.png is 7x5")


def test_mixed_color_spaces(scene: Path) -> None:
    plane = np.ones((5, 6), np.float32)
    write_exr(scene / "train" / "r_1.exr", R=plane, G=plane, B=plane)
    list_files(scene, ["train/r_0", "train/r_1.exr", "train/r_2"])
    expect_error(scene, "r_0.png is srgb", "r_1.exr is linear")


def test_downscale_beyond_the_image(scene: Path) -> None:
    expect_error(scene, "r_0.png", "downscale 6", "6x5", downscale=6)


@pytest.mark.parametrize("downscale", [0, -1])
def test_downscale_below_one(scene: Path, downscale: int) -> None:
    expect_error(scene, "downscale", str(downscale), downscale=downscale)


def test_files_of_different_depths_become_floats(scene: Path) -> None:
    mi = pytest.importorskip("mitsuba")
    values = np.random.default_rng(1).integers(0, 65536, (5, 6, 4)).astype(np.uint16)
    bitmap = mi.Bitmap(values)
    bitmap.set_srgb_gamma(True)
    bitmap.write(str(scene / "train" / "r_1.png"))
    before = load_dataset(scene, "train").subset([0, 2])
    dataset = load_dataset(scene, "train")
    assert dataset.images.dtype == np.float32
    assert dataset.image(1) == pytest.approx(slow_premultiplied(values), abs=2e-7)
    assert np.array_equal(dataset.image(0), before.image(0))
