"""What a user should know of a dataset before its first view: precision and memory."""

from __future__ import annotations

import numpy as np

from ..base.errors import InputError, Option
from ..base.machine import available_memory
from .passes import memory
from .plan import Plan

# What positions a step of single precision apart may be of a scene's size: a tenth of a pixel.
_COARSE = 1e-4

_RAY_EPSILON = 2.0**-24 * 1500  # Mitsuba's RayEpsilon: how far from a surface reflected rays begin
_LEAK = 1e-3  # that may be of a scene's size


def notes(plan: Plan) -> list[str]:
    """One line for each limit of single precision that a scene comes near."""
    box = np.array(plan.box)
    size = float(np.linalg.norm(box[1] - box[0]))
    reach = float(np.abs(box).max())
    spacing = float(np.spacing(np.float32(reach)))
    found = []
    if spacing > _COARSE * size:
        found.append(
            f"note: the scene, of size {size:.3g}, lies {reach:.3g} from the origin: single "
            f"precision tells places {spacing:.2g} apart there, depth and normals are no better"
        )
    if size > 0 and _RAY_EPSILON > _LEAK * size:
        found.append(
            f"note: the scene has a size of {size:.3g}, and Mitsuba begins reflected rays "
            f"{_RAY_EPSILON:.1g} from surfaces: finer shadows are lost, depth and normals exact"
        )
    return found


def memory_line(plan: Plan, samples_at_once: int) -> str:
    """The memory that rendering takes, for people.

    Args:
        samples_at_once: Paths that are traced at a time.

    Raises:
        InputError: if there is less.
    """
    needed, there = memory(plan.pixels), available_memory()
    if needed > there:
        raise InputError(
            "{}: takes about {:.1f} GB of memory, there are {:.1f} GB",
            Option("size", (plan.intrinsics.width, plan.intrinsics.height)),
            needed / 1e9,
            there / 1e9,
        )
    return f"about {needed / 1e9:.1f} GB of memory, {samples_at_once:,} paths at a time"
