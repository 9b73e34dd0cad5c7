"""Integrators around those of scenes: what covers rays, which lights they see, bad samples.

Their classes belong to the active variant, so they are made where they are needed. All of them
trace the camera rays that the integrator of the scene would trace with the same seed, and run in
the same kernel as it.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from .emitters import Hidden
from .integrators import radiance
from .surfaces import coverage, past_hidden

# A sample beyond this counts as infinite: the sum with others of its pixel would become it.
LARGEST = 1e30


def coverage_integrator(hidden: Hidden) -> Any:
    """An integrator whose one channel beside RGBA is alpha: what covers the camera's rays.

    Args:
        hidden: Light sources that do not count.
    """
    import mitsuba as mi

    class Coverage(mi.SamplingIntegrator):
        """What covers the camera's rays."""

        def sample(
            self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True
        ) -> tuple[Any, Any, list[Any]]:
            active = mi.Bool(active)
            return mi.Spectrum(0), active, [coverage(scene, ray, active, hidden)]

        def aov_names(self) -> list[str]:
            return ["coverage"]

    return Coverage(mi.Properties("coverage"))


def choosing(integrator: Any, hidden: Hidden) -> Any:
    """``integrator``, to whose camera rays just these light sources are hidden.

    Args:
        integrator: One that hides none itself.
    """
    import mitsuba as mi

    class Choosing(mi.SamplingIntegrator):
        """Begins behind hidden light sources, and hides what surrounds the scene."""

        def sample(
            self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True
        ) -> tuple[Any, Any, list[Any]]:
            active = mi.Bool(active)
            origin, meets = past_hidden(scene, ray, active, hidden)
            ray = type(ray)(ray)
            ray.o = origin
            color, valid = radiance(integrator, scene, sampler, ray, medium, active)
            if hidden.environment:
                color, valid = dr.select(meets, color, mi.Spectrum(0)), valid & meets
            return color, valid, []

        def aov_names(self) -> list[str]:
            return []

    return Choosing(mi.Properties("choosing"))


def guarded(integrator: Any) -> Any:
    """``integrator``, with 0 for samples that are no numbers; one more channel is their share.

    Args:
        integrator: One whose single rays can be asked for (``integrators.samples_rays``).
    """
    import mitsuba as mi

    class Guarded(mi.SamplingIntegrator):
        """Drops samples that are no numbers."""

        def sample(
            self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True
        ) -> tuple[Any, Any, list[Any]]:
            color, valid = radiance(integrator, scene, sampler, ray, medium, mi.Bool(active))
            plain = mi.unpolarized_spectrum(color) if mi.is_polarized else color
            good = dr.all(dr.abs(plain) < LARGEST)  # not if NaN
            color = dr.select(good, color, mi.Spectrum(0))
            return color, valid & good, [dr.select(good, mi.Float(0), mi.Float(1))]

        def aov_names(self) -> list[str]:
            return ["invalid"]

    return Guarded(mi.Properties("guarded"))
