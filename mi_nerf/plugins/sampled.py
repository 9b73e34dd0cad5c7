"""Fields of a scene with how they are sampled, and rays that are to be sampled so."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ..base.arrays import gather_vector3
from ..march.intervals import ray_segments
from ..march.marched import MarchedField
from ..march.settings import MarchSettings
from ..march.walk import Walked, walk_rays
from .placement import PlacedField


@dataclass(frozen=True)
class SampledField:
    """A field of the scene and how it is sampled."""

    placed: PlacedField
    march: MarchSettings  # without near and far
    near: float | None  # along rays, world units; None: what the field file says
    far: float | None
    encoded: bool = False  # leave colours in the space in which they were composited
    coarse: bool = False  # show the network that places the samples of the other one

    @property
    def field(self) -> Any:
        """The field."""
        field = self.placed.medium.field
        return field.coarse if self.coarse else field

    @property
    def marched(self) -> MarchedField:
        """The field in its own coordinates."""
        return MarchedField(self.field, self.march, self.placed.medium.occupancy)

    @property
    def trained(self) -> bool:
        """Whether this is a step of training: what is seen takes the samples of the derivatives."""
        return self.placed.medium.training and self.differentiable

    @property
    def differentiated(self) -> MarchedField:
        """The field for derivatives: rays end where those of pictures do, or as in training."""
        medium = self.placed.medium
        if not medium.training:
            return self.marched
        settings = replace(self.march, stop=0.0, hidden=medium.hidden)
        return replace(self.marched, settings=settings)

    def walk(self, rays: Rays, *, emission: bool = True) -> tuple[Walked, Any]:
        """What rays see, see :func:`mi_nerf.march.walk.walk_rays`; and local per world length."""
        o, d, scale = self.placed.to_local(rays.o, rays.d)
        dr.eval(o, d, scale)
        bounds = self.bounds(rays.reach, scale, rays.start)
        marched, jitter = self.marched, rays.jitter
        return walk_rays(marched, o, d, jitter=jitter, bounds=bounds, emission=emission), scale

    def unbounded(self) -> SampledField:
        """The same field for rays that do not come from a camera: near and far are its."""
        return replace(self, near=0.0, far=math.inf)

    def bounds(self, reach: Any, scale: Any, start: Any = None) -> tuple[Any, Any]:
        """Bounds of t in field units: the integrator's or the file's, and those of the rays."""
        march = self.placed.medium.march
        near = mi.Float(march.near or 0) if self.near is None else self.near * scale
        far = mi.Float(dr.inf if march.far is None else march.far)
        if self.far is not None:
            far = self.far * scale if self.far < math.inf else mi.Float(dr.inf)
        if start is not None:
            near = dr.fmax(near, start * scale)
        # Infinity times a scale has no derivative.
        ends = reach < dr.inf
        return near, dr.fmin(far, dr.select(ends, dr.select(ends, reach, 0) * scale, dr.inf))

    def hit(self, rays: Rays) -> Any:
        """Which rays cross the box within their bounds."""
        o, d, scale = self.placed.to_local(rays.o, rays.d)
        dr.eval(o, d, scale)
        return ray_segments(self.field, o, d, self.bounds(rays.reach, scale, rays.start)).hit

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
    wavelengths: Any = None  # in spectral variants
    start: Any = None  # R distances from which on fields are to be seen, or None: from the origin

    def take(self, index: Any) -> Rays:
        """Some of them."""
        o, d = gather_vector3(self.o, index), gather_vector3(self.d, index)
        reach = dr.gather(mi.Float, self.reach, index)
        jitter = None if self.jitter is None else dr.gather(mi.Float, self.jitter, index)
        w, start = self.wavelengths, self.start
        w = None if w is None else dr.gather(type(w), w, index)
        start = None if start is None else dr.gather(mi.Float, start, index)
        dr.eval(o, d, reach, jitter, w, start)
        return Rays(mi.Point3f(o), mi.Vector3f(d), reach, jitter, wavelengths=w, start=start)
