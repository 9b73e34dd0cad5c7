"""Marches rays through a field from one occupied sample to the next.

Each ray walks over its strata, leaving empty bricks of the occupancy grid at once, asks the
field where it may be dense, and ends at its transmittance. The samples are those that
:mod:`mi_nerf.march.placing` keeps, to the last bit, and so is what a ray sees, but for the
order in which sums are rounded; it ends at the very sample behind which less than ``stop``
passes, not after the round in which that was noticed. Nothing is stored but a few numbers a
ray. There are no derivatives.

Where the field may be asked within a kernel, all of this is one; else it happens in
:mod:`waves <mi_nerf.march.waves>` of many rays.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from ..base.arrays import Floats, Indices, Mask, Vectors
from .intervals import RaySegments, ray_segments
from .marched import MarchedField
from .path import Path
from .rules import one_minus_exp, opaque_at_most
from .waves import Waves


@dataclass
class Walked:
    """What R rays have seen; without colour and depth if only density was asked for."""

    color: list[Floats]  # three arrays of R values, premultiplied by the opacity
    optical_depth: Floats  # R values
    opacity: Floats  # R values in [0, 1]
    depth: Floats  # R values: mean distance under the weights, scene units; 0 where none
    queries: Indices  # R numbers: how often the field was asked; in waves, in vain at the ends


def can_walk(marched: MarchedField) -> bool:
    """Whether a field can be asked so, and its samples are found one by one."""
    settings, field = marched.settings, marched.field
    refined = field.coarse is not None and settings.fine > 0
    if settings.rule != "constant" or settings.hidden > 0 or refined:
        return False
    ways = (field.fused, field.at_once)
    return any(way(emission=False) is not None for way in ways)


def walk_rays(
    marched: MarchedField,
    o: Vectors,
    d: Vectors,
    *,
    jitter: Floats = None,
    bounds: tuple[Any, Any] = (None, None),
    emission: bool = True,
) -> Walked:
    """Marches the rays ``o + t·d`` of a field for which :func:`can_walk` holds.

    Args:
        jitter, bounds: as for :func:`mi_nerf.march.placing.place_samples`; one number a ray.
        emission: whether colour is wanted.
    """
    field, settings = marched.field, marched.settings
    with dr.suspend_grad():
        within = ray_segments(field, o, d, (settings.near, settings.far), bounds)
        dr.eval(within.o, within.d, within.view, within.near, within.far)
        ask = field.fused_along(within.view) if emission else field.fused(emission=False)
        if ask is not None:
            path = Path(within, settings.samples, jitter, marched.occupancy)
            tau, queries, *channels = _march(path, ask, settings.stop, emission)
        else:
            tau, queries, *channels = _in_waves(marched, within, jitter, emission)
        opacity = one_minus_exp(tau)
        depth = opacity
        if emission:
            depth = channels.pop() / dr.select(opacity > 0, opacity, 1)
            depth = depth if within.ndc is None else within.ndc.to_distance(depth)
            depth = dr.select(opacity > 0, depth, 0)
        dr.eval(channels, tau, opacity, depth, queries)
    return Walked(channels, tau, opacity, depth, queries)


def _in_waves(
    marched: MarchedField, within: RaySegments, jitter: Floats, emission: bool
) -> list[Any]:
    """As :func:`_march`, for a field that is asked about many points at once."""
    settings, ask = marched.settings, marched.field.at_once(emission)
    assert ask is not None
    waves = Waves(within, settings.samples, jitter, marched.occupancy, settings.stop, emission)
    waves.run(ask)
    tau, *channels = waves.seen
    return [tau, waves.queries, *channels]


def _march(path: Path, ask: Callable[..., Any], stop: float, emission: bool) -> list[Any]:
    """Optical depth, queries, and with ``emission`` the sums of colour and t under the weights."""
    float_type = type(path.width)
    uint = dr.uint32_array_t(float_type)
    rays, last = len(path.hit), uint(path.samples)
    limit = dr.opaque(float_type, -math.log(stop) if stop > 0 else dr.inf)
    sums = [dr.zeros(float_type, rays), dr.zeros(uint, rays)]
    sums += [dr.zeros(float_type, rays) for _ in range(4 if emission else 0)]

    def going(stratum: Indices, *_: Any) -> Mask:
        return stratum < last

    def step(stratum: Indices, tau: Floats, queries: Indices, *seen: Floats) -> tuple[Any, ...]:
        t, p = path.at(stratum)
        density, color = ask(p) if emission else (ask(p), [])
        own = opaque_at_most(density * path.width)
        weight = dr.exp(-tau) * one_minus_exp(own)
        values = [*color, t] if emission else []
        seen = tuple(dr.fma(weight, v, s) for v, s in zip(values, seen, strict=True))
        tau = tau + own
        stratum = path.next(dr.select(tau < limit, stratum + 1, last))
        return (stratum, tau, queries + 1, *seen)

    start = path.next(dr.select(path.hit, uint(0), last))
    names = ("stratum", "tau", "queries", "red", "green", "blue", "depth")
    state = dr.while_loop((start, *sums), going, step, labels=names[: len(sums) + 1])
    return list(state[1:])
