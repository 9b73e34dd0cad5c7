"""Cameras inside rooms: clear of everything, seeing the room, never its black backs."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.base.variants import choose_variant
from mi_nerf.cameras.pinhole import Intrinsics
from mi_nerf.cameras.poses import is_rigid
from mi_nerf.generation.probes import camera_rays, first_hits
from mi_nerf.generation.rooms import Room, find_room, is_enclosed

from ..support.scenes import BALL, TWO_SIDED, room, write_scene

UP = np.array([0.0, 0.0, 1.0])
FILM = Intrinsics.from_angle_x(40, 30, 1.2)
BOX = ((-2.0, -2.5, 0.0), (2.0, 2.5, 2.5))


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Room:
    mi.set_variant(choose_variant())
    scene = mi.load_file(str(write_scene(tmp_path_factory.mktemp("room"), room())))
    return find_room(scene, BOX, UP, None, 0)


def clearance(points: np.ndarray) -> np.ndarray:
    """Distance from walls, table and cupboard of :func:`room`, in closed form."""
    walls = np.minimum(points - BOX[0], np.array(BOX[1]) - points).min(axis=1)
    nearest = walls
    for center, half in (((0.3, 0.4, 0.75), (0.7, 0.4, 0.03)), ((-1.6, 0.5, 0.9), (0.3, 0.8, 0.9))):
        outside = np.maximum(np.abs(points - center) - half, 0)
        nearest = np.minimum(nearest, np.linalg.norm(outside, axis=1))
    return nearest


def test_places_are_inside_and_clear(found: Room) -> None:
    places = found.places(200, 3, 0)
    assert 0.1 < found.clear < 0.5
    # Some 64 directions may pass by an edge, but not by a surface.
    assert clearance(places).min() > 0.6 * found.clear
    assert np.ptp(places, axis=0).min() > 1  # all over the room
    assert len(np.unique(places.round(6), axis=0)) == 200


def test_fewer_are_the_first_of_more(found: Room) -> None:
    assert (found.places(20, 3, 0) == found.places(60, 3, 0)[:20]).all()
    assert (found.poses(5, 3, 0, FILM) == found.poses(12, 3, 0, FILM)[:5]).all()
    assert not np.isin(found.places(20, 3, 1)[:, 0], found.places(20, 3, 0)[:, 0]).any()


def test_cameras_see_the_room(found: Room) -> None:
    poses = found.poses(24, 0, 0, FILM)
    assert poses.shape == (24, 4, 4) and all(is_rigid(pose) for pose in poses)
    assert (poses[:, 2, 1] > 0.9).all()  # upright
    o, d = camera_rays(list(poses), [FILM] * 24, 16)
    hits = first_hits(found.scene, o.reshape(-1, 3), d.reshape(-1, 3), hide_emitters=False)
    assert np.isfinite(hits.distance).all() and hits.dark.mean() < 0.01
    assert np.median(hits.distance) > 1  # of a room of 4 by 5 by 2.5
    # All over the compass, and both across the room and into the open.
    angles = np.arctan2(-poses[:, 1, 2], -poses[:, 0, 2])
    assert np.hypot(np.cos(angles).mean(), np.sin(angles).mean()) < 0.6
    inward = ((found.middle - poses[:, :3, 3]) * -poses[:, :3, 2]).sum(axis=1) > 0
    assert 4 <= inward.sum() <= 23
    assert found.poses(0, 0, 0, FILM).shape == (0, 4, 4)


def test_what_is_enclosed(found: Room) -> None:
    assert is_enclosed(found.scene, np.array([0, -1, 1.5]), 0.99)
    assert not is_enclosed(found.scene, np.array([0, -9, 1.5]), 0.1)
    assert not is_enclosed(found.scene, np.array([-1.6, 0.5, 0.9]), 0.5)  # in the cupboard


def test_the_room_in_which_the_sensor_stands(tmp_path: Path) -> None:
    """Two rooms, walls of both sides alike: nothing else tells which."""
    second = room(TWO_SIDED).replace('id="', 'id="second_')
    for name in (
        "ground",
        "ceiling",
        "left",
        "right",
        "back",
        "front",
        "table",
        "cupboard",
        "lamp",
    ):
        start = second.index(f'id="second_{name}"')
        end = second.index("</transform>", start)
        second = second[:end] + '<translate x="10"/>' + second[end:]
    mi.set_variant(choose_variant())
    scene = mi.load_file(str(write_scene(tmp_path, room(TWO_SIDED), second)))
    box = (BOX[0], (12.0, 2.5, 2.5))
    for x in (0.0, 10.0):
        start = np.array([x, -1.5, 1.5])
        places = find_room(scene, box, UP, start, 0).places(40, 0, 0)
        assert np.abs(places[:, 0] - x).max() < 2


def test_a_room_with_an_open_side(tmp_path: Path) -> None:
    mi.set_variant(choose_variant())
    scene = mi.load_file(str(write_scene(tmp_path, room(front=False))))
    places = find_room(scene, BOX, UP, np.array([0, -9.0, 1]), 0).places(40, 0, 0)
    assert (places > BOX[0]).all() and (places < BOX[1]).all()


def test_what_is_no_room(tmp_path: Path) -> None:
    mi.set_variant(choose_variant())
    scene = mi.load_file(str(write_scene(tmp_path, BALL)))
    with pytest.raises(InputError, match="protocol 'room': no place in the scene is enclosed"):
        find_room(scene, ((-1.0,) * 3, (1.0,) * 3), UP, None, 0)
