"""What rays see of all fields, as far as each ray goes: values, and their derivatives."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..base.color import srgb_to_linear
from ..march.merging import integrate_merged, merge
from ..march.quadrature import integrate
from ..march.walk import can_walk
from .colors import emission
from .crossing import Crossing, crossings
from .sampled import Rays, SampledField

# Samples up to which rays are marched together, whether or not they cross a field: to find
# out takes as long.
_FEW = 1 << 18


@dataclass(frozen=True)
class Seen:
    """What R rays see of the fields, before what lies behind them."""

    values: list[Any]  # R, G, B (linear, premultiplied), opacity, depth in world units
    normal: Any  # of the fields, where wanted, else 0
    index: Any  # of the field that contributes most, from 1; 0 for none
    wavelengths: Any = None  # of the rays, in spectral variants

    @property
    def color(self) -> Any:
        """Radiance in the colours of the variant."""
        return emission(self.values[:3], self.wavelengths)

    @property
    def opacity(self) -> Any:
        """In [0, 1]."""
        return self.values[3]


def see(fields: list[SampledField], rays: Rays, *, normals: bool = False) -> Seen:
    """Radiance and opacity of the fields along R rays, in one kernel or in chunks."""
    count = len(rays.o[0])
    values = [dr.zeros(mi.Float, count) for _ in range(5)]
    index = dr.zeros(mi.Float, count)
    normal = mi.Normal3f(*(dr.zeros(mi.Float, count) for _ in range(3)))
    dr.make_opaque(values, index, normal)
    walks = len(fields) == 1 and not normals and _walks(fields[0])
    for where, part in chunks(fields, rays, whole=walks):
        integral = (
            _walked(fields[0], part)
            if walks
            else Integral(fields, part, dr.ADMode.Primal, normals=normals)
        )
        for output, value in zip(values, integral.values, strict=True):
            dr.scatter(output, value, where)
        dr.scatter(index, integral.index, where)
        if normals:
            dr.scatter(normal, mi.Normal3f(*integral.normal), where)
        dr.eval(values, index, normal)
    return Seen(values, normal, index, rays.wavelengths)


def scattered(index: Any, integral: Integral, count: int) -> Seen:
    """What ``count`` rays see, of which the rays ``index`` cross a field; without normals."""
    values = [dr.zeros(mi.Float, count) for _ in range(5)]
    dr.make_opaque(values)
    for output, value in zip(values, integral.values, strict=True):
        dr.scatter(output, dr.detach(value), index)
    dr.eval(values)
    return Seen(values, mi.Normal3f(0), mi.Float(0))


def _walks(marched: SampledField) -> bool:
    """Whether rays walk through a field in one kernel."""
    return can_walk(marched.marched) and not marched.trained


def _walked(marched: SampledField, rays: Rays) -> Seen:
    """What rays see of the only field, where it may be asked within a kernel."""
    walked, scale = marched.walk(rays)
    space = "linear" if marched.encoded else marched.field.color_space
    color = _linear(space, walked.color, walked.opacity)
    index = dr.select(walked.opacity > 0, mi.Float(1), 0)
    return Seen([*color, walked.opacity, walked.depth / scale], mi.Normal3f(0), index)


def transmittance(fields: list[SampledField], rays: Rays) -> Any:
    """The share of light that the fields let pass along R rays, without derivatives.

    As :class:`Integral` finds it. Only densities are asked for, and as they add up, nothing
    has to be merged: one field follows the other.
    """
    total = dr.zeros(mi.Float, len(rays.o[0]))
    dr.make_opaque(total)
    for marched in fields:
        walks = _walks(marched)
        for where, part in chunks([marched], rays, whole=walks):
            depth = (
                marched.walk(part, emission=False)[0].optical_depth
                if walks
                else _optical_depth(marched, part)
            )
            dr.scatter(total, dr.gather(mi.Float, total, where) + depth, where)
            dr.eval(total)
    return dr.exp(-total)


def _optical_depth(marched: SampledField, rays: Rays) -> Any:
    """Of one field along rays that cross it."""
    (crossing,) = crossings([marched], rays, dr.ADMode.Primal, emission=False)
    return crossing.optical_depth()


class Integral:
    """The volume-rendering integral (NeRF, Eq. 3) of all fields along R rays.

    In a differentiable mode, derivatives pass through the fields' answers and their places,
    block by block, as in :class:`mi_nerf.march.query`.
    """

    values: list[Any]  # R, G, B (linear, premultiplied), opacity, depth in world units
    normal: list[Any]  # mean outward normal of density, world: three arrays without history
    index: Any  # number of the field that contributes most, from 1; without history

    def __init__(
        self, fields: list[SampledField], rays: Rays, mode: dr.ADMode, *, normals: bool = False
    ) -> None:
        self._rays, self._normals = len(rays.o[0]), normals
        self._crossings = list(crossings(fields, rays, mode))
        with dr.resume_grad(when=mode != dr.ADMode.Primal):
            for crossing in self._crossings:
                crossing.prepare(mode)
            if len(fields) == 1:
                self._of_one(self._crossings[0])
            elif self._crossings:
                self._of_all()
            else:  # none after all: rays that graze a box hit it or not, by rounding
                self.values = [dr.zeros(mi.Float, self._rays) for _ in range(5)]
                self.index = dr.zeros(mi.Float, self._rays)
                self._set_normal([dr.zeros(mi.Float, self._rays)] * 3, self.index)

    def backward(self, gradients: list[Any]) -> None:
        """Carries the gradients of ``values`` to weights and places of the fields."""
        with dr.resume_grad():
            for value, gradient in zip(self.values, gradients, strict=True):
                dr.set_grad(value, gradient)
                dr.enqueue(dr.ADMode.Backward, value)
            dr.traverse(dr.ADMode.Backward)
            for crossing in self._crossings:
                crossing.backward()

    def forward(self) -> list[Any]:
        """The derivatives of ``values`` along the gradients of weights and places."""
        with dr.resume_grad():
            # The opacity is an output and an input of the colours: keep interior gradients.
            dr.forward_to(self.values, flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad)
            return [dr.grad(value) for value in self.values]

    def _of_one(self, crossing: Crossing) -> None:
        """One field, in its own order of samples."""
        seen = integrate(crossing.evaluation, crossing.samples)
        color = _linear(crossing.color_space, seen.color, seen.opacity)
        self.values = [*color, seen.opacity, seen.depth / crossing.scale]
        self.index = dr.select(seen.opacity > 0, mi.Float(crossing.number), 0)
        if self._normals:
            sums = [
                dr.block_sum(dr.detach(seen.weights) * n, crossing.samples.count)
                for n in crossing.normals()
            ]
            self._set_normal(sums, seen.opacity)

    def _of_all(self) -> None:
        """Several fields, merged along the rays."""
        layers = [crossing.layer() for crossing in self._crossings]
        pieces = merge(layers, self._rays)
        seen = integrate_merged(layers, pieces)
        parts = [
            _linear(crossing.color_space, color, share)
            for crossing, color, share in zip(self._crossings, seen.color, seen.share, strict=True)
        ]
        color = [sum(channel[1:], channel[0]) for channel in zip(*parts, strict=True)]
        self.values = [*color, seen.opacity, seen.depth]
        most, self.index = dr.zeros(mi.Float, self._rays), dr.zeros(mi.Float, self._rays)
        for crossing, share in zip(self._crossings, seen.share, strict=True):
            more = dr.detach(share) > most
            most = dr.select(more, dr.detach(share), most)
            self.index = dr.select(more, mi.Float(crossing.number), self.index)
        if self._normals:
            sums = [dr.zeros(mi.Float, self._rays) for _ in range(3)]
            for crossing, w, sample in zip(
                self._crossings, seen.weights, pieces.sample, strict=True
            ):
                for i, n in enumerate(crossing.normals()):
                    part = dr.gather(mi.Float, n, sample, sample < len(n))
                    sums[i] += dr.block_sum(dr.detach(w) * part, pieces.width)
            self._set_normal(sums, seen.opacity)

    def _set_normal(self, sums: list[Any], opacity: Any) -> None:
        opacity = dr.detach(opacity)
        inverse = dr.select(opacity > 0, 1 / dr.select(opacity > 0, opacity, 1), 0)
        self.normal = [n * inverse for n in sums]


def few(fields: list[SampledField], rays: Rays) -> bool:
    """Whether rays have so few samples that they are marched together."""
    most = sum(marched.march.samples + marched.march.fine for marched in fields)
    return len(rays.o[0]) * most <= _FEW


def pull_back(fields: list[SampledField], rays: Rays, gradients: list[Any]) -> None:
    """Carries gradients of the five ``values`` of R rays to the parameters of the fields."""
    if not any(marched.differentiable for marched in fields):
        return
    for index, part in chunks(fields, rays):
        integral = Integral(fields, part, dr.ADMode.Backward)
        integral.backward([dr.gather(mi.Float, g, index) for g in gradients])


def push_forward(fields: list[SampledField], rays: Rays) -> list[Any]:
    """The derivatives of the five ``values`` of R rays along the gradients of parameters."""
    tangents = [dr.zeros(mi.Float, len(rays.o[0])) for _ in range(5)]
    dr.make_opaque(tangents)
    for index, part in chunks(fields, rays):
        integral = Integral(fields, part, dr.ADMode.Forward)
        for tangent, slope in zip(tangents, integral.forward(), strict=True):
            dr.scatter(tangent, slope, index)
        dr.eval(tangents)
    return tangents


def chunks(
    fields: list[SampledField], rays: Rays, *, whole: bool = False
) -> Iterator[tuple[Any, Rays]]:
    """The rays that cross any field, with their numbers: in parts of bounded memory, or whole."""
    if few(fields, rays) and not whole:
        index = dr.arange(mi.UInt32, len(rays.o[0]))
        dr.eval(index, rays)
        yield index, rays
        return
    samples = dr.zeros(mi.UInt32, len(rays.o[0]))  # of all fields along each ray
    for marched in fields:
        count = dr.opaque(mi.UInt32, marched.march.samples + marched.march.fine)
        samples += dr.select(marched.hit(rays), count, 0)
    dr.eval(samples)
    crossing = mi.UInt32(dr.compress(samples > 0))
    if not len(crossing):
        return
    if whole:
        yield crossing, rays.take(crossing)
        return
    total = np.cumsum(np.array(dr.gather(mi.UInt32, samples, crossing)), dtype=np.int64)
    limit = min(marched.march.chunk for marched in fields)
    ends = np.searchsorted(total, limit * np.arange(1, total[-1] // limit + 2))
    for start, end in pairwise([0, *ends.tolist()]):
        slot = dr.arange(mi.UInt32, end - start) + dr.opaque(mi.UInt32, start)
        if len(slot):
            index = dr.gather(mi.UInt32, crossing, slot)
            yield index, rays.take(index)


def _linear(color_space: str, color: list[Any], opacity: Any) -> list[Any]:
    """Premultiplied linear radiance of a field's own colours."""
    if color_space != "srgb":
        return color
    visible = opacity > 0
    inverse = dr.select(visible, 1 / dr.select(visible, opacity, 1), 0)
    return [srgb_to_linear(c * inverse) * opacity for c in color]
