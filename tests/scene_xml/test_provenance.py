"""A scene's digest: every file that it reads counts, and nothing else does."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.scene_xml.scene_file import SceneFile
from tests.support import gallery

CONTENT = """<default name="size" value="0.4"/><path value="spectra"/>
    <include filename="parts/ball.xml"/><include filename="parts/defaults.xml"/>
    <emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>
    <emitter type="point"><point name="position" value="$x 0 $x"/>
        <spectrum name="intensity" filename="gold.k.spd"/></emitter>
    <shape type="obj"><string name="filename" value="wedge.obj"/><bsdf type="diffuse">
        <texture type="bitmap" name="reflectance">
            <string name="filename" value="textures/paint.png"/></texture></bsdf></shape>
    <shape type="serialized"><string name="filename" value="wedge.serialized"/></shape>
    <shape type="sphere"><float name="radius" value="$size"/><bsdf type="conductor">
        <spectrum name="eta" filename="gold.eta.spd"/></bsdf></shape>
    <shape type="cube"><bsdf type="null"/><medium name="interior" type="heterogeneous">
        <volume name="sigma_t" type="gridvolume"><string name="filename" value="blob.vol"/></volume>
        <float name="scale" value="$thickness"/></medium></shape>
    <shape type="bsplinecurve"><string name="filename" value="curls.txt"/><bsdf type="diffuse">
        <rgb name="reflectance" value="0.5 $tint 0.5"/></bsdf></shape>
    <shape type="cube"><transform name="to_world"><rotate z="1" angle="$turn"/></transform></shape>
    """


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    folder = tmp_path / "scene"
    folder.mkdir()
    gallery.write_assets(folder)
    (folder / "parts/defaults.xml").write_text(
        '<scene version="3.0.0"><default name="thickness" value="2"/><default name="x" value="7"/>'
        '<default name="turn" value="9"/><default name="tint" value="0.6"/></scene>'
    )
    path = folder / "scene.xml"
    path.write_text(f'<scene version="3.0.0">{CONTENT}</scene>')
    return path


def digest(scene: Path, **parameters: str) -> str:
    return SceneFile(scene, parameters).digest()


def appended(path: Path) -> None:
    path.write_bytes(path.read_bytes() + b"\n ")


def replaced(path: Path, old: str, new: str) -> None:
    path.write_text(path.read_text().replace(f'"{old}"', f'"{new}"'))


def other_number(path: Path) -> None:
    path.write_text(path.read_text().replace("3", "4"))


@pytest.mark.parametrize(
    ("file", "change"),
    [
        ("scene.xml", appended),
        ("parts/ball.xml", appended),
        *(
            ("parts/defaults.xml", partial(replaced, old=old, new=new))
            for old, new in (("2", "3"), ("7", "8"), ("9", "10"), ("0.6", "0.61"))
        ),
        ("sky.exr", appended),
        ("textures/paint.png", appended),
        ("wedge.obj", appended),
        ("wedge.serialized", appended),
        ("blob.vol", appended),
        ("curls.txt", appended),
        ("spectra/gold.k.spd", other_number),
        ("spectra/gold.eta.spd", lambda p: p.write_text("400 1.6000001\n700 0.16\n")),
        ("spectra/gold.eta.spd", lambda p: p.write_text("401 1.6\n500 0.9\n600 0.25\n700 0.16\n")),
    ],
)
def test_every_file_counts(
    variant: str, scene: Path, file: str, change: Callable[[Path], None]
) -> None:
    before = digest(scene)
    change(scene.parent / file)
    assert digest(scene) != before


def test_what_does_not_count(
    variant: str, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Names, places, the working directory, files that are not read, loading and replacing."""
    before = digest(scene)
    (scene.parent / "gold.k.spd").write_text("400 9\n700 9\n")  # hidden by the <path>
    moved = Path(shutil.copytree(scene.parent, tmp_path / "else where")) / "scene.xml"
    assert digest(moved) == before
    monkeypatch.chdir(moved.parent)
    assert digest(Path("scene.xml")) == before
    monkeypatch.chdir("parts")
    assert digest(Path("../scene.xml")) == before
    file = SceneFile(scene)
    file.substitute("Film", "Sampler")
    file.load()
    assert file.digest() == before


def test_parameters_count(variant: str, scene: Path) -> None:
    assert len({digest(scene), digest(scene, size="0.3"), digest(scene, size="0.2")}) == 3


def test_a_word_that_is_a_file_in_the_working_directory(
    variant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = tmp_path / "a/scene.xml"
    scene.parent.mkdir()
    scene.write_text(
        '<scene version="3.0.0"><integrator type="path"/><bsdf type="roughconductor">'
        '<string name="material" value="Au"/></bsdf></scene>'
    )
    before = digest(scene)
    (tmp_path / "Au").write_text("no metal")
    monkeypatch.chdir(tmp_path)
    assert digest(scene) == before


def test_a_file_that_is_gone(variant: str, scene: Path) -> None:
    file = SceneFile(scene)
    (scene.parent / "wedge.obj").unlink()
    with pytest.raises(InputError, match=r"wedge\.obj: cannot be read: No such file"):
        file.digest()


def test_files(variant: str, scene: Path) -> None:
    found = SceneFile(scene).files()
    assert len(found) == len(set(found)) and all(path.is_file() for path in found)
    assert {str(path.relative_to(scene.parent)) for path in found} >= {
        "scene.xml",
        "parts/ball.xml",
        "sky.exr",
        "wedge.obj",
        "textures/paint.png",
        "blob.vol",
    }


def test_random_bytes_of_a_texture(variant: str, scene: Path) -> None:
    """The digest is a function of the bytes, and tells any two apart."""
    rng = np.random.default_rng(1)
    texture = scene.parent / "textures/paint.png"
    found = {}
    for _ in range(8):
        content = rng.bytes(int(rng.integers(1, 3 << 20)))
        texture.write_bytes(content)
        found[content] = digest(scene)
    assert len(set(found.values())) == 8
    texture.write_bytes(next(iter(found)))
    assert digest(scene) == next(iter(found.values()))
