"""The record of an evaluation, against what it should be by independent means."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from safetensors import safe_open
from safetensors.numpy import save_file

from mi_nerf import load_field
from mi_nerf.base.color import linear_to_srgb
from mi_nerf.base.variants import array_module, choose_variant
from mi_nerf.cameras.pinhole import Intrinsics
from mi_nerf.cli import main
from mi_nerf.images.exr import read_distance, read_normals
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.surfaces import field_surfaces
from mi_nerf.march.view import render_view
from mi_nerf.tasks import evaluate as evaluation
from mi_nerf.tasks.evaluate import more_quality
from tests.support.datasets import (
    blob_images,
    orbit_poses,
    radiant_images,
    write_blender_dataset,
    write_exr,
    write_radiant_dataset,
)
from tests.support.fields import small_file


def evaluate(target: Path, folder: Path, *options: str | Path) -> dict[str, Any]:
    """What ``mi-nerf eval`` writes."""
    file = folder / "result.json"
    assert main(["eval", str(target), "--json", str(file), *map(str, options)]) == 0
    record: dict[str, Any] = json.loads(file.read_text(), parse_constant=pytest.fail)
    return record


def on_white(file: Path) -> np.ndarray:
    """A straight RGBA picture over white, rounded to 8 bits, as numbers up to 1."""
    pixels = np.asarray(Image.open(file), np.float64) / 255
    color, alpha = pixels[..., :3], pixels[..., 3:]
    return np.rint(255 * (color * alpha + 1 - alpha)) / 255


def slow_psnr(picture: Path, truth: np.ndarray) -> float:
    pixels = np.asarray(Image.open(picture))
    assert pixels.dtype == np.uint8 and pixels.shape == truth.shape
    return -10 * math.log10(np.mean((pixels / 255 - truth) ** 2))


@pytest.fixture(scope="module")
def record(blob_run: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return evaluate(blob_run, tmp_path_factory.mktemp("eval"))


# ---- The record ----------------------------------------------------------------


@pytest.mark.slow
def test_keys_and_types(record: dict[str, Any]) -> None:
    types = {
        "protocol": str,
        "split": str,
        "size": list,
        "background": str,
        "views": int,
        "mean": dict,
        "images": list,
        "seconds_per_view": float,
        "queries_per_ray": float,
        "train_seconds": float,
        "parameters": int,
    }
    assert {key: type(value) for key, value in record.items()} == types
    assert (record["protocol"], record["split"], record["background"]) == (
        "nerf2020",
        "test",
        "white",
    )
    assert record["size"] == [24, 24]
    assert {k: type(v) for k, v in record["mean"].items()} == {"psnr": float, "ssim": float}
    for image in record["images"]:
        assert {k: type(v) for k, v in image.items()} == {
            "name": str,
            "psnr": float,
            "ssim": float,
        }
    assert record["views"] == len(record["images"]) == 5
    assert [image["name"] for image in record["images"]] == [f"r_{i}" for i in range(5)]


def test_figures_agree_with_their_sources(record: dict[str, Any], blob_run: Path) -> None:
    for key in ("psnr", "ssim"):
        values = [image[key] for image in record["images"]]
        assert len(set(values)) == 5
        assert record["mean"][key] == pytest.approx(math.fsum(values) / 5, rel=1e-12)
    with safe_open(blob_run / "field.safetensors", framework="numpy") as file:
        names = [name for name in file.keys() if name.startswith("weights.")]  # noqa: SIM118
        assert record["parameters"] == sum(file.get_tensor(name).size for name in names)
    last = json.loads((blob_run / "log.jsonl").read_text().splitlines()[-1])
    provenance = load_field(blob_run / "field.safetensors").provenance
    assert record["train_seconds"] == provenance["seconds"] >= last["seconds"] - 1e-3 > 0
    assert 0 < record["queries_per_ray"] <= 128
    assert record["seconds_per_view"] > 0


@pytest.mark.parametrize(
    ("views", "chosen"), [(1, [0]), (2, [0, 2]), (3, [0, 1, 3]), (9, [*range(5)])]
)
def test_views_are_evenly_spread(
    views: int, chosen: list[int], record: dict[str, Any], blob_run: Path, tmp_path: Path
) -> None:
    part = evaluate(blob_run, tmp_path, "--views", str(views))
    assert part["views"] == len(chosen)
    assert part["images"] == [record["images"][i] for i in chosen]


def test_other_split(blob_run: Path, tmp_path: Path) -> None:
    train = evaluate(blob_run, tmp_path, "--split", "train")
    assert (train["split"], train["views"]) == ("train", 8)


# ---- Pictures -------------------------------------------------------------------


def test_pictures_have_the_reported_psnr(
    record: dict[str, Any], blob: Path, blob_run: Path, tmp_path: Path
) -> None:
    evaluate(blob_run, tmp_path, "--images", tmp_path / "new" / "pictures")
    files = sorted((tmp_path / "new" / "pictures").iterdir())
    assert [file.name for file in files] == [f"r_{i}.png" for i in range(5)]
    for file, image in zip(files, record["images"], strict=True):
        truth = on_white(blob / "test" / file.name)
        assert slow_psnr(file, truth) == pytest.approx(image["psnr"], abs=1e-6)


def test_ssim_is_that_of_scikit_image(
    record: dict[str, Any], blob: Path, blob_run: Path, tmp_path: Path
) -> None:
    from skimage.metrics import structural_similarity

    evaluate(blob_run, tmp_path, "--views", "1", "--images", tmp_path)
    picture = np.asarray(Image.open(tmp_path / "r_0.png")) / 255
    expected = structural_similarity(
        picture,
        on_white(blob / "test" / "r_0.png"),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1,
        channel_axis=-1,
    )
    assert record["images"][0]["ssim"] == pytest.approx(expected, abs=1e-9)


# ---- Targets and scales -----------------------------------------------------------


def test_field_file_equals_its_run(
    record: dict[str, Any], blob: Path, blob_run: Path, tmp_path: Path
) -> None:
    alone = evaluate(blob_run / "field.safetensors", tmp_path, "--data", blob)
    assert alone.pop("train_seconds") is None  # a field file does not know
    for key in ("images", "mean", "queries_per_ray", "parameters", "size", "views"):
        assert alone[key] == record[key], key


def test_scale_is_that_of_the_run(run: Path, tmp_path: Path) -> None:
    config = json.loads((run / "config.json").read_text())
    config["settings"]["downscale"] = 2
    (run / "config.json").write_text(json.dumps(config))
    assert evaluate(run, tmp_path, "--views", "1")["size"] == [12, 12]
    assert evaluate(run, tmp_path, "--views", "1", "--downscale", "1")["size"] == [24, 24]


def test_no_ssim_of_images_smaller_than_its_window(blob_run: Path, tmp_path: Path) -> None:
    small = evaluate(blob_run, tmp_path, "--views", "2", "--downscale", "3")
    assert small["size"] == [8, 8]
    assert small["mean"]["ssim"] is None and small["images"][1]["ssim"] is None
    assert small["mean"]["psnr"] > 0


@pytest.mark.slow
def test_perfect_images_do_not_hide_the_others(
    record: dict[str, Any], data: Path, blob_run: Path, tmp_path: Path
) -> None:
    evaluate(blob_run, tmp_path, "--views", "1", "--images", tmp_path)
    (tmp_path / "r_0.png").replace(data / "test" / "r_0.png")  # truth = reconstruction
    perfect = evaluate(blob_run, tmp_path, "--data", data)
    assert perfect["images"][0] == {"name": "r_0", "psnr": None, "ssim": 1.0}
    rest = [image["psnr"] for image in record["images"][1:]]
    assert perfect["mean"]["psnr"] == pytest.approx(np.mean(rest))


def test_nan_is_not_averaged_away(run: Path, tmp_path: Path) -> None:
    path = run / "field.safetensors"
    with safe_open(path, framework="numpy") as file:
        metadata = file.metadata()
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    arrays["weights.density.bias"][:] = np.nan
    save_file(arrays, path, metadata)
    broken = evaluate(run, tmp_path, "--views", "2")
    assert broken["mean"] == {"psnr": None, "ssim": None}
    assert evaluation._mean([math.inf, 20.0, 30.0]) == 25
    assert evaluation._mean([math.inf, 20.0, math.nan]) is None
    assert evaluation._mean([math.inf]) is None


# ---- Linear images ------------------------------------------------------------------


@pytest.mark.parametrize("field_space", ["linear", "srgb"])
def test_linear_images_are_compared_in_srgb(field_space: str, tmp_path: Path) -> None:
    poses = orbit_poses(2)
    data = tmp_path / "data"
    file = write_blender_dataset(data, blob_images(poses, 24, 0.6), poses, 0.6, "test")
    meta = json.loads(file.read_text())
    rng = np.random.default_rng(0)
    truths = []
    for i, frame in enumerate(meta["frames"]):
        frame["file_path"] += ".exr"
        alpha = rng.random((24, 24, 1)).astype(np.float32)
        color = alpha * rng.uniform(0, 2, (24, 24, 3)).astype(np.float32)
        planes = np.moveaxis(np.concatenate([color, alpha], axis=-1), -1, 0)
        planes = dict(zip("RGBA", np.ascontiguousarray(planes), strict=True))
        write_exr(data / "test" / f"r_{i}.exr", **planes)
        linear = np.clip(color.astype(float) + 1 - alpha, 0, 1)
        encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        truths.append(np.rint(255 * encoded) / 255)
    file.write_text(json.dumps(meta))
    field = small_file(tmp_path, color_space=field_space)
    record = evaluate(field, tmp_path, "--data", data, "--images", tmp_path / "pictures")
    for i, truth in enumerate(truths):
        found = slow_psnr(tmp_path / "pictures" / f"r_{i}.png", truth)
        assert record["images"][i]["psnr"] == pytest.approx(found, abs=1e-6)

    # A linear field is put on white before its colours are encoded.
    contents = load_field(field)
    module = array_module(choose_variant())
    built, _ = contents.build(module)
    camera = Intrinsics.from_angle_x(24, 24, 0.6)
    view = render_view(MarchedField(built, contents.march), camera, poses[1], module)
    assert view.opacity.max() > 0.1
    expected = view.color + 1 - view.opacity[..., None]
    if field_space == "linear":
        expected = linear_to_srgb(np.clip(expected, 0, 1))
    picture = np.asarray(Image.open(tmp_path / "pictures" / "r_1.png")) / 255
    assert picture == pytest.approx(np.clip(expected, 0, 1), abs=0.5 / 255 + 1e-5)


def test_radiance_of_linear_images(tmp_path: Path) -> None:
    """PSNR of its logarithm and after tone mapping, over black, of fields of either space."""
    data = write_radiant_dataset(tmp_path / "data")
    module, camera = array_module(choose_variant()), Intrinsics.from_angle_x(24, 24, 0.6)
    for space in ("linear", "srgb"):
        field = small_file(tmp_path, color_space=space, density_scale=20.0)
        record = evaluate(field, tmp_path, "--data", data, "--images", "exr")
        assert "depth_error" not in record["mean"] and "consistency" not in record["mean"]
        contents = load_field(field)
        built, _ = contents.build(module)
        poses = orbit_poses(3, height=2.5)
        truths = radiant_images(poses, 24, 0.6)[..., :3].astype(np.float64)
        logs = []
        for i, pose in enumerate(poses):
            view = render_view(MarchedField(built, contents.march), camera, pose, module)
            color = view.color.astype(np.float64)
            if space == "srgb":
                alpha = np.maximum(view.opacity[..., None].astype(np.float64), 1e-30)
                x = color / alpha
                color = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4) * alpha
            decades = np.log10(color + 1e-3) - np.log10(truths[i] + 1e-3)
            logs.append(-10 * math.log10(np.mean(decades**2)))
            assert record["images"][i]["psnr_log"] == pytest.approx(logs[-1], abs=1e-3)
            seen, true = (linear_to_srgb(x / (1 + x)) for x in (color, truths[i]))
            mapped = -10 * math.log10(np.mean((seen - true) ** 2))
            assert record["images"][i]["psnr_tone_mapped"] == pytest.approx(mapped, abs=1e-3)
        assert record["mean"]["psnr_log"] == pytest.approx(np.mean(logs), abs=1e-3)
    pictures = evaluate(field, tmp_path, "--data", data)
    assert set(pictures["mean"]) == {"psnr", "ssim"}


# ---- Surfaces ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def solid(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A field, and a dataset whose exact surfaces are the field's own."""
    folder = tmp_path_factory.mktemp("solid")
    field = small_file(folder, density_scale=60.0, density_shift=1.0)
    module, camera = array_module(choose_variant()), Intrinsics.from_angle_x(24, 24, 0.6)
    contents = load_field(field)
    built, _ = contents.build(module)
    poses = orbit_poses(4, height=1.0)
    images = blob_images(poses, 24, 0.6)
    for i, pose in enumerate(poses):
        found = field_surfaces(MarchedField(built, contents.march), camera, pose, module)
        assert found.normal is not None
        there = found.opacity >= 0.5
        images[i, ..., 3] = np.where(there, 255, 0)
        length = np.maximum(np.linalg.norm(found.normal, axis=-1, keepdims=True), 1e-30)
        normal = np.where(there[..., None], found.normal / length, 0).astype(np.float32)
        stem = folder / "data" / "test"
        stem.mkdir(parents=True, exist_ok=True)
        write_exr(stem / f"r_{i}_depth.exr", Y=np.where(there, found.depth, 0).astype(np.float32))
        planes = (np.ascontiguousarray(normal[..., c]) for c in range(3))
        write_exr(stem / f"r_{i}_normal.exr", **dict(zip("RGB", planes, strict=True)))
    write_blender_dataset(folder / "data", images, poses, 0.6, "test")
    return field, folder / "data"


SURFACES = ("depth_error", "depth_error_95", "normal_error", "silhouette_iou")
CHANGES = ("color_change", "color_change_truth", "consistency")


def test_surfaces_of_the_field_itself(solid: tuple[Path, Path], tmp_path: Path) -> None:
    field, data = solid
    record = evaluate(field, tmp_path, "--data", data)
    for image in [*record["images"], record["mean"]]:
        assert image["depth_error_95"] < 1e-6 and image["normal_error"] < 0.1
        assert image["silhouette_iou"] == 1
    assert [*record["mean"]] == ["psnr", "ssim", *SURFACES, *CHANGES]
    for key in CHANGES:
        values = [image[key] for image in record["images"] if image[key] is not None]
        assert record["mean"][key] == pytest.approx(np.mean(values)) and record["mean"][key] > 0
    without = evaluate(field, tmp_path, "--data", data, "--no-geometry")
    assert set(without["mean"]) == {"psnr", "ssim"}


@pytest.mark.parametrize("downscale", [2, 3])
def test_downscaled_views_are_compared_along_the_rays_of_the_files(
    downscale: int, solid: tuple[Path, Path], tmp_path: Path
) -> None:
    field, data = solid
    record = evaluate(field, tmp_path, "--data", data, "--downscale", str(downscale))
    assert record["mean"]["depth_error_95"] < 1e-5 and record["mean"]["normal_error"] < 0.2


def test_surfaces_elsewhere(solid: tuple[Path, Path], tmp_path: Path) -> None:
    """Distances a quarter too large in the files; normals the wrong way in one view of them."""
    field, folder = solid
    data = Path(shutil.copytree(folder, tmp_path / "data"))
    for file in data.glob("test/*_depth.exr"):
        write_exr(file, Y=np.float32(1.25) * read_distance(file))
    (data / "test" / "r_1_normal.exr").unlink()
    away = -read_normals(data / "test" / "r_2_normal.exr")
    planes = (np.ascontiguousarray(away[..., c]) for c in range(3))
    write_exr(data / "test" / "r_2_normal.exr", **dict(zip("RGB", planes, strict=True)))
    record = evaluate(field, tmp_path, "--data", data)
    for image in record["images"]:
        assert image["depth_error"] == pytest.approx(0.2, abs=1e-5)
        assert image["depth_error_95"] == pytest.approx(0.2, abs=1e-5)
    angles = [image.get("normal_error") for image in record["images"]]
    assert angles[1] is None and "normal_error" not in record["images"][1]
    assert angles[2] == pytest.approx(180, abs=0.1)
    assert record["mean"]["normal_error"] == pytest.approx(
        (angles[0] + 180 + angles[3]) / 3, abs=0.1
    )


def test_surfaces_that_cannot_be_read(
    solid: tuple[Path, Path], tmp_path: Path, refused: Callable[..., str]
) -> None:
    field, folder = solid
    data = Path(shutil.copytree(folder, tmp_path / "data"))
    write_exr(data / "test" / "r_0_depth.exr", Y=np.ones((5, 6), np.float32))
    message = refused("eval", str(field), "--data", str(data))
    assert "r_0_depth.exr: expected 24x24 pixels as in the view, got 6x5" in message


def test_what_is_said_of_surfaces_and_radiance() -> None:
    mean = {
        "psnr": 30.0,
        "ssim": 0.9,
        "psnr_tone_mapped": 28.123,
        "psnr_log": 21.5,
        "depth_error": 0.0012,
        "depth_error_95": 0.034,
        "normal_error": 12.34,
        "silhouette_iou": 0.98765,
        "color_change": 0.02,
        "color_change_truth": 0.01,
        "consistency": None,
    }
    assert more_quality({"mean": mean}) == [
        "radiance: PSNR 28.12 dB tone-mapped, 21.50 dB of its logarithm",
        "surfaces: distance off by 0.12% in the median, by 3.40% at most in 95 %, "
        "normals by 12.3 degrees, silhouettes IoU 0.9877",
        "colours of surface points over views change by 0.0200, in truth by 0.0100; "
        "n/a of it the truth does not share",
    ]
    assert more_quality({"mean": {"psnr": 30.0, "ssim": 0.9}}) == []


# ---- The option --images ------------------------------------------------------------------


def test_images_to_compare_with_and_a_folder(tmp_path: Path) -> None:
    data = write_radiant_dataset(tmp_path / "data")
    field = small_file(tmp_path)
    pictures = tmp_path / "pictures"
    record = evaluate(field, tmp_path, "--data", data, "--images", "exr", "--images", pictures)
    assert "psnr_log" in record["mean"] and len([*pictures.iterdir()]) == 3


def test_two_kinds_of_images(tmp_path: Path, refused: Callable[..., str]) -> None:
    data = write_radiant_dataset(tmp_path / "data")
    field = small_file(tmp_path)
    both = ("eval", str(field), "--data", str(data), "--images", "exr", "--images", "png")
    assert "--images exr png: expected one of png and exr, and one folder" in refused(*both)
