"""Where the cameras of a dataset stand: seeded, and evenly spread at every length.

Positions follow a low-discrepancy sequence (Roberts' R2, the golden ratio in two
dimensions) from a random start, so the first 25 of 100 views are spread as evenly as
all of them, and another split or seed gives other positions of the same kind.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..cameras.poses import look_at

Array = np.ndarray[Any, Any]

_PLASTIC = 1.32471795724474602596  # the real root of x^3 = x + 1
_STEP = np.array([1 / _PLASTIC, 1 / _PLASTIC**2])
_STEP_3 = 1.22074408460575947536 ** -np.arange(1.0, 4)  # the real root of x^4 = x + 1

# Sines of elevation. Not quite the pole, where "upright" means nothing, nor quite the
# horizon, where a ground plane is a line.
_HIGHEST = 0.98
_LOWEST = {"hemisphere": 0.02, "sphere": -0.98}

_SPLIT_SEEDS = {"train": 0, "val": 1, "test": 2}


def unit_square(count: int, seed: int, stream: int) -> Array:
    """``count`` points of the R2 sequence in [0, 1)², (count, 2)."""
    start = np.random.default_rng([seed, stream]).random(2)
    return (start + np.arange(count)[:, None] * _STEP) % 1.0


def unit_cube(count: int, seed: int, stream: int, first: int = 0) -> Array:
    """``count`` points of the R3 sequence in [0, 1)³, (count, 3), from number ``first`` on."""
    start = np.random.default_rng([seed, stream]).random(3)
    return (start + np.arange(first, first + count)[:, None] * _STEP_3) % 1.0


def around(
    count: int,
    split: str,
    seed: int,
    *,
    cameras: str,
    up: Array,
    center: Array,
    radius: float,
    elevation: tuple[float, float] | None = None,
) -> Array:
    """OpenGL poses on a (hemi)sphere, uniform in area, that look at its centre, (count, 4, 4).

    Args:
        split: Another one gives other positions.
        cameras: ``"hemisphere"`` (above ``center``) or ``"sphere"``.
        up: Vertical unit vector.
        radius: Distance from ``center``.
        elevation: The part of the sphere between these angles over its horizon, in degrees,
            whatever ``cameras`` is.
    """
    low, high = _LOWEST[cameras], _HIGHEST
    if elevation is not None:
        low, high = (math.sin(math.radians(angle)) for angle in elevation)
    side, front = horizontal_axes(up)
    poses = []
    for u, v in unit_square(count, seed, _SPLIT_SEEDS[split]):
        height = low + (high - low) * u
        level = math.sqrt(1 - height * height)
        angle = 2 * math.pi * v
        out = level * (math.cos(angle) * side + math.sin(angle) * front) + height * up
        poses.append(look_at(center + radius * out, center, up))
    return np.array(poses).reshape(-1, 4, 4)


def forward(count: int, seed: int, pose: Array, spread: float) -> Array:
    """Poses beside each other that look the same way, as of a hand-held capture.

    Args:
        pose: The OpenGL pose in the middle, (4, 4).
        spread: Half the width of the patch of camera positions, scene units; it is
            two thirds as high.
    """
    offset = (2 * unit_square(count, seed, 3) - 1) * spread * np.array([1.0, 2 / 3])
    poses = np.repeat(np.asarray(pose, np.float64)[None], count, axis=0)
    poses[:, :3, 3] += offset @ pose[:3, :2].T
    return poses


def horizontal_axes(up: Array) -> tuple[Array, Array]:
    """Two unit vectors that make a right-handed frame with ``up``: side, front, up."""
    side = np.cross(up, [0.0, 0.0, 1.0])
    if np.linalg.norm(side) < 0.5:
        side = np.array([1.0, 0.0, 0.0]) - up[0] * np.asarray(up)
    side /= np.linalg.norm(side)
    return side, np.cross(up, side)
