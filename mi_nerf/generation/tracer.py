"""Path-traces the views of a plan: one scene, one sensor that moves, no recompilation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..base.arrays import Image
from ..base.errors import InputError
from ..cameras.poses import mitsuba_from_opengl
from ..scene_xml.refusals import refused_rendering
from .plan import Plan, View
from .sensors import camera_dict
from .surfaces import trace_surfaces

# Samples that one call of mi.render traces at most: bounds its memory, and the time
# until Ctrl-C is heard.
_SAMPLES_PER_PASS = 1 << 24


@dataclass(frozen=True)
class TracedView:
    """What was traced of one view."""

    halves: tuple[Image, Image]  # two (H, W, 4) linear premultiplied RGBA, independent
    depth: Image  # (H, W, 1) distance along the ray, scene units, 0: nothing
    normal: Image  # (H, W, 3) world space, unit or 0


class Tracer:
    """Renders views of a loaded scene."""

    def __init__(self, scene: Any, integrator: Any, sampler: Any, plan: Plan) -> None:
        """``sampler`` must take each of ``plan.halves``."""
        self._scene, self._integrator, self._plan = scene, integrator, plan
        self._sampler = sampler
        self._sensors: dict[Any, Any] = {}  # for each kind of camera in the plan
        # Other samplers spread their points over all samples of a pixel.
        self._in_parts = sampler.class_name() == "IndependentSampler"

    def trace(self, view: View) -> TracedView:
        """Renders one view.

        Raises:
            InputError: if the integrator gives NaN or infinity.
        """
        import mitsuba as mi

        pose = mi.ScalarTransform4f(mitsuba_from_opengl(view.pose).tolist())
        parameters = mi.traverse(self._sensor(view))
        parameters["to_world"] = mi.Transform4f(pose)
        parameters.update()
        a, b = (self._half(view, half, n) for half, n in enumerate(self._plan.halves))
        depth, normal = trace_surfaces(
            self._scene,
            self._plan.camera_of(view),
            view.pose,
            hide_emitters=self._plan.hide_emitters,
        )
        return TracedView((a, b), depth, normal)

    def _half(self, view: View, half: int, samples: int) -> Image:
        """One of the two independent images of a view."""
        total: Any = 0.0
        parts = passes(samples, self._plan.pixels) if self._in_parts else [samples]
        for i, count in enumerate(parts):
            total = total + self._render(view, count, view.render_seed(half, i)) * np.float32(count)
        image = total / np.float32(samples)
        image = image[..., :4]  # what follows are AOVs
        bad = int((~np.isfinite(image)).any(axis=-1).sum())
        if bad:
            raise InputError(f"view {view.name}: {bad} pixels are NaN or infinite")
        return image

    def _sensor(self, view: View) -> Any:
        """The sensor that views of this kind share; it is moved from one to the next."""
        import mitsuba as mi

        kind = (self._plan.camera_of(view), view.lens)
        if kind not in self._sensors:
            description = camera_dict(*kind, self._plan.clips)
            self._sensors[kind] = mi.load_dict({**description, "sampler": self._sampler})
        return self._sensors[kind]

    def _render(self, view: View, spp: int, seed: int) -> Image:
        import mitsuba as mi

        try:
            image = mi.render(
                self._scene,
                sensor=self._sensor(view),
                integrator=self._integrator,
                spp=spp,
                seed=seed,
            )
            return np.array(image)  # waits, so that passes do not pile up in memory
        except RuntimeError as error:  # Dr.Jit wraps what happens inside a custom operation
            if isinstance(error.__cause__, InputError):
                raise error.__cause__ from error
            if (said := refused_rendering(error)) is not None:
                raise InputError(said) from error
            raise


def passes(samples: int, pixels: int) -> list[int]:
    """``samples`` a pixel in parts that each trace a bounded number of paths."""
    count = -(-samples * pixels // _SAMPLES_PER_PASS)
    count = min(samples, max(1, count))
    return [samples // count + (i < samples % count) for i in range(count)]
