"""The Mitsuba plugins of radiance fields, and the way of a camera ray through them.

Integrators ``nerf``, ``nerf_path`` and ``nerf_tracking``, and the medium ``nerfmedium``.

Forwards, from a pixel to the film (``nerf``; what is called stands below what calls it)::

    film.FieldIntegrator.render         for each pass of camera rays:
      field_scene.FieldScene.trace
        backdrop.Backdrop.intersect       where is the first surface?
        integral.see                      for each chunk of rays that cross a field, up to there:
          march.walk.walk_rays            a narrow network: in one kernel, sample by sample; else
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

Plugin classes inherit from classes of the active Mitsuba variant, so the modules
that define them are imported again whenever the variant changes.
"""

from __future__ import annotations

import importlib
import sys

import mitsuba as mi

_PLUGINS = ("nerfmedium", "nerf", "nerf_path", "nerf_tracking")
_loaded_for: str | None = None
_follows_variant = False


def register(*_: object) -> None:
    """Registers the plugins with the active variant; does nothing for scalar ones."""
    global _loaded_for
    variant = mi.variant()
    if variant is None or variant.startswith("scalar") or variant == _loaded_for:
        return
    # All modules of this folder hold classes or functions of the variant, or import such.
    for name in [name for name in sys.modules if name.startswith(f"{__name__}.")]:
        del sys.modules[name]
    for name in _PLUGINS:
        importlib.import_module(f"{__name__}.{name}")
    _loaded_for = variant


def register_always() -> None:
    """Registers now, and again after every change of variant.

    May be called again: newer versions of Mitsuba reload the package on their own.
    """
    global _follows_variant
    if not _follows_variant:
        mi.detail.add_variant_callback(register)
        _follows_variant = True
    register()
