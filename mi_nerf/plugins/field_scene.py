"""A scene as camera rays find it: intersect, integrate the fields, shade; and the derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .backdrop import Backdrop, Hit, Light
from .colors import Radiance, Spectrum
from .film import CameraRays, Channels
from .integral import Integral, Seen, chunks, few, pull_back, push_forward, scattered, see
from .sampled import Rays, SampledField


@dataclass(frozen=True)
class Traced:
    """What the camera rays of one pass have found."""

    camera: CameraRays
    hit: Hit
    seen: Seen  # of the fields before it
    light: Light  # from behind them
    kept: tuple[Any, Integral] | None = None  # of which rays, what its adjoint is made of

    @property
    def outputs(self) -> list[Any]:
        """What has derivatives: R, G, B, opacity and depth of the fields; colours behind."""
        return [*self.seen.values, *self.light.radiance]

    def channels(self) -> Channels:
        """Fields over what is behind them: color, alpha, depth, opacity, normal, index."""
        *color, opacity, depth = self.seen.values
        hit, light, transmittance = self.hit, self.light, 1 - opacity
        channels: Channels = {
            "color": Radiance(color, transmittance * Spectrum(*light.radiance)),
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

    def trace(self, camera: CameraRays, *, keep: bool = False) -> Traced:
        """What the rays of a pass see, without derivatives.

        With ``keep``, few rays are asked once for both their values and their derivatives;
        normals and indices, which have none, are then left out.
        """
        hit = self._backdrop.intersect(camera.ray)
        rays = _rays(camera, hit)
        kept = self._keep(rays) if keep else None
        if kept is None:
            seen = see(self._fields, rays, normals=self._normals)
        else:
            seen = scattered(*kept, dr.width(rays.o))
        light = self._backdrop.shade(hit, camera.ray, camera.sampler, seen.opacity)
        return Traced(camera, hit, seen, light, kept)

    @property
    def trained(self) -> bool:
        """Whether all fields are being trained."""
        return all(marched.trained for marched in self._fields)

    def _keep(self, rays: Rays) -> tuple[Any, Integral] | None:
        """The integral along few rays, and their numbers; ``None`` of many."""
        if not (self._differentiable() and few(self._fields, rays)):
            return None
        index, rays = next(iter(chunks(self._fields, rays)))
        return index, Integral(self._fields, rays, dr.ADMode.Backward)

    def _differentiable(self) -> bool:
        return any(marched.differentiable for marched in self._fields)

    def backward(self, traced: Traced, gradients: list[Any]) -> None:
        """Carries the gradients of ``outputs`` to the parameters of the scene."""
        camera, light = traced.camera, traced.light
        self._backdrop.backward(camera.ray, camera.sampler, light, gradients[5:])
        if traced.kept is None:
            pull_back(self._fields, _rays(camera, traced.hit), gradients[:5])
            return
        index, integral = traced.kept
        integral.backward([dr.gather(mi.Float, g, index) for g in gradients[:5]])

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
