"""How much light comes from the fields of a scene, and how much from its emitters.

An estimate from a few thousand rays, good enough to decide whether, and how often, fields are
worth sampling as light sources; whatever is decided, the mean of a picture is the same.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from ..base.arrays import upload
from .colors import unpolarized
from .field_light import FieldBox, box_of
from .integral import see
from .sampled import Rays, SampledField

_RAYS = 2048  # through each field, and from all emitters together


def field_powers(fields: list[SampledField]) -> list[float]:
    """The power that leaves each field, in the units of the scene; 0 of those without a box."""
    found = []
    for marched in fields:
        box = box_of(marched.placed) if marched.field.ndc is None else None
        found.append(0.0 if box is None else _power(marched, box))
    return found


def emitter_power(scene: mi.Scene) -> float:
    """The power of all emitters; of those at infinity, what enters the scene's bounds."""
    if not scene.emitters():
        return 0.0
    rng = np.random.default_rng(0)
    one = [upload(mi.Float, rng.random(_RAYS, np.float32)) for _ in range(5)]
    place, way = mi.Point2f(*one[1:3]), mi.Point2f(*one[3:])
    _, weight, _ = scene.sample_emitter_ray(0, one[0], place, way, True)
    return _mean(list(unpolarized(weight)))


def _power(marched: SampledField, box: FieldBox) -> float:
    """π A times the mean radiance along lines through the box, A its surface."""
    rng = np.random.default_rng(0)
    matrix = box.from_unit()
    points = rng.random((_RAYS, 3)) @ matrix[:3, :3].T + matrix[:3, 3]
    d = rng.normal(size=(_RAYS, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    _, size = box.bounds()
    o = (points - 3 * size * d).astype(np.float32)
    rays = Rays(
        mi.Point3f(*(upload(mi.Float, x) for x in o.T)),
        mi.Vector3f(*(upload(mi.Float, x) for x in d.T.astype(np.float32))),
        upload(mi.Float, np.full(_RAYS, np.inf, np.float32)),
        None,
    )
    return np.pi * box.surface() * _mean(see([marched], rays).values[:3])


def _mean(channels: list[Any]) -> float:
    values = np.array([np.array(channel, np.float64) for channel in channels])
    return float(np.nan_to_num(values, posinf=0.0).mean())
