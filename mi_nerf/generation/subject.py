"""What of a scene is the object, at which cameras look, and what merely surrounds it.

A floor, a wall or a backdrop is many times larger than all that stands before it. Shapes are
looked at in the order of their size: those that are so much larger than the box of all smaller
ones that they can only be surroundings are set aside, and then the rest is looked at again. How
much larger depends on what else speaks for it:

===============================  =======  ================================================
a shape that is                  times    because
===============================  =======  ================================================
flat                             4        floors and walls are, unless the sensor has it
                                          whole in view, and up to 20 times
around the rest, as the sensor   4        domes, and rooms as one mesh
not flat, the sensor frames the  8        the author looks at the rest, not at it
rest
around the rest, an open mesh    8        backdrops bend around what is before them
anything else                    50       the ground may be a globe
===============================  =======  ================================================

Shapes that are not flat are set aside one at a time: a figure of two balls with a tiny third one
is three balls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..base.errors import InputError, Option
from ..scene_xml.parts import Part, is_open, pieces
from ..scene_xml.scene_file import Bounds
from .sensors import SensorCamera

Array = np.ndarray[Any, Any]

_FLAT, _BENT, _WHOLE, _ANYTHING = 4.0, 8.0, 20.0, 50.0
_FRAME = 1 / 8  # of the picture's smaller side that a thing spans which the sensor looks at
_ASIDE = 64  # shapes at most that are set aside at once
_PIECES = 64  # of a mesh of the surroundings that are looked at: of grass there are more
_MENTIONED = 6  # names in a line
_LISTED = 40  # names in an error


@dataclass(frozen=True)
class Subject:
    """The object, or the whole scene."""

    box: Bounds
    names: tuple[str, ...] = ()  # of its shapes; of the whole scene none
    others: tuple[Part, ...] = ()  # the surroundings
    told: bool = False  # by the user

    @property
    def is_all(self) -> bool:
        """Whether nothing was set aside."""
        return not self.others

    def holds(self, points: Array) -> Array:
        """Which of (N, 3) points on surfaces are the object's."""
        corners = np.array(self.box)
        tolerance = 1e-3 * float(np.ptp(corners, axis=0).max())
        inside = (points >= corners[0] - tolerance) & (points <= corners[1] + tolerance)
        found: Array = inside.all(axis=-1)
        for part in self.others:
            if part.normal is not None:
                found &= ~part.holds(points, tolerance)
        return found

    def __str__(self) -> str:
        """What was taken for the object and what was not, for people; nothing for all."""
        if self.is_all:
            return ""
        size = float(np.ptp(np.array(self.box), axis=0).max())
        times = max(part.size for part in self.others) / size if size else np.inf
        others = tuple(part.name for part in self.others)
        why = "" if self.told else f", up to {times:.3g} times as large (--object overrides)"
        return f"object: {_listed(self.names)}; not {_listed(others)}{why}"

    def record(self) -> dict[str, Any]:
        """What ``dataset.json`` says of it: nothing where it is the whole scene."""
        if self.is_all:
            return {}
        return {"object": list(self.names), "surroundings": [part.name for part in self.others]}


def told_subject(parts: Sequence[Part], names: Sequence[str]) -> Subject:
    """The shapes that the user names; an instance's id means all that it shows.

    Raises:
        InputError: if there is no such shape, with the ids of those there are.
    """
    chosen: list[Part] = []
    for name in names:
        found = [p for p in parts if p.name == name]
        found = found or [p for p in parts if p.name.startswith(f"{name}_")]
        if not found:
            known = sorted({part.name for part in parts})
            raise InputError(
                "{}: no such shape, expected one of {}",
                Option("object", name),
                _listed(tuple(known), _LISTED),
            )
        chosen += [part for part in found if part not in chosen]
    others = [part for part in parts if part not in chosen and not part.glows]
    return _subject(chosen, others, told=True)


def find_subject(parts: Sequence[Part], whole: Bounds, sensor: SensorCamera | None) -> Subject:
    """The object of a scene: all that is visible, but for its surroundings.

    Args:
        parts: The scene's shapes.
        whole: The box of all that is visible.
        sensor: The scene's own, which shows what its author looks at.
    """
    visible = [part for part in parts if not part.glows]
    rest, others = _divide(visible, sensor)
    # One mesh may hold both the ground and the object.
    if others:
        joined = [part for part in others if 1 < len(pieces(part)) <= _PIECES]
    else:
        joined = sorted(visible, key=lambda part: -part.size)[:1]
    for mesh in joined:
        rest, others = _apart(mesh, rest, others, sensor)
    if not others:
        return Subject(whole)
    return _subject(rest, others)


def _subject(chosen: Sequence[Part], others: Sequence[Part], told: bool = False) -> Subject:
    """A subject that keeps no geometry."""
    names = tuple(part.name for part in chosen)
    bare = tuple(replace(part, shape=None) for part in others)
    corners = [part.lower for part in chosen], [part.upper for part in chosen]
    lower, upper = np.min(corners[0], axis=0).tolist(), np.max(corners[1], axis=0).tolist()
    return Subject((tuple(lower), tuple(upper)), names, bare, told)


def _apart(
    mesh: Part, rest: list[Part], others: list[Part], sensor: SensorCamera | None
) -> tuple[list[Part], list[Part]]:
    """The object and its surroundings if the pieces of a mesh may belong to either."""
    split = pieces(mesh)
    if len(split) < 2:
        return rest, others
    parts = [part for part in [*rest, *others] if part is not mesh]
    kept, aside = _divide([*parts, *split], sensor)
    left = [part for part in kept if part in split]
    if not left or not any(part in split for part in aside):
        return rest, others  # all of it belongs where it is
    one = _union(left, f"{mesh.name} ({len(left)} of {len(split)} pieces)")
    return [one, *(part for part in kept if part not in left)], aside


def _divide(parts: Sequence[Part], sensor: SensorCamera | None) -> tuple[list[Part], list[Part]]:
    """The object's parts and those of the surroundings."""
    rest = sorted(parts, key=lambda part: -part.size)
    others: list[Part] = []
    while (count := _larger(rest, sensor)) > 0:
        others += rest[:count]
        rest = rest[count:]
    return rest, others


def _larger(rest: Sequence[Part], sensor: SensorCamera | None) -> int:
    """How many of the largest parts surround all that are smaller; 0: none."""
    if len(rest) < 2:
        return 0
    # Boxes of all parts from number k on.
    lower = np.minimum.accumulate([part.lower for part in rest[::-1]])[::-1]
    upper = np.maximum.accumulate([part.upper for part in rest[::-1]])[::-1]
    for count in range(1, min(len(rest), _ASIDE + 1)):
        low, high = lower[count], upper[count]
        size = float((high - low).max())
        if size <= 0 or rest[count - 1].size < _FLAT * size:
            continue
        first = rest[:count]
        solid = sum(part.normal is None for part in first)
        if solid <= 1 and all(_surrounds(part, low, high, sensor) for part in first):
            return count
    return 0


def _surrounds(part: Part, lower: Array, upper: Array, sensor: SensorCamera | None) -> bool:
    """Whether a part is a floor, a wall or a backdrop of what is in the box."""
    times = part.size / float((upper - lower).max())
    share = None if sensor is None else sensor.share_of_frame(lower, upper)
    framed = share is not None and share >= _FRAME
    if part.normal is not None:
        whole = None if sensor is None else sensor.share_of_frame(part.lower, part.upper)
        return times >= _WHOLE or framed or share is None or whole is None or whole >= 1
    if times >= _ANYTHING or (times >= _BENT and framed):
        return True
    margin = 0.01 * part.size
    if not ((lower >= part.lower - margin).all() and (upper <= part.upper + margin).all()):
        return False
    if sensor is None:
        return times >= _BENT and is_open(part)
    where = sensor.pose[:3, 3]
    return bool((where >= part.lower).all() and (where <= part.upper).all())


def _union(parts: Sequence[Part], name: str) -> Part:
    """Several parts as one."""
    lower = np.min([part.lower for part in parts], axis=0)
    upper = np.max([part.upper for part in parts], axis=0)
    return Part(name, lower, upper, False, None, (0.0, 0.0))


def _listed(names: Sequence[str], most: int = _MENTIONED) -> str:
    """Names in a line, and how many more there are."""
    known = list(dict.fromkeys(names))
    more = len(known) - most
    return ", ".join(known[:most]) + (f" and {more} more" if more > 0 else "")
