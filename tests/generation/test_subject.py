"""What is the object and what surrounds it, for scenes of boxes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerf.base.errors import InputError
from mi_nerf.cameras.pinhole import Intrinsics
from mi_nerf.cameras.poses import look_at
from mi_nerf.generation.sensors import SensorCamera
from mi_nerf.generation.subject import Subject, find_subject, told_subject
from mi_nerf.scene_xml.parts import Part

UP = np.array([0.0, 0.0, 1.0])


def box(name: str, center: Any, size: Any, *, flat: bool = False, glows: bool = False) -> Part:
    """A box; if ``flat``, one that lies level."""
    middle, half = np.array(center, float), np.broadcast_to(np.array(size, float), 3) / 2
    levels = (middle[2] - half[2], middle[2] + half[2])
    return Part(name, middle - half, middle + half, glows, UP if flat else None, levels)


def floor(size: float, level: float = -0.5, name: str = "floor") -> Part:
    return box(name, (0, 0, level), (size, size, 0), flat=True)


def camera(origin: Any, target: Any = (0, 0, 0), angle: float = 0.7) -> SensorCamera:
    pose = look_at(origin, target, UP)
    film = Intrinsics.from_angle_x(64, 64, angle)
    return SensorCamera("sensor", None, pose, film, None, angle, False, False)


def found(parts: list[Part], sensor: SensorCamera | None = None) -> set[str]:
    """Names of what is set aside."""
    lower = np.min([p.lower for p in parts], axis=0)
    upper = np.max([p.upper for p in parts], axis=0)
    subject = find_subject(parts, (tuple(lower), tuple(upper)), sensor)
    others = {part.name for part in subject.others}
    if others:
        kept = [p for p in parts if p.name not in others and not p.glows]
        assert set(subject.names) == {part.name for part in kept}
        corners = np.min([p.lower for p in kept], 0), np.max([p.upper for p in kept], 0)
        assert np.array(subject.box) == pytest.approx(np.array(corners))
    return others


BALL, CUP = box("ball", (0, 0, 0), 1), box("cup", (0.4, 0, 0), 0.05)


@pytest.mark.parametrize("size", [5, 20, 1000, 1e6])
def test_a_large_floor_is_set_aside(size: float) -> None:
    assert found([BALL, CUP, floor(size)]) == {"floor"}
    assert found([BALL, CUP, box("slab", (0, 0, -1), (size, size, 0.01), flat=True)]) == {"slab"}


@pytest.mark.parametrize("size", [1, 2, 3, 3.9])
def test_a_floor_of_a_few_times_the_size_is_part_of_the_object(size: float) -> None:
    assert found([BALL, floor(size)]) == set()


def test_a_board_that_the_sensor_has_whole_in_view_is_the_object() -> None:
    board, pawn = box("board", (0, 0, -0.5), (10, 10, 0.1), flat=True), BALL
    assert found([board, pawn]) == {"board"}
    assert found([board, pawn], camera((3, -4, 3))) == {"board"}  # sees the pawn, and some board
    assert found([board, pawn], camera((15, -20, 15))) == set()
    assert found([replace(board, lower=30 * board.lower), pawn], camera((99, -99, 99))) == {"board"}


def test_floor_and_walls_and_sky() -> None:
    walls = [
        Part(f"wall {i}", *(np.array(c, float) for c in corners), False, np.eye(3)[i], (0.0, 0.0))
        for i, corners in enumerate(
            [([-20, -20, -1], [-20, 20, 30]), ([-20, 20, -1], [20, 20, 30])]
        )
    ]
    sky = box("sky", (0, 0, 0), 2000)
    assert found([BALL, floor(40), *walls]) == {"floor", "wall 0", "wall 1"}
    assert found([BALL, floor(40), *walls, sky]) == {"floor", "wall 0", "wall 1", "sky"}


def test_many_things_of_one_size_stay_together() -> None:
    trees = [box(f"tree {i}", (i % 10, i // 10, 0), (0.8, 0.8, 1)) for i in range(100)]
    assert found(trees) == set()
    assert found([*trees, floor(1000)]) == {"floor"}
    chairs = [box(f"chair {i}", (i - 2, 1, 0), 0.7) for i in range(4)]
    table = box("table", (0, 0, 0), (5, 1.2, 0.05), flat=True)
    assert found([table, *chairs]) == set()
    assert found([table, *chairs, floor(60, -0.8)]) == {"floor"}


def test_tiny_things_beside_the_object() -> None:
    """Two balls and a speck are no backdrop of the speck, nor is a house of its lantern."""
    balls = [box("a", (-1, 0, 0), 1), box("b", (1, 0, 0), 1)]
    assert found([*balls, CUP]) == set()
    assert found([*balls, box("speck", (0, 0, 0), 1e-3)]) == set()
    house, lantern = box("house", (0, 0, 0), 10), box("lantern", (0, 5.2, 0), 0.3)
    assert found([house, lantern]) == set()
    assert found([house, lantern], camera((20, 20, 10))) == set()
    assert found([house, lantern, floor(500, -5)]) == {"floor"}


def test_backdrops_that_are_not_flat(monkeypatch: pytest.MonkeyPatch) -> None:
    cyclorama = box("cyclorama", (0, 3, 3.5), (16, 12, 8))
    assert found([BALL, cyclorama]) == set()  # a solid thing, for all that one knows
    monkeypatch.setattr("mi_nerf.generation.subject.is_open", lambda part: True)
    assert found([BALL, cyclorama]) == {"cyclorama"}
    assert found([BALL, box("bowl", (0, 0, 0.5), 3)]) == set()
    monkeypatch.undo()
    smaller = box("cyclorama", (0, 1, 1.5), (9, 6, 4))
    assert found([BALL, smaller]) == set()
    assert found([BALL, smaller], camera((0, -6, 1))) == {"cyclorama"}  # the sensor frames the ball
    globe = box("globe", (0, 0, -100.5), 200)
    assert found([BALL, globe]) == {"globe"}
    dome = box("dome", (0, 0, 0), 8)
    assert found([BALL, dome]) == set()
    assert found([BALL, dome], camera((0, -2.5, 0))) == {"dome"}  # within it


def test_lamps_are_no_part_of_it() -> None:
    panel = box("panel", (0, 0, 80), (60, 60, 0), flat=True, glows=True)
    assert found([BALL, CUP, panel]) == set()
    assert found([BALL, CUP, panel, floor(90)]) == {"floor"}


@given(st.floats(1e-4, 1e4), st.floats(-5, 5), st.integers(0, 1000))
def test_units_and_places_do_not_matter(scale: float, shift: float, seed: int) -> None:
    """The same scene in other units, elsewhere, in another order."""
    parts = [BALL, CUP, floor(50), box("sky", (0, 0, 0), 3000)]
    moved = [
        replace(
            p,
            lower=scale * (p.lower + shift),
            upper=scale * (p.upper + shift),
            levels=tuple(scale * (level + shift) for level in p.levels),
        )
        for p in parts
    ]
    order = np.random.default_rng(seed).permutation(len(moved))
    assert found([moved[i] for i in order]) == {"floor", "sky"}


def test_which_points_are_the_objects() -> None:
    subject = Subject(((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)), ("ball",), (floor(1000),))
    points = np.array([[0, 0, 0.5], [0, 0, -0.5], [0.2, 0, -0.49], [2, 0, 0]])
    assert subject.holds(points).tolist() == [True, False, True, False]


def test_what_is_said() -> None:
    subject = find_subject([BALL, CUP, floor(1000)], ((-500,) * 3, (500,) * 3), None)
    assert str(subject) == (
        "object: ball, cup; not floor, up to 1e+03 times as large (--object overrides)"
    )
    assert subject.record() == {"object": ["ball", "cup"], "surroundings": ["floor"]}
    assert str(Subject(((0, 0, 0), (1, 1, 1)))) == ""


def test_the_object_as_told() -> None:
    parts = [BALL, CUP, floor(1000), box("tree_leaf", (3, 0, 0), 1), box("tree_stem", (3, 0, 2), 1)]
    subject = told_subject(parts, ["cup"])
    assert subject.names == ("cup",) and subject.told
    assert np.array(subject.box) == pytest.approx(np.array([CUP.lower, CUP.upper]))
    assert told_subject(parts, ["ball", "tree"]).names == ("ball", "tree_leaf", "tree_stem")
    message = "object='tabel': no such shape, expected one of ball, cup, floor, tree_leaf"
    with pytest.raises(InputError, match=message):
        told_subject(parts, ["tabel"])
