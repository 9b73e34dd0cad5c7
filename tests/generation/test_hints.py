"""What scenes say about their own datasets, and that users have the last word."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.base.variants import choose_variant
from mi_nerf.generation import Options
from mi_nerf.generation.hints import with_hints
from mi_nerf.generation.run import prepare
from mi_nerf.scene_xml.scene_file import SceneFile

HINTS = {
    "cameras_object": "ball, stand",
    "cameras_center": "0, 0.5, 1",
    "cameras_radius": "3.5",
    "cameras_elevation": "-5 40",
}


def scene(folder: Path, **hints: str) -> SceneFile:
    """A ball on a stand on a wide floor, under a sky."""
    mi.set_variant(choose_variant())
    lines = [f'<default name="{name}" value="{value}"/>' for name, value in hints.items()]
    path = folder / "hints.xml"
    path.write_text(
        f"""<scene version="3.0.0">{"".join(lines)}
        <emitter type="constant"/>
        <shape type="sphere" id="ball"><point name="center" value="0, 0.5, 1"/></shape>
        <shape type="cube" id="stand"><transform name="to_world"><scale value="0.4"/>
            <translate y="0.5" z="-0.4"/></transform></shape>
        <shape type="rectangle" id="floor"><transform name="to_world"><scale value="30"/>
            <translate z="-0.8"/></transform></shape>
        </scene>"""
    )
    return SceneFile(path)


def test_all_that_the_user_left_open(tmp_path: Path) -> None:
    found = with_hints(scene(tmp_path, **HINTS), Options(seed=4))
    assert found == Options(
        seed=4,
        object=("ball", "stand"),
        center=(0.0, 0.5, 1.0),
        radius=3.5,
        elevation=(-5.0, 40.0),
    )


def test_nothing_without_hints(tmp_path: Path) -> None:
    assert with_hints(scene(tmp_path), Options()) == Options()


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        ({"radius": 2.0}, {"object", "center", "elevation"}),
        ({"elevation": (0.0, 10.0)}, {"object", "center", "radius"}),
        ({"center": (1.0, 2.0, 3.0)}, {"elevation"}),
        ({"object": ("ball",)}, {"elevation"}),
        ({"protocol": "forward"}, set()),
        ({"protocol": "room"}, set()),
        ({"cameras": "scene"}, set()),
    ],
)
def test_what_the_user_says_counts_more(
    given: dict[str, Any], kept: set[str], tmp_path: Path
) -> None:
    file, options = scene(tmp_path, **HINTS), Options(**given)
    every = with_hints(file, Options())
    expected = replace(options, **{name: getattr(every, name) for name in kept})
    assert with_hints(file, options) == expected


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("cameras_center", "1, 2", "expected 3 finite numbers"),
        ("cameras_center", "1, 2, nan", "expected 3 finite numbers"),
        ("cameras_radius", "far", "expected a finite number"),
        ("cameras_elevation", "1 2 3", "expected 2 finite numbers"),
    ],
)
def test_numbers_are_expected(name: str, text: str, expected: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"{name} '{text}', {expected}"):
        with_hints(scene(tmp_path, **{name: text}), Options())


@pytest.mark.parametrize("elevation", ["40 10", "0 90", "-90 0"])
def test_elevations_are_checked(elevation: str, tmp_path: Path) -> None:
    file = scene(tmp_path, cameras_elevation=elevation)
    with pytest.raises(InputError, match="expected two angles between -90 and 90 degrees"):
        prepare(file, Options(train=1, val=0, test=0, size=(8, 8), spp=2))


def test_a_plan_follows_and_records_them(tmp_path: Path) -> None:
    file = scene(tmp_path, **HINTS)
    _, plan = prepare(file, Options(train=3, val=0, test=0, size=(8, 8), spp=2))
    record = plan.record()
    assert (record["center"], record["radius"]) == ([0.0, 0.5, 1.0], 3.5)
    assert record["elevation"] == [-5.0, 40.0] and record["object"] == ["ball", "stand"]
    assert (
        "elevation"
        not in prepare(scene(tmp_path), Options(train=1, val=0, test=0, spp=2))[1].record()
    )
