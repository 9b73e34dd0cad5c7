"""Pictures and videos: what lies in the files, and where the cameras stand."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from mi_nerf import load_field
from mi_nerf.base.color import linear_to_srgb
from mi_nerf.base.variants import array_module, choose_variant
from mi_nerf.cameras.pinhole import Intrinsics, sensor_dict
from mi_nerf.cameras.poses import look_at
from mi_nerf.cli import main
from mi_nerf.march.view import render_view
from tests.support.fields import scene_dict, small_file


def render(target: Path, out: Path, *options: Any) -> Path:
    assert main(["render", str(target), "-o", str(out), *map(str, options)]) == 0
    return out


def read_exr(path: Path) -> np.ndarray:
    """(H, W, 4) as stored; the file must hold 32-bit floats in R, G, B and A."""
    channels = OpenEXR.File(str(path), separate_channels=True).channels()
    assert channels.keys() == set("RGBA")
    planes = [channels[name].pixels for name in "RGBA"]
    assert all(plane.dtype == np.float32 for plane in planes)
    return np.stack(planes, axis=-1)


def read_png(path: Path) -> np.ndarray:
    """(H, W, 4) 8-bit straight RGBA as numbers up to 1."""
    pixels = iio.imread(path)
    assert pixels.dtype == np.uint8 and pixels.shape[-1] == 4
    return pixels / 255


def read_video(path: Path) -> np.ndarray:
    """(N, H, W, 3) 8-bit frames, from ffmpeg itself: imageio's reader leaves pipes open."""
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="a GPU machine may lack it")
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path), "-f", "rawvideo"]
    result = subprocess.run([*command, "-pix_fmt", "rgb24", "-"], capture_output=True, check=True)
    found = re.search(r"Video: h264.*?, (\d+)x(\d+)", result.stderr.decode())
    assert found is not None
    width, height = map(int, found.groups())
    return np.frombuffer(result.stdout, np.uint8).reshape(-1, height, width, 3)


def encoded(linear: np.ndarray) -> np.ndarray:
    """Linear premultiplied RGBA as straight sRGB."""
    alpha = linear[..., 3:].astype(float)
    color = linear_to_srgb(linear[..., :3] / np.where(alpha > 0, alpha, 1))
    return np.concatenate([np.clip(np.where(alpha > 0, color, 0), 0, 1), alpha], axis=-1)


def over_white(straight: np.ndarray) -> np.ndarray:
    return straight[..., :3] * straight[..., 3:] + 1 - straight[..., 3:]


# --------------------------------------------------------------------------
#   Runs
# --------------------------------------------------------------------------


def test_png_and_exr_are_the_same_picture(blob_run: Path, tmp_path: Path) -> None:
    linear = read_exr(render(blob_run, tmp_path / "new" / "a.exr"))
    straight = read_png(render(blob_run, tmp_path / "a.png"))
    assert linear.shape == straight.shape == (24, 24, 4)
    alpha = linear[..., 3]
    assert 0 <= alpha.min() < 0.1 and 0.1 < alpha.max() <= 1
    assert straight == pytest.approx(encoded(linear), abs=0.5 / 255 + 1e-5)


def test_names_in_capitals(blob_run: Path, tmp_path: Path) -> None:
    assert read_exr(render(blob_run, tmp_path / "A.EXR")).shape == (24, 24, 4)
    assert read_png(render(blob_run, tmp_path / "A.PNG")).shape == (24, 24, 4)


@pytest.mark.slow
@pytest.mark.parametrize(("size", "stored"), [((32, 26), (26, 32)), ((33, 27), (28, 34))])
def test_videos(
    size: tuple[int, int],
    stored: tuple[int, int],
    blob_run: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    options = ["--frames", 5, "--size", *size]
    video = read_video(render(blob_run, tmp_path / "a.mp4", *options))
    assert capfd.readouterr().err == ""  # no warnings of ffmpeg's
    assert video.shape == (5, *stored, 3)  # even numbers, as players want them
    folder = render(blob_run, tmp_path / "a", *options)
    for frame, file in zip(video, sorted(folder.iterdir()), strict=True):
        picture = over_white(read_png(file))
        difference = np.abs(frame[: size[1], : size[0]] / 255 - picture)
        assert difference.mean() < 0.02
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


@pytest.mark.parametrize("path", ["orbit", "spiral"])
def test_paths_of_runs(path: str, blob_run: Path, tmp_path: Path) -> None:
    folder = render(blob_run, tmp_path / "a", "--path", path, "--frames", 3)
    files = sorted(folder.iterdir())
    assert [f.name for f in files] == [f"{path}_{i:03d}.png" for i in range(3)]
    pictures = [f.read_bytes() for f in files]
    assert len(set(pictures)) == 3


def test_a_folder_with_a_dot_must_exist(blob_run: Path, tmp_path: Path) -> None:
    (tmp_path / "v1.2").mkdir()
    render(blob_run, tmp_path / "v1.2", "--frames", 1)
    assert (tmp_path / "v1.2" / "orbit_000.png").is_file()


@pytest.mark.slow
def test_test_views_are_those_of_the_evaluation(blob_run: Path, tmp_path: Path) -> None:
    folder = render(blob_run, tmp_path / "views", "--path", "test")
    files = sorted(folder.iterdir())
    assert [f.name for f in files] == [f"test_{i:03d}.png" for i in range(5)]
    assert main(["eval", str(blob_run), "--images", str(tmp_path / "eval")]) == 0
    for i, file in enumerate(files):
        expected = iio.imread(tmp_path / "eval" / f"r_{i}.png") / 255
        # Colour and alpha are rounded to 8 bits before they are put on white.
        assert over_white(read_png(file)) == pytest.approx(expected, abs=1.6 / 255)


def test_a_test_view_in_full_precision(blob_run: Path, tmp_path: Path) -> None:
    linear = read_exr(render(blob_run, tmp_path / "a.exr", "--path", "test"))
    assert main(["eval", str(blob_run), "--views", "1", "--images", str(tmp_path)]) == 0
    expected = iio.imread(tmp_path / "r_0.png") / 255
    assert over_white(encoded(linear)) == pytest.approx(expected, abs=0.5 / 255 + 1e-5)


def test_some_test_views(blob_run: Path, tmp_path: Path) -> None:
    few = render(blob_run, tmp_path / "few", "--path", "test", "--frames", 2)
    every = render(blob_run, tmp_path / "all", "--path", "test")
    for new, old in enumerate([0, 2]):  # of five, evenly spread
        picture = (few / f"test_{new:03d}.png").read_bytes()
        assert picture == (every / f"test_{old:03d}.png").read_bytes()


@pytest.mark.slow
def test_size_keeps_the_field_of_view(blob_run: Path, tmp_path: Path) -> None:
    options = ["--path", "test"]
    small = read_exr(render(blob_run, tmp_path / "a.exr", *options))
    large = read_exr(render(blob_run, tmp_path / "b.exr", *options, "--size", 72, 72))
    assert large.shape == (72, 72, 4)
    assert large[1::3, 1::3] == pytest.approx(small, abs=1e-4)  # the same rays
    wide = read_exr(render(blob_run, tmp_path / "c.exr", *options, "--size", 24, 12))
    assert wide == pytest.approx(small[6:18], abs=1e-4)


@pytest.mark.slow
def test_spp_averages_over_the_pixel(blob_run: Path, tmp_path: Path) -> None:
    options = ["--path", "test"]
    fine = read_exr(render(blob_run, tmp_path / "a.exr", *options, "--size", 48, 48))
    smooth = read_exr(render(blob_run, tmp_path / "b.exr", *options, "--spp", 4))
    alpha = fine[..., 3].reshape(24, 2, 24, 2).mean(axis=(1, 3))
    assert smooth[..., 3] == pytest.approx(alpha, abs=1e-4)


# --------------------------------------------------------------------------
#   Scenes
# --------------------------------------------------------------------------

XML = """<scene version="3.0.0">
    <integrator type="nerf">{options}</integrator>
    <sensor type="perspective">
        <float name="fov" value="40"/>
        <transform name="to_world">
            <lookat origin="1.5, -3, 1" target="0, 0, 0" up="0, 0, 1"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="{width}"/><integer name="height" value="{height}"/>
            <string name="pixel_format" value="{pixels}"/><rfilter type="box"/>
        </film>
        <sampler type="independent"><integer name="sample_count" value="2"/></sampler>
    </sensor>
    <shape type="cube">
        <bsdf type="null"/>
        <medium type="nerfmedium" name="interior">
            <string name="filename" value="field_0.safetensors"/>
        </medium>
    </shape>
    {objects}
</scene>
"""


@pytest.fixture
def scene(tmp_path: Path) -> Callable[..., Path]:
    """Writes a scene with a small field; returns its path."""
    small_file(tmp_path, color_space="linear")

    def write(
        width: int = 16,
        height: int = 12,
        pixels: str = "rgba",
        options: str = "",
        objects: str = "",
        name: str = "scene.xml",
    ) -> Path:
        path = tmp_path / name
        path.write_text(
            XML.format(width=width, height=height, pixels=pixels, options=options, objects=objects)
        )
        return path

    return write


def test_scenes_as_mitsuba_renders_them(scene: Callable[..., Path], tmp_path: Path) -> None:
    path = scene()
    linear = read_exr(render(path, tmp_path / "a.exr", "--spp", 4))
    straight = read_png(render(path, tmp_path / "a.png", "--spp", 4))
    mi.set_variant(choose_variant())
    expected = np.array(mi.render(mi.load_file(str(path)), spp=4))
    assert linear == pytest.approx(expected, abs=1e-6)
    assert straight == pytest.approx(encoded(linear), abs=0.5 / 255 + 1e-5)
    assert expected[..., 3].max() > 0.1


def test_size_of_scenes(scene: Callable[..., Path], tmp_path: Path) -> None:
    resized = read_exr(render(scene(), tmp_path / "a.exr", "--size", 33, 27))
    native = read_exr(render(scene(33, 27), tmp_path / "b.exr"))
    assert resized.shape == (27, 33, 4)
    assert resized == pytest.approx(native, abs=1e-6)


def test_samples_of_scenes(scene: Callable[..., Path], tmp_path: Path) -> None:
    own = read_exr(render(scene(), tmp_path / "a.exr"))
    same = read_exr(render(scene(), tmp_path / "b.exr", "--spp", 2))
    more = read_exr(render(scene(), tmp_path / "c.exr", "--spp", 8))
    assert np.array_equal(own, same)
    assert not np.array_equal(own, more)


@pytest.mark.parametrize("path", ["orbit", "spiral"])
def test_paths_of_scenes(path: str, scene: Callable[..., Path], tmp_path: Path) -> None:
    folder = render(scene(), tmp_path / "a", "--path", path, "--frames", 3)
    files = sorted(folder.iterdir())
    assert [f.name for f in files] == [f"{path}_{i:03d}.png" for i in range(3)]
    assert len({f.read_bytes() for f in files}) == 3
    assert all(read_png(f)[..., 3].max() > 0.1 for f in files)  # the field is in view


def test_video_of_a_scene(scene: Callable[..., Path], tmp_path: Path) -> None:
    out = render(scene(), tmp_path / "a.mp4", "--path", "orbit", "--frames", 3)
    assert read_video(out).shape == (3, 12, 16, 3)


def test_all_sensors_of_a_scene(
    scene: Callable[..., Path], refused: Callable[..., str], tmp_path: Path
) -> None:
    second = """<sensor type="perspective"><film type="hdrfilm">
        <integer name="width" value="8"/><integer name="height" value="6"/></film></sensor>"""
    path = scene(objects=second)
    folder = render(path, tmp_path / "a")
    assert [f.name for f in sorted(folder.iterdir())] == ["sensor_000.png", "sensor_001.png"]
    assert "a.png: one picture for 2 frames" in refused("render", path, "-o", tmp_path / "a.png")


@pytest.mark.parametrize("aovs", ["", '<string name="aovs" value="opacity,depth"/>'])
@pytest.mark.parametrize("pixels", ["rgb", "rgba", "luminance", "luminance_alpha"])
def test_pixel_formats(aovs: str, pixels: str, scene: Callable[..., Path], tmp_path: Path) -> None:
    expected = read_exr(render(scene(), tmp_path / "a.exr"))
    found = read_exr(render(scene(pixels=pixels, options=aovs), tmp_path / "b.exr"))
    opaque = pixels in ("rgb", "luminance")
    assert found[..., 3] == pytest.approx(np.ones((12, 16)) if opaque else expected[..., 3])
    if pixels.startswith("rgb"):
        assert found[..., :3] == pytest.approx(expected[..., :3], abs=1e-5)
    else:
        assert np.array_equal(found[..., 0], found[..., 1])
        assert np.array_equal(found[..., 0], found[..., 2])
        grey = expected[..., :3] @ [0.212671, 0.715160, 0.072169]
        assert found[..., 0] == pytest.approx(grey, abs=1e-4)


# --------------------------------------------------------------------------
#   The two renderers
# --------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("space", ["linear", "srgb"])
def test_mitsuba_sees_what_evaluation_sees(space: str, tmp_path: Path) -> None:
    """One field, one camera, once through ``mi.render`` and once through ``render_view``."""
    path = small_file(tmp_path, color_space=space, upper=(1.0, 0.7, 0.8))
    variant = choose_variant()
    mi.set_variant(variant)
    camera = Intrinsics(20, 14, 26.0, 26.0, 9.0, 8.5)  # off centre
    pose = look_at((1.4, -2.5, 1.7), (0.1, 0.0, -0.1), (0.2, 0.1, 1.0))
    parts = scene_dict(path, integrator={"jitter": False})
    parts["sensor"] = sensor_dict(camera, pose)
    seen = np.array(mi.render(mi.load_dict(parts), spp=128)).astype(float)

    contents = load_field(path)
    backend = array_module(variant)
    view = render_view(contents.marched(backend), camera, pose, backend, spp=64)
    assert view.opacity.max() > 0.3
    if space == "srgb":  # Mitsuba averages a pixel in linear space, evaluation in sRGB
        seen = encoded(seen)
        seen[..., :3] *= seen[..., 3:]
    # Noise at the edges of the box alone; cameras a tenth of a pixel apart differ by 0.008.
    difference = np.abs(np.concatenate([view.color, view.opacity[..., None]], axis=-1) - seen)
    assert difference.max() < 0.08
    assert (difference.mean(axis=(0, 1)) < 0.003).all()
