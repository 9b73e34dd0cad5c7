"""Where a ray is sampled: its interval inside the box, and the strata within it.

Ray directions need not have unit length: t counts multiples of the direction, and
``interval`` returns bounds in that unit. Callers that want scene units normalise
their directions first, as :func:`mi_nerf.cameras.pixel_rays` does.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from .arrays import vector3_type


def box_interval(o: Any, d: Any, lower: Any, upper: Any) -> tuple[Any, Any, Any]:
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
    t_near: Any, t_far: Any, hit: Any, near: Any = None, far: Any = None
) -> tuple[Any, Any, Any]:
    """Shortens intervals to the bounds ``near`` and ``far``: numbers, arrays or ``None``."""
    float_type = type(t_near)
    if near is not None:
        t_near = dr.fmax(t_near, _as_data(float_type, near))
    if far is not None:
        t_far = dr.fmin(t_far, _as_data(float_type, far))
    hit = hit & (t_far > t_near)
    return dr.select(hit, t_near, 0), dr.select(hit, t_far, 0), hit


def _as_data(float_type: Any, value: Any) -> Any:
    """A number as an array that kernels do not take for a constant."""
    return dr.opaque(float_type, float(value)) if isinstance(value, int | float) else value


def stratified(t_near: Any, t_far: Any, samples: int, jitter: Any = None) -> tuple[Any, Any]:
    """One sample in each of ``samples`` equal strata of every ray (NeRF Eq. 2).

    Args:
        t_near, t_far: bounds of R rays.
        samples: number of strata S.
        jitter: R·S numbers in [0, 1), the place of each sample within its stratum;
            R numbers to shift all samples of a ray alike; ``None`` for the middle.

    Returns:
        ``(t, delta)``, R·S values each, ray-major: the sample's parameter and the
        width of its stratum. The widths of a ray sum to ``t_far − t_near``: the last
        interval is as finite as the others.
    """
    float_type = type(t_near)
    uint = dr.uint32_array_t(float_type)
    rays = max(len(t_near), len(t_far))
    index = dr.arange(uint, rays * samples)
    ray = index // samples
    stratum = float_type(index - ray * samples)
    if jitter is None:
        offset = float_type(0.5)
    elif len(jitter) == rays and samples > 1:
        offset = dr.gather(float_type, jitter, ray)
    else:
        offset = jitter
    start = dr.gather(float_type, t_near, ray)
    delta = (dr.gather(float_type, t_far, ray) - start) * (1 / samples)
    return dr.fma(stratum + offset, delta, start), delta


def points_along(o: Any, d: Any, t: Any, ray: Any) -> Any:
    """o + t·d for samples that belong to the rays ``ray``."""
    float_type = type(t)
    return vector3_type(float_type)(
        *(
            dr.fma(t, dr.gather(float_type, d[i], ray), dr.gather(float_type, o[i], ray))
            for i in range(3)
        )
    )
