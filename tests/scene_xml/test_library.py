"""The scenes that come with mi_nerf: what a user and ``generate`` rely on."""

from __future__ import annotations

import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from mi_nerf.base.variants import choose_variant
from mi_nerf.cli import main
from mi_nerf.data import load_dataset
from mi_nerf.generation import PROTOCOLS, Options, generate
from mi_nerf.generation.run import prepare
from mi_nerf.plugins.placement import find_fields
from mi_nerf.scene_xml.library import find_scene, scene_folder, scenes
from mi_nerf.scene_xml.scene_file import SceneFile, visible_bounds

VARIANT = choose_variant()
FOLDER = scene_folder()
ASSETS = FOLDER / "assets"
COMPOSED = sorted(path.stem for path in (FOLDER / "composed").glob("*.xml"))
NAMES = sorted(set(scenes()) - set(COMPOSED))
GROUPS = {"realistic": 8, "diffuse": 4, "forward": 2, "unbounded": 2, "hard": 4}
UNBOUNDED = sorted(path.stem for path in (FOLDER / "unbounded").glob("*.xml"))
# Mean alpha and mean luminance, of pixels up to 1, of 24x18 pixels with 256 samples each.
LOOKS = {
    **{"arches": (0.387, 0.128), "birdcage": (0.285, 0.074), "blob": (0.097, 0.073)},
    **{"bonsai": (0.318, 0.050), "cathedral": (0.313, 0.166), "corner": (1.0, 0.379)},
    **{"courtyard": (1.0, 0.278), "studio": (1.0, 0.208)},
    **{"decanter": (0.265, 0.065), "fog": (0.387, 0.117), "globe": (0.366, 0.134)},
    **{"hdr": (0.249, 0.035), "kettle": (0.347, 0.099), "knot": (0.349, 0.093)},
    **{"lamp": (0.337, 0.129), "pieces": (0.327, 0.088), "puzzleball": (0.361, 0.145)},
    **{"sheet": (0.338, 0.104), "spheres": (0.327, 0.120), "valley": (1.0, 0.265)},
    "vase": (0.307, 0.083),
}
PLUGINS = {"integrator", "sensor", "film", "sampler", "emitter", "shape", "bsdf", "medium"}


@pytest.mark.parametrize("group", GROUPS)
def test_the_suite(group: str) -> None:
    mi.set_variant(VARIANT)
    files = list((FOLDER / group).glob("*.xml"))
    assert len(files) == GROUPS[group]
    cameras = [SceneFile(file).default("cameras") for file in files if group == "realistic"]
    if group == "realistic":
        mi.set_variant(VARIANT)
        assert sorted(filter(None, cameras)) == ["hemisphere"] * 6 + ["sphere"] * 2


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_every_scene(name: str) -> None:
    """Parameters, the box, and a picture that covers and shines as it did when it was made."""
    mi.set_variant(VARIANT)
    path = find_scene(name)
    file = SceneFile(path, {"width": "24", "height": "18", "spp": "4"})
    scene = file.load()
    film = scene.sensors()[0].film()
    assert list(film.size()) == [24, 18]
    assert scene.sensors()[0].sampler().sample_count() == 4
    protocol = file.default("protocol")
    assert protocol in PROTOCOLS
    box = visible_bounds(scene)
    assert box is not None
    reach = np.abs(np.array(box)).max()
    assert reach > 20 if name in UNBOUNDED else reach <= 1.0001
    image = np.array(mi.render(scene, seed=1, spp=16))
    assert image[..., :3].min() >= 0
    alpha, luminance = image[..., 3], image[..., :3] @ [0.2126, 0.7152, 0.0722]
    full = protocol == "forward" or name in UNBOUNDED
    assert (alpha == 1).all() if full else (alpha == 0).any()
    assert alpha.mean() == pytest.approx(LOOKS[name][0], abs=0.02)
    assert np.minimum(luminance, 1).mean() == pytest.approx(LOOKS[name][1], rel=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("name", COMPOSED)
def test_scenes_of_fields(name: str, tmp_path: Path) -> None:
    """Found and rendered by name; in some pixels there is a field, in some there is none."""
    picture = tmp_path / "picture.exr"
    size = ["--size", "40", "20", "--spp", "2"]
    assert main(["render", name, "-o", str(picture), "--variant", VARIANT, *size]) == 0
    image = OpenEXR.File(str(picture)).channels()["RGBA"].pixels
    assert image.shape == (20, 40, 4) and np.isfinite(image).all() and (image[..., 3] > 0.999).all()
    mi.set_variant(VARIANT)
    file = SceneFile(find_scene(name), {"width": "40", "height": "20", "spp": "1", "depth": "1"})
    scene = file.load()
    assert len(find_fields(scene)) == (2 if name == "interlocked" else 1)
    opaque = mi.load_dict({"type": "nerf", "aovs": "opacity"})
    opacity = np.array(mi.render(scene, integrator=opaque))[..., 4]
    assert 0.05 < (opacity > 0.9).mean() < 0.6 and (opacity == 0).mean() > 0.2


def test_fields_are_small() -> None:
    files = list((FOLDER / "fields").iterdir())
    assert all(path.stat().st_size < 600e3 for path in files)
    text = "".join(path.read_text() for path in (FOLDER / "composed").glob("*.xml"))
    assert all(path.name in text for path in files)


@pytest.mark.parametrize("name", NAMES + COMPOSED)
def test_everything_has_an_id(name: str) -> None:
    """Otherwise Mitsuba names parameters after addresses in memory."""
    root = ElementTree.parse(find_scene(name)).getroot()
    assert root.get("version") == "3.0.0"
    for element in root.iter():
        assert element.tag not in PLUGINS or element.get("id") or inner(element, root), (
            ElementTree.tostring(element)[:200]
        )


def inner(element: ElementTree.Element, root: ElementTree.Element) -> bool:
    """A material inside a material, such as that of ``twosided``, goes by the outer one's id."""
    parents = {child: parent for parent in root.iter() for child in parent}
    return element.tag == "bsdf" and parents[element].tag == "bsdf"


def test_lambertian_scenes_are_lambertian() -> None:
    for file in (FOLDER / "diffuse").glob("*.xml"):
        for bsdf in ElementTree.parse(file).getroot().iter("bsdf"):
            assert bsdf.get("type") in ("diffuse", "twosided"), file


@pytest.mark.parametrize("file", sorted(p.name for p in ASSETS.glob("*.txt")))
def test_nothing_meets_the_end_of_the_last_curve(file: str) -> None:
    """Mitsuba 3.9.1 may crash there: a thin curve inside the one before is the last."""
    blocks = (ASSETS / file).read_text().strip().split("\n\n")
    *_, outer, hidden = (np.array([r.split() for r in b.split("\n")], float) for b in blocks)
    t = np.linspace(0, 1, 200)[:, None]
    weights = np.hstack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, 1 + 3 * t + 3 * t**2 - 3 * t**3])
    weights = np.hstack([weights, t**3]) / 6  # of a uniform cubic B-spline
    seen = np.concatenate([weights @ outer[i : i + 4] for i in range(len(outer) - 3)])
    for point in hidden:
        distance = np.linalg.norm(seen[:, :3] - point[:3], axis=1) + point[3]
        assert (distance < 0.5 * seen[:, 3]).any()


def test_assets_are_small() -> None:
    total = sum(p.stat().st_size for p in ASSETS.iterdir() if p.suffix != ".py")
    assert total < 3.4e6


def test_no_asset_lies_idle() -> None:
    text = "".join(p.read_text() for p in FOLDER.rglob("*.xml"))
    for path in ASSETS.iterdir():
        if path.is_file() and path.suffix != ".py":
            assert path.name in text, path.name


SCRIPTS = sorted(p.name for p in ASSETS.glob("*.py"))


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS)
def test_scripts_make_the_files_again(script: str, tmp_path: Path) -> None:
    """Texts and headers to the byte, numbers up to what another processor rounds."""
    subprocess.run([sys.executable, str(ASSETS / script), str(tmp_path)], check=True)
    for made in tmp_path.iterdir():
        kept = ASSETS / made.name
        assert kept.is_file(), f"{made.name} is not in scenes/assets"
        same_content(made, kept)


def same_content(made: Path, kept: Path) -> None:
    if made.read_bytes() == kept.read_bytes():
        return
    if made.suffix == ".ply":
        a, b = (mi.load_dict({"type": "ply", "filename": str(p)}) for p in (made, kept))
        assert (a.vertex_count(), a.face_count()) == (b.vertex_count(), b.face_count())
        close = np.array(a.bbox().max) == pytest.approx(np.array(b.bbox().max), abs=1e-4)
        assert close
        return
    if made.suffix in (".png", ".jpg"):
        import imageio.v3 as iio

        a, b = (iio.imread(p).astype(float) for p in (made, kept))
        assert a.shape == b.shape and np.abs(a - b).mean() < 1
        return
    a, b = (p.read_text().split() for p in (made, kept))
    assert len(a) == len(b)


# ---- Scenes of which the answer is known -------------------------------------


def one_view(name: str, folder: Path, spp: int, size: int = 48) -> tuple[np.ndarray, ...]:
    """Image, distance, and the pixels' central rays of a generated view."""
    options = Options(train=1, val=0, test=0, size=(size, size), spp=spp, seed=2)
    generate(find_scene(name), folder, VARIANT, options, show=False)
    image, depth = (
        next(iter(OpenEXR.File(str(folder / f"train/r_0{end}.exr")).channels().values())).pixels
        for end in ("", "_depth")
    )
    views = load_dataset(folder, "train")
    pose, camera = views.cam_to_world[0], views.intrinsics
    y, x = np.mgrid[:size, :size] + 0.5
    local = [(x - camera.cx) / camera.fx, (camera.cy - y) / camera.fy, -np.ones_like(x)]
    d = np.stack(local, -1) @ pose[:3, :3].T
    return image, depth, pose[:3, 3], d / np.linalg.norm(d, axis=-1, keepdims=True)


def test_blob_has_the_stated_integral(tmp_path: Path) -> None:
    image, _, o, d = one_view("blob", tmp_path / "data", 64)
    b2 = o @ o - (d @ o) ** 2
    opacity = -np.expm1(-12 * 0.2 * np.sqrt(2 * np.pi) * np.exp(-b2 / (2 * 0.2**2)))
    # A pixel shows the mean over its area: within what the opacity changes across it.
    slope = np.hypot(*np.gradient(opacity))
    assert (np.abs(image[..., 3] - opacity) <= 0.02 + 0.3 * slope).all()
    assert np.abs(image[..., 3] - opacity).mean() < 3e-3
    for channel, radiance in enumerate((1.6, 0.55, 0.16)):
        assert image[..., channel] == pytest.approx(radiance * image[..., 3], abs=1e-3)


@pytest.mark.slow
def test_fog_has_the_stated_transmittance(tmp_path: Path) -> None:
    """Where a ray meets nothing but fog, alpha is what the fog keeps back."""
    image, depth, o, d = one_view("fog", tmp_path / "data", 512)
    lower, upper = np.array([-0.8, -0.8, -0.6]), np.array([0.8, 0.8, -0.05])
    t = np.stack([(lower - o) / d, (upper - o) / d])
    near, far = t.min(0).max(-1), t.max(0).min(-1)
    length = np.maximum(far - near, 0)
    # Not near the edges of things: alpha is a mean over the pixel, depth its centre.
    empty = np.pad(depth, 1, mode="edge") == 0
    shifted = [empty[1 + i : 49 + i, 1 + j : 49 + j] for i in (-1, 0, 1) for j in (-1, 0, 1)]
    alone = np.logical_and.reduce(shifted) & (length > 0.02)
    expected = -np.expm1(-2 * length[alone])
    assert alone.sum() > 20 and np.ptp(expected) > 0.2
    found = image[..., 3][alone]
    noise = np.sqrt(expected * (1 - expected) / 512)
    slope = np.hypot(*np.gradient(-np.expm1(-2 * length)))[alone]
    assert (np.abs(found - expected) <= 5 * noise + slope).all()
    assert abs((found - expected).mean()) < 0.02


@pytest.mark.slow
def test_hdr_spans_four_decades(tmp_path: Path) -> None:
    image, _, _, _ = one_view("hdr", tmp_path / "data", 256, size=64)
    seen = image[..., 3] > 0.99
    luminance = image[..., :3][seen] @ [0.2126, 0.7152, 0.0722]
    assert luminance.max() > 1e4 * np.quantile(luminance, 0.1)


# ---- Scenes without an end ---------------------------------------------------


def distances(scene: Any, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """How far along rays something is; infinite where nothing is."""
    ray = mi.Ray3f(mi.Point3f(origins.T), mi.Vector3f(directions.T))
    return np.array(scene.ray_intersect_preliminary(ray).t)


def everywhere(count: int) -> np.ndarray:
    """Unit vectors that are spread over the sphere, (count, 3)."""
    z = 1 - 2 * (np.arange(count) + 0.5) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    level = np.sqrt(1 - z * z)
    return np.stack([level * np.cos(angle), level * np.sin(angle), z], 1)


@pytest.mark.slow
def test_cameras_of_the_courtyard_stand_in_the_court() -> None:
    """Clear of everything, with the object before them, hills behind it, and some sky."""
    mi.set_variant(VARIANT)
    file = SceneFile(find_scene("courtyard"))
    _, plan = prepare(file, Options(train=24, val=0, test=0, size=(32, 32), spp=2))
    scene = SceneFile(find_scene("courtyard")).load()
    places = np.array([view.pose[:3, 3] for view in plan.views])
    center = np.array(plan.center)
    assert np.linalg.norm(places - center, axis=1) == pytest.approx(plan.radius)
    assert (np.abs(places[:, :2]) < 6).all() and (places[:, 2] > 1.4).all()
    assert (places[:, 2] < 4.5).all()
    around = everywhere(256)
    for place in places:
        assert distances(scene, np.tile(place, (256, 1)), around).min() > 0.5
    # From the centre to the cameras nothing but the object itself is in the way.
    inwards = (center - places) / plan.radius
    beyond = distances(scene, places, inwards)
    assert (beyond > plan.radius - 1.6).all()
    seen = np.concatenate([distances(scene, np.tile(p, (256, 1)), around) for p in places])
    assert (seen > 100).mean() > 0.02 and np.isinf(seen).mean() > 0.2
    assert np.quantile(seen[np.isfinite(seen)], 0.5) < 10
    assert plan.subject.names and all(name.startswith("fountain") for name in plan.subject.names)


@pytest.mark.slow
def test_the_studio_is_closed_but_for_its_window() -> None:
    mi.set_variant(VARIANT)
    scene = SceneFile(find_scene("studio")).load()
    around = everywhere(4096)
    for place in ((0.3, -0.3, 1.5), (-1.5, -0.5, 1.2), (2.0, 0.8, 1.7)):
        found = distances(scene, np.tile(place, (4096, 1)), around)
        outside = np.array(place) + np.minimum(found, 100)[:, None] * around
        escaped = (np.abs(outside) > [3.21, 2.61, 3.3]).any(axis=1)
        out = around[escaped]
        assert 0.02 < escaped.mean() < 0.2 and (out[:, 1] > 0).all()
        through = np.array(place) + out * ((2.6 - place[1]) / out[:, 1])[:, None]
        assert (through >= [-2.01, 0, 0.81]).all() and (through <= [1.41, 3, 2.76]).all()
        assert np.isinf(found).any() and found[np.isfinite(found)].max() > 10
