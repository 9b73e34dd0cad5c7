"""Datasets that ``mi-nerf generate`` makes, against closed forms and against themselves."""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from mi_nerf.base.color import linear_to_srgb
from mi_nerf.base.errors import InputError
from mi_nerf.base.variants import choose_variant
from mi_nerf.cameras.pinhole import project
from mi_nerf.cameras.poses import opengl_from_mitsuba
from mi_nerf.cli import main
from mi_nerf.data import load_dataset
from mi_nerf.generation import Options, generate
from mi_nerf.generation import run as generation
from mi_nerf.generation.tracer import Tracer

VARIANT = choose_variant()
CAMERA = 0.6911

# A ball on a square, a null box and a lamp in front of them.
BALL = """<scene version="3.0.0">
    <default name="radius" value="0.5"/>
    <integrator type="path"><integer name="max_depth" value="6"/></integrator>
    {sensor}
    <emitter type="constant"><float name="radiance" value="0.8"/></emitter>
    <shape type="sphere"><float name="radius" value="$radius"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.7, 0.4, 0.2"/></bsdf></shape>
    <shape type="rectangle">
        <transform name="to_world"><scale value="0.9"/><translate z="-0.5"/></transform>
        <bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>
    <shape type="cube"><bsdf type="null"/></shape>
    <shape type="sphere"><float name="radius" value="0.1"/><point name="center" value="0,0,1.5"/>
        <emitter type="area"><float name="radiance" value="3"/></emitter></shape>
</scene>"""


def ball(folder: Path, sensor: str = "", **changes: str) -> Path:
    text = BALL.replace("{sensor}", sensor)
    for old, new in changes.items():
        text = text.replace(old, new)
    path = folder / "ball.xml"
    path.write_text(text)
    return path


def small(**changes: Any) -> Options:
    base = Options(train=2, val=1, test=1, size=(40, 32), spp=8)
    return replace(base, **changes)


def make(scene: Path, out: Path, options: Options | None = None, **more: Any) -> dict[str, Any]:
    return generate(scene, out, VARIANT, options or small(), show=False, **more)


def exr(path: Path) -> np.ndarray:
    (channel,) = OpenEXR.File(str(path)).channels().values()
    return channel.pixels


def frames(folder: Path, split: str = "train") -> list[dict[str, Any]]:
    return json.loads((folder / f"transforms_{split}.json").read_text())["frames"]


def contents(folder: Path) -> dict[str, bytes]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def camera_rays(folder: Path, frame: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Origin and unit directions through the pixel centres, by the JSON alone."""
    meta = json.loads((folder / "transforms_train.json").read_text())
    pose = np.array(frame["transform_matrix"])
    focal = meta["w"] / 2 / math.tan(meta["camera_angle_x"] / 2)
    y, x = np.mgrid[: meta["h"], : meta["w"]] + 0.5
    local = [(x - meta["w"] / 2) / focal, (meta["h"] / 2 - y) / focal, -np.ones_like(x)]
    d = np.stack(local, -1) @ pose[:3, :3].T
    return pose[:3, 3], d / np.linalg.norm(d, axis=-1, keepdims=True)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The ball, finely sampled, and its record. Not to be changed."""
    folder = tmp_path_factory.mktemp("ball")
    out = folder / "data"
    record = make(ball(folder), out, small(train=3, size=(80, 60), spp=512))
    return out, record


# --------------------------------------------------------------------------
#   What is in the files
# --------------------------------------------------------------------------


@pytest.mark.slow
def test_splits_and_cameras(dataset: tuple[Path, dict[str, Any]]) -> None:
    folder, record = dataset
    assert record["complete"] and record == json.loads((folder / "dataset.json").read_text())
    for split, count in (("train", 3), ("val", 1), ("test", 1)):
        views = load_dataset(folder, split)
        assert len(views) == count and views.has_alpha
        assert (views.intrinsics.width, views.intrinsics.height) == (80, 60)
        positions = views.cam_to_world[:, :3, 3]
        assert np.linalg.norm(positions, axis=1) == pytest.approx(4)
        assert (positions[:, 2] > 0).all()
        forwards = -views.cam_to_world[:, :3, 2]
        assert forwards == pytest.approx(-positions / 4)
    meta = json.loads((folder / "transforms_train.json").read_text())
    assert meta["camera_angle_x"] == CAMERA
    assert meta["fl_x"] == pytest.approx(40 / math.tan(CAMERA / 2))
    assert meta["fl_y"] == meta["fl_x"] and (meta["cx"], meta["cy"]) == (40, 30)
    # The lamp is no part of the scene, the null box is.
    assert np.array(meta["aabb"]) == pytest.approx(np.array([[-1, -1, -1], [1, 1, 1]]))
    assert record["scene"]["box"] == meta["aabb"]


@pytest.mark.slow
def test_readers_of_the_original_format(dataset: tuple[Path, dict[str, Any]]) -> None:
    """As the loader of the paper's code does it: every split, names plus .png, 8 bits."""
    folder = dataset[0]
    for split in ("train", "val", "test"):
        meta = json.loads((folder / f"transforms_{split}.json").read_text())
        assert isinstance(meta["camera_angle_x"], float)
        for i, frame in enumerate(meta["frames"]):
            assert frame["file_path"] == f"./{split}/r_{i}"
            image = iio.imread(os.path.join(folder, frame["file_path"] + ".png"))
            assert image.shape == (60, 80, 4) and image.dtype == np.uint8
            assert np.array(frame["transform_matrix"]).shape == (4, 4)


@pytest.mark.slow
def test_depth_and_normals_by_closed_form(dataset: tuple[Path, dict[str, Any]]) -> None:
    folder = dataset[0]
    for i, frame in enumerate(frames(folder)):
        depth = exr(folder / f"train/r_{i}_depth.exr")
        normal = exr(folder / f"train/r_{i}_normal.exr")
        assert depth.shape == (60, 80) and normal.shape == (60, 80, 3)
        o, d = camera_rays(folder, frame)
        b = d @ o
        disc = b * b - (o @ o - 0.25)
        on_ball = disc > 1e-3
        t_ball = -b - np.sqrt(np.maximum(disc, 0))
        t_floor = (-0.5 - o[2]) / d[..., 2]
        p = o + t_floor[..., None] * d
        on_floor = (np.abs(p[..., :2]) < 0.899).all(-1) & (t_floor > 0) & (disc < -1e-3)
        assert on_ball.sum() > 100 and on_floor.sum() > 100
        assert depth[on_ball] == pytest.approx(t_ball[on_ball], abs=1e-4)
        assert depth[on_floor] == pytest.approx(t_floor[on_floor], abs=1e-4)
        points = (o + depth[..., None] * d)[on_ball]
        assert normal[on_ball] == pytest.approx(points / 0.5, abs=1e-3)
        assert np.allclose(normal[on_floor], [0, 0, 1], atol=1e-6)
        seen = depth > 0
        assert (np.linalg.norm(normal[~seen], axis=-1) == 0).all()
        assert np.linalg.norm(normal[seen], axis=-1) == pytest.approx(1, abs=1e-5)
        assert ((normal * d).sum(-1)[seen] < 1e-6).all()  # towards the camera
        # The lamp, the null box and the empty background are nothing.
        elsewhere = (np.abs(p[..., :2]) > 0.901).any(-1) & (disc < -1e-3)
        assert elsewhere.sum() > 100 and (depth[elsewhere] == 0).all()


def test_depth_agrees_between_views(tmp_path: Path) -> None:
    """Points of one view lie on the surfaces that another one sees."""
    out = tmp_path / "data"
    make(Path("scenes/spheres.xml").resolve(), out, small(train=2, size=(160, 160), spp=2))
    views = load_dataset(out, "train")
    depths = [exr(out / f"train/r_{i}_depth.exr") for i in range(2)]
    normals = [exr(out / f"train/r_{i}_normal.exr") for i in range(2)]
    rays = [camera_rays(out, frame) for frame in frames(out)]
    points = [o + depth[..., None] * d for (o, d), depth in zip(rays, depths, strict=True)]
    compared = 0
    for a, b in ((0, 1), (1, 0)):
        seen = depths[a] > 0
        p, n = points[a][seen], normals[a][seen]
        xy, _ = project(p, views.intrinsics, views.cam_to_world[b])
        x, y = np.floor(xy).astype(int).T
        inside = (x >= 0) & (x < 160) & (y >= 0) & (y < 160)
        p, n, x, y = p[inside], n[inside], x[inside], y[inside]
        q, m = points[b][y, x], normals[b][y, x]
        # The same flat surface, seen by both: within a pixel's footprint, with one normal.
        same = ((n * m).sum(-1) > 0.9999) & (np.linalg.norm(p - q, axis=-1) < 0.05)
        assert np.abs(((p - q) * n).sum(-1)[same]).max() < 1e-3 * 2
        compared += same.sum()
    assert compared > 2000


@pytest.mark.slow
def test_png_is_the_encoded_exr(dataset: tuple[Path, dict[str, Any]]) -> None:
    folder = dataset[0]
    for i in range(3):
        image = exr(folder / f"train/r_{i}.exr").astype(np.float64)
        assert image.dtype == np.float64 and image.shape == (60, 80, 4)
        png = iio.imread(folder / f"train/r_{i}.png").astype(np.float64)
        alpha = image[..., 3]
        assert np.abs(png[..., 3] - 255 * alpha).max() <= 0.5001
        seen = alpha > 0
        straight = image[..., :3][seen] / alpha[seen][:, None]
        expected = 255 * np.clip(linear_to_srgb(straight), 0, 1)
        assert np.abs(png[..., :3][seen] - expected).max() <= 0.501
        assert (png[~seen] == 0).all()


@pytest.mark.slow
def test_alpha_is_coverage(dataset: tuple[Path, dict[str, Any]]) -> None:
    """Against the share of 16x16 rays a pixel that meet the ball or the square."""
    folder = dataset[0]
    meta = json.loads((folder / "transforms_train.json").read_text())
    for i, frame in enumerate(frames(folder)):
        alpha = exr(folder / f"train/r_{i}.exr")[..., 3]
        pose, fine = np.array(frame["transform_matrix"]), 16
        y, x = (np.mgrid[: 60 * fine, : 80 * fine] + 0.5) / fine
        local = [(x - 40) / meta["fl_x"], (30 - y) / meta["fl_x"], -np.ones_like(x)]
        d = np.stack(local, -1) @ pose[:3, :3].T
        o = pose[:3, 3]
        b = d @ o
        on_ball = b * b > (d * d).sum(-1) * (o @ o - 0.25)
        p = o + ((-0.5 - o[2]) / d[..., 2])[..., None] * d
        hit = on_ball | (np.abs(p[..., :2]) < 0.9).all(-1)
        coverage = hit.reshape(60, fine, 80, fine).mean((1, 3))
        # 512 random samples: five standard deviations, and the grid's own error.
        tolerance = 5 * np.sqrt(coverage * (1 - coverage) / 512) + 2 / fine
        partial = (coverage > 0) & (coverage < 1)
        assert partial.sum() > 50
        assert (np.abs(alpha - coverage) <= tolerance).all()
        assert np.abs(alpha - coverage)[partial].mean() < 0.02


@pytest.mark.slow
def test_radiance_is_that_of_a_plain_rendering(
    dataset: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    """A sensor made by hand from the JSON, no generate: the difference is noise."""
    folder, record = dataset
    mi.set_variant(VARIANT)
    scene = mi.load_file(str(ball(tmp_path)))
    frame = frames(folder)[0]
    c2w = np.array(frame["transform_matrix"]) @ np.diag([-1, 1, -1, 1])
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": math.degrees(CAMERA),
            "to_world": mi.ScalarTransform4f(c2w.tolist()),
            "film": {
                "type": "hdrfilm",
                "width": 80,
                "height": 60,
                "rfilter": {"type": "box"},
                "pixel_format": "rgba",
            },
        }
    )
    integrator = mi.load_dict({"type": "path", "max_depth": 6, "hide_emitters": True})
    truth = np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=4096, seed=77))
    image = exr(folder / "train/r_0.exr")
    assert image[..., :3].mean() > 0.05
    mse = np.mean((image - truth)[..., :3] ** 2)
    assert mse == pytest.approx(record["views"]["train/r_0"]["noise"]["mse_linear"], rel=0.3)


# --------------------------------------------------------------------------
#   Determinism, stopping, resuming
# --------------------------------------------------------------------------


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    scene = ball(tmp_path)
    make(scene, tmp_path / "a")
    make(scene, tmp_path / "b")
    make(scene, tmp_path / "c", small(seed=1))
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    other = contents(tmp_path / "c")
    for name, data in contents(tmp_path / "a").items():
        assert other[name] != data, name


@pytest.mark.slow
def test_more_views_begin_with_the_same_ones(tmp_path: Path) -> None:
    scene = ball(tmp_path)
    make(scene, tmp_path / "few")
    make(scene, tmp_path / "many", small(train=4, test=2))
    few, many = contents(tmp_path / "few"), contents(tmp_path / "many")
    pictures = [name for name in few if not name.endswith(".json")]
    assert len(pictures) == 16
    assert all(few[name] == many[name] for name in pictures)


@pytest.mark.slow
def test_resume_goes_on_and_repairs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = ball(tmp_path)
    make(scene, tmp_path / "whole")
    whole = contents(tmp_path / "whole")
    traced: list[str] = []
    trace = Tracer.trace

    def stopping(self: Tracer, view: Any) -> Any:
        traced.append(view.name)
        if len(traced) == 2:
            os.kill(os.getpid(), 2)
        return trace(self, view)

    monkeypatch.setattr(Tracer, "trace", stopping)
    out = tmp_path / "data"
    record = make(scene, out)
    assert not record["complete"] and list(record["views"]) == ["train/r_0", "train/r_1"]
    assert "interrupted" in generation.summary(record)
    assert not list(out.glob("transforms_*.json"))  # nobody takes it for a dataset
    assert json.loads((out / "dataset.json").read_text()) == record

    (out / "train/r_0_depth.exr").write_bytes(b"damaged")
    (out / "train/r_1.png").unlink()
    assert make(scene, out, resume=True)["complete"]
    assert traced[2:] == ["train/r_0", "train/r_1", "val/r_0", "test/r_0"]
    assert contents(out) == whole

    (out / "test/r_0.exr").write_bytes(whole["test/r_0.exr"][:-1])
    make(scene, out, resume=True)
    assert traced[6:] == ["test/r_0"]
    assert contents(out) == whole
    make(scene, out, resume=True)  # nothing left to do
    assert len(traced) == 7 and contents(out) == whole


@pytest.mark.slow
def test_resume_refuses_another_dataset(tmp_path: Path) -> None:
    scene = ball(tmp_path)
    out = tmp_path / "data"
    make(scene, out)
    before = contents(out)
    for changed, message in (
        (small(seed=3), "settings.seed is 0, expected 3"),
        (small(train=3), "settings.views.train is 2, expected 3"),
        (small(spp=16), "settings.spp is 8, expected 16"),
    ):
        with pytest.raises(InputError, match=f"another dataset: {message}"):
            make(scene, out, changed, resume=True)
    scene.write_text(scene.read_text().replace("0.7, 0.4, 0.2", "0.7, 0.4, 0.3"))
    with pytest.raises(InputError, match="another dataset: scene.sha256"):
        make(scene, out, resume=True)
    with pytest.raises(InputError, match="expected a new or empty folder, or resume=True"):
        make(scene, out)
    assert contents(out) == before


@pytest.mark.slow
def test_ctrl_c_of_the_command(tmp_path: Path) -> None:
    """A real process: 130, a hint, and what is there is whole."""
    scene, out = ball(tmp_path), tmp_path / "data"
    arguments = ["generate", scene, out, "--train", "300", "--size", "64", "64", "--spp", "64"]
    command = [sys.executable, "-u", "-m", "mi_nerf.cli", *map(str, arguments)]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=Path.cwd()
    )
    while not (out / "dataset.json").exists():
        assert process.poll() is None
    process.send_signal(2)
    text, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "go on with --resume" in text and "Traceback" not in errors
    record = json.loads((out / "dataset.json").read_text())
    assert not record["complete"] and record["views"]
    assert {f"{name}.png" for name in record["views"]} == {
        str(p.relative_to(out)) for p in out.rglob("*.png")
    }


@pytest.mark.slow
def test_a_full_disk(tmp_path: Path) -> None:
    """Files may not grow beyond a few kilobytes: one line, nothing half-written."""
    scene, out = ball(tmp_path), tmp_path / "data"
    rest = ["--train", "2", "--size", "100", "100", "--spp", "4"]
    # Dr.Jit writes compiled kernels to files too: the same process compiles them before. What
    # is left depends on how memory happens to lie, and Dr.Jit says so in lines of its own.
    script = f"""
import resource, sys
from mi_nerf.cli import main
def generate(out):
    return main(["generate", {str(scene)!r}, out, *{rest!r}])
assert generate({str(tmp_path / "first")!r}) == 0
resource.setrlimit(resource.RLIMIT_FSIZE, (9000, 9000))
sys.exit(generate({str(out)!r}))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    lines = [v for v in done.stderr.splitlines() if not v.startswith("jit_kernel_write(): ")]
    assert len(lines) == 1 and lines[0].startswith("mi-nerf: ") and "cannot be written" in lines[0]
    files = [p for p in out.rglob("*") if p.is_file()]
    assert not [p.name for p in files if p.name.startswith(".")]
    for picture in (p for p in files if p.suffix == ".png"):
        assert iio.imread(picture).shape == (100, 100, 4)  # small enough to be whole
    assert not json.loads((out / "dataset.json").read_text())["views"]


@pytest.mark.slow
def test_no_kernel_is_compiled_after_the_first_view(tmp_path: Path) -> None:
    """In a process of its own, whose kernel cache starts empty."""
    script = f"""
import drjit as dr
import mi_nerf
from mi_nerf.generation import Options, generate
from mi_nerf.generation.tracer import Tracer
misses, trace = [], Tracer.trace
def counting(self, view):
    dr.kernel_history_clear()
    result = trace(self, view)
    misses.append(sum(k.get("cache_hit") == 0 for k in dr.kernel_history()))
    return result
Tracer.trace = counting
dr.set_flag(dr.JitFlag.KernelHistory, True)
options = Options(train=6, val=2, test=2, size=(40, 30), spp=6)
generate({str(ball(tmp_path))!r}, {str(tmp_path / "data")!r}, {VARIANT!r}, options, show=False)
print(*misses)
"""
    output = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "HOME": str(tmp_path), "PYTHONPATH": str(Path.cwd())},
        capture_output=True,
        text=True,
        check=True,
    )
    first, *others = map(int, output.stdout.split())
    assert first > 0 and others == [0] * 9


# --------------------------------------------------------------------------
#   Scenes of all kinds
# --------------------------------------------------------------------------

SENSOR_Y_UP = """<sensor type="perspective"><float name="fov" value="60"/>
    <string name="fov_axis" value="x"/>
    <transform name="to_world">
        <lookat origin="0, 1, -2" target="0, 0, 5" up="0, 1, 0"/></transform>
    <sampler type="stratified"><integer name="sample_count" value="32"/></sampler>
</sensor>"""


@pytest.mark.slow
def test_a_large_scene_elsewhere(tmp_path: Path) -> None:
    """The cameras move out in proportion, around the middle of what is visible."""
    scene = ball(
        tmp_path, **{'value="$radius"/>': 'value="20"/><point name="center" value="50, 0, 0"/>'}
    )
    record = make(scene, tmp_path / "data")
    (x0, y0, z0), (x1, y1, z1) = record["scene"]["box"]
    assert (x0, x1, y0, z1) == pytest.approx((-1, 70, -20, 20))
    assert record["settings"]["center"] == pytest.approx([34.5, 0, 0])
    assert record["settings"]["radius"] == pytest.approx(4 * 35.5)
    positions = load_dataset(tmp_path / "data", "train").cam_to_world[:, :3, 3]
    assert np.linalg.norm(positions - [34.5, 0, 0], axis=1) == pytest.approx(142)
    told = make(scene, tmp_path / "told", small(center=(50, 0, 0), radius=60.0, up="x"))
    assert told["settings"]["up"] == [1, 0, 0]
    positions = load_dataset(tmp_path / "told", "test").cam_to_world[:, :3, 3]
    assert np.linalg.norm(positions - [50, 0, 0], axis=1) == pytest.approx(60)
    assert (positions[:, 0] > 50).all()
    assert exr(tmp_path / "told/train/r_0_depth.exr").max() == pytest.approx(60, abs=21)


@pytest.mark.slow
def test_the_sensor_says_what_is_up(tmp_path: Path) -> None:
    scene = ball(tmp_path, SENSOR_Y_UP)
    record = make(scene, tmp_path / "data", small(spp=None))
    assert record["settings"]["up"] == [0, 1, 0] and record["settings"]["spp"] == 50  # 2 x 5^2
    poses = load_dataset(tmp_path / "data", "train").cam_to_world
    assert (poses[:, 1, 3] > 0).all() and (poses[:, 1, 1] > 0).all()


@pytest.mark.slow
def test_parameters_of_the_scene(tmp_path: Path) -> None:
    scene = ball(tmp_path)
    plain = make(scene, tmp_path / "plain")
    small_ball = make(scene, tmp_path / "small", parameters={"radius": "0.2"})
    assert small_ball["scene"]["sha256"] != plain["scene"]["sha256"]
    assert small_ball["scene"]["parameters"] == {"radius": "0.2"}
    alpha = [exr(tmp_path / n / "train/r_0.exr")[..., 3].mean() for n in ("plain", "small")]
    assert alpha[1] < alpha[0]


@pytest.mark.slow
def test_the_hash_covers_files_that_the_scene_names(tmp_path: Path) -> None:
    texture = tmp_path / "texture.png"
    iio.imwrite(texture, np.full((4, 4, 3), 99, np.uint8))
    bitmap = '<texture type="bitmap" name="reflectance">'
    bitmap += '<string name="filename" value="texture.png"/></texture>'
    scene = ball(tmp_path, **{'<rgb name="reflectance" value="0.7, 0.4, 0.2"/>': bitmap})
    first = make(scene, tmp_path / "a")["scene"]["sha256"]
    iio.imwrite(texture, np.full((4, 4, 3), 98, np.uint8))
    assert make(scene, tmp_path / "b")["scene"]["sha256"] != first
    shutil.copytree(tmp_path / "a", tmp_path / "c")  # where a scene lies does not matter
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    shutil.copy(texture, moved)
    shutil.copy(scene, moved)
    assert make(moved / "ball.xml", tmp_path / "d")["scene"]["sha256"] != first


@pytest.mark.slow
def test_forward_captures(tmp_path: Path) -> None:
    """Against the formulas by which readers of LLFF turn its rows into cameras."""
    sensor = SENSOR_Y_UP.replace("stratified", "independent")
    scene = ball(tmp_path, sensor)
    out = tmp_path / "data"
    record = make(scene, out, Options(protocol="forward", train=14, size=(48, 36), spp=4))
    assert record["settings"]["views"] == {"train": 14, "val": 0, "test": 2}
    rows = np.load(out / "poses_bounds.npy")
    assert rows.shape == (16, 17) and rows.dtype == np.float64
    matrix = rows[:, :15].reshape(-1, 3, 5)
    assert np.allclose(matrix[:, :, 4], [36, 48, 24 / math.tan(math.radians(30))])
    # [down, right, back] to [right, up, back], as the reader of the original code does.
    poses = np.concatenate([matrix[..., 1:2], -matrix[..., 0:1], matrix[..., 2:4]], axis=-1)
    images = sorted((out / "images").iterdir())
    assert len(images) == 16
    number = {"train": 0, "test": 0}
    for i, image in enumerate(images):
        split = "test" if i % 8 == 0 else "train"
        frame = frames(out, split)[number[split]]
        assert poses[i] == pytest.approx(np.array(frame["transform_matrix"])[:3])
        name = out / split / f"r_{number[split]}"
        assert image.read_bytes() == name.with_suffix(".png").read_bytes()
        depth = exr(name.with_name(name.name + "_depth.exr"))
        near, far = rows[i, 15:]
        assert 0 < near < far and near <= depth[depth > 0].min() * 1.05
        assert far <= depth.max()
        alpha = iio.imread(image)[..., 3]
        assert (alpha == 255).all()  # the sky is part of the picture
        number[split] += 1
    # Beside each other, looking the same way, at the scene's own field of view.
    assert np.ptp(poses[:, :, :3], axis=0) == pytest.approx(0, abs=1e-12)
    own = opengl_from_mitsuba(
        np.array(mi.ScalarTransform4f().look_at([0, 1, -2], [0, 0, 5], [0, 1, 0]).matrix)
    )
    offset = (poses[:, :, 3] - own[:3, 3]) @ own[:3, :3]
    spread = record["settings"]["radius"]
    assert (np.abs(offset).max(axis=0) <= np.array([spread, spread * 2 / 3, 1e-6]) * 1.001).all()
    assert np.ptp(offset[:, 0]) > spread


@pytest.mark.slow
def test_forward_without_a_sensor(tmp_path: Path) -> None:
    record = make(ball(tmp_path), tmp_path / "data", small(protocol="forward", val=0))
    assert record["settings"]["camera_angle_x"] == pytest.approx(CAMERA)
    assert record["settings"]["center"] == pytest.approx([0, -4, 0])
    assert exr(tmp_path / "data/train/r_0_depth.exr").max() > 0


@pytest.mark.slow
def test_forward_cameras_move_as_told(tmp_path: Path) -> None:
    scene = ball(tmp_path, **{"<integrator": '<default name="spread" value="0.3"/><integrator'})
    for radius, expected in ((None, 0.3), (0.1, 0.1)):
        out = tmp_path / f"data_{radius}"
        record = make(scene, out, small(protocol="forward", val=0, train=9, radius=radius))
        assert record["settings"]["radius"] == expected
        positions = np.load(out / "poses_bounds.npy")[:, :15].reshape(-1, 3, 5)[:, :, 3]
        assert np.abs(positions - [0, -4, 0]).max() <= expected * 1.0001
        assert np.ptp(positions[:, 0]) > expected


@pytest.mark.slow
def test_many_passes_are_one_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Split into parts of very few samples, the noise and its estimate stay what they are."""
    scene = ball(tmp_path)
    whole = make(scene, tmp_path / "whole", small(spp=64))
    monkeypatch.setattr("mi_nerf.generation.passes.SAMPLES_PER_PASS", 40 * 32 * 5)
    parts = make(scene, tmp_path / "parts", small(spp=64))
    for name, view in whole["views"].items():
        noise = parts["views"][name]["noise"]
        assert noise["mse_linear"] == pytest.approx(view["noise"]["mse_linear"], rel=0.3)
        images = [exr(tmp_path / d / f"{name}.exr") for d in ("whole", "parts")]
        between = np.mean((images[0] - images[1])[..., :3] ** 2)
        assert between == pytest.approx(2 * noise["mse_linear"], rel=0.4)


# --------------------------------------------------------------------------
#   Bad input
# --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--train", "0"], "--train 0: expected at least 1"),
        (["--test", "-1"], "--test -1: expected 0 or more"),
        (["--size", "0", "40"], "--size 0 40: expected two numbers of at least 1"),
        (["--spp", "0"], "--spp 0: expected at least 2"),
        (["--spp", "1"], "--spp 1: expected at least 2"),
        (["--seed", "-1"], "--seed -1: expected a number from 0"),
        (["--radius", "0"], "--radius 0: expected a number above 0"),
        (["--center", "0", "nan", "0"], "expected three finite numbers"),
        (["--set", "radius"], "--set radius: expected name=value"),
        (["--set", "color=3"], "unused parameters"),
        (["--protocol", "forward", "--center", "3", "0", "0"], "--center: has no meaning"),
        (["--protocol", "forward", "--radius", "0"], "--radius 0: expected a number above 0"),
    ],
)
def test_bad_options(
    refused: Callable[..., str], tmp_path: Path, options: list[str], message: str
) -> None:
    small = ["--train", "1", "--val", "0", "--test", "0", "--size", "8", "8", "--spp", "2"]
    scene = ball(tmp_path)
    assert message in refused("generate", scene, tmp_path / "out", *small, *options)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('type="sphere"', 'type="speer"', "speer"),
        ('<emitter type="constant"><float name="radiance" value="0.8"/></emitter>', "", None),
        ("</scene>", "</scen>", "Mitsuba cannot load this scene"),
    ],
)
def test_bad_scenes(
    refused: Callable[..., str], tmp_path: Path, old: str, new: str, message: str | None
) -> None:
    scene = ball(tmp_path, **{old: new})
    if message is None:  # the lamp alone still lights it
        make(scene, tmp_path / "lit")
        scene = ball(
            tmp_path, **{old: new, "<emitter": "<!--<emitter", "</emitter>": "</emitter>-->"}
        )
        message = "has no emitter"
    line = refused("generate", scene, tmp_path / "out", "--size", "8", "8", "--spp", "2")
    assert message in line and str(scene) in line


def test_radiance_that_is_no_number(tmp_path: Path) -> None:
    scene = ball(tmp_path, **{'value="0.8"': 'value="1e39"'})
    with pytest.raises(InputError, match=r"view train/r_0: \d+.\d% of its samples are NaN or inf"):
        make(scene, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_nothing_to_see(refused: Callable[..., str], tmp_path: Path) -> None:
    scene = tmp_path / "empty.xml"
    light = '<emitter type="constant"/>'
    scene.write_text(f'<scene version="3.0.0">{light}</scene>')
    assert "its box is empty" in refused("generate", scene, tmp_path / "out")
    scene.write_text(
        f'<scene version="3.0.0">{light}<shape type="sphere"><emitter type="area"/></shape></scene>'
    )
    line = refused("generate", scene, tmp_path / "out")
    assert "all its shapes are light sources" in line and "expected --keep-emitters all" in line


def test_samplers_that_take_another_number(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two halves of at least as many samples as wanted, which is said."""
    scene = ball(tmp_path, SENSOR_Y_UP)
    record = make(scene, tmp_path / "out", small(spp=30))
    assert record["settings"]["spp"] == 32
    generate(scene, tmp_path / "told", VARIANT, small(spp=30))
    assert "32 samples a pixel" in capsys.readouterr().out


def test_folders_in_use(refused: Callable[..., str], tmp_path: Path) -> None:
    scene, other = ball(tmp_path), tmp_path / "other"
    other.mkdir()
    (other / "notes.txt").write_text("mine")
    assert "holds files already" in refused("generate", scene, other)
    assert "holds no dataset.json" in refused("generate", scene, other, "--resume")
    (other / "dataset.json").write_text("{}")
    assert "expected the record of a dataset" in refused("generate", scene, other, "--resume")
    assert "is a file" in refused("generate", scene, other / "notes.txt")
    assert "unknown, expected an .xml file or" in refused("generate", "nothing", tmp_path / "x")


# --------------------------------------------------------------------------
#   The command
# --------------------------------------------------------------------------


@pytest.mark.slow
def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "data"
    arguments = ["--train", "2", "--val", "0", "--test", "1", "--size", "24", "24", "--spp", "4"]
    assert main(["generate", str(ball(tmp_path)), str(out), *arguments]) == 0
    text, errors = capsys.readouterr()
    assert errors == ""
    assert "realistic360: 2 train, 0 val, 1 test views of 24x24, 4 samples a pixel" in text
    assert "scene box (-1, -1, -1) to (1, 1, 1)" in text
    assert f"{out}: 3 views of 24x24, PSNR ceiling train " in text
    assert not (out / "transforms_val.json").exists()
    assert main(["info", str(out)]) == 0
    text = capsys.readouterr().out
    assert "ball.xml, SHA-256" in text and "4 samples a pixel, seed 0" in text
