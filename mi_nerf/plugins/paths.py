"""Light paths through fields: what is behind the fields that camera rays cross first."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
from mitsuba.python.ad.integrators.common import mis_weight

from .backdrop import Backdrop, Hit, Light
from .colors import Spectrum
from .field_light import FieldLight
from .integral import see, transmittance
from .path_derivatives import Derivatives, Pull, Push
from .path_replay import Colors, Recording, Replay
from .path_state import (
    Chance,
    Connections,
    Ends,
    Image,
    Paths,
    PathSettings,
    Vertex,
    gather,
)
from .sampled import Rays, SampledField
from .vertex import Surroundings


@dataclass(frozen=True)
class PathHit(Hit):
    """The same, and where paths set out."""

    ends: Any = None  # an :class:`Ends`


@dataclass(frozen=True)
class Followed:
    """What replays one path for each of R camera rays."""

    first: Ends
    slot: Any  # the camera rays that were followed
    radiance: Any  # R colours: what the paths have brought
    shown: list[Any]  # what fields have shown to them, in order, as far as that was kept


class PathsBehind(Backdrop):
    """The scene's surfaces and lights, seen by paths that fields weaken and brighten.

    A path tracer like Mitsuba's :monosp:`path`, bounce by bounce in wavefronts: fields are
    asked in blocks, which no recorded loop can hold. Paths that have ended are left out of
    the next wavefront. Derivatives follow the same paths once more
    (:mod:`mi_nerf.plugins.path_replay`).
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
        lamps = [] if settings.field_powers is None else self._fields
        lights = FieldLight(lamps, settings.field_powers)
        self._around = Surroundings(scene, settings, lights)

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
        settings, rays, states = self._settings, dr.width(hit.distance), list[Followed]()
        total = Image(rays)
        sampler = sampler.clone()
        going = dr.compress(1 - opacity > settings.stop) if settings.max_depth else mi.UInt32()
        colors = Colors(self._around) if settings.keep else None
        for _ in range(settings.paths):
            slot = mi.UInt32(going)
            image = Image(rays) if colors is None else Recording(rays, settings.paths, colors)
            self._follow(hit.ends, slot, sampler, image)
            total.radiance += image.radiance
            total.alpha += image.alpha
            total.evaluate()
            if isinstance(image, Recording):
                states.append(Followed(hit.ends, slot, image.radiance, image.kept))
        radiance = list(total.radiance * (1 / settings.paths))
        valid = dr.fmin(total.alpha * (1 / settings.paths), 1)
        if not settings.hide_lights and self._scene.environment() is not None:
            valid = dr.full(mi.Float, 1, rays)  # as in Mitsuba's path tracer
        dr.eval(radiance, valid)
        return Light(radiance, valid, states)

    def backward(self, ray: Any, sampler: Any, light: Light, gradients: list[Any]) -> None:
        """Carries gradients of the radiance to fields, surfaces and lights."""
        gradient = Spectrum(*gradients) * (1 / self._settings.paths)
        self._replay(sampler, light, Pull(self._fields, gradient))

    def forward(self, ray: Any, sampler: Any, light: Light) -> list[Any]:
        """The derivative of the radiance along the gradients of fields, surfaces and lights."""
        push = Push(self._fields, len(light.valid))
        self._replay(sampler, light, push)
        return list(push.tangent * (1 / self._settings.paths))

    def _replay(self, sampler: Any, light: Light, derivatives: Derivatives) -> None:
        """Follows the paths that :meth:`shade` has followed, with the same random numbers."""
        sampler = sampler.clone()
        colors = Colors(self._around)
        for state in light.states:
            replay = Replay(state.radiance, state.shown, colors, derivatives)
            self._follow(state.first, state.slot, sampler, replay)
        derivatives.finish()

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
            straight=dr.full(mi.Bool, False, len(slot)),
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
            rays, lights = (
                Rays(paths.o, paths.d, pi.t, jitter, wavelengths=paths.wavelengths),
                self._around.fields,
            )
            color, opacity = image.shown(lambda: self._seen(rays))
            share = mi.Float(1)
            if lights.boxes:
                pdf = lights.pdf(paths.vertex, paths.d)
                share = dr.select(paths.delta, 1, mis_weight(paths.pdf, pdf))
            weight = paths.throughput * share
            image.add(paths.slot, weight * color)
            image.cover(paths.slot, paths.transmittance * opacity)
            through = 1 - opacity
            through = dr.select(through > dr.opaque(mi.Float, self._settings.stop), through, 0)
            paths.throughput *= through
            paths.transmittance *= through
            dr.eval(paths, weight, through)
            image.evaluate()
            image.passed(paths.slot, rays, weight, through)
        return Ends(ray, pi)

    def _seen(self, rays: Rays) -> tuple[Any, Any]:
        """Colour and opacity of the fields along rays."""
        seen = see(self._fields, rays)
        return seen.color, seen.opacity

    def _bounce(
        self, paths: Paths, ends: Ends, depth: int, chance: Chance, image: Image
    ) -> tuple[Paths, Any]:
        """Gathers light where paths meet a surface.

        Returns:
            The next segments, and which of the paths go on.
        """
        around, slot = self._around, paths.slot
        si, bsdf = around.at(ends)
        vertex = Vertex(paths, ends, depth, chance)
        image.add(slot, around.emitted(si, paths, depth))
        if depth + 1 >= self._settings.max_depth:
            image.cover(slot, dr.select(si.is_valid(), paths.transmittance, 0))
            image.evaluate()
            image.left(vertex)
            return paths, mi.Bool(False)
        active = si.is_valid() & (dr.max(paths.throughput) > 0)
        smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        every = image.every_connection
        chosen = around.choose_light(si, bsdf, paths, chance, smooth)
        emitters = around.to_emitters(si, bsdf, paths, chosen, smooth, every=every)
        fields = around.to_fields(si, bsdf, paths, chance, smooth, every=every)
        following, going = around.turn(si, bsdf, paths, depth, chance, active)
        covered = paths.transmittance - following.transmittance
        image.cover(slot, dr.select(si.is_valid(), covered, 0))
        dr.eval(emitters, fields, following, going, chosen)
        image.evaluate()
        vertex.following, vertex.going, vertex.chosen = following, going, chosen
        vertex.through = self._add_emitters(emitters, slot, chance.jitter[0], image)
        vertex.shone = self._add_fields(fields, slot, chance.jitter[1], image)
        image.left(vertex)
        return following, going

    # ---------------------------------- Connections ----------------------------------

    def _add_emitters(self, connections: Connections, slot: Any, jitter: Any, image: Image) -> Any:
        """Adds the light of emitters; returns what the fields before them let pass, N values."""
        lit, rays, light = connections.take(jitter)
        passing = dr.zeros(mi.Float, len(slot))
        if not len(lit):
            return passing
        through = dr.ones(mi.Float, len(lit))
        if self._fields:
            (through,) = image.shown(lambda: (transmittance(self._fields, rays),))
        slot = gather(slot, lit)
        image.add(slot, light * through)
        dr.scatter(passing, through, lit)
        dr.eval(passing, through, slot)
        image.evaluate()
        image.lit(slot, rays, light, through)
        return passing

    def _add_fields(
        self, connections: Connections | None, slot: Any, jitter: Any, image: Image
    ) -> Any:
        """Adds the light of fields before the first surface; returns it, N colours, if any."""
        if connections is None:
            return None
        lit, rays, weight = connections.take(jitter)
        shone = dr.zeros(Spectrum, len(slot))
        if not len(lit):
            return shone
        first = mi.Ray3f(rays.o, rays.d)
        rays.reach = self._scene.ray_intersect_preliminary(first, coherent=False).t
        dr.eval(rays.reach)
        (color, _), slot = image.shown(lambda: self._seen(rays)), gather(slot, lit)
        image.add(slot, weight * color)
        dr.scatter(shone, color, lit)
        dr.eval(shone, slot)
        image.evaluate()
        image.shone_upon(slot, rays, weight)
        return shone

    def _chance(self, sampler: Any, slot: Any) -> Chance:
        """Draws for all R camera rays, so that the sampler keeps its order; N are kept."""
        one, two = sampler.next_1d, sampler.next_2d
        jitter = [one() for _ in range(3)] if self._settings.jitter else [None] * 3
        point = mi.Point3f(*two(), one())
        chance = Chance(two(), one(), two(), one(), one(), one(), point, jitter)
        sampler.schedule_state()
        dr.eval(chance)
        return chance.take(slot)
