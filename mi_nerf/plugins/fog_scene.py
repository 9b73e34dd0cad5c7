"""A scene with media of Mitsuba's own, as camera rays find it: fields before, behind and in fog.

Along a ray, gaps without any medium follow each other, 0 … n, with media between them. Where
fields are in the gaps alone, let C_j and O_j be colour and opacity of those in gap j, T_j what the
media before it let pass, V_j = Π_{i≤j} (1 − O_i) what the fields up to its end do, and X_j what the
nested integrator returns for the ray from the beginning of the gap on. It knows no fields, so what
the media j send towards the camera is X_{j−1} − (T_j / T_{j−1}) X_j, and together they show

    L = Σ_j T_j V_{j−1} C_j + Σ_j V_{j−1} (T_{j−1} X_{j−1} − T_j X_j) + T_n V_n X_n
      = X_0 + Σ_j T_j V_{j−1} (C_j − O_j X_j).

Each X_j is an estimate of its own and so is T_j where a medium is uneven: the mean is right, a
single value may be negative. Without media this is C_0 + (1 − O_0) X_0.

A field in a medium has a place at every depth t: with its weights w(t), in the place of the term j
is V_{j−1} ∫ T(t) w(t) (c(t) − X(t)) dt, where the extinctions of both add up. Here T and X are
those at one depth, the mean of t under w, of each ray. That is exact for fields that are opaque
where they begin; else the error is of second order in how much the medium weakens light from the
front of what is seen of the field to its back. It has no derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..base.errors import InputError
from ..march.intervals import ray_segments
from .backdrop import Hit, Light, Surfaces
from .colors import CHANNELS, Radiance, Spectrum
from .field_scene import Traced
from .film import CameraRays, Channels
from .integral import Seen, pull_back, push_forward, see
from .media import OVERLAP, Fog, Gap, Passed, find_way, media_of
from .sampled import Rays, SampledField


@dataclass(frozen=True)
class InGap:
    """What camera rays find in one of their gaps, or within a medium."""

    gap: Gap
    seen: Seen  # of the fields in it
    active: Any  # where it matters what is behind them
    light: Light  # along the gap's ray
    passed: Passed | None  # by the media before that; None for the first gap
    within: bool = False  # a medium

    @property
    def outputs(self) -> list[Any]:
        """What has derivatives: five values of the fields, colours behind, what media let pass."""
        passed = [] if self.passed is None else self.passed.share
        return [*self.seen.values, *self.light.radiance, *passed]


@dataclass(frozen=True)
class TracedInFog:
    """What the camera rays of one pass have found."""

    camera: CameraRays
    hit: Hit
    parts: list[InGap]

    @property
    def outputs(self) -> list[Any]:
        """The arrays of which the channels are made."""
        return [output for part in self.parts for output in part.outputs]

    def channels(self) -> Channels:
        """As :class:`Traced` has them; media count in color and alpha alone."""
        first = self.parts[0]
        color, through = Spectrum(0), mi.Float(1)
        depth, normal = mi.Float(0), mi.Normal3f(0)
        most, index = mi.Float(0), mi.Float(0)
        for part in self.parts:
            seen, light = part.seen, Spectrum(*part.light.radiance)
            if part.passed is None:
                color += (1 - seen.opacity) * light
            else:
                passed = Spectrum(*part.passed.share)
                color += passed * through * (seen.color - seen.opacity * light)
            share = through * seen.opacity
            depth += share * seen.values[4]
            normal += dr.detach(share) * seen.normal
            more = dr.detach(share) > most
            most = dr.select(more, dr.detach(share), most)
            index = dr.select(more, seen.index, index)
            through *= 1 - seen.opacity
        opacity = 1 - through
        inverse = dr.select(opacity > 0, 1 / dr.select(opacity > 0, opacity, 1), 0)
        values = [*first.seen.values[:3], opacity, depth * inverse]
        whole = Seen(values, normal * dr.detach(inverse), mi.Float(index))
        channels = Traced(self.camera, self.hit, whole, first.light).channels()
        return channels | {"color": Radiance(first.seen.values[:3], color)}


class FogScene:
    """Fields, surfaces and media of a scene, for the time of one rendering."""

    trained = False  # its derivatives have samples of their own

    def __init__(
        self, fields: list[SampledField], solid: mi.Scene, surfaces: Surfaces, normals: bool
    ):
        """
        Args:
            solid: the scene without the cubes of fields.
            surfaces: the same as the nested integrator shows it.
        """
        self._fields, self._solid, self._surfaces = fields, solid, surfaces
        self._normals = normals
        self._uneven = any(not medium.is_homogeneous() for _, medium in media_of(solid))

    def trace(self, camera: CameraRays, *, keep: bool = False) -> TracedInFog:
        """What the rays of a pass see, without derivatives; nothing is kept for these."""
        way = find_way(self._solid, camera.ray)
        hit = Hit(way.distance, way.normal)
        random = self._random(camera)
        parts: list[InGap] = []
        before: list[Fog] = []
        for number, gap in enumerate(way.gaps):
            part = self._in_gap(hit, gap, before, camera, random, first=number == 0)
            parts += [] if part is None else [part]
            for fog in way.fogs[number] if number < len(way.fogs) else ():
                part = self._in_fog(hit, fog, before, camera, random)
                parts += [] if part is None else [part]
                before.append(fog)
        return TracedInFog(camera, hit, parts)

    def _in_gap(
        self, hit: Hit, gap: Gap, before: list[Fog], camera: CameraRays, random: Any, first: bool
    ) -> InGap | None:
        """What is seen in a gap; nothing, unless it is the first, where no field is."""
        seen = see(self._fields, _rays(camera, gap), normals=self._normals)
        active = gap.there & (seen.opacity > 0)
        if not first and not dr.any(active):
            return None
        active = mi.Bool(True) if first else active
        light = self._surfaces.shade(hit, gap.ray, camera.sampler, seen.opacity, active)
        passed = None if first else Passed([*before], camera.ray, active, random, self._uneven)
        return InGap(gap, seen, active, light, passed)

    def _in_fog(
        self, hit: Hit, fog: Fog, before: list[Fog], camera: CameraRays, random: Any
    ) -> InGap | None:
        """What is seen of fields within a medium, at their mean depth; nothing where none is."""
        there = self._shared(fog, camera)
        if not dr.any(there):
            return None
        ray = mi.Ray3f(camera.ray)
        gap = Gap(fog.start, dr.select(there, fog.end, fog.start), there, ray)
        seen = see(self._fields, _rays(camera, gap), normals=self._normals)
        active = there & (seen.opacity > 0)
        if not dr.any(active):
            return None
        at = dr.clip(dr.select(active, seen.values[4], fog.start), fog.start, fog.end)
        ray.o, ray.maxt = camera.ray(at), camera.ray.maxt - at
        dr.eval(ray, active, at)
        light = self._surfaces.shade(
            hit, ray, camera.sampler, seen.opacity, active, medium=fog.medium
        )
        until = Fog(fog.medium, fog.start, at, active)
        passed = Passed([*before, until], camera.ray, active, random, self._uneven)
        return InGap(gap, seen, active, light, passed, within=True)

    def backward(self, traced: TracedInFog, gradients: list[Any]) -> None:
        """Carries the gradients of ``outputs`` to the parameters of the scene."""
        _require_clear(traced)
        camera, gradients = traced.camera, list(gradients)
        for part in traced.parts:
            count = len(part.outputs)
            own, gradients = gradients[:count], gradients[count:]
            ray, sampler = part.gap.ray, camera.sampler
            self._surfaces.backward(ray, sampler, part.light, own[5 : 5 + CHANNELS], part.active)
            if part.passed is not None:
                part.passed.backward(own[5 + CHANNELS :])
            pull_back(self._fields, _rays(camera, part.gap), own[:5])

    def forward(self, traced: TracedInFog) -> list[Any]:
        """The derivatives of ``outputs`` along the gradients of the parameters."""
        _require_clear(traced)
        camera, slopes = traced.camera, []
        for part in traced.parts:
            slopes += push_forward(self._fields, _rays(camera, part.gap))
            ray, sampler = part.gap.ray, camera.sampler
            slopes += self._surfaces.forward(ray, sampler, part.light, part.active)
            if part.passed is not None:
                slopes += part.passed.forward()
        return slopes

    def _random(self, camera: CameraRays) -> Any:
        """A generator for each ray, where media are uneven."""
        if not self._uneven:
            return None
        sampler, count = camera.sampler.clone(), dr.width(camera.ray)
        bits = [dr.reinterpret_array(mi.UInt32, sampler.next_1d()) for _ in range(2)]
        state = mi.sample_tea_32(dr.arange(mi.UInt32, count) ^ bits[0], bits[1])
        wide = (mi.UInt64(state[0]) << 32) | mi.UInt64(state[1])
        random = mi.PCG32(initstate=wide, initseq=dr.arange(mi.UInt64, count))
        dr.eval(random)
        return random

    def _shared(self, fog: Fog, camera: CameraRays) -> Any:
        """Which rays cross a field's box within a medium, by more than rounding."""
        ray, found = camera.ray, mi.Bool(False)
        for marched in self._fields:
            o, d, scale = marched.placed.to_local(ray.o, ray.d)
            whole = ray_segments(marched.field, o, d)
            both = ray_segments(marched.field, o, d, (fog.start * scale, fog.end * scale))
            found |= both.hit & (both.far - both.near > OVERLAP * (whole.far - whole.near))
        return fog.there & found


def _require_clear(traced: TracedInFog) -> None:
    """Refuses derivatives where fields are seen within media, at a depth that has none."""
    if any(part.within for part in traced.parts):
        raise InputError(
            "nerf: what is seen of fields within fog has no derivatives, expected fog beside "
            "their boxes"
        )


def _rays(camera: CameraRays, gap: Gap) -> Rays:
    """The camera rays within a gap."""
    ray = camera.ray
    reach = dr.fmin(gap.end, ray.maxt)
    return Rays(ray.o, ray.d, reach, camera.random, wavelengths=ray.wavelengths, start=gap.start)
