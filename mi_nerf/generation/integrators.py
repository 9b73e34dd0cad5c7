"""What is known of integrators: which one makes the colours, and whose alpha is one.

Mitsuba's path tracers say of every camera ray whether it has met anything. Others say something
else: particle tracers sum up what arrives, ``direct`` and ``prb`` count surfaces that let light
straight through, ``direct_projective`` says yes always. For them camera rays are traced once more,
up to the first surface (surfaces.py).
"""

from __future__ import annotations

from typing import Any

from ..base.errors import InputError, Option
from .emitters import ALL, Hidden

# Those that only pass on what the first one nested in them sees, beside channels of their own.
_WRAPPERS = {"AOVIntegrator": "aov", "MomentIntegrator": "moment", "StokesIntegrator": "stokes"}

_NO_COLOR = {
    "DepthIntegrator": "'depth' gives distances instead of colours",
    "BasicVolumetricPrimitiveRadianceFieldIntegrator": "'volprim_rf_basic' gives no alpha",
}

# Whose alpha is not the share of rays that meet a surface that is there.
_NO_ALPHA = (
    "DirectIntegrator",
    "ParticleTracerIntegrator",
    "PRBIntegrator",
    "BasicPRBIntegrator",
    "PathProjectiveIntegrator",
    "DirectProjectiveIntegrator",
)
# Which show light sources even if they are told not to.
_SHOW_LAMPS = ("PathProjectiveIntegrator",)
# Which know surfaces only: what covers a ray is known without them.
_SURFACES = (*_NO_ALPHA, "PathIntegrator")


def color_integrator(integrator: Any, path: object) -> Any:
    """The integrator that makes the colours: the first one nested in ``aov`` and its like.

    Raises:
        InputError: if there is none, or it makes no colours.
    """
    name = kind(integrator)
    if name in _WRAPPERS:
        nested = _first_nested(integrator)
        if nested is None:
            raise InputError(
                f"{path}: the integrator '{_WRAPPERS[name]}' nests none that gives colours, "
                "expected one, such as path"
            )
        return color_integrator(nested, path)
    if name in _NO_COLOR:
        raise InputError(f"{path}: the integrator {_NO_COLOR[name]}, expected one such as path")
    return integrator


def kind(integrator: Any) -> str:
    """The name of an integrator's class, be it of C++ or of Python."""
    own = type(integrator).__name__
    known = own in _SURFACES or own in _NO_COLOR or type(integrator).__module__ != "mitsuba"
    return own if known else str(integrator.class_name())


def needs_own_alpha(integrator: Any, hidden: Hidden) -> bool:
    """Whether the alpha of an integrator's picture is to be replaced."""
    name = kind(integrator)
    return name in _NO_ALPHA or (hidden.chosen and name in _SURFACES)


def needs_help_hiding(integrator: Any, hidden: Hidden) -> bool:
    """Whether an integrator does not hide just these light sources itself."""
    return hidden.partly or (hidden.any and kind(integrator) in _SHOW_LAMPS)


def is_adjoint(integrator: Any) -> bool:
    """Whether paths start at light sources: no part of a picture can be traced alone."""
    import mitsuba as mi

    return isinstance(integrator, mi.AdjointIntegrator)


def samples_rays(integrator: Any) -> bool:
    """Whether single camera rays of an integrator can be asked for, to the same result."""
    import mitsuba as mi

    if is_adjoint(integrator) or not isinstance(integrator, mi.SamplingIntegrator):
        return False
    base = _differentiable() if _takes_mode(integrator) else mi.SamplingIntegrator
    return bool(type(integrator).render is base.render)


def radiance(
    integrator: Any, scene: Any, sampler: Any, ray: Any, medium: Any, active: Any
) -> tuple[Any, Any]:
    """What arrives along camera rays, and whether these have met anything."""
    import drjit as dr
    import mitsuba as mi

    if not _takes_mode(integrator):
        color, valid, *_ = integrator.sample(scene, sampler, ray, medium, active)
        return color, mi.Bool(valid)
    color, valid, *_ = integrator.sample(
        mode=dr.ADMode.Primal,
        scene=scene,
        sampler=sampler,
        ray=ray,
        depth=mi.UInt32(0),
        δL=None,
        δaovs=None,
        state_in=None,
        active=active,
    )
    return color, mi.Bool(valid)


def require_choice(integrator: Any, hidden: Hidden, path: object) -> None:
    """Refuses to hide some light sources and not others from an integrator that cannot.

    Raises:
        InputError: for those that follow no camera rays, and, since the way past a light source
            is not asked for fog, for those that know fog.
    """
    can_choose = samples_rays(integrator) and kind(integrator) in _SURFACES
    if (hidden.partly and not can_choose) or (hidden.by_name and is_adjoint(integrator)):
        raise InputError(
            "{}: the integrator '{}' can show all light sources or none, expected {}",
            path,
            kind(integrator),
            Option("keep_emitters", ALL),
        )


def _takes_mode(integrator: Any) -> bool:
    return isinstance(integrator, _differentiable())


def _differentiable() -> Any:
    """Mitsuba's integrators in Python, whose rays are asked for in another way."""
    from mitsuba.python.ad.integrators.common import ADIntegrator

    return ADIntegrator


def _first_nested(integrator: Any) -> Any:
    """The first integrator nested in one of Mitsuba's own."""
    import mitsuba as mi

    found: list[Any] = []

    class Finder(mi.TraversalCallback):
        def put(self, name: str, value: Any, *_: Any) -> None:
            if isinstance(value, mi.Integrator):
                found.append(value)

        put_object = put_value = put

    integrator.traverse(Finder())
    return found[0] if found else None
