"""A scene of fields and surfaces, seen along camera rays: values, and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi

from .backdrop import Backdrop, Behind
from .crossing import Marched, Rays, View, chunks
from .film import Wave
from .segments import see


@dataclass
class StageWave(Wave):
    """Camera rays, and what they see."""

    behind: Behind | None = None
    fields: list[Any] = field(default_factory=list)  # R, G, B, opacity, depth of the fields
    normal: Any = None  # of the fields, where wanted
    index: Any = None  # of the field that contributes most, from 1; 0 for none

    @property
    def outputs(self) -> list[Any]:
        """What has derivatives: R, G, B, opacity and depth of the fields; R, G, B behind."""
        assert self.behind is not None
        return [*self.fields, *self.behind.radiance]

    def shown(self) -> dict[str, Any]:
        """Fields in front of what is behind: color, alpha, depth, opacity, normal, index."""
        assert self.behind is not None
        *color, opacity, depth = self.fields
        behind, through = self.behind, 1 - opacity
        values = {
            "color": mi.Color3f(
                *(c + through * b for c, b in zip(color, behind.radiance, strict=True))
            ),
            "alpha": opacity + through * behind.valid,
            "opacity": opacity,
            "depth": depth,
            "normal": self.normal,
            "index": self.index,
        }
        if behind.distance is None:
            return values
        # ---- Means over fields and the surface, by what each contributes ----
        hit = behind.distance < dr.inf
        surface = dr.select(hit, through, 0)
        total = opacity + surface
        share = dr.select(total > 0, surface / dr.select(total > 0, total, 1), 0)
        values["depth"] = dr.select(
            hit, depth + share * (dr.select(hit, behind.distance, 0) - depth), depth
        )
        if self.normal is not None:
            values["normal"] = self.normal + dr.detach(share) * (behind.normal - self.normal)
        return values


class Stage:
    """The fields of a scene and what stands around them, for the time of one rendering."""

    def __init__(self, fields: list[Marched], backdrop: Backdrop, normals: bool):
        self._fields, self._backdrop, self._normals = fields, backdrop, normals

    def trace(self, wave: StageWave) -> None:
        """Fills in what the rays of a pass see, without derivatives."""
        wave.behind = self._backdrop.meet(wave.ray)
        seen = see(self._fields, _rays(wave), normals=self._normals)
        wave.fields, wave.normal, wave.index = seen.values, seen.normal, seen.index
        self._backdrop.look(wave.behind, wave.ray, wave.sampler, seen.opacity)

    def backward(self, wave: StageWave, gradients: list[Any]) -> None:
        """Carries the gradients of a wave's outputs to the parameters of the scene."""
        assert wave.behind is not None
        self._backdrop.backward(wave.ray, wave.sampler, wave.behind, gradients[5:])
        if not any(marched.differentiable for marched in self._fields):
            return
        for index, rays in chunks(self._fields, _rays(wave)):
            view = View(self._fields, rays, dr.ADMode.Backward)
            view.backward([dr.gather(mi.Float, g, index) for g in gradients[:5]])

    def forward(self, wave: StageWave) -> list[Any]:
        """The derivatives of a wave's outputs along the gradients of the parameters."""
        assert wave.behind is not None
        tangents = [dr.zeros(mi.Float, len(wave.index)) for _ in range(5)]
        dr.make_opaque(tangents)
        for index, rays in chunks(self._fields, _rays(wave)):
            view = View(self._fields, rays, dr.ADMode.Forward)
            for tangent, slope in zip(tangents, view.forward(), strict=True):
                dr.scatter(tangent, slope, index)
            dr.eval(tangents)
        return tangents + self._backdrop.forward(wave.ray, wave.sampler, wave.behind)


def _rays(wave: StageWave) -> Rays:
    """The rays of a pass, as far as the first surface."""
    assert wave.behind is not None
    ray = wave.ray
    reach = ray.maxt
    if wave.behind.distance is not None:
        reach = dr.fmin(reach, wave.behind.distance)
    reach = reach + dr.zeros(mi.Float, dr.width(ray))
    return Rays(ray.o, ray.d, reach, wave.random)
