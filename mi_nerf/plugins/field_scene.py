"""A scene as camera rays find it: intersect, integrate the fields, shade; and the derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .backdrop import Backdrop, Hit, Light
from .film import CameraRays, Channels
from .integral import Seen, pull_back, push_forward, see
from .sampled import Rays, SampledField


@dataclass(frozen=True)
class Traced:
    """What the camera rays of one pass have found."""

    camera: CameraRays
    hit: Hit
    seen: Seen  # of the fields before it
    light: Light  # from behind them

    @property
    def outputs(self) -> list[Any]:
        """What has derivatives: R, G, B, opacity and depth of the fields; R, G, B behind."""
        return [*self.seen.values, *self.light.radiance]

    def channels(self) -> Channels:
        """Fields over what is behind them: color, alpha, depth, opacity, normal, index."""
        *color, opacity, depth = self.seen.values
        hit, light, transmittance = self.hit, self.light, 1 - opacity
        over = [c + transmittance * b for c, b in zip(color, light.radiance, strict=True)]
        channels: Channels = {
            "color": mi.Color3f(*over),
            "alpha": opacity + transmittance * light.valid,
            "opacity": opacity,
            "depth": depth,
            "normal": self.seen.normal,
            "index": self.seen.index,
        }
        if hit.distance is None:
            return channels
        # ---- Means over fields and the surface, by what each contributes ----
        valid = hit.distance < dr.inf
        surface = dr.select(valid, transmittance, 0)
        total = opacity + surface
        share = dr.select(total > 0, surface / dr.select(total > 0, total, 1), 0)
        channels["depth"] = dr.select(
            valid, depth + share * (dr.select(valid, hit.distance, 0) - depth), depth
        )
        channels["normal"] = self.seen.normal + dr.detach(share) * (hit.normal - self.seen.normal)
        return channels


class FieldScene:
    """The fields of a scene and what stands around them, for the time of one rendering."""

    def __init__(self, fields: list[SampledField], backdrop: Backdrop, normals: bool):
        self._fields, self._backdrop, self._normals = fields, backdrop, normals

    def trace(self, camera: CameraRays) -> Traced:
        """What the rays of a pass see, without derivatives."""
        hit = self._backdrop.intersect(camera.ray)
        seen = see(self._fields, _rays(camera, hit), normals=self._normals)
        light = self._backdrop.shade(hit, camera.ray, camera.sampler, seen.opacity)
        return Traced(camera, hit, seen, light)

    def backward(self, traced: Traced, gradients: list[Any]) -> None:
        """Carries the gradients of ``outputs`` to the parameters of the scene."""
        camera, light = traced.camera, traced.light
        self._backdrop.backward(camera.ray, camera.sampler, light, gradients[5:])
        pull_back(self._fields, _rays(camera, traced.hit), gradients[:5])

    def forward(self, traced: Traced) -> list[Any]:
        """The derivatives of ``outputs`` along the gradients of the parameters."""
        camera = traced.camera
        tangents = push_forward(self._fields, _rays(camera, traced.hit))
        return tangents + self._backdrop.forward(camera.ray, camera.sampler, traced.light)


def _rays(camera: CameraRays, hit: Hit) -> Rays:
    """The rays of a pass, as far as the first surface."""
    ray = camera.ray
    reach = ray.maxt if hit.distance is None else dr.fmin(ray.maxt, hit.distance)
    reach = reach + dr.zeros(mi.Float, dr.width(ray))
    return Rays(ray.o, ray.d, reach, camera.random)
