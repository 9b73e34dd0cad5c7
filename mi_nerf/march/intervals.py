"""Where rays cross the box of a field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from ..base.arrays import Floats, Mask, Vectors
from ..cameras.ndc import NdcRays
from ..fields.protocol import Field


def box_interval(o: Vectors, d: Vectors, lower: Any, upper: Any) -> tuple[Floats, Floats, Mask]:
    """Intersects rays with an axis-aligned box (slab method, Kay & Kajiya 1986).

    Args:
        o, d: ray origins and directions, R 3-vectors each.
        lower, upper: corners of the box, three numbers each.

    Returns:
        ``(t_near, t_far, hit)``: entry and exit with ``t_near`` clamped to 0, and
        whether they bound an interval of positive length. Where ``hit`` is false
        both are 0. Rays parallel to a face (a zero of either sign or a subnormal number
        in ``d``) are inside or outside that slab as a whole; no 0·∞ is formed.
    """
    float_type = type(o[0])
    near, far = float_type(0), float_type(dr.inf)
    inside = dr.mask_t(float_type)(True)
    for i in range(3):
        parallel = dr.abs(d[i]) < dr.smallest(float_type)  # whose reciprocal is not finite
        rate = 1 / dr.select(parallel, 1, d[i])
        first, second = (lower[i] - o[i]) * rate, (upper[i] - o[i]) * rate
        enter, leave = dr.fmin(first, second), dr.fmax(first, second)
        near = dr.select(parallel, near, dr.fmax(near, enter))
        far = dr.select(parallel, far, dr.fmin(far, leave))
        inside &= ~parallel | ((o[i] >= lower[i]) & (o[i] <= upper[i]))
    hit = inside & (far > near) & dr.isfinite(far)
    return dr.select(hit, near, 0), dr.select(hit, far, 0), hit


def clip_interval(
    t_near: Floats, t_far: Floats, hit: Mask, near: Any = None, far: Any = None
) -> tuple[Floats, Floats, Mask]:
    """Shortens intervals to the bounds ``near`` and ``far``: numbers, arrays or ``None``."""
    float_type = type(t_near)
    if near is not None:
        t_near = dr.fmax(t_near, _as_data(float_type, near))
    if far is not None:
        t_far = dr.fmin(t_far, _as_data(float_type, far))
    hit = hit & (t_far > t_near)
    return dr.select(hit, t_near, 0), dr.select(hit, t_far, 0), hit


def _as_data(float_type: Any, value: Any) -> Floats:
    """A number as an array that kernels do not take for a constant."""
    return dr.opaque(float_type, float(value)) if isinstance(value, int | float) else value


@dataclass
class RaySegments:
    """The parts of R rays o + t·d in which a field lies: near ≤ t ≤ far."""

    o: Vectors  # R origins, in the space where the field lives
    d: Vectors  # R unit directions in that space
    view: Vectors  # R unit directions in scene space, along which the field emits
    near: Floats  # R bounds of t; both 0 where the field is missed
    far: Floats
    hit: Mask  # whether there is anything between them
    ndc: NdcRays | None  # how o, d and t came about, where that is not scene space


def ray_segments(field: Field, o: Vectors, d: Vectors, *limits: tuple[Any, Any]) -> RaySegments:
    """Where the rays ``o + t·d`` (unit ``d``) are inside the field's box.

    Rays are projected first where the field asks for it (NeRF, appendix C); those that do
    not face forward see nothing then.

    Args:
        limits: pairs of further bounds of t, in scene units: numbers, R values or ``None``.
    """
    view, ndc = d, None
    limits = limits or ((None, None),)  # without any, nothing behind the camera is seen either
    if field.ndc is not None:
        ndc = field.ndc.rays(o, d)
        o, d, limits = ndc.o, ndc.d, tuple(ndc.bounds(*limit) for limit in limits)
    near, far, hit = box_interval(o, d, field.lower, field.upper)
    if ndc is not None:
        hit &= ndc.facing
    for limit in limits:
        near, far, hit = clip_interval(near, far, hit, *limit)
    return RaySegments(o, d, view, near, far, hit, ndc)
