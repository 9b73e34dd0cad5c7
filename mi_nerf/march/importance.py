"""Samples where weights are large: the inverse transform (NeRF, Sec. 5.2)."""

from __future__ import annotations

from typing import Any

import drjit as dr

from ..base.arrays import Floats, Indices
from .strata import stratified

# Added to every weight before they are normalised, as in the code of the paper: bins that
# the coarse network sees as empty stay reachable, and weights that are all 0 mean "anywhere".
PADDING = 1e-5

_BELOW_ONE = 1 - 2.0**-24


def inverse_transform(
    t_near: Floats, t_far: Floats, weights: Floats, bins: int, samples: int, jitter: Floats = None
) -> Floats:
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


def merge_sorted(a: Floats, b: Floats, count_a: int, count_b: int) -> Floats:
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


def count_below(row: Indices, value: Floats, first: Indices, count: int, strict: bool) -> Indices:
    """How many of ``row[first … first + count]`` lie below (or at) ``value``."""
    float_type = type(row)

    def below(i: Any) -> Indices:
        entry = dr.gather(float_type, row, first + dr.fmin(i, count - 1))
        return entry < value if strict else entry <= value

    return dr.binary_search(0, count, below)
