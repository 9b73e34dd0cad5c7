"""What stands in front of, among and behind the fields: surfaces, or only an environment."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi

from ..base.color import linear_to_srgb
from ..base.errors import InputError
from .colors import CHANNELS, Spectrum, polarized, unpolarized
from .media import distinct_media

# What may be nested, by name of the class (after a change of variant, Mitsuba may hold a class of
# its own twice). Each returns the radiance along a ray, knows nothing of other rays, and has
# derivatives that tests compare with finite differences.
_RECORDED = {  # C++, differentiated by recording the paths
    "PathIntegrator": "path",
    "DirectIntegrator": "direct",
    "VolumetricPathIntegrator": "volpath",
    "VolpathMisIntegratorImpl": "volpathmis",
}
_REPLAYED = {  # Python, differentiated by following the same paths once more
    "PRBIntegrator": "prb",
    "BasicPRBIntegrator": "prb_basic",
    "PathProjectiveIntegrator": "prb_projective",
    "PRBVolpathIntegrator": "prbvolpath",
}


_OF_MEDIA = ("VolumetricPathIntegrator", "VolpathMisIntegratorImpl", "PRBVolpathIntegrator")


@dataclass(frozen=True)
class Hit:
    """Where camera rays end: at the first surface, or nowhere."""

    distance: Any = None  # infinite where there is no surface; None: nowhere at all
    normal: Any = None  # of the surface, in world coordinates; 0 where there is none


@dataclass(frozen=True)
class Light:
    """What arrives from there, as if no fields were before it."""

    radiance: list[Any]  # one array for each colour of the variant
    valid: Any  # 1 where there is something opaque, to the film's alpha channel
    states: list[Any] = field(default_factory=list)  # of the nested integrator, path by path


class Backdrop(ABC):
    """All that is no field: says first how far fields can be seen, then what is behind them."""

    @abstractmethod
    def intersect(self, ray: Any) -> Hit:
        """Distance and normal of the surface that rays meet first."""

    @abstractmethod
    def shade(self, hit: Any, ray: Any, sampler: Any, opacity: Any) -> Light:
        """The light that comes from there.

        Args:
            hit: what :meth:`intersect` returned.
            opacity: of the fields before it, which says how much the light matters.
        """

    def backward(self, ray: Any, sampler: Any, light: Light, gradients: list[Any]) -> None:
        """Carries gradients of the radiance to the parameters of surfaces and lights."""
        raise NotImplementedError

    def forward(self, ray: Any, sampler: Any, light: Light) -> list[Any]:
        """The derivative of the radiance along the gradients of surfaces and lights."""
        raise NotImplementedError


class Environment(Backdrop):
    """The environment emitter, infinitely far away, or black."""

    def __init__(self, scene: mi.Scene, visible: bool, encoded: bool) -> None:
        """With ``encoded``, radiance is turned into sRGB."""
        self._emitter = scene.environment() if visible else None
        self._encoded = encoded

    def intersect(self, ray: Any) -> Hit:
        """Nothing, at any distance."""
        return Hit()

    def shade(self, hit: Hit, ray: Any, sampler: Any, opacity: Any) -> Light:
        """Radiance from along the rays."""
        return Light(self._radiance(ray), mi.Float(0))

    def backward(self, ray: Any, sampler: Any, light: Light, gradients: list[Any]) -> None:
        """Carries gradients of the radiance to the emitter."""
        with dr.resume_grad():
            _backward(self._radiance(ray), gradients)

    def forward(self, ray: Any, sampler: Any, light: Light) -> list[Any]:
        """The derivative of the radiance along the gradients of the emitter."""
        with dr.resume_grad():
            return _forward(self._radiance(ray))

    def _radiance(self, ray: Any) -> list[Any]:
        if self._emitter is None:
            return [mi.Float(0)] * CHANNELS
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray))
        si.wi, si.wavelengths = -ray.d, ray.wavelengths
        radiance = list(unpolarized(self._emitter.eval(si)))
        return [linear_to_srgb(c) for c in radiance] if self._encoded else radiance


class Surfaces(Backdrop):
    """All shapes but the cubes of fields, as a nested integrator shows them."""

    def __init__(
        self, scene: mi.Scene, integrator: mi.SamplingIntegrator, paths: int, normals: bool
    ) -> None:
        """
        Args:
            scene: without the cubes, see :class:`mi_nerf.plugins.solid_scene.SolidScene`.
            paths: how often the integrator is asked about every ray.
            normals: whether normals are wanted.
        """
        self._scene, self._integrator = scene, integrator
        self._replayed = _class_name(integrator) in _REPLAYED
        self._paths, self._normals = paths, normals
        self._media = distinct_media(scene)

    def intersect(self, ray: Any) -> Hit:
        """The first surface along the rays."""
        if not self._normals:
            pi = self._scene.ray_intersect_preliminary(mi.Ray3f(ray), coherent=True)
            hit = Hit(pi.t, mi.Normal3f(0))
        else:
            si = self._scene.ray_intersect(mi.Ray3f(ray), mi.RayFlags.All, coherent=True)
            hit = Hit(si.t, dr.select(si.is_valid(), si.sh_frame.n, 0))
        dr.eval(hit.distance, hit.normal)
        return hit

    def shade(
        self,
        hit: Hit,
        ray: Any,
        sampler: Any,
        opacity: Any,
        active: Any = True,
        medium: Any = None,
    ) -> Light:
        """What the nested integrator returns for the rays, on average; 0 if not active.

        Args:
            medium: in which each ray begins; without, in none.
        """
        total, states, valid = Spectrum(0), [], mi.Bool(False)
        sampler = sampler.clone()
        for _ in range(self._paths):
            radiance, valid, state = self._sample(
                dr.ADMode.Primal, ray, sampler, active, medium=medium
            )
            total += radiance
            states.append(state)
            sampler.schedule_state()
            dr.eval(total, valid, state)
        light = Light(list(total * (1 / self._paths)), dr.select(valid, mi.Float(1), 0), states)
        dr.eval(light.radiance, light.valid)
        return light

    def backward(
        self, ray: Any, sampler: Any, light: Light, gradients: list[Any], active: Any = True
    ) -> None:
        if not self._differentiable():
            return
        pull = Spectrum(*gradients) * (1 / self._paths)
        sampler = sampler.clone()
        for state in light.states:
            if self._replayed:
                self._sample(dr.ADMode.Backward, ray, sampler, active, pull, state)
            else:
                with dr.resume_grad(), _differentiable_loops():
                    radiance, *_ = self._sample(dr.ADMode.Backward, ray, sampler, active)
                    _backward(list(radiance), list(pull))
            sampler.schedule_state()
            dr.eval()

    def forward(self, ray: Any, sampler: Any, light: Light, active: Any = True) -> list[Any]:
        total = dr.zeros(Spectrum, dr.width(ray))
        if not self._differentiable():
            return list(total)
        if _class_name(self._integrator) == "PRBVolpathIntegrator":
            raise InputError(
                "nerf: nested integrator 'prbvolpath' has no derivatives in forward mode, "
                "expected 'volpath' or 'prb'"
            )
        sampler = sampler.clone()
        for state in light.states:
            if self._replayed:
                total += self._sample(dr.ADMode.Forward, ray, sampler, active, None, state)[0]
            else:
                with dr.resume_grad(), _differentiable_loops():
                    radiance, *_ = self._sample(dr.ADMode.Forward, ray, sampler, active)
                    total += Spectrum(*_forward(list(radiance)))
            sampler.schedule_state()
            dr.eval(total)
        return list(total * (1 / self._paths))

    def _differentiable(self) -> bool:
        """Whether any parameter has a gradient: some integrators refuse to work without."""
        with dr.resume_grad():
            found = bool(dr.grad_enabled([value for _, value in mi.traverse(self._scene)]))
        if found and self._replayed and mi.is_polarized:
            # Measured with Mitsuba 3.9.1: they stop at derivatives of Mueller matrices.
            name = _REPLAYED[_class_name(self._integrator)]
            raise InputError(
                f"nerf: nested integrator '{name}' has no derivatives in polarised variants, "
                "expected 'path'"
            )
        return found

    def _sample(
        self,
        mode: dr.ADMode,
        ray: Any,
        sampler: Any,
        active: Any,
        pull: Any = None,
        state: Any = None,
        medium: Any = None,
    ) -> tuple[Any, Any, Any]:
        """Radiance, validity and state of one path a ray."""
        scene = self._scene
        if medium is not None:
            return *self._sample_within(medium, ray, sampler, active), None
        if not self._replayed:
            radiance, valid, _ = self._integrator.sample(scene, sampler, ray, None, active)
            return unpolarized(radiance), valid, None
        radiance, valid, _, state = self._integrator.sample(
            mode=mode,
            scene=scene,
            sampler=sampler,
            ray=ray,
            depth=mi.UInt32(0),
            δL=None if pull is None else polarized(pull),
            δaovs=None,
            state_in=state,
            active=mi.Bool(active),
        )
        return unpolarized(radiance), valid, state

    def _sample_within(self, medium: Any, ray: Any, sampler: Any, active: Any) -> tuple[Any, Any]:
        """Radiance and validity of one path a ray, each of which begins in a medium."""
        if self._replayed:
            name = _REPLAYED[_class_name(self._integrator)]
            raise InputError(
                f"nerf: a field lies within a medium, where nested integrator '{name}' cannot "
                "begin a path, expected 'volpath' or 'volpathmis'"
            )
        radiance, valid = Spectrum(0), mi.Bool(False)
        for one in self._media:
            here = active & (medium == mi.MediumPtr(one))
            found, reached, _ = self._integrator.sample(self._scene, sampler, ray, one, here)
            radiance += dr.select(here, unpolarized(found), 0)
            valid |= here & reached
        return radiance, valid


def knows_media(integrator: Any) -> bool:
    """Whether a nested integrator shows media."""
    return integrator is not None and _class_name(integrator) in _OF_MEDIA


def check_nested(integrator: Any) -> None:
    """Refuses integrators that cannot say what is seen along a ray, and how that changes.

    Raises:
        InputError: naming the integrator.
    """
    name, known = _class_name(integrator), _RECORDED | _REPLAYED
    if name not in known:
        raise InputError(f"nerf: nested integrator '{name}', expected {', '.join(known.values())}")


def _class_name(integrator: Any) -> str:
    """The name of an integrator's class, in C++ or Python."""
    name = type(integrator).__name__
    return name if name in _REPLAYED else str(integrator.class_name())


def _differentiable_loops() -> Any:
    """Loops step by step: recorded ones of Mitsuba's C++ integrators have no adjoint."""
    return dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False)


def _backward(values: list[Any], gradients: list[Any]) -> None:
    for value, gradient in zip(values, gradients, strict=True):
        if dr.grad_enabled(value):
            dr.accum_grad(value, gradient)
            dr.enqueue(dr.ADMode.Backward, value)
    dr.traverse(dr.ADMode.Backward, dr.ADFlag.ClearVertices)  # other passes take the same way


def _forward(values: list[Any]) -> list[Any]:
    dr.forward_to(values, flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad)
    return [dr.grad(value) for value in values]
