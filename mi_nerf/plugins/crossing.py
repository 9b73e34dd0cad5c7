"""What fields of a scene show along some rays, and the derivatives of that."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..base.arrays import gather_vector3
from ..base.color import srgb_to_linear
from ..base.errors import InputError
from ..march.intervals import RaySegments, ray_segments
from ..march.marched import MarchedField
from ..march.merging import Layer, integrate_merged, merge
from ..march.normals import density_gradient
from ..march.placing import place_samples
from ..march.quadrature import integrate
from ..march.query import Evaluation
from ..march.settings import MarchSettings
from .placement import PlacedField


@dataclass(frozen=True)
class Marched:
    """A field of the scene and how it is sampled."""

    placed: PlacedField
    march: MarchSettings  # without near and far
    near: float | None  # along rays, world units; None: what the field file says
    far: float | None
    encoded: bool = False  # leave colours in the space in which they were composited

    @property
    def field(self) -> Any:
        """The field."""
        return self.placed.medium.field

    def unbounded(self) -> Marched:
        """The same field for rays that do not come from a camera: near and far are its."""
        return replace(self, near=0.0, far=math.inf)

    def bounds(self, reach: Any, scale: Any) -> tuple[Any, Any]:
        """Bounds of t in field units: the integrator's or the file's, and ``reach``."""
        march = self.placed.medium.march
        near = mi.Float(march.near or 0) if self.near is None else self.near * scale
        far = mi.Float(dr.inf if march.far is None else march.far)
        if self.far is not None:
            far = self.far * scale
        return near, dr.fmin(far, reach * scale)

    def hit(self, rays: Rays) -> Any:
        """Which rays cross the box within their bounds."""
        o, d, scale = self.placed.to_local(rays.o, rays.d)
        dr.eval(o, d, scale)
        return ray_segments(self.field, o, d, self.bounds(rays.reach, scale)).hit

    @property
    def differentiable(self) -> bool:
        """Whether gradients of the field or its place are wanted."""
        with dr.resume_grad():
            weights = list(self.field.parameters().values())
            return bool(dr.grad_enabled(weights)) or self.placed.moves


@dataclass
class Rays:
    """R rays in the world, and how far along each fields are to be seen."""

    o: Any
    d: Any  # unit
    reach: Any  # R distances: of a surface, or of the far clip plane
    jitter: Any  # R numbers in [0, 1), or None

    def take(self, index: Any) -> Rays:
        """Some of them."""
        o, d = gather_vector3(self.o, index), gather_vector3(self.d, index)
        reach = dr.gather(mi.Float, self.reach, index)
        jitter = None if self.jitter is None else dr.gather(mi.Float, self.jitter, index)
        dr.eval(o, d, reach, jitter)
        return Rays(mi.Point3f(o), mi.Vector3f(d), reach, jitter)


def chunks(fields: list[Marched], rays: Rays) -> Iterator[tuple[Any, Rays]]:
    """The rays that cross any field, in parts of bounded memory, with their numbers."""
    samples = dr.zeros(mi.UInt32, len(rays.o[0]))  # of all fields along each ray
    for marched in fields:
        count = dr.opaque(mi.UInt32, marched.march.samples + marched.march.fine)
        samples += dr.select(marched.hit(rays), count, 0)
    dr.eval(samples)
    crossing = mi.UInt32(dr.compress(samples > 0))
    if not len(crossing):
        return
    total = np.cumsum(np.array(dr.gather(mi.UInt32, samples, crossing)), dtype=np.int64)
    limit = min(marched.march.chunk for marched in fields)
    ends = np.searchsorted(total, limit * np.arange(1, total[-1] // limit + 2))
    for start, end in pairwise([0, *ends.tolist()]):
        slot = dr.arange(mi.UInt32, end - start) + dr.opaque(mi.UInt32, start)
        if len(slot):
            index = dr.gather(mi.UInt32, crossing, slot)
            yield index, rays.take(index)


class View:
    """What R rays see of all fields together, before what lies behind them.

    In a differentiable mode, derivatives pass through the fields' answers and their places,
    block by block, as in :class:`mi_nerf.march.query`.
    """

    values: list[Any]  # R, G, B (linear, premultiplied), opacity, depth in world units
    normal: list[Any]  # mean outward normal of density, world: three arrays without history
    index: Any  # number of the field that contributes most, from 1; without history

    def __init__(
        self, fields: list[Marched], rays: Rays, mode: dr.ADMode, *, normals: bool = False
    ) -> None:
        self._rays, self._normals = len(rays.o[0]), normals
        self._crossings = list(_crossings(fields, rays, mode))
        with dr.resume_grad(when=mode != dr.ADMode.Primal):
            for crossing in self._crossings:
                crossing.prepare(mode)
            if len(fields) == 1:
                self._look_at_one(self._crossings[0])
            elif self._crossings:
                self._look_at_all()
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
                if crossing.differentiable:
                    crossing.evaluation.backward()
                    crossing.moving.backward()

    def forward(self) -> list[Any]:
        """The derivatives of ``values`` along the gradients of weights and places."""
        with dr.resume_grad():
            # The opacity is an output and an input of the colours: keep interior gradients.
            dr.forward_to(self.values, flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad)
            return [dr.grad(value) for value in self.values]

    def _look_at_one(self, crossing: _Crossing) -> None:
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

    def _look_at_all(self) -> None:
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


def optical_depth(fields: list[Marched], rays: Rays) -> Any:
    """Of all fields along R rays, without derivatives: only densities are asked for.

    As opaque as :class:`View` finds them. Densities add up, so nothing has to be merged.
    """
    total = dr.zeros(mi.Float, len(rays.o[0]))
    dr.make_opaque(total)
    for crossing in _crossings(fields, rays, dr.ADMode.Primal, emission=False):
        samples, density = crossing.samples, crossing.evaluation.density
        depth = dr.block_sum(density * samples.delta, samples.count)
        if crossing.ray is None:
            total += depth
        else:
            dr.scatter_add(total, depth, crossing.ray)
        dr.eval(total)
    return total


class _Crossing:
    """The samples of one field on the rays that cross its box, and what it answers."""

    def __init__(
        self,
        number: int,
        marched: Marched,
        ray: Any,
        rays: Rays,
        mode: dr.ADMode,
        emission: bool = True,
    ) -> None:
        self.number, self.field, self.ray = number, marched.field, ray
        self.differentiable = mode != dr.ADMode.Primal and marched.differentiable
        self._placed, self._march, self.moving = marched.placed, marched.march, _Moving()
        self.color_space = "linear" if marched.encoded else self.field.color_space
        moving = mode != dr.ADMode.Primal and self._placed.moves
        if moving and self.field.ndc is not None:
            raise InputError(
                "nerf: the place of a field in normalised device coordinates has no gradient, "
                "expected a 'to_world' without"
            )
        with dr.resume_grad(when=moving):
            o, d, self.scale = self._placed.to_local(rays.o, rays.d, moving=moving)
            dr.eval(o, d, self.scale)
            bounds = marched.bounds(rays.reach, self.scale)
            self.samples = place_samples(
                MarchedField(self.field, self._march, self._placed.medium.occupancy),
                dr.detach(o),
                dr.detach(d),
                jitter=rays.jitter,
                bounds=dr.detach(bounds),
            )
            self._edges: Any = None
            if moving:
                self._move(ray_segments(self.field, o, d, bounds))
        stop = self._march.stop if mode == dr.ADMode.Primal else 0.0
        self.evaluation = Evaluation(
            self.field, self.samples, self._march.block, stop=stop, emission=emission
        )

    def prepare(self, mode: dr.ADMode) -> None:
        """Makes the field's answers the leaves of what is computed next."""
        if mode != dr.ADMode.Primal:
            self.evaluation.enable_grad()
        if mode == dr.ADMode.Forward and self.differentiable:
            self.moving.forward()
            self.evaluation.forward()

    def layer(self) -> Layer:
        """What is merged with other fields."""
        edges = self.samples.edges() if self._edges is None else self._edges
        if self._edges is None:
            ray = dr.arange(mi.UInt32, len(edges)) // (self.samples.count + 1)
            edges = edges / dr.gather(mi.Float, self.scale, ray)
            dr.eval(edges)
        return Layer(self.ray, self.samples, self.evaluation, self.scale, edges)

    def normals(self) -> list[Any]:
        """Unit normals at all samples, in world coordinates; 0 where the field was not asked."""
        gradient = density_gradient(
            self.field, self.samples, self.evaluation.asked, self._march.block
        )
        return self._placed.normal_to_world(gradient)

    def _move(self, within: RaySegments) -> None:
        """Lets samples follow the field's box: each keeps its share of the ray's part in it."""
        samples, cut = self.samples, self.moving.cut

        def follow(t: Any, stride: int, length: bool = False) -> Any:
            ray = dr.arange(mi.UInt32, len(t)) // stride
            near, far = (dr.gather(mi.Float, v, ray) for v in (within.near, within.far))
            start, size = dr.detach(near), dr.detach(far - near)
            share = dr.select(size > 0, (t if length else t - start) / size, 0)
            near, far = near - start, far - dr.detach(far)  # zeros that carry derivatives
            return t + share * (far - near) + (0 if length else near)

        edges = follow(samples.edges(), samples.count + 1)
        row = dr.arange(mi.UInt32, len(edges)) // (samples.count + 1)
        self._edges = cut(edges / dr.gather(mi.Float, self.scale, row))
        self.scale = cut(self.scale)
        d = cut(within.d)
        if samples.rule.reads_bounds:
            samples = replace(samples, near=cut(within.near), far=cut(within.far))
        self.samples = replace(
            samples,
            o=cut(within.o),
            d=d,
            view=d,
            t=cut(follow(samples.t, samples.count)),
            delta=cut(follow(samples.delta, samples.count, length=True)),
        )


class _Moving:
    """Values that depend on a field's place, cut off from where they come from.

    What is made of them is differentiated on its own, in several passes; the gradients of
    the cut values are carried on at the end.
    """

    def __init__(self) -> None:
        self._pairs: list[tuple[Any, Any]] = []

    def cut(self, value: Any) -> Any:
        """A copy without history whose gradient is remembered."""
        leaf = dr.detach(value)
        dr.enable_grad(leaf)
        dr.eval(value, leaf)
        self._pairs.append((value, leaf))
        return leaf

    def backward(self) -> None:
        """Carries the gradients of all copies to what their originals were made of."""
        for value, leaf in self._pairs:
            dr.set_grad(value, dr.grad(leaf))
            dr.enqueue(dr.ADMode.Backward, value)
        dr.traverse(dr.ADMode.Backward)

    def forward(self) -> None:
        """Gives all copies the derivatives of their originals."""
        if self._pairs:
            values = [value for value, _ in self._pairs]
            dr.forward_to(values, flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad)
        for value, leaf in self._pairs:
            dr.set_grad(leaf, dr.grad(value))


def _crossings(
    fields: list[Marched], rays: Rays, mode: dr.ADMode, emission: bool = True
) -> Iterator[_Crossing]:
    """The fields that any of the rays cross."""
    if len(fields) == 1:
        yield _Crossing(1, fields[0], None, rays, mode, emission)
        return
    for number, marched in enumerate(fields, 1):
        ray = mi.UInt32(dr.compress(marched.hit(rays)))
        if len(ray):
            yield _Crossing(number, marched, ray, rays.take(ray), mode, emission)


def _linear(color_space: str, color: list[Any], opacity: Any) -> list[Any]:
    """Premultiplied linear radiance of a field's own colours."""
    if color_space != "srgb":
        return color
    visible = opacity > 0
    inverse = dr.select(visible, 1 / dr.select(visible, opacity, 1), 0)
    return [srgb_to_linear(c * inverse) * opacity for c in color]
