"""Whatever Mitsuba loads is loaded, from anywhere; whatever it refuses is refused in one line."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.scene_xml.library import find_scene
from mi_nerf.scene_xml.scene_file import SceneFile, visible_bounds

TRIANGLE = "v 0 0 0\nv {size} 0 0\nv 0 {size} 0\nf 1 2 3\n"
MESH = '<shape type="obj"><string name="filename" value="{}"/></shape>'
SPECTRUM = '<emitter type="constant"><spectrum name="radiance" filename="{}"/></emitter>'


def scene(content: str, version: str = "3.0.0") -> str:
    return f'<scene version="{version}">{content}</scene>'


def write(path: Path, content: str, version: str = "3.0.0") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(scene(content, version), "utf-8")
    return path


def mesh(path: Path, size: float = 1) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(TRIANGLE.format(size=size))
    return path


def spectrum(path: Path, value: float = 0.5) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"400 {value}\n700 {value}\n")
    return path


def resolver() -> list[str]:
    return [str(folder) for folder in mi.file_resolver()]


# ---- Encodings ---------------------------------------------------------------

BALL = '<!-- -- Köln -- --><shape type="sphere" id="Köln"/><bsdf type="diffuse" id="größe"/>'
DECLARED = '<?xml version="1.0" encoding="{}"?>'


@pytest.mark.parametrize(
    ("encoding", "head"),
    [
        ("utf-8", ""),
        ("utf-8-sig", ""),
        ("utf-8", DECLARED.format("utf-8")),
        ("utf-16", DECLARED.format("utf-16")),
        ("utf-16", ""),
        ("utf-32", ""),
        ("latin-1", DECLARED.format("ISO-8859-1")),
        ("latin-1", DECLARED.format("latin1")),
        ("latin-1", ""),
        ("cp1252", DECLARED.format("windows-1252")),
    ],
)
def test_encodings(variant: str, tmp_path: Path, encoding: str, head: str) -> None:
    path = tmp_path / "scene.xml"
    path.write_bytes((head + scene(BALL)).encode(encoding))
    assert len(mi.load_file(str(path)).shapes()) == 1
    file = SceneFile(path)
    assert len(file.load().shapes()) == 1
    assert file.default("protocol") is None
    assert len(file.digest()) == 64


def test_a_name_in_no_known_encoding_that_must_be_told(variant: str, tmp_path: Path) -> None:
    path = tmp_path / "scene.xml"
    path.write_bytes(scene('<shape type="sphäre"/>').encode("latin-1"))
    with pytest.raises(InputError, match=r"scene\.xml: "):
        SceneFile(path).load()


def test_entities_spaces_and_capitals(variant: str, tmp_path: Path) -> None:
    content = """<!DOCTYPE scene [<!ENTITY unused "x">]><scene version="3.0.0">
        <![CDATA[ <shape> ]]><?target data?>
        <shape type="sphere"><float name="radius" value=" 2.5e-1 "/>
            <point name="center" value="1 2,3"/><boolean name="flip_normals" value="TRUE"/>
            <transform name="to_world"><scale value="2"/><rotate z="1" angle="90"/></transform>
        </shape>
        <shape type="cube" id="a&amp;b&#228;"/></scene>"""
    path = tmp_path / "scene.xml"
    path.write_text(content, "utf-8")
    box = SceneFile(path).load().shapes()[0].bbox()
    assert np.ravel(box.center()) == pytest.approx([-4, 2, 6], abs=1e-5)
    assert np.ravel(box.extents()) == pytest.approx([1, 1, 1], abs=1e-5)


# ---- Where files are looked for ----------------------------------------------


def test_paths_and_includes_as_mitsuba_resolves_them(
    variant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A <path> of the scene serves meshes as well; those of an included file serve only it."""
    mesh(tmp_path / "meshes/m.obj")
    spectrum(tmp_path / "spectra/s.spd")
    spectrum(tmp_path / "beside.spd")
    write(tmp_path / "parts/deep/inner.xml", SPECTRUM.format("beside.spd"))
    write(tmp_path / "parts/outer.xml", '<path value="deep"/><include filename="deep/inner.xml"/>')
    path = write(
        tmp_path / "scene.xml",
        '<path value="meshes"/><path value="spectra"/><include filename="parts/outer.xml"/>'
        '<bsdf type="diffuse" id="b"><spectrum name="reflectance" filename="s.spd"/></bsdf>'
        + MESH.format("m.obj"),
    )
    before = resolver()
    file = SceneFile(path)
    monkeypatch.chdir("/")
    loaded = file.load()
    assert len(loaded.shapes()) == 1 and len(loaded.emitters()) == 1
    assert {found.name for found in file.files()} == {
        "scene.xml",
        "outer.xml",
        "inner.xml",
        "m.obj",
    }
    assert file.load() is not None  # a scene may be loaded again
    assert resolver() == before


def test_a_scene_s_own_folder_comes_before_the_working_directory(
    variant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh(tmp_path / "a/m.obj", 1)
    mesh(tmp_path / "b/m.obj", 9)
    write(tmp_path / "a/scene.xml", MESH.format("m.obj"))
    monkeypatch.chdir(tmp_path / "b")
    mi.file_resolver().prepend(str(tmp_path / "b"))
    try:
        bounds = visible_bounds(SceneFile("../a/scene.xml").load())
    finally:
        del mi.file_resolver()[0]
    assert bounds is not None and bounds[1] == pytest.approx((1, 1, 0))


def test_a_link_finds_files_beside_it_and_beside_its_target(variant: str, tmp_path: Path) -> None:
    write(tmp_path / "real/scene.xml", MESH.format("m.obj") + MESH.format("n.obj"))
    mesh(tmp_path / "real/n.obj")
    mesh(tmp_path / "here/m.obj")
    (tmp_path / "here/link.xml").symlink_to(tmp_path / "real/scene.xml")
    assert SceneFile(tmp_path / "here/link.xml").load() is not None


def test_defaults_come_with_includes_as_deep_as_mitsuba_allows(
    variant: str, tmp_path: Path
) -> None:
    for i in range(13):
        write(tmp_path / f"{i}.xml", f'<include filename="{i + 1}.xml"/>')
    write(tmp_path / "13.xml", '<default name="protocol" value="forward"/><shape type="cube"/>')
    assert len(mi.load_file(str(tmp_path / "0.xml")).shapes()) == 1
    assert SceneFile(tmp_path / "0.xml").default("protocol") == "forward"


def test_odd_file_names(variant: str, tmp_path: Path) -> None:
    content = '<default name="protocol" value="forward"/>'
    for name in ("$spp.xml", "a b&c'd\"e.xml", "größe.XML", "no_suffix"):
        path = write(tmp_path / name, content)
        assert SceneFile(path).default("protocol") == "forward"
        assert find_scene(str(path)) == path


# ---- Old versions ------------------------------------------------------------


@pytest.mark.parametrize("version", ["0.4.0", "0.5.0", "0.6.0", "1.0.0"])
def test_old_names_are_those_of_today(variant: str, tmp_path: Path, version: str) -> None:
    content = """<integrator type="path"><integer name="maxDepth" value="4"/>
        <boolean name="hideEmitters" value="true"/></integrator>
    <sensor type="perspective"><float name="nearClip" value="0.1"/><transform name="toWorld">
        <lookat origin="0, 0, 5" target="0, 0, 0" up="0, 1, 0"/></transform></sensor>
    <shape type="shapegroup" id="g"><shape type="sphere"><transform name="toWorld">
        <translate x="1"/></transform></shape></shape>
    <shape type="instance"><ref id="g"/><transform name="toWorld"><translate x="2"/></transform>
        </shape>"""
    file = SceneFile(write(tmp_path / "scene.xml", content, version))
    (integrator,) = file.plugins("Integrator")
    assert integrator["hide_emitters"] is True and integrator["max_depth"] == 4
    integrator["hide_emitters"] = True
    (sensor,) = file.plugins("Sensor")
    assert "to_world" in sensor and "toWorld" not in sensor
    (shape,) = file.load().shapes()
    assert np.ravel(shape.bbox().center()) == pytest.approx([3, 0, 0], abs=1e-6)


def test_included_files_have_versions_of_their_own(variant: str, tmp_path: Path) -> None:
    old = '<shape type="sphere"><transform name="toWorld"><translate x="7"/></transform></shape>'
    write(tmp_path / "old.xml", old, "0.5.0")
    file = SceneFile(write(tmp_path / "scene.xml", '<include filename="old.xml"/>'))
    (shape,) = file.load().shapes()
    assert np.ravel(shape.bbox().center()) == pytest.approx([7, 0, 0], abs=1e-5)


def test_what_a_plugin_does_not_know_is_refused_still(variant: str, tmp_path: Path) -> None:
    """Looking at properties does not count as using them."""
    content = '<shape type="shapegroup" id="g"><shape type="sphere"/></shape>'
    instance = '<shape type="instance"><ref id="g"/><float name="bar" value="1"/></shape>'
    for wrong in (
        content + instance.replace("ref id", "ref name='x' id"),
        content + '<shape type="cube"><float name="bar" value="1"/></shape>',
        '<integrator type="path"><float name="bar" value="1"/></integrator>',
        '<film type="hdrfilm"><float name="bar" value="1"/></film>',
    ):
        path = write(tmp_path / "scene.xml", wrong)
        with pytest.raises(RuntimeError, match="bar"):
            mi.load_file(str(path))
        file = SceneFile(path)
        file.files(), file.digest()
        with pytest.raises(InputError, match="bar"):
            file.load()


# ---- Refusals ----------------------------------------------------------------

REFUSED = {
    "empty": b"",
    "junk": bytes(range(256)) * 4,
    "cut": b'<scene version="3.0.0"><shape',
    "no_version": b"<scene/>",
    "bad_version": b'<scene version="3"/>',
    "text": b"hello",
    "not_a_scene": b'<shape version="3.0.0" type="cube"/>',
    "number": scene('<shape type="sphere"><float name="radius" value="a"/></shape>').encode(),
    "vector": scene('<shape type="sphere"><point name="center" value="1 2"/></shape>').encode(),
    "mixed": scene('<shape type="sphere"><point name="center" value="1" x="2"/></shape>').encode(),
    "integer": scene('<shape type="obj"><integer name="r" value="9e99"/></shape>').encode(),
    "spectrum": scene(
        '<emitter type="point"><spectrum name="intensity" value="400:a"/></emitter>'
    ).encode(),
    "reference": scene('<shape type="sphere"><ref id="nothing"/></shape>').encode(),
    "plugin": scene('<shape type="sphere"><bsdf type="nothing"/></shape>').encode(),
    "kind": scene('<shape type="path"/>').encode(),
    "property": scene('<shape type="sphere"><float name="bar" value="1"/></shape>').encode(),
    "tag": scene('<blackbody name="x" temperature="3000K"/>').encode(),
    "twice": scene('<shape type="sphere" id="a"/><shape type="cube" id="a"/>').encode(),
    "circle": scene('<bsdf type="twosided" id="a"><ref id="a"/></bsdf>').encode(),
    "no_mesh": scene(MESH.format("nothing.obj")).encode(),
    "folder_as_mesh": scene(MESH.format("folder").replace("obj", "ply")).encode(),
    "junk_as_mesh": scene(MESH.format("junk.xml").replace("obj", "ply")).encode(),
    "no_picture": scene(
        '<texture type="bitmap"><string name="filename" value="nothing.png"/></texture>'
    ).encode(),
    "junk_as_picture": scene(
        '<texture type="bitmap"><string name="filename" value="junk.xml"/></texture>'
    ).encode(),
    "no_spectrum": scene(SPECTRUM.format("nothing.spd")).encode(),
    "folder_as_spectrum": scene(SPECTRUM.format("folder")).encode(),
    "junk_as_spectrum": scene(SPECTRUM.format("junk.xml")).encode(),
    "no_include": scene('<include filename="nothing.xml"/>').encode(),
    "itself": scene('<include filename="itself.xml"/>').encode(),
    "folder_as_include": scene('<include filename="folder"/>').encode(),
    "empty_include": scene('<include filename="empty.xml"/>').encode(),
    "no_path": scene('<path value="nothing"/>').encode(),
    "unknown_parameter": scene('<shape type="$kind"/>').encode(),
    "folder": None,
    "nothing": None,
    "n" * 300: None,
}


@pytest.mark.parametrize("name", REFUSED)
def test_refusals_are_one_line(variant: str, tmp_path: Path, name: str) -> None:
    for other, content in REFUSED.items():
        if content is not None:
            (tmp_path / f"{other}.xml").write_bytes(content)
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder.xml").mkdir()
    before = resolver()
    with pytest.raises(InputError) as refused:
        SceneFile(tmp_path / f"{name}.xml").load()
    message = str(refused.value)
    assert "\n" not in message and len(message) < 600
    assert message.startswith(str(tmp_path / f"{name}.xml"))
    assert resolver() == before


def test_a_scene_that_includes_itself(variant: str, tmp_path: Path) -> None:
    write(tmp_path / "a.xml", '<include filename="b.xml"/>')
    write(tmp_path / "b.xml", '<include filename="a.xml"/>')
    with pytest.raises(InputError, match="include recursion depth of 15"):
        SceneFile(tmp_path / "a.xml")


def test_a_file_that_may_not_be_read(
    variant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "scene.xml", "")
    opened = Path.open

    def refuse(self: Path, *arguments: str) -> object:
        if self == path:
            raise PermissionError(13, "Permission denied")
        return opened(self, *arguments)

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(InputError, match="cannot be read: Permission denied"):
        SceneFile(path)
