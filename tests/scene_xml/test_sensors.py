"""Sensors taken apart, and what their lookat elements call up."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_nerf.base.variants import choose_variant
from mi_nerf.scene_xml.scene_file import SceneFile
from mi_nerf.scene_xml.sensors import named_ups, separate_sensors

LOOKAT = '<lookat origin="{0}, -4, 1" target="0, 0, 0" up="0, 0, 1"/>'


def pinhole(x: float, more: str = "", name: str = "") -> str:
    given = f' name="{name}"' if name else ""
    return (
        f'<sensor type="perspective"{given}><float name="fov" value="40"/>'
        f'<transform name="to_world">{more}{LOOKAT.format(x)}</transform>{{film}}</sensor>'
    )


FILM = (
    '<film type="hdrfilm"><integer name="width" value="{0}"/>'
    '<integer name="height" value="{1}"/></film>'
)


def write(folder: Path, *sensors: str) -> SceneFile:
    mi.set_variant(choose_variant())
    path = folder / "scene.xml"
    path.write_text(
        f'<scene version="3.0.0">{"".join(sensors)}<shape type="sphere"/>'
        '<emitter type="constant"/></scene>'
    )
    return SceneFile(path)


def places(scene: mi.Scene) -> list[float]:
    """The x of each sensor's place."""
    found = [np.array(s.world_transform().matrix).reshape(4, 4)[0, 3] for s in scene.sensors()]
    return [float(x) for x in found]


def test_batches_are_unpacked_in_their_place(tmp_path: Path) -> None:
    members = pinhole(2, name="a").format(film="") + pinhole(3, name="b").format(
        film=FILM.format(10, 10)
    )
    sampler = '<sampler type="independent"><integer name="sample_count" value="7"/></sampler>'
    batch = f'<sensor type="batch" id="both">{members}{FILM.format(64, 24)}{sampler}</sensor>'
    one = pinhole(1).format(film=FILM.format(8, 8))
    four = pinhole(4).format(film=FILM.format(9, 9))
    file = write(tmp_path, one, batch, four)
    assert separate_sensors(file.state) == [
        "sensor 'both', a batch, is unpacked into its 2 sensors"
    ]
    scene = file.load()
    assert places(scene) == pytest.approx([1, 2, 3, 4])
    sizes = [tuple(int(n) for n in sensor.film().size()) for sensor in scene.sensors()]
    assert sizes == [(8, 8), (32, 24), (32, 24), (9, 9)]  # the batch's film is divided
    assert [s.sampler().sample_count() for s in scene.sensors()][1:3] == [7, 7]


def test_scales_and_shears_are_taken_out(tmp_path: Path) -> None:
    """Mitsuba refuses such cameras; where they stand and look stays."""
    plain = write(tmp_path, pinhole(1).format(film="")).load()
    expected = np.array(plain.sensors()[0].world_transform().matrix).reshape(4, 4)
    for more, mirrored in (
        ('<scale value="3"/>', False),
        ('<scale x="2" y="0.5" z="4"/>', False),
        ('<scale x="-2" y="2" z="2"/>', True),
        ('<matrix value="1 0 0 0  0.5 1 0 0  0 0.3 1 0  0 0 0 1"/>', False),
    ):
        file = write(tmp_path, pinhole(1, more).format(film=""))
        (note,) = separate_sensors(file.state)
        assert "scales" in note
        found = np.array(file.load().sensors()[0].world_transform().matrix).reshape(4, 4)
        assert found[:3, 1:] == pytest.approx(expected[:3, 1:], abs=1e-6)
        sign = -1 if mirrored else 1
        assert found[:3, 0] == pytest.approx(sign * expected[:3, 0], abs=1e-6)


def test_other_scenes_are_left_alone(tmp_path: Path) -> None:
    for sensors in ([], [pinhole(1).format(film="")], [pinhole(1, '<scale x="-1"/>')]):
        file = write(tmp_path, *(s.replace("{film}", "") for s in sensors))
        assert separate_sensors(file.state) == []


def test_ups_that_lookats_of_sensors_name(tmp_path: Path) -> None:
    light = (
        '<shape type="rectangle"><transform name="to_world"><lookat origin="0, 0, 9" '
        'target="0, 0, 0" up="1, 0, 0"/></transform><emitter type="area"/></shape>'
    )
    tilted = pinhole(1).format(film="").replace('up="0, 0, 1"', 'up="0.3 0 1"')
    nonsense = pinhole(2).format(film="").replace('up="0, 0, 1"', 'up="$a, 0, 1"')
    file = write(tmp_path, '<default name="a" value="0"/>', light, tilted, nonsense)
    (up,) = named_ups(file)
    assert up == pytest.approx(np.array([0.3, 0, 1]) / np.linalg.norm([0.3, 0, 1]))
