"""The Mitsuba plugins of radiance fields, and the way of a camera ray through them.

Integrators ``nerf``, ``nerf_path`` and ``nerf_tracking``, the medium ``nerfmedium``, and the sensor
``nerfviews`` for all views of a dataset.

Forwards, from a pixel to the film (``nerf``; what is called stands below what calls it)::

    film.FieldIntegrator.render         for each pass of camera rays:
      field_scene.FieldScene.trace
        backdrop.Backdrop.intersect       where is the first surface?
        integral.see                      for each chunk of rays that cross a field, up to there:
          march.walk.walk_rays            sample by sample, in one kernel or in waves; or else
          integral.Integral
            crossing.Crossing               rays to field coordinates, samples placed, field asked
            march.quadrature.integrate      densities and colours to
              march.quadrature.composite      color Σ T_i α_i c_i, opacity, depth
        backdrop.Backdrop.shade           what arrives from the surface or the sky
      Traced.channels                     fields + transmittance · surface
      FieldIntegrator._splat              reconstruction filter, film

Backwards, from a gradient of the image to parameters (``nerf``)::

    film.FieldIntegrator.render_backward   to the film's sums; then for each pass, traced again:
      FieldIntegrator._splat                  its adjoint: to color, alpha, depth of every ray
      field_scene.FieldScene.backward
        backdrop.Backdrop.backward              to surfaces and lights, by the nested integrator
        integral.Integral.backward              for each chunk: quadrature, to the field's answers
          march.query.Evaluation.backward         block by block: to the network's weights
          crossing.Moving.backward                to the pose of medium and cube

``nerf_path`` has another backdrop (paths.py), whose derivatives follow the same paths once more
(path_replay.py, path_derivatives.py); ``nerf_tracking`` has another estimate of the integral.
Where media of Mitsuba's own stand beside the fields, the scene is another one (fog_scene.py).

Plugin classes inherit from classes of the active Mitsuba variant, so the modules that define them
are imported once for each variant. Inside, light is RGB where fields emit it and in the colours of
the variant everywhere else (colors.py).
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import Any, NoReturn

import mitsuba as mi

from ..base.errors import InputError
from ..base.variants import unsuitable

_MEDIA = ("nerfmedium",)
_SENSORS = ("nerfviews",)
_INTEGRATORS = ("nerf", "nerf_path", "nerf_tracking")

# The modules of this folder, of every variant that was active, whose classes or functions they
# hold. Only those of the active one can be imported.
_modules: dict[str, dict[str, ModuleType]] = {}
_active: str | None = None


def register(*_: object) -> None:
    """Registers the plugins with the active variant, or such as say why it has none."""
    global _active
    variant = mi.variant()
    if variant is None or variant == _active:
        return
    _active = variant
    for name in _ours():
        del sys.modules[name]
        vars(sys.modules[__name__]).pop(name.removeprefix(f"{__name__}."), None)
    if variant in _modules:
        for name, module in _modules[variant].items():
            sys.modules[name] = module
            setattr(sys.modules[__name__], name.removeprefix(f"{__name__}."), module)
    elif (why := unsuitable(variant)) is not None:
        _refuse(variant, why)
        _modules[variant] = {}
    else:
        for name in _MEDIA + _SENSORS + _INTEGRATORS:
            importlib.import_module(f"{__name__}.{name}")
        _modules[variant] = {name: sys.modules[name] for name in _ours()}


def _ours() -> list[str]:
    return [name for name in sys.modules if name.startswith(f"{__name__}.")]


def _refuse(variant: str, why: str) -> None:
    """Registers plugins that cannot be made."""

    def refuse(props: Any) -> NoReturn:
        raise InputError(f"{props.plugin_name()}: variant '{variant}' {why}, such as 'llvm_ad_rgb'")

    for name in _MEDIA:
        mi.register_medium(name, refuse)
    for name in _SENSORS:
        mi.register_sensor(name, refuse)
    for name in _INTEGRATORS:
        mi.register_integrator(name, refuse)


_follows_variant = False


def register_always() -> None:
    """Registers now, and again after every change of variant.

    May be called again: newer versions of Mitsuba reload the package on their own.
    """
    global _follows_variant
    if not _follows_variant:
        mi.detail.add_variant_callback(register)
        _follows_variant = True
    register()
