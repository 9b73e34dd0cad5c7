"""The scenes that come with mi_nerf: what a user and ``generate`` rely on."""

from __future__ import annotations

import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_nerf.backend import choose_variant
from mi_nerf.generation import PROTOCOLS
from mi_nerf.scene_file import SceneFile, visible_bounds
from mi_nerf.scene_library import find_scene, scene_folder, scenes

VARIANT = choose_variant()
FOLDER = scene_folder()
ASSETS = FOLDER / "assets"
NAMES = sorted(scenes())
GROUPS = {"realistic": 8, "diffuse": 4, "forward": 2, "hard": 4}
PLUGINS = {"integrator", "sensor", "film", "sampler", "emitter", "shape", "bsdf", "medium"}


@pytest.mark.parametrize("group", GROUPS)
def test_the_suite(group: str) -> None:
    files = list((FOLDER / group).glob("*.xml"))
    assert len(files) == GROUPS[group]
    cameras = [SceneFile(file).default("cameras") for file in files if group == "realistic"]
    if group == "realistic":
        mi.set_variant(VARIANT)
        assert sorted(filter(None, cameras)) == ["hemisphere"] * 6 + ["sphere"] * 2


@pytest.mark.parametrize("name", NAMES)
def test_every_scene(name: str) -> None:
    """Parameters, ids, the box, and a picture with something in it."""
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
    assert box is not None and np.abs(np.array(box)).max() <= 1.0001
    image = np.array(mi.render(scene, seed=1))
    assert np.isfinite(image).all() and image[..., :3].min() >= 0
    alpha = image[..., 3]
    if protocol == "forward":
        assert (alpha == 1).all()
    else:
        assert 0.05 < (alpha > 0).mean() and (alpha == 0).any()
    assert image[..., :3].max() > 0.1


@pytest.mark.parametrize("name", NAMES)
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


def test_assets_are_small() -> None:
    total = sum(p.stat().st_size for p in ASSETS.iterdir() if p.suffix != ".py")
    assert total < 1.2e6


def test_no_asset_lies_idle() -> None:
    text = "".join(p.read_text() for p in FOLDER.rglob("*.xml"))
    for path in ASSETS.iterdir():
        if path.is_file() and path.suffix != ".py":
            assert path.name in text, path.name


SCRIPTS = sorted(p.name for p in ASSETS.glob("*.py"))


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
    if made.suffix == ".png":
        import imageio.v3 as iio

        a, b = (iio.imread(p).astype(float) for p in (made, kept))
        assert a.shape == b.shape and np.abs(a - b).mean() < 1
        return
    a, b = (p.read_text().split() for p in (made, kept))
    assert len(a) == len(b)
