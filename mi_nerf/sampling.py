"""Where a ray is sampled: its interval inside the box, strata, and where weights are large.

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


# ---- Hierarchical sampling (NeRF Sec. 5.2) -----------------------------------

# Added to every weight before they are normalised, as in the code of the paper: bins that
# the coarse network sees as empty stay reachable, and weights that are all 0 mean "anywhere".
PADDING = 1e-5

_BELOW_ONE = 1 - 2.0**-24


def inverse_transform(
    t_near: Any, t_far: Any, weights: Any, bins: int, samples: int, jitter: Any = None
) -> Any:
    """Samples distributed as piecewise-constant weights over equal bins of every ray.

    Inverts the cumulative distribution c of the normalised weights at one point u of each
    of ``samples`` equal strata of [0, 1): in the bin k with c_k ≤ u < c_{k+1}, linearly.
    Both ends are exact, and the results ascend.

    Args:
        t_near, t_far: bounds of R rays.
        weights: R·S values ≥ 0, ray-major.
        bins: S.
        samples: F, of each ray.
        jitter: R·F numbers in [0, 1), the place of each u within its stratum; R numbers to
            shift all of a ray alike; ``None`` for the middle.

    Returns:
        R·F parameters between the bounds.
    """
    float_type = type(weights)
    uint = dr.uint32_array_t(float_type)
    total = dr.block_sum(weights + PADDING, bins)
    bin_ray = dr.arange(uint, len(weights)) // bins
    share = (weights + PADDING) / dr.gather(float_type, total, bin_ray)
    start = dr.block_prefix_sum(share, bins, exclusive=True)
    dr.eval(share, start)

    u, _ = stratified(dr.zeros(float_type, len(total)), float_type(1), samples, jitter)
    u = dr.fmin(u, _BELOW_ONE)
    ray = dr.arange(uint, len(u)) // samples
    first = ray * bins
    k = count_below(start, u, first, bins, strict=False) - 1  # start is 0 in the first bin
    inside = (u - dr.gather(float_type, start, first + k)) / dr.gather(float_type, share, first + k)
    place = (float_type(k) + dr.clip(inside, 0, 1)) * (1 / bins)
    near, far = dr.gather(float_type, t_near, ray), dr.gather(float_type, t_far, ray)
    return dr.clip(dr.fma(place, far - near, near), near, far)


def merge_sorted(a: Any, b: Any, count_a: int, count_b: int) -> Any:
    """Merges two ascending rows of every ray into one ascending row of A + B values.

    Args:
        a, b: R·A and R·B values, ray-major, ascending within each ray.
        count_a, count_b: A and B.
    """
    float_type = type(a)
    uint = dr.uint32_array_t(float_type)
    count = count_a + count_b
    merged = dr.zeros(float_type, len(a) + len(b))
    # Equal values: those of a go first, so that every place is taken once.
    for own, other, own_count, other_count, strict in (
        (a, b, count_a, count_b, True),
        (b, a, count_b, count_a, False),
    ):
        index = dr.arange(uint, len(own))
        ray = index // own_count
        rank = count_below(other, own, ray * other_count, other_count, strict)
        dr.scatter(merged, own, ray * count + (index - ray * own_count) + rank)
    dr.eval(merged)
    return merged


def count_below(row: Any, value: Any, first: Any, count: int, strict: bool) -> Any:
    """How many of ``row[first … first + count]`` lie below (or at) ``value``."""
    float_type = type(row)

    def below(i: Any) -> Any:
        entry = dr.gather(float_type, row, first + dr.fmin(i, count - 1))
        return entry < value if strict else entry <= value

    return dr.binary_search(0, count, below)


def stratum_edges(t_near: Any, t_far: Any, samples: int) -> Any:
    """The ends of equal strata: R·(S + 1) ascending parameters, of S strata a ray."""
    float_type = type(t_near)
    uint = dr.uint32_array_t(float_type)
    index = dr.arange(uint, len(t_near) * (samples + 1))
    ray = index // (samples + 1)
    near, far = dr.gather(float_type, t_near, ray), dr.gather(float_type, t_far, ray)
    share = float_type(index - ray * (samples + 1)) * (1 / samples)
    return dr.select(share < 1, dr.fmin(dr.fma(share, far - near, near), far), far)


def cell_edges(t: Any, t_near: Any, t_far: Any, samples: int) -> Any:
    """The ends of what belongs to each sample, see :func:`cell_widths`.

    Args:
        t: R·S ascending parameters.
        t_near, t_far: bounds of R rays.
        samples: S.

    Returns:
        R·(S + 1) ascending parameters, from ``t_near`` to ``t_far``.
    """
    float_type = type(t)
    uint = dr.uint32_array_t(float_type)
    index = dr.arange(uint, len(t_near) * (samples + 1))
    ray = index // (samples + 1)
    within = index - ray * (samples + 1)
    after = ray * samples + dr.fmin(within, samples - 1)
    before = ray * samples + dr.fmax(within, 1) - 1
    middle = 0.5 * (dr.gather(float_type, t, before) + dr.gather(float_type, t, after))
    near, far = dr.gather(float_type, t_near, ray), dr.gather(float_type, t_far, ray)
    return dr.select(within == 0, near, dr.select(within == samples, far, middle))


def cell_widths(t: Any, t_near: Any, t_far: Any, samples: int) -> Any:
    """The part of each ray that belongs to each sample: up to halfway to its neighbours.

    Args:
        t: R·S ascending parameters.
        t_near, t_far: bounds of R rays.
        samples: S.

    Returns:
        R·S widths ≥ 0 that sum to ``t_far − t_near``.
    """
    below, above = half_widths(t, t_near, t_far, samples)
    return below + above


def half_widths(t: Any, t_near: Any, t_far: Any, samples: int) -> tuple[Any, Any]:
    """The parts of a sample's cell before and behind the sample; see :func:`cell_widths`."""
    float_type = type(t)
    index = dr.arange(dr.uint32_array_t(float_type), len(t))
    ray = index // samples
    within = index - ray * samples
    before, after = neighbours(t, samples)
    to_near = t - dr.gather(float_type, t_near, ray)
    to_far = dr.gather(float_type, t_far, ray) - t
    below = dr.select(within > 0, 0.5 * (t - before), to_near)
    return below, dr.select(within < samples - 1, 0.5 * (after - t), to_far)


def neighbours(x: Any, samples: int, *, first: Any = None, last: Any = None) -> tuple[Any, Any]:
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
