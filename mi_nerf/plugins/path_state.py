"""What the wavefronts of a path tracer through fields consist of."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import drjit as dr
import mitsuba as mi

from .sampled import Rays


@dataclass(frozen=True)
class PathSettings:
    """How far and how often paths are followed."""

    max_depth: int  # of the longest path, in segments
    rr_depth: int  # from which on paths end at random
    paths: int  # for every camera ray
    hide_lights: bool  # from cameras
    sample_fields: bool  # as light sources
    jitter: bool  # of the samples on segments
    stop: float  # what fields must let pass for a path to go on


@dataclass
class Image:
    """What R camera rays have gathered so far."""

    radiance: Any
    alpha: Any

    def add(self, slot: Any, radiance: Any) -> None:
        """Adds to some of the rays, each named once."""
        dr.scatter_add(self.radiance, radiance, slot)

    def cover(self, slot: Any, alpha: Any) -> None:
        """Makes some of the rays more opaque."""
        dr.scatter_add(self.alpha, alpha, slot)


@dataclass
class Paths:
    """The N paths that go on, each at the start of its next segment."""

    slot: Any  # numbers of their camera rays
    o: Any  # where the segment starts
    d: Any
    throughput: Any
    eta: Any  # by which throughput was scaled at refractions
    transmittance: Any  # of what a camera ray that went straight on has passed; 0 after a turn
    vertex: Any  # the surface that the segment comes from
    pdf: Any  # of its direction, by the surface's BSDF
    delta: Any  # whether that has no density: emitters and fields cannot be sampled so
    wavelengths: Any  # in spectral variants

    def take(self, index: Any) -> Any:
        """Some of them."""
        kept = gather(self, index)
        dr.eval(kept)
        return kept


@dataclass
class Ends:
    """Where the segments of N paths end."""

    ray: Any
    pi: Any  # what was hit


@dataclass
class Connections:
    """Segments from N surfaces to something that may light them."""

    ray: Any
    reach: Any  # where they end, one number or N
    light: Any  # what arrives, or by what the light there is weighed; 0 where there is none

    def take(self, jitter: Any) -> tuple[Any, Rays, Any]:
        """Those that bring anything: their numbers, the rays, and ``light``."""
        lit = mi.UInt32(dr.compress(dr.max(self.light) > 0))
        reach = self.reach if len(self.reach) == 1 else gather(self.reach, lit)
        o, d, light = (gather(v, lit) for v in (self.ray.o, self.ray.d, self.light))
        wavelengths = gather(self.ray.wavelengths, lit)
        jitter = None if jitter is None else gather(jitter, lit)
        dr.eval(o, d, reach, light, jitter, wavelengths)
        return lit, Rays(o, d, reach, jitter, wavelengths), light


@dataclass
class Chance:
    """Random numbers of N paths for one vertex."""

    emitter: Any
    bsdf: Any
    bsdf_component: Any
    roulette: Any
    field: Any
    field_point: Any
    jitter: list[Any]  # of the segments to an emitter, to a field, and of the path; or None

    def take(self, index: Any) -> Chance:
        """Those of some paths."""
        names = [f.name for f in fields(self) if f.name != "jitter"]
        kept = {name: gather(getattr(self, name), index) for name in names}
        jitter = [None if v is None else gather(v, index) for v in self.jitter]
        return Chance(**kept, jitter=jitter)


def gather(value: Any, index: Any) -> Any:
    """Some entries of an array, a vector or a structure of them."""
    return dr.gather(type(value), value, index)
