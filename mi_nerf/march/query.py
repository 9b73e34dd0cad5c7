"""Asks a field about samples, in blocks of constant size, front to back; and its adjoint."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr

from ..base.arrays import Floats, Indices, Mask, gather_vector3, joined
from ..base.kernel_stages import stage
from ..fields.protocol import Field
from .blocks import blocks
from .samples import Samples
from .strata import points_along

# Before it is asked which rays go on, so many samples of each are evaluated, or more where
# that makes less than so many queries.
_LEAST_OF_RAY = 4
_LEAST_QUERIES = 1 << 14

# Numbers in the copies of a gradient that threads may have for themselves, together.
_PRIVATE_NUMBERS = 1 << 26


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
        fuse: bool = True,
        emission: bool = True,
    ) -> None:
        """Evaluates the field; with ``keep``, activations stay for :meth:`backward`.

        Args:
            block: queries the network evaluates at a time.
            emission: whether it is wanted; a network is asked for its density alone else.
            tail: of the last blocks, to waste less on filling them up. Default: a quarter
                of large blocks in rounds, else the same.
            fuse: whether a narrow network may be asked within a kernel where nothing is kept;
                else as in training.
        """
        self._field, self._samples, self._block = field, samples, block
        self._graph: list[tuple[Any, Any, list[Any]]] = []
        self._tail = tail or (block // 4 if stop > 0 and block >= 4096 else block)
        self._fused = field.fused(emission) if fuse and not keep else None
        self._emits = emission
        float_type = type(samples.t)
        self._channels = [dr.zeros(float_type, len(samples.t)) for _ in range(4 if emission else 1)]
        dr.make_opaque(self._channels)  # without queries they would stay constants
        if stop <= 0:
            self.asked = samples.index
            self._evaluate(samples.index, keep)
            return
        rounds = [self._evaluate(index, keep) for index in self._front_to_back(stop)]
        self.asked = joined(type(samples.index), rounds)

    def _evaluate(self, index: Indices, keep: bool) -> Indices:
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

    def _front_to_back(self, stop: float) -> Iterator[Indices]:
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
    def density(self) -> Floats:
        """R·S densities, 1/scene unit."""
        return self._channels[0]

    @property
    def emission(self) -> list[Floats]:
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
        samples, leaves = self._samples, list(self._field.parameters().values())
        moving = (samples.o, samples.d, samples.view, samples.t)
        leaves += [value for value in moving if dr.grad_enabled(value)]
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
                    dr.eval([dr.grad(leaf) for leaf in leaves])
        self._graph = []

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

    def _blocks(self, index: Indices, block: int) -> Iterator[tuple[Indices, Mask]]:
        """Sample numbers and validity of each block; the last one is padded."""
        tail = self._tail if block == self._block else None
        for _, valid, where in blocks(index, block, tail):
            with stage("samples"):
                dr.eval(where, valid)
            yield where, valid

    def _query(self, where: Indices, fused: Any = None) -> list[Floats]:
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


def _spans(ray: Indices, rays: int) -> tuple[Indices, Indices]:
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
