"""Where rays cross a field: its samples there, what it answers, and how both move."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ..base.errors import InputError
from ..march.intervals import RaySegments, ray_segments
from ..march.merging import Layer
from ..march.normals import density_gradient
from ..march.placing import place_samples
from ..march.query import Evaluation
from .sampled import Rays, SampledField

# Queries whose activations are kept from a field's answers to their adjoint, some hundred
# megabytes of a wide network; more than these are asked a second time, block by block.
_KEPT = 1 << 15


class Crossing:
    """The samples of one field on the rays that cross its box, and what it answers."""

    def __init__(
        self,
        number: int,
        marched: SampledField,
        ray: Any,
        rays: Rays,
        mode: dr.ADMode,
        emission: bool = True,
    ) -> None:
        self.number, self.field, self.ray = number, marched.field, ray
        self.differentiable = mode != dr.ADMode.Primal and marched.differentiable
        self._placed, self._march, self.moving = marched.placed, marched.march, Moving()
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
            bounds = marched.bounds(rays.reach, self.scale, rays.start)
            exact = mode != dr.ADMode.Primal or marched.trained
            whole = marched.differentiated if exact else marched.marched
            self.samples = place_samples(
                whole,
                dr.detach(o),
                dr.detach(d),
                jitter=rays.jitter,
                bounds=dr.detach(bounds),
            )
            self._edges: Any = None
            if moving:
                self._move(ray_segments(self.field, o, d, bounds))
        block = self._march.block
        few = self.samples.queries <= _KEPT
        keep = mode == dr.ADMode.Backward and self.differentiable and few
        with dr.resume_grad(when=keep):
            self.evaluation = Evaluation(
                self.field,
                self.samples,
                block,
                keep=keep,
                stop=whole.settings.stop,
                tail=-(-block // 2) if exact else None,
                fuse=not exact,
                emission=emission,
            )
        occupancy = whole.occupancy
        if marched.trained and mode == dr.ADMode.Backward and occupancy is not None:
            occupancy.witness(self.samples, self.evaluation.density)

    def prepare(self, mode: dr.ADMode) -> None:
        """Makes the field's answers the leaves of what is computed next."""
        if mode != dr.ADMode.Primal:
            self.evaluation.enable_grad()
        if mode == dr.ADMode.Forward and self.differentiable:
            self.moving.forward()
            self.evaluation.forward()

    def optical_depth(self) -> Any:
        """Along the whole of each ray; differentiable as :meth:`prepare` has it."""
        return dr.block_sum(self.evaluation.density * self.samples.delta, self.samples.count)

    def backward(self) -> None:
        """Carries the gradients of the field's answers and places to what they depend on."""
        if self.differentiable:
            self.evaluation.backward()
            self.moving.backward()

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


class Moving:
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


def crossings(
    fields: list[SampledField], rays: Rays, mode: dr.ADMode, emission: bool = True
) -> Iterator[Crossing]:
    """The fields that any of the rays cross."""
    if len(fields) == 1:
        yield Crossing(1, fields[0], None, rays, mode, emission)
        return
    for number, marched in enumerate(fields, 1):
        ray = mi.UInt32(dr.compress(marched.hit(rays)))
        if len(ray):
            yield Crossing(number, marched, ray, rays.take(ray), mode, emission)
