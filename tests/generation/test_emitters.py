"""Which light sources are hidden, by kind and by name."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.base.variants import choose_variant
from mi_nerf.generation.emitters import Hidden
from mi_nerf.scene_xml.scene_file import visible_bounds


@pytest.fixture(autouse=True)
def variant() -> None:
    mi.set_variant(choose_variant())


def scene(**more: Any) -> Any:
    """A ball, two lamps, a sky and a point of light."""
    return mi.load_dict(
        {
            "type": "scene",
            "ball": {"type": "sphere", "id": "ball"},
            "bulb": {
                "type": "sphere",
                "id": "bulb",
                "center": [3, 0, 0],
                "emitter": {"type": "area", "id": "glow"},
            },
            "tube": {
                "type": "cube",
                "id": "tube",
                "to_world": mi.ScalarTransform4f().translate([-4, 0, 0]),
                "emitter": {"type": "area"},
            },
            "sky": {"type": "constant", "id": "sky"},
            "spark": {"type": "point", "id": "spark", "position": [0, 0, 9]},
            **more,
        }
    )


def state(hidden: Hidden) -> tuple[bool, bool, bool]:
    return hidden.any, hidden.partly, hidden.environment


def test_all_or_none() -> None:
    loaded = scene()
    assert state(Hidden(loaded, False)) == (False, False, False)
    assert state(Hidden(loaded, True)) == (True, False, True)
    assert state(Hidden(loaded, True, ["all"])) == (False, False, False)
    assert not Hidden(loaded, True).chosen and not Hidden(loaded, True, ["all"]).by_name


@pytest.mark.parametrize("names", [["bulb"], ["glow"]])
def test_by_name(names: list[str]) -> None:
    loaded = scene()
    hidden = Hidden(loaded, True, names)
    assert state(hidden) == (True, True, True) and hidden.by_name
    kept = {shape.id(): hidden.keeps(shape) for shape in loaded.shapes()}
    assert kept["bulb"] and not kept["tube"] and not kept["ball"]
    lower, upper = visible_bounds(loaded, hidden.keeps)
    assert (lower[0], upper[0]) == pytest.approx((-1, 4))
    lower, upper = visible_bounds(loaded)
    assert (lower[0], upper[0]) == pytest.approx((-1, 1))


def test_everything_by_name_and_the_sky_alone() -> None:
    loaded = scene()
    assert state(Hidden(loaded, True, ["bulb", "tube", "sky"])) == (False, False, False)
    assert state(Hidden(loaded, True, ["sky"])) == (True, True, False)
    assert state(Hidden(loaded, True, ["bulb", "tube"])) == (True, True, True)


def test_which_rays_meet_them() -> None:
    loaded = scene()
    ray = mi.Ray3f(mi.Point3f([3, -4, 0], 9, 0), mi.Vector3f([0, 0, 0], -1, 0))
    emitter = loaded.ray_intersect(ray).emitter(loaded)
    assert list(Hidden(loaded, True)(emitter)) == [True, True, False]
    assert list(Hidden(loaded, True, ["bulb"])(emitter)) == [False, True, False]
    assert list(Hidden(loaded, True, ["tube"])(emitter)) == [True, False, False]
    met = Hidden(loaded, False)(emitter)
    assert not any(met)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("lamp", "no light source, expected all or "),
        ("ball", "no light source, expected all or "),
        ("spark", "cannot be seen, it is no surface, expected all or "),
    ],
)
def test_names_of_others(name: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        Hidden(scene(), True, [name])
    assert all(known in str(caught.value) for known in ("bulb", "tube", "sky"))
    assert "spark," not in str(caught.value)


def test_lights_that_are_not_seen_are_named() -> None:
    loaded = scene()
    assert Hidden(loaded, False).note == "" and Hidden(loaded, True, ["all"]).note == ""
    note = Hidden(loaded, True).note
    assert "bulb" in note and "tube" in note and "--keep-emitters" in note
    assert "sky" not in note and "spark" not in note
    note = Hidden(loaded, True, ["bulb"]).note
    assert "tube" in note and "bulb" not in note


def test_many_lights_are_counted() -> None:
    lamp = {"type": "sphere", "emitter": {"type": "area"}}
    loaded = scene(**{f"lamp_{i}": {**lamp, "center": [i, 0, 9]} for i in range(7)})
    shown = Hidden(loaded, True).note
    assert shown.count(",") == 3 and "and 5 more" in shown
