"""Which way is up in a scene, and how one knows.

A camera's own upward axis is square to where it looks: of a camera that looks down it leans
forward, and the world with it if one took it for the vertical. What a camera does show is that
the vertical lies in the plane of its upward and its viewing axis, unless it is rolled. So, in this
order:

1. what the user says;
2. the direction that the sensor's ``lookat`` calls up, if it agrees with the pose, and is not just
   the camera's own axis;
3. of several sensors: the one direction that is level with the picture of none of them;
4. the coordinate axis in that plane; of two, which the camera faces square on, the one in which
   the scene stands on its base, or else the nearer one;
5. the normal of the base, if it lies in that plane;
6. the sensor's own axis as it is.

Without a sensor: the normal of the base, or z. The base is the largest flat shape on one side of
which all others are.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..base.box import corners
from ..base.errors import InputError, Option
from ..scene_xml.parts import Part
from .sensors import SensorCamera

Array = np.ndarray[Any, Any]

_ROLL = 0.01  # sine of the roll up to which a camera counts as upright
_SAME = 1e-3  # up to which directions are one
_TURNED = 0.05  # spread of several cameras' horizontal axes from which they tell the vertical
_GAP = 0.5  # between the base and what stands over it, per size of the latter
_LARGE = 0.5  # of the largest flat shape's area: also a base


def told_up(up: str | Sequence[float]) -> Array:
    """The unit vector that a user names: x, -y, … or three numbers.

    Raises:
        InputError: if it is no direction.
    """
    if isinstance(up, str):
        sign = -1.0 if up.startswith("-") else 1.0
        if up.removeprefix("-") in ("x", "y", "z"):
            return sign * np.eye(3)["xyz".index(up[-1])] + 0.0
    else:
        values = np.array(up, np.float64)
        if values.shape == (3,) and np.isfinite(values).all() and values.any():
            return _snapped(values / np.linalg.norm(values))
    raise InputError("{}: expected x, y, z, -x, -y, -z or three numbers", Option("up", up))


def vertical(
    sensors: Sequence[SensorCamera], named: Sequence[Array], parts: Sequence[Part]
) -> tuple[Array, str]:
    """The vertical unit vector of a scene, (3,), and what it was taken from.

    Args:
        sensors: The scene's own; the first one counts most.
        named: Directions that ``lookat`` elements of its file call up.
        parts: Its shapes.
    """
    bases = _bases(parts)
    if not sensors:
        if bases:
            return _snapped(bases[0][1]), f"the base of the scene, {bases[0][0].name}"
        return np.array([0.0, 0.0, 1.0]), "nothing in the scene: no sensor, no base"
    first = sensors[0]
    right, upward, back = (first.pose[:3, i] for i in range(3))
    for up in named:
        # A mirrored camera may show the world upside down without being so.
        agrees = abs(up @ upward) if first.mirrored else up @ upward
        if abs(up @ right) <= _SAME and agrees > _SAME:
            if abs(up @ back) > _SAME or _is_axis(up):
                return _snapped(up), f"the up vector of {first.name}"
    agreed = _agreed(sensors)
    if agreed is not None:
        return _snapped(agreed), f"{len(sensors)} sensors that stand upright"
    axes = [a for a in np.concatenate([np.eye(3), -np.eye(3)]) if abs(a @ right) <= _ROLL]
    axes = [a for a in axes if a @ upward > _ROLL]
    if len(axes) > 1:
        standing = [a for a in axes if any(n @ a > 1 - _SAME for _, n in bases)]
        axes = standing if len(standing) == 1 else [max(axes, key=lambda a: float(a @ upward))]
    if axes:
        return axes[0] + 0.0, f"{first.name}, which stands upright"
    for part, normal in bases:
        if abs(normal @ right) <= 2 * _ROLL and normal @ upward > _ROLL:
            return _snapped(normal), f"the base of the scene, {part.name}"
    return _snapped(upward), f"{first.name} as it is"


def _agreed(sensors: Sequence[SensorCamera]) -> Array | None:
    """What is square to the horizontal axes of all cameras, if these are level and differ."""
    right = np.array([sensor.pose[:3, 0] for sensor in sensors])
    spread, axes = np.linalg.eigh(right.T @ right / len(right))
    if len(sensors) < 2 or spread[0] > _ROLL**2 or spread[1] < _TURNED:
        return None
    up = axes[:, 0]
    along = np.array([sensor.pose[:3, 1] for sensor in sensors]) @ up
    if (along > 0).all() or (along < 0).all():
        return np.asarray(up * np.sign(along[0]))
    return None


def _bases(parts: Sequence[Part]) -> list[tuple[Part, Array]]:
    """Large flat shapes with the normal on the side of all others; z and y up first."""
    flat = [part for part in parts if part.normal is not None and not part.glows]
    if not flat:
        return []
    area = {id(part): float(np.prod(np.sort(part.upper - part.lower)[1:])) for part in flat}
    least = _LARGE * max(area.values())
    found = []
    for part in flat:
        others = [p for p in parts if not p.glows and area.get(id(p), 0.0) < least]
        if area[id(part)] >= least and others:
            normal = _side(part, others)
            if normal is not None:
                found.append((part, normal))
    found.sort(key=lambda base: (-round(base[1][2], 3), -round(base[1][1], 3)))
    return found


def _side(base: Part, others: Sequence[Part]) -> Array | None:
    """The base's normal if all others are on that side of it, and near."""
    normal = np.asarray(base.normal)
    points = np.concatenate([corners(part.lower, part.upper) for part in others])
    size = float(np.ptp(points, axis=0).max())
    # Boxes reach further across than what is in them.
    below = 0.05 if _is_axis(normal) else 0.25
    for sign in (1.0, -1.0):
        heights = sign * (points @ normal)
        top = max(sign * level for level in base.levels)
        if -below * size <= float(heights.min()) - top <= _GAP * size:
            return sign * normal
    return None


def _is_axis(direction: Array) -> bool:
    return bool(np.abs(direction).max() > 1 - _SAME**2 / 2)


def _snapped(direction: Array) -> Array:
    """A coordinate axis where it is one up to rounding, without negative zeros."""
    axis = np.rint(direction)
    near = np.abs(direction - axis).max() <= _SAME and np.abs(axis).sum() == 1
    return np.asarray((axis if near else direction) + 0.0)
