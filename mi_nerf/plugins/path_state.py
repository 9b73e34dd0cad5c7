"""What the wavefronts of a path tracer through fields consist of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import drjit as dr
import mitsuba as mi

from ..base.arrays import taken
from .colors import Spectrum
from .light_choice import Chosen
from .sampled import Rays


@dataclass(frozen=True)
class PathSettings:
    """How far and how often paths are followed."""

    max_depth: int  # of the longest path, in segments
    rr_depth: int  # from which on paths end at random
    paths: int  # for every camera ray
    hide_lights: bool  # from cameras
    emitter_candidates: int  # points of light sources, one of which is chosen
    field_powers: list[float] | None  # of fields that are sampled as light sources
    jitter: bool  # of the samples on segments
    stop: float  # what fields must let pass for a path to go on
    keep: bool = False  # what each path brings, for derivatives


class Image:
    """What R camera rays gather; told of all that brings them light, path by path."""

    every_connection = False  # whether also those matter that bring no light just now

    def __init__(self, rays: int) -> None:
        self.radiance = dr.zeros(Spectrum, rays)
        self.alpha = dr.zeros(mi.Float, rays)
        dr.make_opaque(self.radiance, self.alpha)

    def add(self, slot: Any, radiance: Any) -> None:
        """Adds to some of the rays, each named once."""
        dr.scatter_add(self.radiance, radiance, slot)

    def shown(self, find: Callable[[], Any]) -> Any:
        """What fields show to paths, arrays; ``find`` asks them."""
        return find()

    def cover(self, slot: Any, alpha: Any) -> None:
        """Makes some of the rays more opaque."""
        dr.scatter_add(self.alpha, alpha, slot)

    def evaluate(self) -> None:
        """Computes what is pending."""
        dr.eval(self.radiance, self.alpha)

    def passed(self, slot: Any, rays: Rays, weight: Any, through: Any) -> None:
        """Paths have passed fields, whose light counts by ``weight``, and all that follows
        by ``through``, the share that they let pass; both were added."""

    def lit(self, slot: Any, rays: Rays, light: Any, through: Any) -> None:
        """The light of emitters has passed fields: ``light · through`` was added."""

    def shone_upon(self, slot: Any, rays: Rays, weight: Any) -> None:
        """The light of fields, times ``weight``, was added."""

    def left(self, vertex: Vertex) -> None:
        """All light that reaches paths at a surface was added; what follows comes with the
        next segment."""


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
    straight: Any  # whether the surface has let it through without a turn

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
    light: Any  # what arrives, or by what the light there is weighed
    wanted: Any  # N: which of them matter

    def take(self, jitter: Any) -> tuple[Any, Rays, Any]:
        """Those that matter: their numbers, the rays, and ``light``."""
        lit = mi.UInt32(dr.compress(self.wanted))
        reach = taken(self.reach, lit)
        o, d, light = (gather(v, lit) for v in (self.ray.o, self.ray.d, self.light))
        wavelengths = gather(self.ray.wavelengths, lit)
        jitter = None if jitter is None else gather(jitter, lit)
        dr.eval(o, d, reach, light, jitter, wavelengths)
        return lit, Rays(o, d, reach, jitter, wavelengths), light


@dataclass
class Chance:
    """Random numbers of N paths for one vertex."""

    emitter: Any
    choice: Any  # among points of emitters
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


@dataclass
class Vertex:
    """N paths at the surfaces, or the sky, that they have met, and what came of it."""

    paths: Paths  # as they arrived
    ends: Ends
    depth: int  # of the segments that end here, from 0
    chance: Chance
    following: Paths | None = None  # as they went on; None at the end of the longest paths
    going: Any = None  # which of them did
    chosen: Chosen | None = None  # the points of emitters; None at the end of the longest paths
    through: Any = None  # N: what fields let pass of the light of the emitter that was chosen
    shone: Any = None  # N colours: what fields sent from the direction that was chosen; or None


def gather(value: Any, index: Any) -> Any:
    """Some entries of an array, a vector or a structure of them."""
    return dr.gather(type(value), value, index)
