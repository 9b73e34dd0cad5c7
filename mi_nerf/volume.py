"""Renders rays through a field: the one path that training, evaluation and plugins share.

    rays → (normalised device coordinates) → interval in the box → strata
         → (cells that may hold something) → (where the coarse network sees something)
         → field, in blocks of constant size, front to back → quadrature

The field sees its queries in blocks of a constant number of columns, so tensor-mode
kernels are compiled once whatever the number of samples a ray batch needs. The
quadrature works on all samples at once. Its adjoint reaches the field block by
block, which is what bounds the memory of a gradient.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, get_args

import drjit as dr

from .arrays import gather_vector3
from .field import Field
from .ndc import NdcRays
from .occupancy import OccupancyGrid
from .quadrature import Composite, Rule, composite, sample_weights
from .sampling import (
    box_interval,
    cell_edges,
    cell_widths,
    clip_interval,
    inverse_transform,
    merge_sorted,
    points_along,
    stratified,
    stratum_edges,
)
from .stages import stage

# Before it is asked which rays go on, so many samples of each are evaluated, or more where
# that makes less than so many queries.
_LEAST_OF_RAY = 4
_LEAST_QUERIES = 1 << 14

# Numbers in the copies of a gradient that threads may have for themselves, together.
_PRIVATE_NUMBERS = 1 << 26


@dataclass(frozen=True)
class MarchSettings:
    """How rays are sampled."""

    samples: int = 128  # strata a ray
    fine: int = 0  # samples more, placed by the field's coarse network, if it has one
    near: float | None = None  # lower bound of t, in scene units; None: the box alone
    far: float | None = None  # upper bound of t
    rule: Rule = "constant"  # of quadrature
    stop: float = 0.0  # a ray ends where less than this share of light passes; 0: never
    hidden: float = 0.0  # optical depth by the occupancy's floor that hides a sample; 0: none
    block: int = 16384  # queries a network evaluation
    chunk: int = 1 << 21  # samples placed at a time in primal rendering

    def __post_init__(self) -> None:
        for name in ("samples", "block", "chunk"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}, expected at least 1")
        for name in ("fine", "hidden"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name}={getattr(self, name)}, expected 0 or more")
        if self.rule not in get_args(Rule):
            raise ValueError(f"rule='{self.rule}', expected {' or '.join(get_args(Rule))}")
        if not 0 <= self.stop < 1:
            raise ValueError(f"stop={self.stop}, expected 0 to less than 1")
        if self.near is not None and self.far is not None and not self.near < self.far:
            raise ValueError(f"near={self.near} must be smaller than far={self.far}")


@dataclass
class RaySegments:
    """The parts of R rays o + t·d in which a field lies: near ≤ t ≤ far."""

    o: Any  # R origins, in the space where the field lives
    d: Any  # R unit directions in that space
    view: Any  # R unit directions in scene space, along which the field emits
    near: Any  # R bounds of t; both 0 where the field is missed
    far: Any
    hit: Any  # whether there is anything between them
    ndc: NdcRays | None  # how o, d and t came about, where that is not scene space


def ray_segments(field: Field, o: Any, d: Any, *limits: tuple[Any, Any]) -> RaySegments:
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


@dataclass
class Samples:
    """R·S samples of R rays, and which of them the field has to be asked about."""

    o: Any  # R origins, in the space where the field lives
    d: Any  # R unit directions in that space
    view: Any  # R unit directions in scene space, along which the field emits
    t: Any  # R·S sample parameters
    delta: Any  # R·S interval lengths
    count: int  # S
    near: Any  # R bounds of t
    far: Any
    index: Any = None  # the M samples to evaluate, ascending
    coarse_queries: int = 0  # of the coarse network, by which the samples were placed
    ndc: NdcRays | None = None  # how o, d and t came about, where that is not scene space
    rule: Rule = "constant"
    even: bool = True  # whether the intervals are equal strata of the ray

    @property
    def rays(self) -> int:
        """R."""
        return len(self.t) // self.count

    @property
    def queries(self) -> int:
        """M."""
        return len(self.index)

    def edges(self) -> Any:
        """R·(S + 1) ascending ends of the intervals: sample s lies between s and s + 1."""
        if self.even:
            return stratum_edges(self.near, self.far, self.count)
        return cell_edges(self.t, self.near, self.far, self.count)

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


def place_samples(
    field: Field,
    o: Any,
    d: Any,
    settings: MarchSettings,
    *,
    occupancy: OccupancyGrid | None = None,
    jitter: Any = None,
    bounds: tuple[Any, Any] | None = None,
) -> Samples:
    """Stratified samples of the rays ``o + t·d`` (unit ``d``) inside the field's box.

    ``jitter`` is passed on to :func:`mi_nerf.sampling.stratified`; ``bounds`` limits t
    ray by ray, besides what ``settings`` say. Sample positions carry no gradient. In
    normalised device coordinates samples are evenly spread in t' (NeRF, appendix C).
    """
    with dr.suspend_grad():
        within = ray_segments(field, o, d, (settings.near, settings.far), bounds or (None, None))
        o, d, near, far = within.o, within.d, within.near, within.far
        t, delta = stratified(near, far, settings.samples, jitter)
        even = settings.rule == "constant"
        if not even:
            delta = cell_widths(t, near, far, settings.samples)
        count, rule, ndc = settings.samples, settings.rule, within.ndc
        samples = Samples(
            o, d, within.view, t, delta, count, near, far, ndc=ndc, rule=rule, even=even
        )
        samples = _select(samples, within.hit, occupancy, settings.hidden)
        coarse = getattr(field, "coarse", None)
        if coarse is None or not settings.fine:
            return samples
        evaluation = Evaluation(coarse, samples, settings.block, stop=settings.stop)
        weights, _ = sample_weights(evaluation.density, delta, settings.samples)
        shift = jitter if jitter is not None and len(jitter) == samples.rays else None
        samples.index = evaluation.asked
        return refine(samples, weights, settings.fine, occupancy, shift)


def refine(
    samples: Samples,
    weights: Any,
    fine: int,
    occupancy: OccupancyGrid | None = None,
    jitter: Any = None,
    hidden: float = 0.0,
) -> Samples:
    """Adds ``fine`` samples a ray where ``weights`` are large (NeRF Sec. 5.2).

    Args:
        samples: the coarse samples, one in each of equal strata.
        weights: theirs; without gradient.
        jitter: R·F numbers in [0, 1), or R to shift all of a ray alike; ``None`` for the
            middle of the strata of the cumulative distribution.
        hidden: as in :class:`MarchSettings`.
    """
    with dr.suspend_grad():
        near, far, count = samples.near, samples.far, samples.count
        more = inverse_transform(near, far, dr.detach(weights), count, fine, jitter)
        t = merge_sorted(samples.t, more, count, fine)
        delta = cell_widths(t, near, far, count + fine)
        merged = replace(
            samples,
            t=t,
            delta=delta,
            count=count + fine,
            coarse_queries=samples.queries,
            even=False,
        )
        return _select(merged, far > near, occupancy, hidden)


def _select(samples: Samples, hit: Any, occupancy: OccupancyGrid | None, hidden: float) -> Samples:
    """Keeps for evaluation the samples that may lie in something, and may be seen."""
    dr.eval(samples.t, samples.delta, samples.near, samples.far)
    t = samples.t
    uint = dr.uint32_array_t(type(t))
    ray = dr.arange(uint, len(t)) // samples.count
    wanted = dr.gather(dr.mask_t(type(t)), hit, ray)
    if occupancy is not None:
        cell = occupancy.cell(points_along(samples.o, samples.d, t, ray))
        wanted &= occupancy.occupied(cell)
        if hidden > 0:
            tau = dr.select(wanted, occupancy.least_density(cell) * samples.delta, 0)
            before = dr.block_prefix_sum(tau, samples.count, exclusive=True)
            wanted &= before < dr.opaque(type(t), hidden)
    samples.index = uint(dr.compress(wanted))
    return samples


class Evaluation:
    """A field's answers at all samples, zero where it was not asked.

    ``density`` and ``emission`` are R·S arrays without history. To differentiate,
    enable their gradients, differentiate what was made of them, then call
    :meth:`backward`: it carries their gradients into the field's parameters.

    With ``stop``, the samples of a ray are evaluated front to back in rounds, and those
    behind a transmittance below ``stop`` not at all. They would have added less than
    ``stop`` to the opacity, and less than ``stop`` times the largest emission behind them
    to a colour.
    """

    def __init__(
        self,
        field: Field,
        samples: Samples,
        block: int,
        *,
        keep: bool = False,
        stop: float = 0.0,
        tail: int | None = None,
        emission: bool = True,
    ) -> None:
        """Evaluates the field; with ``keep``, activations stay for :meth:`backward`.

        Args:
            block: queries the network evaluates at a time.
            emission: whether it is wanted; a network is asked for its density alone else.
            tail: of the last blocks, to waste less on filling them up. Default: a quarter
                of large blocks in rounds, else the same.
        """
        self._field, self._samples, self._block = field, samples, block
        self._graph: list[tuple[Any, Any, list[Any]]] = []
        self._tail = tail or (block // 4 if stop > 0 and block >= 4096 else block)
        fused = getattr(field, "fused", None)
        self._fused = fused(emission) if fused is not None and not keep else None
        self._emits = emission
        float_type = type(samples.t)
        self._channels = [dr.zeros(float_type, len(samples.t)) for _ in range(4 if emission else 1)]
        dr.make_opaque(self._channels)  # without queries they would stay constants
        if stop <= 0:
            self.asked = samples.index
            self._evaluate(samples.index, keep)
            return
        rounds = [self._evaluate(index, keep) for index in self._front_to_back(stop)]
        self.asked = _joined(rounds, type(samples.index))

    def _evaluate(self, index: Any, keep: bool) -> Any:
        """Fills in the samples ``index``, and returns it."""
        size = max(len(index), 1) if self._fused else self._block  # only tensors have shapes
        for where, valid in self._blocks(index, size):
            if keep:
                outputs = self._query(where)
                self._graph.append((where, valid, outputs))
            else:
                with dr.suspend_grad():
                    outputs = self._query(where, self._fused)
            for channel, value in zip(self._channels, outputs, strict=True):
                dr.scatter(channel, dr.detach(value), where, valid)
            with stage("scatter"):
                dr.eval(self._channels, outputs)
        return index

    def _front_to_back(self, stop: float) -> Iterator[Any]:
        """Indices of the samples to ask for next, as long as any ray goes on.

        Each round looks at a few more samples of every ray that goes on, and at more of them
        when few rays are left.
        """
        samples, index = self._samples, self._samples.index
        float_type, uint = type(samples.t), type(index)
        if not len(index):
            return
        limit, delta = dr.opaque(float_type, -math.log(stop)), dr.detach(samples.delta)
        first, number = _spans(index // samples.count, samples.rays)
        ray = uint(dr.compress(number > 0))
        depth, seen = dr.zeros(float_type, len(ray)), 0
        dr.make_opaque(depth)
        while len(ray):
            size = self._round_size(len(ray))
            lane = dr.arange(uint, len(ray) * size)
            place = lane % size + dr.opaque(uint, seen)
            own = dr.gather(uint, ray, lane // size)
            there = place < dr.gather(uint, number, own)
            sample = dr.gather(uint, index, dr.gather(uint, first, own) + place, there)
            dr.eval(sample, there)
            yield dr.gather(uint, sample, dr.compress(there))
            width = dr.gather(float_type, delta, sample, there)
            tau = dr.gather(float_type, self.density, sample, there) * width
            depth, seen = depth + dr.block_sum(tau, size), seen + size
            more = dr.gather(uint, number, ray) > dr.opaque(uint, seen)
            alive = dr.compress((depth < limit) & more)
            ray, depth = dr.gather(uint, ray, alive), dr.gather(float_type, depth, alive)
            dr.eval(ray, depth)

    def _round_size(self, rays: int) -> int:
        """Samples of each of so many rays to ask for at once: a power of two."""
        size = _LEAST_OF_RAY
        while size * rays < _LEAST_QUERIES and size < self._samples.count:
            size *= 2
        return size

    @property
    def density(self) -> Any:
        """R·S densities, 1/scene unit."""
        return self._channels[0]

    @property
    def emission(self) -> list[Any]:
        """Three arrays of R·S colours, or none if not wanted."""
        return self._channels[1:]

    def enable_grad(self) -> None:
        """Makes density and emission the leaves of what is computed next."""
        for channel in self._channels:
            dr.enable_grad(channel)

    def backward(self) -> None:
        """Propagates the gradients of density and emission to the parameters.

        And to o, d, t and view of the samples, as far as gradients of these are enabled.
        """
        gradients = [dr.grad(channel) for channel in self._channels]
        with stage("compositing"):  # its adjoint
            dr.eval(gradients)
        kept = self._graph or ((w, v, None) for w, v in self._blocks(self.asked, self._block))
        with _private_sums():
            for where, valid, outputs in kept:
                outputs = outputs or self._query(where)
                for value, gradient in zip(outputs, gradients, strict=True):
                    if dr.grad_enabled(value):
                        # Added up: a grey field may return one array for all channels.
                        dr.accum_grad(value, dr.gather(type(value), gradient, where, valid))
                        dr.enqueue(dr.ADMode.Backward, value)
                dr.traverse(dr.ADMode.Backward)
                with stage("encoding_adjoint"):
                    dr.eval([dr.grad(leaf) for leaf in self._leaves()])
        self._graph = []

    def _leaves(self) -> list[Any]:
        """All that gradients are added up for."""
        samples = self._samples
        moving = [v for v in (samples.o, samples.d, samples.view, samples.t) if dr.grad_enabled(v)]
        return [*self._field.parameters().values(), *moving]

    def forward(self) -> None:
        """Fills the gradients of density and emission from those that :meth:`backward` adds to."""
        tangents = [dr.zeros(type(c), len(c)) for c in self._channels]
        for where, valid in self._blocks(self.asked, self._block):
            outputs = self._query(where)
            # One output may be computed from another: keep the tangents of all.
            dr.forward_to(outputs, flags=dr.ADFlag.ClearNone | dr.ADFlag.AllowNoGrad)
            for tangent, value in zip(tangents, outputs, strict=True):
                dr.scatter(tangent, dr.grad(value), where, valid)
            dr.eval(tangents)
        for channel, tangent in zip(self._channels, tangents, strict=True):
            dr.set_grad(channel, tangent)

    def _blocks(self, index: Any, block: int) -> Iterator[tuple[Any, Any]]:
        """Sample numbers and validity of each block; the last one is padded."""
        uint = type(index)
        for start, size in self._ranges(len(index), block):
            slot = dr.arange(uint, size) + dr.opaque(uint, start)
            valid = slot < dr.opaque(uint, len(index))
            where = dr.gather(uint, index, slot, valid)
            with stage("samples"):
                dr.eval(where, valid)
            yield where, valid

    def _ranges(self, queries: int, block: int) -> Iterator[tuple[int, int]]:
        """Starts and sizes of blocks."""
        small = min(self._tail, block) if block == self._block else block
        start = 0
        while start < queries:
            size = block if queries - start > block - small else small
            yield start, size
            start += size

    def _query(self, where: Any, fused: Any = None) -> list[Any]:
        samples = self._samples
        ray = where // samples.count
        t = dr.gather(type(samples.t), samples.t, where)
        p = points_along(samples.o, samples.d, t, ray)
        if not self._emits:
            return [(fused or self._field.density)(p)]
        ask = fused or self._field.density_emission
        density, emission = ask(p, gather_vector3(samples.view, ray))
        return [density, *emission]


@contextmanager
def _private_sums() -> Iterator[None]:
    """Lets every thread add up the gradient of a table on its own, unless that is too large.

    On the CPU, adding to the entries of a hash grid atomically takes several times longer.
    """
    before = dr.expand_threshold()
    dr.set_expand_threshold(_PRIVATE_NUMBERS // max(1, dr.thread_count()))
    try:
        yield
    finally:
        dr.set_expand_threshold(before)


def _joined(parts: list[Any], uint: Any) -> Any:
    """One array after the other; ``dr.concat`` would compile kernels for their lengths."""
    total = dr.zeros(uint, sum(len(part) for part in parts))
    dr.make_opaque(total)
    start = 0
    for part in parts:
        dr.scatter(total, part, dr.arange(uint, len(part)) + dr.opaque(uint, start))
        start += len(part)
    dr.eval(total)
    return total


def _spans(ray: Any, rays: int) -> tuple[Any, Any]:
    """Where the entries of each of the rays begin among ascending ray numbers, and how many."""
    uint, last = type(ray), dr.opaque(type(ray), len(ray) - 1)
    place = dr.arange(uint, len(ray))
    before = dr.gather(uint, ray, place - 1, place > 0)
    after = dr.gather(uint, ray, place + 1, place < last)
    first, end = dr.zeros(uint, rays), dr.zeros(uint, rays)
    dr.make_opaque(first, end)
    dr.scatter(first, place, ray, (place == 0) | (before != ray))
    dr.scatter(end, place + 1, ray, (place == last) | (after != ray))
    number = end - first
    dr.eval(first, number)
    return first, number


def integrate(evaluation: Evaluation, samples: Samples) -> Composite:
    """Quadrature of an evaluated batch; differentiable in density and emission.

    Depth is a distance in scene space: in normalised device coordinates, that of the
    mean t'.
    """
    ends = (samples.near, samples.far) if samples.rule == "linear" else None
    seen = composite(
        evaluation.density, evaluation.emission, samples.t, samples.delta, samples.count, ends
    )
    if samples.ndc is None:
        return seen
    distance = samples.ndc.to_distance(seen.depth)
    return replace(seen, depth=dr.select(seen.opacity > 0, distance, 0))


@dataclass
class RayImage:
    """What R rays see, without background, in the field's colour space."""

    color: list[Any]  # three arrays of R values, premultiplied by the opacity
    opacity: Any
    depth: Any  # distance along the unit ray, scene units; 0 where nothing is seen
    queries: int  # how often its networks were asked


def ray_chunks(rays: int, settings: MarchSettings) -> Iterator[tuple[int, int]]:
    """Splits R rays into ranges whose samples fit in ``settings.chunk``."""
    size = max(1, settings.chunk // (settings.samples + settings.fine))
    for start in range(0, rays, size):
        yield start, min(size, rays - start)


def render_rays(
    field: Field,
    o: Any,
    d: Any,
    settings: MarchSettings,
    *,
    occupancy: OccupancyGrid | None = None,
    jitter: Any = None,
) -> RayImage:
    """Renders R rays without derivatives, in chunks of bounded memory.

    Args:
        o, d: origins and unit directions, in the field's coordinates.
        jitter: R numbers in [0, 1) that shift the samples of each ray within their
            strata; ``None`` for the middle of each stratum.
    """
    float_type = type(o[0])
    rays = max(len(o[0]), len(d[0]))
    outputs = [dr.zeros(float_type, rays) for _ in range(5)]
    queries = 0
    with dr.suspend_grad():
        for start, size in ray_chunks(rays, settings):
            index, chunk_o, chunk_d, offset = slice_rays(o, d, jitter, start, size)
            samples = place_samples(
                field, chunk_o, chunk_d, settings, occupancy=occupancy, jitter=offset
            )
            evaluation = Evaluation(field, samples, settings.block, stop=settings.stop)
            result = integrate(evaluation, samples)
            values = [*result.color, result.opacity, result.depth]
            for output, value in zip(outputs, values, strict=True):
                dr.scatter(output, value, index)
            dr.eval(outputs)
            queries += len(evaluation.asked) + samples.coarse_queries
    return RayImage(outputs[:3], outputs[3], outputs[4], queries)


def slice_rays(o: Any, d: Any, jitter: Any, start: int, size: int) -> tuple[Any, Any, Any, Any]:
    """Rays ``start … start + size`` of a batch, with their indices and jitter."""
    float_type = type(o[0])
    uint = dr.uint32_array_t(float_type)
    index = dr.arange(uint, size) + dr.opaque(uint, start)
    part_o, part_d = gather_vector3(o, index), gather_vector3(d, index)
    offset = None if jitter is None else dr.gather(float_type, jitter, index)
    dr.eval(index, part_o, part_d, offset)
    return index, part_o, part_d, offset
