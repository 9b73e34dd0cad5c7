"""What integrators that show a radiance field have in common: camera rays, film, background."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
from mitsuba.ad.integrators.common import ADIntegrator

from ..color import linear_to_srgb, srgb_to_linear
from ..errors import InputError
from ..field import Field
from ..quadrature import over_background
from .placement import PlacedField, find_field

# Camera rays traced at a time; more samples per pixel take several passes.
_RAYS_PER_PASS = 1 << 22


@dataclass
class Wave:
    """The camera rays of one pass, and what they returned."""

    ray: Any
    weight: Any
    position: Any  # on the film
    random: Any  # what the integrator needs of randomness, a number or so a ray
    outputs: list[Any]  # R, G, B, opacity, and what else the integrator knows


class FieldIntegrator(ADIntegrator):
    """Sends camera rays through the one field of a scene; how is up to subclasses."""

    plugin: str  # its name
    known: tuple[str, ...]  # extra channels that it offers, in the order of its outputs

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        if not mi.variant().endswith("_rgb"):
            raise InputError(
                f"{self.plugin}: variant '{mi.variant()}' is not supported, "
                "expected 'llvm_ad_rgb' or 'cuda_ad_rgb'"
            )
        self.near, self.far = props.get("near", None), props.get("far", None)
        # Read by the base class in C++; kept here for the background.
        self.show_background = not bool(props.get("hide_emitters", False))
        self.encoded = bool(props.get("encoded", False))
        self.aovs = self._parse_aovs(str(props.get("aovs", "")))

    def aov_names(self) -> list[str]:
        """Names of the extra channels."""
        return [name for name, _ in self.aovs]

    # ---------------------------------- What subclasses do ----------------------------------

    @abstractmethod
    def _draw(self, sampler: mi.Sampler, rays: int, seed: Any) -> Any:
        """Takes from the sampler what a wave needs of randomness."""

    @abstractmethod
    def _traced(
        self, scene: mi.Scene, placed: PlacedField, waves: Iterable[Wave]
    ) -> Iterator[Wave]:
        """Fills in the outputs of waves, without derivatives."""

    # ---------------------------------- Rendering ----------------------------------

    def render(
        self,
        scene: mi.Scene,
        sensor: int | mi.Sensor = 0,
        seed: Any = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> Any:
        """Renders an image; see ``mi.render``."""
        sensor = self._sensor(scene, sensor)
        with dr.suspend_grad():
            placed = find_field(scene)
            waves = self._waves(scene, sensor, seed, spp)
            image = self._develop(sensor.film(), self._traced(scene, placed, waves), develop)
            if evaluate and develop:
                dr.eval(image)
        return image

    def sample(
        self, mode: Any, scene: mi.Scene, sampler: mi.Sampler, ray: Any, **kwargs: Any
    ) -> tuple[Any, Any, list[Any], Any]:
        """Radiance along single rays, for integrators that nest this one."""
        with dr.suspend_grad():
            placed = find_field(scene)
            wave = Wave(ray, None, None, self._draw(sampler, dr.width(ray), 0), [])
            for _ in self._traced(scene, placed, [wave]):
                pass
        valid = wave.outputs[3] > 0
        return mi.Color3f(*wave.outputs[:3]), valid, self._aov_values(wave), None

    # ---------------------------------- Camera rays ----------------------------------

    def _sensor(self, scene: mi.Scene, sensor: int | mi.Sensor) -> mi.Sensor:
        """The sensor meant by an index or given as such."""
        if not isinstance(sensor, int):
            return sensor
        sensors = scene.sensors()
        if sensor >= len(sensors):
            raise InputError(
                f"{self.plugin}: sensor {sensor} of {len(sensors)}: the scene has no such sensor"
            )
        return sensors[sensor]

    def _waves(self, scene: mi.Scene, sensor: mi.Sensor, seed: Any, spp: int) -> Iterator[Wave]:
        """Camera rays, in passes of bounded size with seeds of their own."""
        film = sensor.film()
        spp = spp or sensor.sampler().sample_count()
        pixels = int(dr.prod(film.crop_size()))
        per_pass = max(1, min(spp, _RAYS_PER_PASS // max(pixels, 1)))
        passes = -(-spp // per_pass)
        for i in range(passes):
            count = spp if passes == 1 else min(per_pass, spp - i * per_pass)
            pass_seed = seed if i == 0 else mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(i))[0]
            sampler, _ = self.prepare(sensor, pass_seed, count, self.aov_names())
            ray, weight, position = self.sample_rays(scene, sensor, sampler)
            random = self._draw(sampler, dr.width(ray), pass_seed)
            dr.eval(ray, weight, position, random)
            yield Wave(ray, weight, position, random, [])

    def _develop(self, film: mi.Film, waves: Iterable[Wave], develop: bool) -> Any:
        """Splats the rays' values through the film's reconstruction filter."""
        block = None
        for wave in waves:
            block = block or film.create_block()
            r, g, b, opacity = wave.outputs[:4]
            ADIntegrator._splat_to_block(
                block,
                film,
                wave.position,
                value=mi.Color3f(r, g, b) * wave.weight,
                weight=1.0,
                alpha=opacity,
                aovs=self._aov_values(wave),
                wavelengths=wave.ray.wavelengths,
            )
            dr.eval(block.tensor())  # lets go of this pass before the next one
        film.put_block(block)
        return film.develop() if develop else None

    def _aov_values(self, wave: Wave) -> list[Any]:
        values = dict(zip(self.known, wave.outputs[3:], strict=True))
        return [values[kind] for _, kind in self.aovs]

    def _parse_aovs(self, text: str) -> list[tuple[str, str]]:
        """Channel names and kinds of a list such as ``depth, a:opacity``."""
        aovs = []
        for item in text.replace(" ", "").split(","):
            name, _, kind = item.rpartition(":")
            if item and kind not in self.known:
                raise InputError(
                    f"{self.plugin}: aov '{item}' is unknown, "
                    f"expected {' or '.join(sorted(self.known))}"
                )
            if item:
                aovs.append((name or kind, kind))
        return aovs

    # ---------------------------------- Bounds and background ----------------------------------

    def _bounds(self, placed: PlacedField, ray: Any, scale: Any) -> tuple[Any, Any]:
        """Per-ray bounds of t in field units: the integrator's, the file's, the sensor's."""
        march = placed.medium.march
        near = mi.Float(march.near or 0) if self.near is None else self.near * scale
        far = mi.Float(dr.inf if march.far is None else march.far)
        if self.far is not None:
            far = self.far * scale
        return near, dr.fmin(far, ray.maxt * scale)

    def _background(self, scene: mi.Scene, ray: Any) -> list[Any]:
        """Radiance of the environment emitter along rays, zero without one."""
        emitter = scene.environment() if self.show_background else None
        if emitter is None:
            return [mi.Float(0)] * 3
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray))
        si.wi = -ray.d
        radiance = emitter.eval(si)
        return [radiance.x, radiance.y, radiance.z]

    def _in_front(
        self, field: Field, color: list[Any], opacity: Any, background: list[Any]
    ) -> list[Any]:
        """What a field shows in front of a background, in linear space or as composited."""
        if field.color_space == "srgb" and self.encoded:
            background = [linear_to_srgb(b) for b in background]
        elif field.color_space == "srgb":
            color = _linear(color, opacity)
        return over_background(color, opacity, background)


def _linear(color: list[Any], opacity: Any) -> list[Any]:
    """Premultiplied linear radiance of premultiplied sRGB colour."""
    visible = opacity > 0
    inverse = dr.select(visible, 1 / dr.select(visible, opacity, 1), 0)
    return [srgb_to_linear(c * inverse) * opacity for c in color]
