"""What ``mi-nerf info`` says of scenes."""

from __future__ import annotations

from pathlib import Path

import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.cli import main
from mi_nerf.tasks.describe import describe
from tests.support import gallery


def rows(text: str) -> dict[str, str]:
    return {line[:10].strip(): line[12:] for line in text.splitlines()}


def test_a_scene(tmp_path: Path) -> None:
    found = rows(describe(gallery.write("testball", tmp_path)))
    assert found["files"] == "testball.xml, sky.exr"
    assert found["integrator"] == "path" and found["emitters"] == "envmap"
    assert found["sensors"] == "PerspectiveCamera of 32x24, 16 samples"
    assert found["shapes"] == "rectangle, sphere, cylinder"
    assert found["box"] == "(-0.950, -0.950, -0.700) to (0.950, 0.950, 0.500)"
    assert "media" not in found and "asks for" not in found


def test_what_a_scene_lacks_or_asks_for(tmp_path: Path) -> None:
    path = tmp_path / "scene.xml"
    path.write_text(
        """<scene version="3.0.0"><default name="protocol" value="diffuse360"/>
        <medium type="homogeneous" id="m"/></scene>"""
    )
    found = rows(describe(path))
    assert found["integrator"] == "none" and found["sensors"] == "none"
    assert found["emitters"] == found["shapes"] == "none"
    assert found["media"] == "homogeneous" and found["box"] == "nothing to be seen"
    assert found["asks for"] == "protocol diffuse360"


def test_a_scene_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", "spheres"]) == 0
    assert "spheres.xml, SHA-256 " in capsys.readouterr().out


def test_a_broken_scene(tmp_path: Path) -> None:
    path = tmp_path / "scene.xml"
    path.write_text("no scene")
    with pytest.raises(InputError, match="Mitsuba cannot load this scene: Parsing of XML file"):
        describe(path)
