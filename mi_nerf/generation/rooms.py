"""Cameras inside a room, clear of its surfaces, that look about.

Where a room is, rays tell: a point is inside if most directions from it meet something, and next
to none the black back of a wall. Points of a low-discrepancy sequence that are inside, see each
other directly or round a corner, and keep a distance from everything, are where cameras may
stand: their order is that of the sequence, so fewer views are the first of more. Every other
camera looks across the room, those between into the open.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..base.errors import InputError
from ..cameras.pinhole import Intrinsics
from ..cameras.poses import look_at
from ..scene_xml.scene_file import Bounds
from .probes import all_around, blocked, camera_rays, first_hits
from .viewpoints import horizontal_axes, unit_cube

Array = np.ndarray[Any, Any]

_DIRECTIONS = 64  # in which a place is looked at
_PLACES = 2048  # that are looked at to know the room
_ENCLOSED = 0.6  # share of directions that meet something, inside a room
_DARK = 0.03  # of which those that meet the back of a wall are at most so many
_SPACIOUS = 0.03  # share of the scene that is inside: less are gaps between things
_CLEAR = 0.15  # distance from all surfaces, per typical distance of the walls
_FEWEST = 64  # places, below which cameras may stand nearer to surfaces
_SMALL = 1 / 4  # of the volume searched, below which it is searched again, closer around the room
_NEAREST = 1 / 8  # of that distance, at least
_HUBS, _ROUNDS = 24, 3  # places from which others are seen, around how many corners
_TRIES, _GRID = 12, 8  # directions tried for a camera, rays along each side of its film
_PITCH = math.radians(20)  # cameras look up and down by so much at most
_TURN = math.pi * (3 - math.sqrt(5))


@dataclass(frozen=True, eq=False)
class Room:
    """The inside of a scene, as cameras need to know it."""

    scene: Any
    box: Bounds  # within which places are sought
    up: Array
    hubs: Array  # (H, 3) from some of which each place is seen
    middle: Array  # (3,) of all places
    clear: float  # least distance of cameras from surfaces

    def places(self, count: int, seed: int, stream: int) -> Array:
        """``count`` places for cameras, (count, 3), the first of a sequence."""
        found = np.empty((0, 3))
        for start in range(0, 64 * max(count, 256), 1024):
            points = _points(self.box, 1024, seed, stream, start)
            good = _inside(self.scene, points, self.clear)
            good[good] = _seen(self.scene, points[good], self.hubs)
            found = np.concatenate([found, points[good]])
            if len(found) >= count:
                return found[:count]
        return np.resize(found, (count, 3))  # the same places again, looking elsewhere

    def poses(self, count: int, seed: int, stream: int, intrinsics: Intrinsics) -> Array:
        """``count`` OpenGL poses, (count, 4, 4)."""
        if count == 0:
            return np.empty((0, 4, 4))
        places = self.places(count, seed, stream)
        tried = np.array(
            [[self._pose(p, i, k, seed) for k in range(_TRIES)] for i, p in enumerate(places)]
        )
        flat = tried.reshape(-1, 4, 4)
        o, d = camera_rays(list(flat), [intrinsics] * len(flat), _GRID)
        hits = first_hits(self.scene, o.reshape(-1, 3), d.reshape(-1, 3), hide_emitters=False)
        shape = (count, _TRIES, _GRID**2)
        lit = hits.something & ~hits.dark
        open_view = (hits.nearest > 6 * self.clear).reshape(shape).mean(axis=-1)
        score = lit.reshape(shape).mean(axis=-1) + np.minimum(open_view, 0.8)
        # The first direction that is about as good as any: others serve as well as they differ.
        good = score >= score.max(axis=1, keepdims=True) - 0.05
        return np.asarray(tried[np.arange(count), good.argmax(axis=1)])

    def _pose(self, place: Array, number: int, attempt: int, seed: int) -> Array:
        """One of the directions in which a camera may look."""
        side, front = horizontal_axes(self.up)
        random = np.random.default_rng([seed, number, attempt])
        inward = self.middle - place
        level = inward - (inward @ self.up) * self.up
        angle = number * _TURN + attempt * 2 * math.pi / _TRIES
        if number % 2 == 0 and np.linalg.norm(level) > self.clear:
            angle = math.atan2(level @ front, level @ side) + random.uniform(-0.5, 0.5)
        pitch = random.uniform(-_PITCH, _PITCH)
        ahead = math.cos(angle) * side + math.sin(angle) * front
        direction = math.cos(pitch) * ahead + math.sin(pitch) * self.up
        return look_at(place, place + direction, self.up)


def find_room(scene: Any, box: Bounds, up: Array, start: Array | None, seed: int) -> Room:
    """The room around a point, or else the most spacious one in a box.

    Args:
        box: Of all that is visible.
        start: A point that is inside if any is: where the scene's sensor stands.

    Raises:
        InputError: if there is no place to stand.
    """
    enclosed = start is not None and is_enclosed(scene, start, _ENCLOSED)
    if enclosed:
        box = _nearby(scene, box, np.asarray(start))
    known = _room_in(scene, box, start if enclosed else None, seed)
    # What is seen through a window is many times larger: few places would be in the room.
    around = known.around(box)
    while _volume(around) < _SMALL * _volume(box):
        box, known = around, _room_in(scene, around, known.start, seed)
        around = known.around(box)
    room, near = known.places, known.distances.min(axis=1)
    clear = _CLEAR * float(np.median(np.median(known.distances, axis=1)))
    least = _NEAREST * clear
    while clear > least and (near >= clear).sum() < _FEWEST:
        clear *= 0.8
    if not (near >= clear).any():
        raise InputError("protocol 'room': no place in it is clear of surfaces, expected a room")
    return Room(scene, box, up, known.hubs, room[near >= clear].mean(axis=0), clear)


@dataclass(frozen=True, eq=False)
class _Known:
    """Places in a room, and distances all around them."""

    places: Array  # (N, 3)
    distances: Array  # (N, directions)
    hubs: Array  # (H, 3)
    start: Array  # (3,) where the search began

    def around(self, box: Bounds) -> Bounds:
        """The part of a box that the room can fill, as far as these places show."""
        reach = float(np.median(self.distances))
        lower = np.maximum(box[0], self.places.min(axis=0) - reach)
        upper = np.minimum(box[1], self.places.max(axis=0) + reach)
        return tuple(lower.tolist()), tuple(upper.tolist())


def _room_in(scene: Any, box: Bounds, start: Array | None, seed: int) -> _Known:
    """The room around a point that is enclosed, or else the most spacious one in a box."""
    points = _points(box, _PLACES, seed, 3, 0)
    if start is not None:
        points = np.concatenate([np.asarray(start)[None], points])
    inside = points[_inside(scene, points, 0.0)]
    if len(inside) < (1 if start is not None else _SPACIOUS * _PLACES):
        raise InputError("protocol 'room': no place in the scene is enclosed, expected a room")
    distances = _distances(scene, inside)
    typical = np.median(distances, axis=1)
    first = 0 if start is not None and (inside[0] == start).all() else int(np.argmax(typical))
    hubs, reached = _reachable(scene, inside, first)
    return _Known(inside[reached], distances[reached], hubs, inside[first])


def _volume(box: Bounds) -> float:
    return float(np.prod(np.subtract(box[1], box[0])))


def is_enclosed(scene: Any, point: Array, share: float) -> bool:
    """Whether so many directions from a point meet something, and hardly any a wall's back."""
    d = all_around(4 * _DIRECTIONS)
    hits = first_hits(scene, np.broadcast_to(point, d.shape), d, hide_emitters=False)
    solid = np.isfinite(hits.distance)
    return bool(solid.mean() >= share and hits.dark.sum() <= _DARK * max(1, solid.sum()))


def _nearby(scene: Any, box: Bounds, start: Array) -> Bounds:
    """The part of a box around a point within which its room must be."""
    reach = 3 * float(np.quantile(_distances(scene, start[None]), 0.9))
    lower, upper = np.maximum(box[0], start - reach), np.minimum(box[1], start + reach)
    return tuple(lower.tolist()), tuple(upper.tolist())


def _points(box: Bounds, count: int, seed: int, stream: int, start: int) -> Array:
    """Points within a box, (count, 3), from number ``start`` of a sequence on."""
    lower, upper = np.array(box)
    return np.asarray(lower + unit_cube(count, seed, stream, start) * (upper - lower))


def _inside(scene: Any, points: Array, clear: float) -> Array:
    """Which points are inside a room, and so far from all surfaces, (N,)."""
    d = all_around(_DIRECTIONS)
    o = np.repeat(points, _DIRECTIONS, axis=0)
    hits = first_hits(scene, o, np.tile(d, (len(points), 1)), hide_emitters=False)
    shape = (len(points), _DIRECTIONS)
    solid = np.isfinite(hits.distance).reshape(shape).sum(axis=1)
    dark = hits.dark.reshape(shape).sum(axis=1)
    near = hits.distance.reshape(shape).min(axis=1)
    enclosed = (solid >= _ENCLOSED * _DIRECTIONS) & (dark <= _DARK * solid)
    return np.asarray(enclosed & (near >= clear))


def _distances(scene: Any, points: Array) -> Array:
    """Distances of what is around points, (N, directions); of nothing as far as anything."""
    d = all_around(_DIRECTIONS)
    o = np.repeat(points, _DIRECTIONS, axis=0)
    hits = first_hits(scene, o, np.tile(d, (len(points), 1)), hide_emitters=False)
    distance = hits.distance.reshape(len(points), _DIRECTIONS)
    known = distance[np.isfinite(distance)]
    return np.where(np.isfinite(distance), distance, known.max() if known.size else 0.0)


def _reachable(scene: Any, points: Array, first: int) -> tuple[Array, Array]:
    """Places from which the room around a point is seen, and which points are in it."""
    reached = np.zeros(len(points), bool)
    reached[first] = True
    hubs = points[first][None]
    fresh = hubs
    for _ in range(_ROUNDS):
        new = _seen(scene, points, fresh) & ~reached
        if not new.any():
            break
        reached |= new
        places = points[new]
        fresh = places[:: max(1, len(places) // _HUBS)][:_HUBS]
        hubs = np.concatenate([hubs, fresh])
    return hubs, reached


def _seen(scene: Any, points: Array, hubs: Array) -> Array:
    """Which points are seen from any of the hubs, (N,).

    All in one: each tracing of rays through a scene of many materials takes half a second
    before the first ray.
    """
    if not len(points):
        return np.zeros(0, bool)
    origins = np.repeat(hubs, len(points), axis=0)
    hidden = blocked(scene, origins, np.tile(points, (len(hubs), 1)))
    return np.asarray(~hidden.reshape(len(hubs), len(points)).all(axis=0))
