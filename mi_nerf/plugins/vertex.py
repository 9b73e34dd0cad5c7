"""What happens to light at the surfaces that paths meet: emitted, reflected, sent on.

With ``attached``, the results carry derivatives of colours, textures and the power of lights;
never of where things are, nor of how directions were sampled (detached sampling: Zeltner et
al. 2021). Weights of multiple importance sampling are numbers, too: as they add up to one for
every direction, derivatives stay without bias.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
from mitsuba.python.ad.integrators.common import mis_weight

from .colors import unpolarized
from .field_light import FieldLight
from .light_choice import Chosen, choose
from .path_state import Chance, Connections, Ends, Paths, PathSettings

_MOST_SURVIVE = 0.95  # of a wavefront in Russian roulette, as in Mitsuba's path tracer


@dataclass(frozen=True)
class Surroundings:
    """The surfaces and lights of a scene, and its fields as lights."""

    scene: mi.Scene
    settings: PathSettings
    fields: FieldLight

    def at(self, ends: Ends) -> tuple[Any, Any]:
        """Surface interactions where segments end, and their BSDFs."""
        si = ends.pi.compute_surface_interaction(ends.ray, mi.RayFlags.All)
        return si, si.bsdf(ends.ray)

    def emitted(self, si: Any, paths: Paths, depth: int, *, attached: bool = False) -> Any:
        """What the surfaces that were hit, or the sky, emit towards the paths."""
        before = dr.zeros(mi.Interaction3f)
        before.p = paths.vertex
        ds = mi.DirectionSample3f(self.scene, si, before)
        pdf = self.scene.pdf_emitter_direction(before, ds, ~paths.delta)
        shown = si.is_valid() | mi.Bool(depth > 0 or not self.settings.hide_lights)
        weight = mis_weight(paths.pdf, pdf)
        with dr.resume_grad(when=attached):
            return paths.throughput * weight * unpolarized(ds.emitter.eval(si, shown))

    def choose_light(self, si: Any, bsdf: Any, paths: Paths, chance: Chance, active: Any) -> Chosen:
        """The points of light sources to which surfaces are connected."""

        def brings(number: Any) -> Any:
            return dr.max(self._connect(si, bsdf, paths, number, active)[1])

        count = self.settings.emitter_candidates if self.scene.emitters() else 1
        return choose(brings, chance.emitter, chance.choice, count, active)

    def to_emitters(
        self,
        si: Any,
        bsdf: Any,
        paths: Paths,
        chosen: Chosen,
        active: Any,
        *,
        attached: bool = False,
        every: bool = False,
    ) -> Connections:
        """Towards light sources: what they would bring if no field were between.

        Args:
            every: whether connections matter that bring no light as things are.
        """
        # With ``attached``, ``active`` says already what is in sight.
        ds, light, active = self._connect(
            si, bsdf, paths, chosen.number, active, visible=not attached, attached=attached
        )
        with dr.resume_grad(when=attached):
            light = light * chosen.weight
        # Of emitters at infinity the scene says a distance, within which not all fields lie.
        infinite = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
        reach = dr.select(infinite, dr.inf, ds.dist)
        wanted = active if every else dr.max(dr.detach(light)) > 0
        return Connections(mi.Ray3f(si.p, ds.d, 0, si.wavelengths), reach, light, wanted)

    def _connect(
        self,
        si: Any,
        bsdf: Any,
        paths: Paths,
        number: Any,
        active: Any,
        *,
        visible: bool = False,
        attached: bool = False,
    ) -> tuple[Any, Any, Any]:
        """What a point of a light source, found from ``number``, brings; and for which paths.

        Args:
            visible: only where no surface is between.
        """
        ds, weight = self.scene.sample_emitter_direction(si, number, visible, active)
        active = active & (ds.pdf != 0)
        with dr.resume_grad(when=attached):
            if attached:
                power = self.scene.eval_emitter_direction(si, ds, active)
                weight = power / dr.select(active, dr.detach(ds.pdf), 1)
            value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(ds.d), active)
            share = dr.detach(dr.select(ds.delta, 1, mis_weight(ds.pdf, pdf)))
            weight = unpolarized(weight) * share
            light = dr.select(active, paths.throughput * unpolarized(value) * weight, 0)
        return ds, light, active

    def to_fields(
        self,
        si: Any,
        bsdf: Any,
        paths: Paths,
        chance: Chance,
        active: Any,
        *,
        attached: bool = False,
        every: bool = False,
    ) -> Connections | None:
        """Towards fields: by what the light that comes from there counts; or ``None``."""
        if not self.fields.boxes:
            return None
        d = self.fields.sample(si.p, chance.field, chance.field_point)
        density = self.fields.pdf(si.p, d)
        active = active & (density > 0)
        with dr.resume_grad(when=attached):
            value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(d), active)
            weight = mis_weight(density, dr.detach(pdf)) / dr.select(active, density, 1)
            light = dr.select(active, paths.throughput * unpolarized(value) * weight, 0)
        wanted = active if every else dr.max(dr.detach(light)) > 0
        return Connections(si.spawn_ray(d), mi.Float(dr.inf), light, wanted)

    def turn(
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
        if depth + 1 >= self.settings.rr_depth:
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
            wavelengths=paths.wavelengths,
            straight=straight,
            delta=mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta),
        )
        return following, going

    def turned(self, si: Any, bsdf: Any, following: Paths, chance: Chance, going: Any) -> Any:
        """By what :meth:`turn` has weighed the light that follows, relative to its value.

        That is 1, but with the derivatives of the surface's colours. Of a mirror or of glass,
        whose directions have no density, the value is the weight of the sample times the
        probability of its choice; of what lets light straight through, its transmittance.
        """
        context, straight = mi.BSDFContext(), going & following.straight
        specular = going & following.delta & ~straight
        with dr.resume_grad():
            value = bsdf.eval(context, si, si.to_local(following.d), going & ~following.delta)
            value = unpolarized(value)
            sample, weight = bsdf.sample(context, si, chance.bsdf_component, chance.bsdf, specular)
            value = dr.select(specular, unpolarized(weight) * sample.pdf, value)
            through = unpolarized(bsdf.eval_null_transmission(si, straight))
            value = dr.select(straight, through, value)
            known = dr.detach(value) > 0
            return dr.select(known, value / dr.select(known, dr.detach(value), 1), 1)
