"""How much light fields bring, beside the emitters of a scene.

An estimate from a few thousand rays, good enough to decide whether, and how often, fields are
worth sampling as light sources; whatever is decided, the mean of a picture is the same.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..base.arrays import upload
from .colors import unpolarized
from .field_light import FieldBox, box_of
from .integral import see
from .sampled import Rays, SampledField

_RAYS = 2048  # through each field, and to emitters
_WAVELENGTH = 555.0  # at which light is compared in spectral variants, in nanometres


def field_powers(fields: list[SampledField]) -> list[float]:
    """The power that leaves each field, in the units of the scene; 0 of those without a box."""
    found = []
    for marched in fields:
        box = box_of(marched.placed) if marched.field.ndc is None else None
        found.append(0.0 if box is None else _power(marched, box))
    return found


def field_share(scene: mi.Scene, fields: list[SampledField], powers: list[float]) -> float:
    """The share of light around fields that comes from them, in [0, 1].

    Light is that from all directions, as if nothing were between, at points around each field
    that are half to one diagonal of its box away from its centre. A field of the power P brings
    P / 4π / (distance² + R²), with half the diagonal R.

    Args:
        scene: without the cubes of fields.
        powers: of the fields.
    """
    boxes = [box_of(marched.placed) if marched.field.ndc is None else None for marched in fields]
    known = [(box.bounds(), power) for box, power in zip(boxes, powers, strict=True) if box]
    if not known:
        return 0.0
    rng = np.random.default_rng(0)
    which = rng.integers(len(known), size=_RAYS)
    centers = np.array([center for (center, _), _ in known])
    sizes = np.array([size for (_, size), _ in known])
    away = rng.normal(size=(_RAYS, 3))
    away *= rng.uniform(1, 2, (_RAYS, 1)) / np.linalg.norm(away, axis=1, keepdims=True)
    points = centers[which] + sizes[which, None] * away
    own = sum(
        power / (4 * np.pi) / (np.square(points - center).sum(axis=1) + size**2)
        for (center, size), power in known
    ).mean()
    others = _from_emitters(scene, points, rng) if scene.emitters() else 0.0
    return float(own / (own + others)) if own > 0 else 0.0


def _from_emitters(scene: mi.Scene, points: Any, rng: Any) -> float:
    """The light of emitters from all directions, the mean over points."""
    at = dr.zeros(mi.Interaction3f, _RAYS)
    at.p = mi.Point3f(*(upload(mi.Float, x) for x in points.T.astype(np.float32)))
    if mi.is_spectral:
        at.wavelengths = dr.full(type(at.wavelengths), _WAVELENGTH, _RAYS)
    number = mi.Point2f(*(upload(mi.Float, rng.random(_RAYS, np.float32)) for _ in range(2)))
    _, weight = scene.sample_emitter_direction(at, number, False, True)
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
