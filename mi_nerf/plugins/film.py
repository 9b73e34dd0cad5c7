"""What integrators that show radiance fields have in common: camera rays and film."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
from mitsuba.ad.integrators.common import ADIntegrator

from ..base.errors import InputError

_AXES = (".X", ".Y", ".Z")


@dataclass
class Wave:
    """The camera rays of one pass; subclasses add what these return."""

    ray: Any
    weight: Any
    position: Any  # on the film
    random: Any  # what the integrator needs of randomness, a number or so a ray
    sampler: mi.Sampler  # in the state in which a nested integrator finds it

    def shown(self) -> dict[str, Any]:
        """``color``, ``alpha``, and all channels that the integrator knows."""
        raise NotImplementedError


class FieldIntegrator(ADIntegrator):
    """Sends camera rays through the fields of a scene; how is up to subclasses."""

    plugin: str  # its name
    known: tuple[str, ...]  # extra channels that it offers
    wave: type[Wave]
    rays_per_pass = 1 << 22  # traced at a time; more samples per pixel take several passes

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
        self.aovs = self._parse_aovs(str(props.get("aovs", "")))

    def aov_names(self) -> list[str]:
        """Names of the extra channels."""
        return [
            name + part
            for name, kind in self.aovs
            for part in (_AXES if kind == "normal" else ("",))
        ]

    # ---------------------------------- What subclasses do ----------------------------------

    @abstractmethod
    def _draw(self, sampler: mi.Sampler, rays: int, seed: Any) -> Any:
        """Takes from the sampler what a wave needs of randomness."""

    @abstractmethod
    def _traced(self, scene: mi.Scene, waves: Iterable[Any]) -> Iterator[Any]:
        """Fills in what the rays of such waves see, without derivatives."""

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
            waves = self._traced(scene, self._waves(scene, sensor, seed, spp))
            image = self._develop(sensor.film(), waves, develop)
            if evaluate and develop:
                dr.eval(image)
        return image

    def sample(
        self, mode: Any, scene: mi.Scene, sampler: mi.Sampler, ray: Any, **kwargs: Any
    ) -> tuple[Any, Any, list[Any], Any]:
        """Radiance along single rays, for integrators that nest this one."""
        with dr.suspend_grad():
            wave = self.wave(ray, None, None, self._draw(sampler, dr.width(ray), 0), sampler)
            for _ in self._traced(scene, [wave]):
                pass
            shown = wave.shown()
        return shown["color"], shown["alpha"] > 0, self._aov_values(shown), None

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

    def _waves(self, scene: mi.Scene, sensor: mi.Sensor, seed: Any, spp: int) -> Iterator[Any]:
        """Camera rays, in passes of bounded size with seeds of their own."""
        film = sensor.film()
        spp = spp or sensor.sampler().sample_count()
        pixels = int(dr.prod(film.crop_size()))
        per_pass = max(1, min(spp, self.rays_per_pass // max(pixels, 1)))
        passes = -(-spp // per_pass)
        for i in range(passes):
            count = spp if passes == 1 else min(per_pass, spp - i * per_pass)
            pass_seed = seed if i == 0 else mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(i))[0]
            sampler, _ = self.prepare(sensor, pass_seed, count, self.aov_names())
            ray, weight, position = self.sample_rays(scene, sensor, sampler)
            random = self._draw(sampler, dr.width(ray), pass_seed)
            dr.eval(ray, weight, position, random)
            sampler.schedule_state()
            dr.eval()
            yield self.wave(ray, weight, position, random, sampler)

    def _develop(self, film: mi.Film, waves: Iterable[Wave], develop: bool) -> Any:
        """Splats the rays' values through the film's reconstruction filter."""
        block = None
        for wave in waves:
            block = block or film.create_block()
            shown = wave.shown()
            ADIntegrator._splat_to_block(
                block,
                film,
                wave.position,
                value=shown["color"] * wave.weight,
                weight=1.0,
                alpha=shown["alpha"],
                aovs=self._aov_values(shown),
                wavelengths=wave.ray.wavelengths,
            )
            dr.eval(block.tensor())  # lets go of this pass before the next one
        film.put_block(block)
        return film.develop() if develop else None

    def _aov_values(self, shown: dict[str, Any]) -> list[Any]:
        return [
            value
            for _, kind in self.aovs
            for value in (shown[kind] if kind == "normal" else [shown[kind]])
        ]

    def _parse_aovs(self, text: str) -> list[tuple[str, str]]:
        """Channel names and kinds of a list such as ``depth, a:opacity``."""
        aovs = []
        expected = " or ".join(filter(None, (", ".join(self.known[:-1]), self.known[-1])))
        for item in text.replace(" ", "").split(","):
            name, _, kind = item.rpartition(":")
            if item and kind not in self.known:
                raise InputError(f"{self.plugin}: aov '{item}' is unknown, expected {expected}")
            if item:
                aovs.append((name or kind, kind))
        return aovs
