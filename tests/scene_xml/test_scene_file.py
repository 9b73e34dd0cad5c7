"""Scene files as Mitsuba's own parser reads them, and whose fault an error is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.generation.planning import protocol_name
from mi_nerf.generation.protocol import Options
from mi_nerf.scene_xml.scene_file import SceneFile

DEFAULT = '<default name="protocol" value="forward"/>'


def write(path: Path, content: str, encoding: str = "utf-8") -> Path:
    path.write_bytes(f'<scene version="3.0.0">{content}</scene>'.encode(encoding))
    return path


@pytest.mark.parametrize(
    ("content", "encoding", "value"),
    [
        (DEFAULT, "utf-8", "forward"),
        ("<!-- ---- camera -- and light ---- -->" + DEFAULT, "utf-8", "forward"),
        ("<!-- Köln -->" + DEFAULT, "latin-1", "forward"),
        (DEFAULT + '<string name="title" value="salt & pepper"/>', "utf-8", "forward"),
        ('<default name="protocol" value="a&amp;b"/>', "utf-8", "a&b"),
        (f'<shape type="cube">{DEFAULT}</shape>', "utf-8", "forward"),
        ("<default name='protocol' value='first'/>" + DEFAULT, "utf-8", "first"),
        (
            '<default name="q" value="asked"/><default name="protocol" value="$q"/>',
            "utf-8",
            "asked",
        ),
        (f"<!-- {DEFAULT} -->", "utf-8", None),
        ('<default name="cameras" value="sphere"/>', "utf-8", None),
        ('<include filename="part.xml"/>', "utf-8", "diffuse360"),
    ],
)
def test_defaults_as_mitsuba_reads_them(
    variant: str, tmp_path: Path, content: str, encoding: str, value: str | None
) -> None:
    write(tmp_path / "part.xml", '<default name="protocol" value="diffuse360"/>')
    file = SceneFile(write(tmp_path / 'a & "b".xml', content, encoding))
    assert file.default("protocol") == value


def test_a_given_parameter_wins(variant: str, tmp_path: Path) -> None:
    path = write(tmp_path / "scene.xml", DEFAULT + '<string name="s" value="$protocol"/>')
    file = SceneFile(path, {"protocol": "diffuse360"})
    assert file.default("protocol") == "diffuse360"
    assert file.default("cameras") is None
    assert protocol_name(file, Options()) == "diffuse360"


def test_files_that_a_scene_names_lie_beside_it(variant: str, tmp_path: Path) -> None:
    """Spectra are read while the XML is parsed, other files when the scene is created."""
    (tmp_path / "gold.spd").write_text("400 0.2\n500 0.4\n700 0.9\n")
    content = '<emitter type="constant"><spectrum name="radiance" filename="gold.spd"/></emitter>'
    scene = SceneFile(write(tmp_path / "scene.xml", content)).load()
    assert len(scene.emitters()) == 1


# ---- Whose fault -------------------------------------------------------------


def test_a_fault_of_the_program_is_no_input_error(
    variant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "scene.xml", '<shape type="cube"/>')

    def fault(*_: Any) -> None:
        raise AttributeError("a fault")

    monkeypatch.setattr("mi_nerf.scene_xml.scene_file.copy_instances", fault)
    with pytest.raises(AttributeError, match="a fault"):
        SceneFile(path).load()


@pytest.mark.parametrize("exception", [AttributeError, TypeError, KeyError, ZeroDivisionError])
def test_a_fault_of_a_plugin_is_no_input_error(
    variant: str, tmp_path: Path, exception: type[Exception]
) -> None:
    class Faulty(mi.Texture):  # type: ignore[misc, name-defined]
        def __init__(self, props: Any) -> None:
            mi.Texture.__init__(self, props)
            raise exception("a fault")

    mi.register_texture("faulty", Faulty)
    file = SceneFile(write(tmp_path / "scene.xml", '<texture type="faulty"/>'))
    with pytest.raises(RuntimeError, match=r"(?s)Traceback.*a fault"):
        file.load()


def test_a_refusal_of_a_plugin_is_one_line(variant: str, tmp_path: Path) -> None:
    class Refusing(mi.Texture):  # type: ignore[misc, name-defined]
        def __init__(self, props: Any) -> None:
            mi.Texture.__init__(self, props)
            raise InputError("refusing: no\nError: way")

    mi.register_texture("refusing", Refusing)
    file = SceneFile(write(tmp_path / "scene.xml", '<texture type="refusing"/>'))
    with pytest.raises(InputError) as refused:
        file.load()
    assert str(refused.value).endswith('plugin of type "refusing": refusing: no Error: way')


@pytest.mark.parametrize("flips", [("true", "false"), ("false", "true"), ("true", "true")])
def test_meshes_that_do_not_merge(tmp_path: Path, flips: tuple[str, str]) -> None:
    cubes = "".join(
        f'<shape type="cube"><transform name="to_world"><translate x="{4 * i}"/></transform>'
        f'<boolean name="flip_normals" value="{flip}"/><ref id="m"/></shape>'
        for i, flip in enumerate(flips)
    )
    file = SceneFile(write(tmp_path / "s.xml", f'<bsdf type="diffuse" id="m"/>{cubes}'))
    scene = file.load()
    for i, flip in enumerate(flips):
        si = scene.ray_intersect(mi.Ray3f([4 * i, 0, 9], [0, 0, -1]))
        assert si.n.z[0] == (-1 if flip == "true" else 1)
