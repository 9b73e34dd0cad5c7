"""Samples along rays, and which of them a field has to be asked about."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import drjit as dr

from ..base.arrays import Floats, Indices, Vectors, gather_vector3, taken
from ..cameras.ndc import NdcRays
from .rules import RULES, CellRule


@dataclass
class Samples:
    """R·S samples of R rays, and which of them the field has to be asked about.

    ``delta`` is kept besides :meth:`edges`, whose differences it equals but for rounding: far
    from a ray's origin, ends in single precision agree in most of their digits, and little
    of a short interval's length would survive their subtraction.
    """

    o: Vectors  # R origins, in the space where the field lives
    d: Vectors  # R unit directions in that space
    view: Vectors  # R unit directions in scene space, along which the field emits
    t: Floats  # R·S sample parameters
    delta: Floats  # R·S interval lengths
    count: int  # S
    near: Floats  # R bounds of t
    far: Floats
    index: Indices = None  # the M samples to evaluate, ascending
    coarse_queries: int = 0  # of the coarse network, by which the samples were placed
    ndc: NdcRays | None = None  # how o, d and t came about, where that is not scene space
    rule: CellRule = RULES["constant"]  # of quadrature

    @property
    def rays(self) -> int:
        """R."""
        return len(self.t) // self.count

    @property
    def queries(self) -> int:
        """M."""
        return len(self.index)

    def edges(self) -> Floats:
        """R·(S + 1) ascending ends of the intervals: sample s lies between s and s + 1."""
        return self.rule.edges(self.t, self.near, self.far, self.count)

    def truncate(self, budget: int) -> Any:
        """Keeps the first ``budget`` queries; returns how many rays keep all of theirs.

        Rays from that number on are incomplete and must be left out of a loss. The number
        is an array of one element, which the host need not wait for.
        """
        uint, queries = type(self.index), self.queries
        if not queries:
            return dr.opaque(uint, self.rays)
        after = dr.opaque(uint, budget)
        lost = after < dr.opaque(uint, queries)  # the same kernels, whether or not there are any
        first_lost = dr.gather(uint, self.index, after, lost)
        kept = dr.arange(uint, min(queries, budget)) + dr.opaque(uint, 0)
        self.index = dr.gather(uint, self.index, kept)
        return dr.select(lost, first_lost // self.count, dr.opaque(uint, self.rays))


def rays_with_samples(samples: Samples) -> tuple[Samples, Indices]:
    """The samples of the rays that have any to ask for, and the ascending numbers of these rays.

    Others see nothing, whatever the field is: most of those that pass an object by.
    """
    uint = type(samples.index)
    asks = dr.zeros(uint, samples.rays)
    dr.make_opaque(asks)
    ray = samples.index // samples.count
    dr.scatter(asks, uint(1), ray)
    place = dr.cumsum(asks) - asks
    numbers = uint(dr.compress(asks > 0))
    index = samples.index - (ray - dr.gather(uint, place, ray)) * samples.count
    lane = dr.arange(uint, len(numbers) * samples.count)
    own = lane // samples.count
    source = dr.gather(uint, numbers, own) * samples.count + (lane - own * samples.count)
    kept = replace(
        samples,
        o=gather_vector3(samples.o, numbers),
        d=gather_vector3(samples.d, numbers),
        view=gather_vector3(samples.view, numbers),
        t=dr.gather(type(samples.t), samples.t, source),
        delta=dr.gather(type(samples.delta), samples.delta, source),
        near=taken(samples.near, numbers),
        far=taken(samples.far, numbers),
        index=index,
        ndc=None if samples.ndc is None else _ndc_rays(samples.ndc, numbers),
    )
    dr.eval(kept.o, kept.d, kept.view, kept.t, kept.delta, kept.near, kept.far, kept.index)
    return kept, numbers


def _ndc_rays(rays: NdcRays, numbers: Indices) -> NdcRays:
    """Some of the rays in normalised device coordinates."""
    vectors = ("o", "d")
    values = {
        f.name: (gather_vector3 if f.name in vectors else taken)(getattr(rays, f.name), numbers)
        for f in fields(rays)
    }
    return NdcRays(**values)
