"""What stands in front of, among and behind the fields: surfaces, or only an environment."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
from mitsuba.ad.integrators.common import ADIntegrator, RBIntegrator

from ..base.color import linear_to_srgb
from ..base.errors import InputError
from .placement import is_field


@dataclass
class Behind:
    """What camera rays meet where fields do not stop them."""

    distance: Any = None  # to the first surface, infinite where there is none; None: nowhere
    normal: Any = None  # of that surface, in world coordinates; 0 where there is none
    radiance: list[Any] = dataclasses.field(default_factory=list)  # R, G, B
    valid: Any = None  # 1 where there is something opaque, to the film's alpha channel
    states: Any = None  # of the nested integrator, which some need for derivatives


class Backdrop(ABC):
    """All that is no field: says first how far fields can be seen, then what is behind them."""

    @abstractmethod
    def meet(self, ray: Any) -> Behind:
        """Distance and normal of what the rays meet first."""

    @abstractmethod
    def look(self, behind: Behind, ray: Any, sampler: Any, opacity: Any) -> None:
        """Fills in the radiance from there, and ``valid``.

        Args:
            behind: what :meth:`meet` returned.
            opacity: of the fields before it, which says how much the radiance matters. The
                radiance is what arrives without them.
        """

    @abstractmethod
    def backward(self, ray: Any, sampler: Any, seen: Behind, gradients: list[Any]) -> None:
        """Carries gradients of the radiance to the parameters of surfaces and lights."""

    @abstractmethod
    def forward(self, ray: Any, sampler: Any, seen: Behind) -> list[Any]:
        """The derivative of the radiance along the gradients of surfaces and lights."""


class Environment(Backdrop):
    """The environment emitter, infinitely far away, or black."""

    def __init__(self, scene: mi.Scene, visible: bool, encoded: bool) -> None:
        """With ``encoded``, radiance is turned into sRGB."""
        self._emitter = scene.environment() if visible else None
        self._encoded = encoded

    def meet(self, ray: Any) -> Behind:
        """Nothing, at any distance."""
        return Behind()

    def look(self, behind: Behind, ray: Any, sampler: Any, opacity: Any) -> None:
        """Radiance from along the rays."""
        behind.radiance, behind.valid = self._radiance(ray), mi.Float(0)

    def backward(self, ray: Any, sampler: Any, seen: Behind, gradients: list[Any]) -> None:
        """Carries gradients of the radiance to the emitter."""
        with dr.resume_grad():
            _backward(self._radiance(ray), gradients)

    def forward(self, ray: Any, sampler: Any, seen: Behind) -> list[Any]:
        """The derivative of the radiance along the gradients of the emitter."""
        with dr.resume_grad():
            return _forward(self._radiance(ray))

    def _radiance(self, ray: Any) -> list[Any]:
        if self._emitter is None:
            return [mi.Float(0)] * 3
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray))
        si.wi = -ray.d
        radiance = list(self._emitter.eval(si))
        return [linear_to_srgb(c) for c in radiance] if self._encoded else radiance


class Surfaces(Backdrop):
    """All shapes but the cubes of fields, as a nested integrator shows them."""

    def __init__(
        self, scene: mi.Scene, integrator: mi.SamplingIntegrator, paths: int, normals: bool
    ) -> None:
        """
        Args:
            scene: without the cubes, see :class:`SolidScene`.
            paths: how often the integrator is asked about every ray.
            normals: whether normals are wanted.
        """
        self._scene, self._integrator = scene, integrator
        self._paths, self._normals = paths, normals

    def meet(self, ray: Any) -> Behind:
        """The first surface along the rays."""
        if not self._normals:
            pi = self._scene.ray_intersect_preliminary(mi.Ray3f(ray), coherent=True)
            behind = Behind(pi.t, mi.Normal3f(0))
        else:
            si = self._scene.ray_intersect(mi.Ray3f(ray), mi.RayFlags.All, coherent=True)
            behind = Behind(si.t, dr.select(si.is_valid(), si.sh_frame.n, 0))
        dr.eval(behind.distance, behind.normal)
        return behind

    def look(self, behind: Behind, ray: Any, sampler: Any, opacity: Any) -> None:
        """What the nested integrator returns for the rays, on average."""
        total, states, valid = mi.Color3f(0), [], mi.Bool(False)
        sampler = sampler.clone()
        for _ in range(self._paths):
            radiance, valid, state = self._sample(dr.ADMode.Primal, ray, sampler)
            total += radiance
            states.append(state)
            sampler.schedule_state()
            dr.eval(total, valid, state)
        behind.radiance = list(total * (1 / self._paths))
        behind.valid, behind.states = dr.select(valid, mi.Float(1), 0), states
        dr.eval(behind.radiance, behind.valid)

    def backward(self, ray: Any, sampler: Any, seen: Behind, gradients: list[Any]) -> None:
        """Carries gradients of the radiance to the parameters of surfaces and lights."""
        if not self._differentiable():
            return
        pull = mi.Color3f(*gradients) * (1 / self._paths)
        sampler = sampler.clone()
        for state in seen.states:
            if isinstance(self._integrator, RBIntegrator):
                self._sample(dr.ADMode.Backward, ray, sampler, pull, state)
            else:
                with dr.resume_grad(), _differentiable_loops():
                    radiance, *_ = self._sample(dr.ADMode.Backward, ray, sampler)
                    _backward(list(radiance), list(pull))
            sampler.schedule_state()
            dr.eval()

    def forward(self, ray: Any, sampler: Any, seen: Behind) -> list[Any]:
        """The derivative of the radiance along the gradients of surfaces and lights."""
        total = dr.zeros(mi.Color3f, dr.width(ray))
        if not self._differentiable():
            return list(total)
        sampler = sampler.clone()
        for state in seen.states:
            if isinstance(self._integrator, RBIntegrator):
                total += self._sample(dr.ADMode.Forward, ray, sampler, None, state)[0]
            else:
                with dr.resume_grad(), _differentiable_loops():
                    radiance, *_ = self._sample(dr.ADMode.Forward, ray, sampler)
                    total += mi.Color3f(*_forward(list(radiance)))
            sampler.schedule_state()
            dr.eval(total)
        return list(total * (1 / self._paths))

    def _differentiable(self) -> bool:
        """Whether any parameter has a gradient: some integrators refuse to work without."""
        with dr.resume_grad():
            return bool(dr.grad_enabled([value for _, value in mi.traverse(self._scene)]))

    def _sample(
        self, mode: dr.ADMode, ray: Any, sampler: Any, pull: Any = None, state: Any = None
    ) -> tuple[Any, Any, Any]:
        """Radiance, validity and state of one path a ray."""
        scene = self._scene
        if not isinstance(self._integrator, ADIntegrator):
            radiance, valid, _ = self._integrator.sample(scene, sampler, ray, None, True)
            return radiance, valid, None
        radiance, valid, _, state = self._integrator.sample(
            mode=mode,
            scene=scene,
            sampler=sampler,
            ray=ray,
            depth=mi.UInt32(0),
            δL=pull,
            δaovs=None,
            state_in=state,
            active=mi.Bool(True),
        )
        return radiance, valid, state


class SolidScene:
    """A scene without the cubes of its fields; made again when shapes have changed.

    A path tracer must not meet the cubes: even with a ``null`` BSDF they cast shadows on
    whatever they contain.
    """

    def __init__(self) -> None:
        self._made_of: list[Any] = []
        self._scene: mi.Scene | None = None

    def of(self, scene: mi.Scene) -> mi.Scene:
        """The scene, less its cubes, in its present state."""
        parts = [
            part
            for part in _parts(scene)
            if isinstance(part, mi.Shape | mi.Emitter) and not _holds_field(part)
        ]
        lights = [v for part in parts for v in _parts(part) if isinstance(v, mi.Emitter)]
        made_of = [v for part in parts + lights for v in (part, *_parts(part))]
        if self._scene is None or not _same(made_of, self._made_of):
            props = mi.Properties("scene")
            for i, part in enumerate(parts):
                props[f"part_{i}"] = part
            self._scene, self._made_of = mi.Scene(props), made_of
        return self._scene


def check_nested(integrator: Any) -> None:
    """Refuses integrators that cannot say what is seen along a ray.

    Raises:
        InputError: naming the integrator.
    """
    name = integrator.class_name()
    if not isinstance(integrator, mi.SamplingIntegrator):
        raise InputError(
            f"nerf: nested integrator '{name}' cannot look along single rays, "
            "expected one like 'path' or 'prb'"
        )
    if integrator.aov_names():
        raise InputError(
            f"nerf: nested integrator '{name}' has channels of its own, "
            "expected one like 'path' or 'prb', and 'aovs' on the integrator 'nerf'"
        )


def has_surfaces(scene: mi.Scene) -> bool:
    """Whether a scene holds any shape but cubes of fields."""
    return not all(_holds_field(shape) for shape in scene.shapes())


def check_no_loose_field(scene: mi.Scene) -> None:
    """Refuses a field that is part of the scene, but not of any of its shapes.

    Raises:
        InputError: naming it.
    """
    for part in _parts(scene):
        if isinstance(part, mi.Medium) and is_field(part):
            raise InputError(
                f"nerfmedium: '{part.id()}' is in no shape, expected the interior of a 'cube'"
            )


def _holds_field(part: Any) -> bool:
    return isinstance(part, mi.Shape) and is_field(part.interior_medium())


class _Children(mi.TraversalCallback):
    """Takes down everything that an object says it consists of."""

    def __init__(self, node: Any) -> None:
        super().__init__()
        self._node = node
        self.values: list[Any] = []

    def put(self, name: str, value: Any, flags: Any = None, kind: Any = None) -> None:
        """Called by the object."""
        self.values.append(value if kind is None else mi.get_property(value, kind, self._node))


def _parts(node: Any) -> list[Any]:
    """Objects and values, without history, that an object consists of."""
    children = _Children(node)
    node.traverse(children)
    return [dr.detach(value) for value in children.values]


def _same(a: list[Any], b: list[Any]) -> bool:
    """Whether lists hold the very same objects and arrays, not just equal ones."""
    return len(a) == len(b) and all(
        x is y or (type(x) is type(y) and _identity(x) == _identity(y))
        for x, y in zip(a, b, strict=True)
    )


def _identity(value: Any) -> Any:
    """What tells a value from all others that are alive."""
    if isinstance(value, mi.Object):
        return id(value)
    if isinstance(value, mi.Transform4f):
        value = value.matrix
    if not dr.is_jit_v(value):
        return value
    return [_identity(v) for v in value] if dr.depth_v(value) > 1 else value.index


@contextmanager
def _differentiable_loops() -> Iterator[None]:
    """Loops step by step: recorded ones of Mitsuba's C++ integrators have no adjoint."""
    with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False):
        yield


def _backward(values: list[Any], gradients: list[Any]) -> None:
    for value, gradient in zip(values, gradients, strict=True):
        if dr.grad_enabled(value):
            dr.accum_grad(value, gradient)
            dr.enqueue(dr.ADMode.Backward, value)
    dr.traverse(dr.ADMode.Backward)


def _forward(values: list[Any]) -> list[Any]:
    dr.forward_to(values, flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad)
    return [dr.grad(value) for value in values]
