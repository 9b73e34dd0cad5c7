"""Media of Mitsuba's own beside the fields: where rays pass them, and what they let through."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .colors import Spectrum
from .placement import is_field

_TRACKINGS = 4  # estimates of what an uneven medium lets through, of which the mean is taken
_POINTS = 4  # at which an uneven medium is asked how that changes
OVERLAP = 1e-3  # of a ray's part in a field's box that a medium may share with it, by rounding


@dataclass(frozen=True)
class Gap:
    """What R rays pass between two media, before the first one, or within one.

    Fields are looked for in each of them on its own.
    """

    start: Any  # distances along the camera rays
    end: Any  # of a medium, of a surface, or infinite; the start where a ray has no such gap
    there: Any  # whether it has
    ray: Any  # from where what is behind the fields counts: the start, or their place in a medium


@dataclass(frozen=True)
class Fog:
    """What R rays pass within one medium."""

    medium: Any
    start: Any
    end: Any
    there: Any


@dataclass(frozen=True)
class Way:
    """How R rays come through media to the first surface."""

    gaps: list[Gap]  # at least one
    fogs: list[list[Fog]]  # before each gap but the first; the last ones may be before none
    distance: Any  # of the surface, infinite where there is none
    normal: Any  # of the surface, 0 where there is none


def media_of(scene: mi.Scene) -> list[tuple[Any, Any]]:
    """Shapes of a scene with media other than fields, and these."""
    return [
        (shape, medium)
        for shape in scene.shapes()
        for medium in (shape.interior_medium(), shape.exterior_medium())
        if medium is not None and not is_field(medium)
    ]


def distinct_media(scene: mi.Scene) -> list[Any]:
    """Media other than fields, each of them once."""
    found: list[Any] = []
    for _, medium in media_of(scene):
        if not any(medium is other or medium == other for other in found):
            found.append(medium)
    return found


def find_way(scene: mi.Scene, ray: Any) -> Way:
    """Follows rays that begin outside of all media through surfaces that only bound these.

    Such surfaces have the BSDF ``null``; at any other, rays end, also within a medium.

    Args:
        scene: without the cubes of fields.
    """
    walk = _Walk(scene, ray)
    gaps, fogs = [walk.gap()], []
    while dr.any(walk.going):
        fogs.append(walk.fogs())
        if not dr.any(walk.going):
            break
        gaps.append(walk.gap())
    return Way(gaps, fogs, walk.distance, walk.normal)


class _Walk:
    """R rays on their way."""

    def __init__(self, scene: mi.Scene, ray: Any) -> None:
        count = dr.width(ray)
        self._scene, self._o, self._ray = scene, ray.o, mi.Ray3f(ray)
        self._t, self._medium = dr.zeros(mi.Float, count), dr.zeros(mi.MediumPtr, count)
        self.going = dr.full(mi.Bool, True, count)
        self.distance, self.normal = dr.full(mi.Float, dr.inf, count), dr.zeros(mi.Normal3f, count)
        dr.make_opaque(self._t, self._medium, self.going, self.distance, self.normal)

    def gap(self) -> Gap:
        """On to the next medium."""
        start, ray, there = self._t, mi.Ray3f(self._ray), self.going
        end = start
        moving = there & (self._medium == None)  # noqa: E711  (lane by lane)
        while dr.any(moving):
            reached = self._step(moving)
            end = dr.select(moving, reached, end)
            moving = moving & self.going & (self._medium == None)  # noqa: E711
            dr.eval(end, moving)
        return Gap(start, end, there, ray)

    def fogs(self) -> list[Fog]:
        """On through one medium or several to where there is none."""
        found = []
        moving = self.going & (self._medium != None)  # noqa: E711
        while dr.any(moving):
            start, medium = self._t, self._medium
            end = self._step(moving)
            dr.eval(end)
            found.append(Fog(medium, start, end, moving))
            moving = moving & self.going & (self._medium != None)  # noqa: E711
            dr.eval(moving)
        return found

    def _step(self, active: Any) -> Any:
        """On to the next surface, and behind it if that is nothing but the end of a medium.

        Returns:
            Its distance from the camera.
        """
        ray = self._ray
        si = self._scene.ray_intersect(ray, mi.RayFlags.All, coherent=True, active=active)
        here = active & si.is_valid()
        flags = si.bsdf(mi.RayDifferential3f(ray)).flags()
        seen = mi.has_flag(flags, mi.BSDFFlags.Smooth)
        for flag in (mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission):
            seen |= mi.has_flag(flags, flag)
        seen |= ~mi.has_flag(flags, mi.BSDFFlags.Null) | (si.shape.emitter() != None)  # noqa: E711
        passed, ended = here & ~seen, here & seen
        reached = dr.select(here, self._t + si.t, dr.inf)
        changes = passed & si.is_medium_transition()
        self._medium = dr.select(changes, si.target_medium(ray.d), self._medium)
        behind = si.spawn_ray(ray.d)
        self._t = dr.select(passed, dr.dot(behind.o - self._o, ray.d), self._t)
        self._ray = mi.Ray3f(ray)
        self._ray.o = dr.select(passed, behind.o, ray.o)
        self._ray.maxt = dr.select(passed, ray.maxt - si.t, ray.maxt)
        self.distance = dr.select(ended, reached, self.distance)
        self.normal = dr.select(ended, si.sh_frame.n, self.normal)
        self.going = self.going & (~active | passed)
        dr.eval(self._t, self._medium, self._ray, self.distance, self.normal, self.going)
        return reached


class Passed:
    """The share of light that the media before a gap let pass along R rays."""

    def __init__(self, fogs: list[Fog], ray: Any, going: Any, random: Any, uneven: bool) -> None:
        """
        Args:
            fogs: that are passed one after the other.
            ray: from the camera.
            going: which of the rays reach the gap.
            random: a generator for each ray, where media are uneven.
            uneven: whether any is heterogeneous.
        """
        self._fogs, self._ray, self._going = fogs, ray, going
        self._uneven = uneven
        share = Spectrum(1)
        for fog in fogs:
            there = fog.there & going
            even = there & fog.medium.is_homogeneous() if uneven else there
            share *= dr.select(even, dr.exp(-self._depth(fog, even, [0.5])), 1)
            if uneven:
                share *= _tracked(fog, ray, there & ~even, random)
        self.share = list(share)
        self._points = [random.next_float32() for _ in range(_POINTS)] if uneven else [0.5]
        dr.eval(self.share, self._points)

    def backward(self, gradients: list[Any]) -> None:
        """Carries gradients of the share to the media."""
        with dr.resume_grad():
            for value, gradient in zip(self._attached(), gradients, strict=True):
                if dr.grad_enabled(value):
                    dr.set_grad(value, gradient)
                    dr.enqueue(dr.ADMode.Backward, value)
            # What leads from here to a grid of numbers is needed again.
            dr.traverse(dr.ADMode.Backward, dr.ADFlag.ClearVertices)

    def forward(self) -> list[Any]:
        """The derivatives of the share along the gradients of the media."""
        with dr.resume_grad():
            values = self._attached()
            dr.forward_to(values, flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad)
            return [dr.grad(value) for value in values]

    def _attached(self) -> list[Any]:
        """The share with the history of the media.

        Its derivative is −T ∫ dσ: that of uneven media is asked for at random points, which
        were not those that led to T.
        """
        depth = Spectrum(0)
        for fog in self._fogs:
            there = fog.there & self._going
            depth += dr.select(there, self._depth(fog, there, self._points), 0)
        return [t * dr.exp(dr.detach(x) - x) for t, x in zip(self.share, depth, strict=True)]

    def _depth(self, fog: Fog, there: Any, points: list[Any]) -> Any:
        """The optical depth: exact of an even medium, else an estimate."""
        length = dr.select(there, fog.end - fog.start, 0)
        total = Spectrum(0)
        for u in points:
            at = dr.zeros(mi.MediumInteraction3f, dr.width(length))
            at.t, at.wavelengths = fog.start + u * length, self._ray.wavelengths
            at.p = self._ray(at.t)
            _, _, extinction = fog.medium.get_scattering_coefficients(at, there)
            total += extinction * (length / len(points))
        return total


def _tracked(fog: Fog, ray: Any, there: Any, random: Any) -> Any:
    """Transmittance by ratio tracking (Novák et al. 2014): a random number, right on average."""
    total = Spectrum(0)
    for _ in range(_TRACKINGS):
        part = mi.Ray3f(ray)
        part.o, part.maxt = ray(fog.start), dr.select(there, fog.end - fog.start, 0)
        share = Spectrum(dr.full(mi.Float, 1, dr.width(there)))
        going = mi.Bool(there)

        def body(part: Any, share: Any, going: Any, random: Any) -> Any:
            at = fog.medium.sample_interaction(part, random.next_float32(), 0, going)
            going &= at.is_valid() & (at.t < part.maxt)
            share = dr.select(going, share * at.sigma_n / at.combined_extinction, share)
            part.o = dr.select(going, at.p, part.o)
            part.maxt = dr.select(going, part.maxt - at.t, part.maxt)
            going &= dr.max(share) > 0
            return part, share, going, random

        _, share, _, after = dr.while_loop(
            (part, share, going, random), lambda part, share, going, random: going, body
        )
        random.state = after.state
        total += share
        dr.eval(total, random)
    return total / _TRACKINGS
