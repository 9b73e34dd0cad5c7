"""Which of several points of light sources a path is connected to.

The mean of what M points x_j bring, f_j / p_j each, is estimated by one of them: taken with
the probability q_j, it counts as f_j / (M p_j q_j). What costs is to find out what is between,
fields above all; what a point brings if nothing is, costs next to nothing. So q_j follows that,

    q_j = (1 − ε) w_j / Σ w + ε / M,    w_j = max_c f_j,c / p_j,

as in resampled importance sampling (Talbot et al. 2005), found in one go over the points (Chao
1982). The points are a lattice that is shifted at random (Cranley and Patterson 1976): each of
them is spread evenly, and together they are on different lights and different parts of these.
The ε lets what brings nothing be chosen, too: a lamp without power has a derivative. It changes
little else, as f_j / q_j never exceeds Σ w / (1 − ε).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

_EVENLY = 0.05  # ε
_GOLDEN = 0.6180339887498949  # by which a lattice moves on in its second coordinate


@dataclass
class Chosen:
    """Points of light sources, one for each of N paths."""

    number: Any  # N pairs of numbers in [0, 1) from which Mitsuba finds the point
    weight: Any  # N: by which what comes from there counts, 1 / (M q)


def choose(
    brings: Callable[[Any], Any], number: Any, choice: Any, count: int, active: Any
) -> Chosen:
    """One of ``count`` points for each of N paths.

    Args:
        brings: what the points that N pairs of numbers lead to bring, N numbers w ≥ 0.
        number: N pairs of numbers in [0, 1): the first point of the lattice.
        choice: N numbers in [0, 1).
        active: for which paths it matters.
    """
    if count == 1:
        return Chosen(number, dr.full(mi.Float, 1, dr.width(number)))
    evenly = choice < _EVENLY
    u = dr.select(evenly, choice / _EVENLY, (choice - _EVENLY) / (1 - _EVENLY))
    u = dr.clip(u, 0, dr.one_minus_epsilon(mi.Float))
    any_one = dr.fmin(mi.UInt32(u * count), count - 1)

    def going(j: Any, *_: Any) -> Any:
        return j < count

    def step(j: Any, u: Any, total: Any, best: Any, most: Any, own: Any) -> tuple[Any, ...]:
        w = dr.fmax(brings(lattice_point(number, j, count)), 0)
        total += w
        share = w / dr.select(total > 0, total, 1)
        taken = u < share
        rest = (u - share) / dr.select(share < 1, 1 - share, 1)
        u = dr.clip(dr.select(taken, u / share, rest), 0, dr.one_minus_epsilon(mi.Float))
        best, most = dr.select(taken, j, best), dr.select(taken, w, most)
        return j + 1, u, total, best, most, dr.select(j == any_one, w, own)

    zero = dr.zeros(mi.Float, dr.width(number))
    first = dr.select(active, mi.UInt32(0), count)
    state = (first, u, zero, mi.UInt32(first), mi.Float(zero), mi.Float(zero))
    names = ("j", "u", "total", "best", "most", "own")
    _, _, total, best, most, own = dr.while_loop(state, going, step, labels=names)
    evenly |= total == 0  # nothing brings any light
    best, w = dr.select(evenly, any_one, best), dr.select(evenly, own, most)
    known = total > 0
    share = (1 - _EVENLY) * w / dr.select(known, total, 1) + _EVENLY / count
    share = dr.select(known, share, 1 / count)
    return Chosen(lattice_point(number, best, count), 1 / (count * share))


def lattice_point(number: Any, j: Any, count: int) -> Any:
    """The j-th of ``count`` points, the first of which is ``number``."""
    shift = mi.Float(j)
    x, y = number.x + shift * (1 / count), number.y + shift * _GOLDEN
    most = dr.one_minus_epsilon(mi.Float)
    return mi.Point2f(dr.fmin(x - dr.floor(x), most), dr.fmin(y - dr.floor(y), most))
