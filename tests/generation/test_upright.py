"""Which way is up: from sensors, their scene's base, and what the user says."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from mi_nerf.base.errors import InputError
from mi_nerf.cameras.pinhole import Intrinsics
from mi_nerf.cameras.poses import look_at
from mi_nerf.generation.sensors import SensorCamera
from mi_nerf.generation.upright import told_up, vertical
from mi_nerf.scene_xml.parts import Part

X, Y, Z = np.eye(3)
FILM = Intrinsics.from_angle_x(64, 48, 0.7)

unit = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.3)


def sensor(origin: Any, target: Any = (0, 0, 0), up: Any = Z) -> SensorCamera:
    return SensorCamera("it", None, look_at(origin, target, up), FILM, None, 0.7, False, False)


def plate(normal: np.ndarray, level: float, size: float = 4.0, name: str = "base") -> Part:
    """A square with its middle at ``level`` times its normal."""
    half = np.where(np.abs(normal) > 0.99, 0, size / 2) + 0.0
    center = level * normal
    return Part(name, center - half, center + half, False, normal, (level, level))


def ball(center: Any = (0, 0, 0), radius: float = 0.5) -> Part:
    middle = np.array(center, float)
    return Part("ball", middle - radius, middle + radius, False, None, (0.0, 0.0))


@given(unit, unit)
def test_the_up_vector_of_a_lookat_as_it_is(up: np.ndarray, origin: np.ndarray) -> None:
    """However the camera is pitched, and not the nearest axis."""
    up = up / np.linalg.norm(up)
    view = origin / np.linalg.norm(origin)
    assume(1e-2 < abs(up @ view) < 0.99)
    found, why = vertical([sensor(3 * origin, up=up)], [up], [])
    assert found == pytest.approx(up, abs=2e-3) and "up vector" in why


@given(st.integers(0, 2), st.sampled_from([-1.0, 1.0]), unit)
def test_cameras_that_look_down_stand_upright(axis: int, sign: float, origin: np.ndarray) -> None:
    """Without a lookat, from any side: the pitch does not tilt the world."""
    up = sign * np.eye(3)[axis]
    view = origin / np.linalg.norm(origin)
    assume(abs(view[axis]) < 0.98)
    assume(sum(abs(v) > 0.05 for v in np.delete(view, axis)) == 2)  # not along another axis
    found, why = vertical([sensor(4 * origin, up=up)], [], [])
    assert found.tolist() == up.tolist() and "upright" in why


def test_a_camera_that_faces_an_axis_may_stand_in_two_worlds() -> None:
    """Pitched by 60 degrees along y: z up and looking down, or y up and looking up."""
    steep = sensor((0, -1, 1.7))
    assert vertical([steep], [], [])[0].tolist() == Y.tolist()  # nearer: nothing else is known
    assert vertical([steep], [], [ball(), plate(Z, -0.5)])[0].tolist() == Z.tolist()
    assert vertical([steep], [Z], [])[0].tolist() == Z.tolist()
    assert vertical([sensor((0, -4, 1))], [], [])[0].tolist() == Z.tolist()


def test_several_cameras_agree() -> None:
    tilted = np.array([0.3, 0, 1]) / np.linalg.norm([0.3, 0, 1])
    sensors = [sensor((4 * np.cos(a), 4 * np.sin(a), 1.5), up=tilted) for a in np.arange(8)]
    found, why = vertical(sensors, [], [])
    assert found == pytest.approx(tilted, abs=1e-6) and "8 sensors" in why


def test_a_tilted_world() -> None:
    tilted = np.array([0.3, 0.1, 1]) / np.linalg.norm([0.3, 0.1, 1])
    one = sensor((3, -4, 2), up=tilted)
    found, why = vertical([one], [], [ball(), plate(tilted, -0.5)])
    assert found == pytest.approx(tilted) and "base" in why
    found, why = vertical([one], [], [])
    assert found == pytest.approx(one.pose[:3, 1]) and "as it is" in why


def test_a_lookat_that_names_the_cameras_own_axis_says_nothing() -> None:
    one = sensor((3, -4, 3))
    assert vertical([one], [one.pose[:3, 1]], [])[0].tolist() == Z.tolist()


def test_rolled_cameras_are_taken_as_they_are() -> None:
    rolled = sensor((3, -4, 3), up=(0.5, 0.2, 1))
    found, why = vertical([rolled], [], [ball(), plate(Z, -0.5)])
    assert found == pytest.approx(rolled.pose[:3, 1]) and "as it is" in why


@pytest.mark.parametrize("normal", [Z, Y, -Y, X])
def test_without_a_sensor_the_base_says(normal: np.ndarray) -> None:
    found, why = vertical([], [], [ball(), plate(normal, -0.5)])
    assert found.tolist() == normal.tolist() and "base" in why
    # The normal's own sign does not matter: the scene is above it.
    turned = replace(plate(normal, -0.5), normal=-normal, levels=(0.5, 0.5))
    assert vertical([], [], [ball(), turned])[0].tolist() == normal.tolist()


def test_of_a_floor_and_walls_the_floor() -> None:
    parts = [ball(), plate(Y, -0.6, name="wall"), plate(Z, -0.5), plate(-X, -0.7, name="side")]
    assert vertical([], [], parts)[0].tolist() == Z.tolist()


def test_what_lies_through_the_middle_is_no_base() -> None:
    found, why = vertical([], [], [ball(), plate(Y, 0)])
    assert found.tolist() == Z.tolist() and "nothing" in why
    assert vertical([], [], [])[0].tolist() == Z.tolist()


@pytest.mark.parametrize(
    ("up", "expected"),
    [("x", X), ("y", Y), ("-z", -Z), ((0, 0, -5), -Z), ((0, 3, 4), [0, 0.6, 0.8])],
)
def test_told(up: Any, expected: Any) -> None:
    assert told_up(up) == pytest.approx(np.array(expected))


@pytest.mark.parametrize("up", ["w", "", "-", "xy", "--y", (0, 0, 0), (1, 2), (0, 0, np.nan)])
def test_told_nonsense(up: Any) -> None:
    with pytest.raises(InputError, match="expected x, y, z, -x, -y, -z or three numbers"):
        told_up(up)
