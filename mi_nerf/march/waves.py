"""Marches rays through a field in waves: the next few samples of many rays at a time.

Where matrix products of the host are the least that a network costs, it has to be asked about
many points at once, and about as few as possible. A wave takes the next samples of the rays that
go on, those that :mod:`mi_nerf.march.placing` keeps and no others, asks the field about all of
them, and adds up what they show; new rays take the places of those that have ended. A ray ends
at the very sample behind which less than ``stop`` passes. There are no derivatives.

Kernels depend neither on the number of rays nor on that of samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr

from ..base.arrays import Floats, Indices, Mask, Vectors, taken, vector3_type
from .intervals import RaySegments
from .occupancy import OccupancyGrid
from .path import Path
from .rules import one_minus_exp, opaque_at_most

_RAYS = 1 << 16  # of a wave: its queries, two a ray, take some tens of megabytes
_LEAST_SAMPLES = 2  # of each ray; half a sample behind the ray's end is asked for in vain
_MOST_SAMPLES = 32
_LEAST_QUERIES = 1 << 12  # of a wave; fewer would take no less time, so rays look farther ahead
_NONE = 0xFFFFFFFF  # no sample


class Waves:
    """What R rays have seen so far, and how far they are."""

    def __init__(
        self,
        within: RaySegments,
        samples: int,
        jitter: Floats,
        grid: OccupancyGrid | None,
        stop: float,
        emission: bool,
    ) -> None:
        """Arguments as for :class:`mi_nerf.march.path.Path`, besides:

        Args:
            stop, emission: as for :func:`mi_nerf.march.walk.walk_rays`.
        """
        self._within, self._samples, self._jitter, self._grid = within, samples, jitter, grid
        self._float, rays = type(within.near), len(within.hit)
        self._uint = uint = dr.uint32_array_t(self._float)
        self._last = dr.opaque(uint, samples)
        self._limit = dr.opaque(self._float, -math.log(stop) if stop > 0 else dr.inf)
        # Optical depth, and with ``emission`` the sums of colour and t under the weights.
        self.seen = [dr.zeros(self._float, rays) for _ in range(5 if emission else 1)]
        self.queries = dr.zeros(uint, rays)
        self._next = self._path(None).next(dr.select(within.hit, uint(0), self._last))
        dr.make_opaque(self.seen, self.queries, self._next)

    def run(self, ask: Callable[[Vectors, Vectors], list[Floats]]) -> None:
        """Marches all rays to their ends.

        Args:
            ask: density, and with ``emission`` the channels of colour, of N points that are
                looked at along N directions, evaluated.
        """
        uint = self._uint
        waiting, begun = uint(dr.compress(self._next < self._last)), 0
        alive = dr.zeros(uint, 0)
        while len(alive) or begun < len(waiting):
            fresh = min(_RAYS - len(alive), len(waiting) - begun)
            ray = self._joined(alive, waiting, begun, fresh)
            begun += fresh
            alive = dr.gather(uint, ray, self._wave(ray, ask))

    def _joined(self, alive: Indices, waiting: Indices, begun: int, fresh: int) -> Indices:
        """Rays that go on, and behind them so many of those that wait: they ascend."""
        uint = self._uint
        lane, old = dr.arange(uint, len(alive) + fresh), dr.opaque(uint, len(alive))
        first = lane < old
        ray = dr.gather(uint, waiting, lane - old + dr.opaque(uint, begun), ~first)
        if len(alive):
            ray = dr.select(first, dr.gather(uint, alive, lane, first), ray)
        dr.eval(ray)
        return ray

    def _wave(self, ray: Indices, ask: Callable[..., list[Floats]]) -> Indices:
        """Goes on with these rays; which of them have not ended then, as places among them."""
        uint, ahead = self._uint, _binary_logarithm(len(ray))
        shift = dr.opaque(uint, ahead)
        stratum, number, beyond = self._find(ray, len(ray) << ahead, shift)
        slot = uint(dr.compress(stratum != _NONE))
        own = dr.gather(uint, ray, slot >> shift)
        _, p = self._path(own).at(dr.gather(uint, stratum, slot))
        answers = ask(p, _vectors_of(self._within.view, own))
        return self._add(ray, shift, stratum, number, beyond, answers)

    def _find(self, ray: Indices, size: int, shift: Indices) -> tuple[Indices, Indices, Indices]:
        """The next samples of each ray, in rows, their number, and the one that follows them."""
        uint, path = self._uint, self._path(ray)
        stratum, most = dr.full(uint, _NONE, size), uint(1) << shift
        dr.make_opaque(stratum)
        row = dr.arange(uint, len(ray)) << shift

        def going(found: Indices, at: Indices) -> Mask:
            return (found < most) & (at < self._last)

        def step(found: Indices, at: Indices) -> tuple[Indices, Indices]:
            dr.scatter(stratum, at, row + found)
            return found + 1, path.next(at + 1)

        start = (dr.zeros(uint, len(ray)), dr.gather(uint, self._next, ray))
        number, beyond = dr.while_loop(start, going, step, labels=("found", "at"))
        dr.eval(stratum, number, beyond)
        return stratum, number, beyond

    def _add(
        self,
        ray: Indices,
        shift: Indices,
        stratum: Indices,
        number: Indices,
        beyond: Indices,
        answers: list[Floats],
    ) -> Indices:
        """Quadrature of the samples that were asked for, up to the end of each ray."""
        uint, path = self._uint, self._path(ray)
        row = dr.arange(uint, len(ray)) << shift
        first = dr.cumsum(number) - number

        def going(k: Indices, tau: Floats, *_: Floats) -> Mask:
            return (k < number) & (tau < self._limit)

        def step(k: Indices, tau: Floats, *seen: Floats) -> tuple[Any, ...]:
            t, _ = path.at(dr.gather(uint, stratum, row + k))
            density, *values = (dr.gather(self._float, a, first + k) for a in answers)
            own = opaque_at_most(density * path.width)
            weight = dr.exp(-tau) * one_minus_exp(own)
            values = [*values, t] if seen else []
            seen = tuple(dr.fma(weight, v, s) for v, s in zip(values, seen, strict=True))
            return (k + 1, tau + own, *seen)

        start = [dr.gather(self._float, values, ray) for values in self.seen]
        labels = ("k", "tau", "red", "green", "blue", "depth")[: len(start) + 1]
        _, *seen = dr.while_loop((dr.zeros(uint, len(ray)), *start), going, step, labels=labels)
        asked = dr.gather(uint, self.queries, ray) + number
        alive = (seen[0] < self._limit) & (beyond < self._last)
        dr.eval(seen, asked, alive)
        for target, value in zip(self.seen, seen, strict=True):
            dr.scatter(target, value, ray)
        dr.scatter(self.queries, asked, ray)
        dr.scatter(self._next, beyond, ray)
        return uint(dr.compress(alive))

    def _path(self, ray: Indices | None) -> Path:
        """The strata of some rays, or of all."""
        within, jitter = self._within, self._jitter
        if ray is not None:
            near, far = (taken(v, ray) for v in (within.near, within.far))
            o, d = _vectors_of(within.o, ray), _vectors_of(within.d, ray)
            within = replace(within, o=o, d=d, near=near, far=far)
            jitter = None if jitter is None else taken(jitter, ray)
        return Path(within, self._samples, jitter, self._grid)


def _binary_logarithm(rays: int) -> int:
    """Of the number of samples that a wave takes of each of so many rays."""
    size = _LEAST_SAMPLES
    while size * rays < _LEAST_QUERIES and size < _MOST_SAMPLES:
        size *= 2
    return size.bit_length() - 1


def _vectors_of(vectors: Vectors, ray: Indices) -> Vectors:
    """Of each of some rays."""
    values = [taken(vectors[i], ray) for i in range(3)]
    return vector3_type(type(values[0]))(*values)
