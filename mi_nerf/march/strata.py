"""Where a ray is sampled: its interval inside the box, strata, and where weights are large.

Ray directions need not have unit length: t counts multiples of the direction, and
``interval`` returns bounds in that unit. Callers that want scene units normalise
their directions first, as :func:`mi_nerf.cameras.pinhole` does.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from ..base.arrays import Floats, Indices, Vectors, vector3_type


def rows(uint: Any, count: int, size: int) -> tuple[Indices, Indices]:
    """The row of each of ``count`` entries, in rows of ``size``, and its place there."""
    index = dr.arange(uint, count)
    row = index // size
    return row, index - row * size


def stratified(
    t_near: Floats, t_far: Floats, samples: int, jitter: Floats = None
) -> tuple[Floats, Floats]:
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
    rays = max(len(t_near), len(t_far))
    ray, stratum = rows(dr.uint32_array_t(float_type), rays * samples, samples)
    stratum = float_type(stratum)
    if jitter is None:
        offset = float_type(0.5)
    elif len(jitter) == rays and samples > 1:
        offset = dr.gather(float_type, jitter, ray)
    else:
        offset = jitter
    start = dr.gather(float_type, t_near, ray)
    delta = (dr.gather(float_type, t_far, ray) - start) * (1 / samples)
    return dr.fma(stratum + offset, delta, start), delta


def points_along(o: Vectors, d: Vectors, t: Floats, ray: Indices) -> Vectors:
    """o + t·d for samples that belong to the rays ``ray``."""
    float_type = type(t)
    return vector3_type(float_type)(
        *(
            dr.fma(t, dr.gather(float_type, d[i], ray), dr.gather(float_type, o[i], ray))
            for i in range(3)
        )
    )


def stratum_edges(t_near: Floats, t_far: Floats, samples: int) -> Floats:
    """The ends of equal strata: R·(S + 1) ascending parameters, of S strata a ray."""
    float_type, ends = type(t_near), samples + 1
    ray, within = rows(dr.uint32_array_t(float_type), len(t_near) * ends, ends)
    near, far = dr.gather(float_type, t_near, ray), dr.gather(float_type, t_far, ray)
    share = float_type(within) * (1 / samples)
    return dr.select(share < 1, dr.fmin(dr.fma(share, far - near, near), far), far)


def cell_edges(t: Floats, t_near: Floats, t_far: Floats, samples: int) -> Floats:
    """The ends of what belongs to each sample, see :func:`cell_widths`.

    Args:
        t: R·S ascending parameters.
        t_near, t_far: bounds of R rays.
        samples: S.

    Returns:
        R·(S + 1) ascending parameters, from ``t_near`` to ``t_far``.
    """
    float_type, ends = type(t), samples + 1
    ray, within = rows(dr.uint32_array_t(float_type), len(t_near) * ends, ends)
    after = ray * samples + dr.fmin(within, samples - 1)
    before = ray * samples + dr.fmax(within, 1) - 1
    middle = 0.5 * (dr.gather(float_type, t, before) + dr.gather(float_type, t, after))
    near, far = dr.gather(float_type, t_near, ray), dr.gather(float_type, t_far, ray)
    return dr.select(within == 0, near, dr.select(within == samples, far, middle))


def cell_widths(t: Floats, t_near: Floats, t_far: Floats, samples: int) -> Floats:
    """The part of each ray that belongs to each sample: up to halfway to its neighbours.

    R·S widths ≥ 0 that sum to ``t_far − t_near``; arguments as for :func:`cell_edges`.
    """
    below, above = half_widths(t, t_near, t_far, samples)
    return below + above


def half_widths(t: Floats, t_near: Floats, t_far: Floats, samples: int) -> tuple[Floats, Floats]:
    """The parts of a sample's cell before and behind the sample; see :func:`cell_widths`."""
    float_type = type(t)
    ray, within = rows(dr.uint32_array_t(float_type), len(t), samples)
    before, after = neighbours(t, samples)
    to_near = t - dr.gather(float_type, t_near, ray)
    to_far = dr.gather(float_type, t_far, ray) - t
    below = dr.select(within > 0, 0.5 * (t - before), to_near)
    return below, dr.select(within < samples - 1, 0.5 * (after - t), to_far)


def neighbours(
    x: Floats, samples: int, *, first: Floats = None, last: Floats = None
) -> tuple[Floats, Floats]:
    """The values of the samples before and behind each one, of R·S.

    ``first`` and ``last`` (R·S values each) stand in where a ray begins and ends; by
    default it is the sample's own value.
    """
    float_type = type(x)
    index = dr.arange(dr.uint32_array_t(float_type), len(x))
    within = index % samples
    has_before, has_after = within > 0, within < samples - 1
    before = dr.gather(float_type, x, dr.select(has_before, index, 1) - 1)
    after = dr.gather(float_type, x, index + dr.select(has_after, 1, 0))
    before = dr.select(has_before, before, x if first is None else first)
    return before, dr.select(has_after, after, x if last is None else last)
