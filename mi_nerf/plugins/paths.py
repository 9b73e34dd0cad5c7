"""Light paths through fields: what is behind the fields that camera rays cross first."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
from mitsuba.python.ad.integrators.common import mis_weight

from .backdrop import Backdrop, Hit, Light
from .colors import Spectrum, unpolarized
from .field_light import FieldLight
from .integral import see, transmittance
from .path_state import Chance, Connections, Ends, Image, Paths, PathSettings, gather
from .sampled import Rays, SampledField

_MOST_SURVIVE = 0.95  # of a wavefront in Russian roulette, as in Mitsuba's path tracer


@dataclass(frozen=True)
class PathHit(Hit):
    """The same, and where paths set out."""

    ends: Any = None  # an :class:`Ends`


class PathsBehind(Backdrop):
    """The scene's surfaces and lights, seen by paths that fields weaken and brighten.

    A path tracer like Mitsuba's :monosp:`path`, bounce by bounce in wavefronts: fields are
    asked in blocks, which no recorded loop can hold. Paths that have ended are left out of
    the next wavefront.
    """

    def __init__(
        self,
        scene: mi.Scene,
        marched: list[SampledField],
        settings: PathSettings,
        normals: bool,
    ) -> None:
        """
        Args:
            scene: without the cubes of fields.
            marched: the fields.
            normals: whether normals are wanted.
        """
        self._scene, self._settings, self._normals = scene, settings, normals
        self._fields = [field.unbounded() for field in marched]
        self._light = FieldLight(self._fields if settings.sample_fields else [])

    # ---------------------------------- What cameras see ----------------------------------

    def intersect(self, ray: Any) -> PathHit:
        """The first surface along the rays."""
        ray = mi.Ray3f(ray)
        start, pi = ray, self._scene.ray_intersect_preliminary(ray, coherent=True)
        if self._settings.hide_lights:
            start, pi = self._behind_lights(ray, pi)
        distance, normal = dr.dot(start.o - ray.o, ray.d) + pi.t, mi.Normal3f(0)
        if self._normals:
            si = pi.compute_surface_interaction(start, mi.RayFlags.All)
            normal = dr.select(si.is_valid(), si.sh_frame.n, 0)
        dr.eval(distance, normal, start, pi)
        return PathHit(distance, normal, Ends(start, pi))

    def shade(self, hit: PathHit, ray: Any, sampler: Any, opacity: Any) -> Light:
        """The radiance from there on, on average over paths."""
        settings, count = self._settings, dr.width(hit.distance)
        image = Image(dr.zeros(Spectrum, count), dr.zeros(mi.Float, count))
        dr.make_opaque(image.radiance, image.alpha)
        sampler = sampler.clone()
        going = dr.compress(1 - opacity > settings.stop) if settings.max_depth else mi.UInt32()
        for _ in range(settings.paths):
            self._follow(hit.ends, mi.UInt32(going), sampler, image)
        radiance = list(image.radiance * (1 / settings.paths))
        valid = dr.fmin(image.alpha * (1 / settings.paths), 1)
        if not settings.hide_lights and self._scene.environment() is not None:
            valid = dr.full(mi.Float, 1, count)  # as in Mitsuba's path tracer
        dr.eval(radiance, valid)
        return Light(radiance, valid)

    def _behind_lights(self, ray: Any, pi: Any) -> tuple[Any, Any]:
        """The rays behind the light sources that they hit first, and what these meet."""
        while True:
            lit = pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711  (lane by lane)
            if not dr.any(lit):
                return ray, pi
            si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, lit)
            ray = dr.select(lit, si.spawn_ray(ray.d), ray)
            further = self._scene.ray_intersect_preliminary(ray, coherent=True, active=lit)
            pi = dr.select(lit, further, pi)
            dr.eval(ray, pi)

    # ---------------------------------- Paths ----------------------------------

    def _follow(self, first: Ends, slot: Any, sampler: Any, image: Image) -> None:
        """Adds what one path for each of some camera rays brings."""
        if not len(slot):
            return
        ends = Ends(gather(first.ray, slot), gather(first.pi, slot))
        one = dr.full(mi.Float, 1, len(slot))
        paths = Paths(
            slot=slot,
            o=ends.ray.o,
            d=ends.ray.d,
            throughput=Spectrum(one),
            eta=one,
            transmittance=one,
            vertex=ends.ray.o,
            pdf=one,
            delta=dr.full(mi.Bool, True, len(slot)),
            wavelengths=ends.ray.wavelengths,
        )
        dr.make_opaque(paths, ends)
        for depth in itertools.count():
            chance = self._chance(sampler, paths.slot)
            following, going = self._bounce(paths, ends, depth, chance, image)
            alive = mi.UInt32(dr.compress(going))
            if not len(alive):
                return
            paths, jitter = following.take(alive), chance.jitter[2]
            ends = self._travel(paths, None if jitter is None else gather(jitter, alive), image)

    def _travel(self, paths: Paths, jitter: Any, image: Image) -> Ends:
        """Follows paths through the fields to the next surface."""
        ray = mi.Ray3f(paths.o, paths.d, 0, paths.wavelengths)
        pi = self._scene.ray_intersect_preliminary(ray, coherent=False)
        dr.eval(ray, pi)
        if self._fields:
            seen = see(self._fields, Rays(paths.o, paths.d, pi.t, jitter, paths.wavelengths))
            weight = mi.Float(1)
            if self._light.boxes:
                pdf = self._light.pdf(paths.vertex, paths.d)
                weight = dr.select(paths.delta, 1, mis_weight(paths.pdf, pdf))
            image.add(paths.slot, paths.throughput * weight * seen.color)
            image.cover(paths.slot, paths.transmittance * seen.opacity)
            through = 1 - seen.opacity
            through = dr.select(through > dr.opaque(mi.Float, self._settings.stop), through, 0)
            paths.throughput *= through
            paths.transmittance *= through
            dr.eval(paths, image)
        return Ends(ray, pi)

    def _bounce(
        self, paths: Paths, ends: Ends, depth: int, chance: Chance, image: Image
    ) -> tuple[Paths, Any]:
        """Gathers light where paths meet a surface.

        Returns:
            The next segments, and which of the paths go on.
        """
        si = ends.pi.compute_surface_interaction(ends.ray, mi.RayFlags.All)
        bsdf = si.bsdf(ends.ray)
        image.add(paths.slot, self._emitted(si, paths, depth))
        if depth + 1 >= self._settings.max_depth:
            image.cover(paths.slot, dr.select(si.is_valid(), paths.transmittance, 0))
            dr.eval(image)
            return paths, mi.Bool(False)
        active = si.is_valid() & (dr.max(paths.throughput) > 0)
        smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        from_emitters = self._to_emitters(si, bsdf, paths, chance, smooth)
        from_fields = self._to_fields(si, bsdf, paths, chance, smooth)
        following, going = self._turn(si, bsdf, paths, depth, chance, active)
        image.cover(
            paths.slot, dr.select(si.is_valid(), paths.transmittance - following.transmittance, 0)
        )
        dr.eval(image, from_emitters, from_fields, following, going)
        self._add_emitters(from_emitters, paths.slot, chance.jitter[0], image)
        self._add_fields(from_fields, paths.slot, chance.jitter[1], image)
        return following, going

    def _emitted(self, si: Any, paths: Paths, depth: int) -> Any:
        """What the surfaces that were hit, or the sky, emit towards the paths."""
        before = dr.zeros(mi.Interaction3f)
        before.p = paths.vertex
        ds = mi.DirectionSample3f(self._scene, si, before)
        pdf = self._scene.pdf_emitter_direction(before, ds, ~paths.delta)
        shown = si.is_valid() | mi.Bool(depth > 0 or not self._settings.hide_lights)
        emitted = unpolarized(ds.emitter.eval(si, shown))
        return paths.throughput * mis_weight(paths.pdf, pdf) * emitted

    def _to_emitters(
        self, si: Any, bsdf: Any, paths: Paths, chance: Chance, active: Any
    ) -> Connections:
        """Towards light sources: what they would bring if no field were between."""
        ds, weight = self._scene.sample_emitter_direction(si, chance.emitter, True, active)
        active = active & (ds.pdf != 0)
        value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(ds.d), active)
        weight = unpolarized(weight) * dr.select(ds.delta, 1, mis_weight(ds.pdf, pdf))
        light = dr.select(active, paths.throughput * unpolarized(value) * weight, 0)
        # Of emitters at infinity the scene says a distance, within which not all fields lie.
        infinite = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
        return Connections(
            mi.Ray3f(si.p, ds.d, 0, si.wavelengths), dr.select(infinite, dr.inf, ds.dist), light
        )

    def _to_fields(
        self, si: Any, bsdf: Any, paths: Paths, chance: Chance, active: Any
    ) -> Connections | None:
        """Towards fields: by what the light that comes from there counts."""
        if not self._light.boxes:
            return None
        d = self._light.sample(si.p, chance.field, chance.field_point)
        density = self._light.pdf(si.p, d)
        active = active & (density > 0)
        value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(d), active)
        weight = mis_weight(density, pdf) / dr.select(active, density, 1)
        light = dr.select(active, paths.throughput * unpolarized(value) * weight, 0)
        return Connections(si.spawn_ray(d), mi.Float(dr.inf), light)

    def _turn(
        self, si: Any, bsdf: Any, paths: Paths, depth: int, chance: Chance, active: Any
    ) -> tuple[Paths, Any]:
        """The segments after the surface, and which paths go on with them."""
        sample, weight = bsdf.sample(
            mi.BSDFContext(), si, chance.bsdf_component, chance.bsdf, active
        )
        ray = si.spawn_ray(si.to_world(sample.wo))
        throughput, eta = paths.throughput * unpolarized(weight), paths.eta * sample.eta
        strongest = dr.max(throughput)
        going = active & (strongest > 0)
        if depth + 1 >= self._settings.rr_depth:
            # Less often where refraction has only spread the light out.
            survival = dr.fmin(strongest * dr.square(eta), _MOST_SURVIVE)
            going &= chance.roulette < survival
            throughput /= dr.select(going, survival, 1)
        straight = active & mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
        following = Paths(
            slot=paths.slot,
            o=ray.o,
            d=ray.d,
            throughput=throughput,
            eta=eta,
            transmittance=dr.select(straight, paths.transmittance, 0),
            vertex=si.p,
            pdf=sample.pdf,
            delta=mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta),
            wavelengths=paths.wavelengths,
        )
        return following, going

    # ---------------------------------- Connections ----------------------------------

    def _add_emitters(self, connections: Connections, slot: Any, jitter: Any, image: Image) -> None:
        """Adds the light of emitters, weakened by the fields before them."""
        lit, rays, light = connections.take(jitter)
        if not len(lit):
            return
        if self._fields:
            light *= transmittance(self._fields, rays)
        image.add(gather(slot, lit), light)
        dr.eval(image)

    def _add_fields(
        self, connections: Connections | None, slot: Any, jitter: Any, image: Image
    ) -> None:
        """Adds the light of fields before the first surface."""
        if connections is None:
            return
        lit, rays, light = connections.take(jitter)
        if not len(lit):
            return
        first = mi.Ray3f(rays.o, rays.d)
        rays.reach = self._scene.ray_intersect_preliminary(first, coherent=False).t
        dr.eval(rays.reach)
        image.add(gather(slot, lit), light * see(self._fields, rays).color)
        dr.eval(image)

    def _chance(self, sampler: Any, slot: Any) -> Chance:
        """Draws for all R camera rays, so that the sampler keeps its order; N are kept."""
        one, two = sampler.next_1d, sampler.next_2d
        jitter = [one() for _ in range(3)] if self._settings.jitter else [None] * 3
        point = mi.Point3f(*two(), one())
        chance = Chance(two(), two(), one(), one(), one(), point, jitter)
        sampler.schedule_state()
        dr.eval(chance)
        return chance.take(slot)
