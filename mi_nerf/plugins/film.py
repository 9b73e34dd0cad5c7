"""What integrators that show radiance fields have in common: camera rays and film.

Forwards: film position → camera ray → what the scene shows along it → the film's reconstruction
filter. Backwards, as in Mitsuba's ``RBIntegrator``: first from the image to the film's sums, then
pass by pass from these to the values of the rays, and from there into the scene. The sums are
linear in the values, so that no pass needs to know another one's.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
from mitsuba.python.ad.integrators.common import ADIntegrator

from ..base.errors import InputError
from .colors import Radiance, polarized, unpolarized
from .placement import is_field

_AXES = (".X", ".Y", ".Z")

Channels = dict[str, Any]  # color (Radiance), alpha, and what else is known, ray by ray


@dataclass(frozen=True)
class CameraRays:
    """The camera rays of one pass."""

    ray: Any
    weight: Any
    position: Any  # on the film
    random: Any  # what the integrator needs of randomness, a number or so a ray
    sampler: mi.Sampler  # in the state in which a nested integrator finds it


class Traced(Protocol):
    """What the rays of a pass have found."""

    @property
    def outputs(self) -> list[Any]:
        """The arrays of which the channels are made, where derivatives can be had."""

    @property
    def camera(self) -> CameraRays:
        """The rays themselves."""

    def channels(self) -> Channels:
        """What the rays show."""


class TracedScene(Protocol):
    """A scene as it is now, to be seen along camera rays."""

    def trace(self, camera: CameraRays, *, keep: bool = False) -> Any:
        """What the rays find, a :class:`Traced`; without derivatives.

        Args:
            keep: what :meth:`backward` will need, as far as it is small.
        """

    def backward(self, traced: Any, gradients: list[Any]) -> None:
        """Carries gradients of the ``outputs`` to the parameters of the scene."""

    def forward(self, traced: Any) -> list[Any]:
        """The derivatives of the ``outputs`` along the gradients of the parameters."""


class FieldIntegrator(ADIntegrator):
    """Sends camera rays through the fields of a scene; how is up to subclasses."""

    plugin: str  # its name
    known: tuple[str, ...]  # extra channels that it offers
    differentiable = False  # whether its scenes have derivatives
    rays_per_pass = 1 << 22  # traced at a time; more samples per pixel take several passes
    rays_per_adjoint = 1 << 18  # the same for derivatives, which keep more of every ray

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.near, self.far = props.get("near", None), props.get("far", None)
        for name, value in (("near", self.near), ("far", self.far)):
            if value is not None and math.isnan(value):
                raise self._unlike(name, value, "a distance")
        # Read by the base class in C++; kept here for the background.
        self.show_background = not bool(props.get("hide_emitters", False))
        self.aovs = self._parse_aovs(str(props.get("aovs", "")))
        self._shown: _Shown | None = None

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
        """Takes from the sampler what the rays of a pass need of randomness."""

    @abstractmethod
    def _scene(self, scene: mi.Scene) -> Any:
        """The scene as it is now: a :class:`TracedScene`, without derivatives only ``trace``."""

    def _trains(self, view: Any, sensor: mi.Sensor, spp: int) -> bool:
        """Whether the picture is a step of training, whose derivatives take the same samples."""
        return False

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
        self._require_thawed()
        sensor = self._sensor(scene, sensor)
        film, block = sensor.film(), None
        with dr.suspend_grad():
            view = self._scene(scene)
            self._shown, trains = None, self._trains(view, sensor, spp)
            for camera in self._passes(scene, sensor, seed, spp, self.rays_per_pass):
                traced = view.trace(camera, keep=True) if trains else view.trace(camera)
                block = self._splat(film, block, camera, traced.channels())
                if trains:  # all rays are one pass
                    self._shown = _Shown(scene, sensor, _seed_grad(seed), spp, view, traced)
            film.put_block(block)
            image = film.develop() if develop else None
            if evaluate and develop:
                dr.eval(image)
        return image

    def sample(
        self,
        mode: Any,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: Any,
        active: Any = True,
        **kwargs: Any,
    ) -> tuple[Any, Any, list[Any], Any]:
        """Radiance along single rays, for integrators that nest this one; 0 if not active."""
        self._require_thawed()
        with dr.suspend_grad():
            random = self._draw(sampler, dr.width(ray), 0)
            camera = CameraRays(ray, None, None, random, sampler)
            channels = self._scene(scene).trace(camera).channels()
            active = mi.Bool(active)
            color = channels["color"].spectrum(ray.wavelengths)
            color = polarized(dr.select(active, color, 0))
            aovs = [dr.select(active, value, 0) for value in self._aov_values(channels)]
        return color, active & (channels["alpha"] > 0), aovs, None

    # ---------------------------------- Derivatives ----------------------------------

    def render_backward(
        self,
        scene: mi.Scene,
        params: Any,
        grad_in: Any,
        sensor: int | mi.Sensor = 0,
        seed: Any = 0,
        spp: int = 0,
    ) -> None:
        """Carries the gradient of an image to the parameters of fields, surfaces and lights.

        First to the film's sums, then pass by pass to the values of camera rays, and chunk by
        chunk through quadrature and network: memory grows neither with the image nor with
        the samples per pixel.
        """
        self._require_derivatives()
        sensor = self._sensor(scene, sensor)
        film, limit = sensor.film(), self.rays_per_adjoint
        with dr.suspend_grad():
            shown, self._shown = self._shown, None
            if shown is not None and shown.is_of(scene, sensor, seed, spp):
                view: TracedScene = shown.view
                cameras: Iterable[CameraRays] = [shown.traced.camera]
                film.prepare(self.aov_names())
            else:
                shown, view = None, self._scene(scene)
                cameras = _Kept(lambda: self._passes(scene, sensor, seed, spp, limit))
            sums = self._weights(film, cameras)
            with dr.resume_grad():
                dr.enable_grad(sums.tensor())
                film.put_block(sums)
                _pull(film.develop(), grad_in)
                adjoint = dr.grad(sums.tensor())
            for camera in cameras:
                traced: Traced = shown.traced if shown else view.trace(camera, keep=True)
                outputs = traced.outputs
                with dr.resume_grad():
                    dr.enable_grad(outputs)
                    block = self._splat(film, None, camera, traced.channels(), evaluate=False)
                    _pull(block.tensor(), adjoint)
                    gradients = [dr.grad(output) for output in outputs]
                dr.eval(gradients)
                dr.disable_grad(outputs)
                view.backward(traced, gradients)
                dr.eval()

    def render_forward(
        self,
        scene: mi.Scene,
        params: Any,
        sensor: int | mi.Sensor = 0,
        seed: Any = 0,
        spp: int = 0,
    ) -> Any:
        """The derivative of an image along the gradients of the scene's parameters."""
        self._require_derivatives()
        sensor = self._sensor(scene, sensor)
        film, limit = sensor.film(), self.rays_per_adjoint
        with dr.suspend_grad():
            view: TracedScene = self._scene(scene)
            cameras = _Kept(lambda: self._passes(scene, sensor, seed, spp, limit))
            sums = self._weights(film, cameras)
            tangent = dr.zeros(mi.TensorXf, sums.tensor().shape)
            for camera in cameras:
                traced: Traced = view.trace(camera)
                outputs, slopes = traced.outputs, view.forward(traced)
                with dr.resume_grad():
                    dr.enable_grad(outputs)
                    for output, slope in zip(outputs, slopes, strict=True):
                        dr.set_grad(output, slope)
                    block = self._splat(film, None, camera, traced.channels(), evaluate=False)
                    dr.forward_to(block.tensor())
                    tangent += dr.grad(block.tensor())
                dr.disable_grad(outputs)
                dr.eval(tangent)
            with dr.resume_grad():
                dr.enable_grad(sums.tensor())
                dr.set_grad(sums.tensor(), tangent)
                film.put_block(sums)
                image = film.develop()
                dr.forward_to(image)
                return dr.grad(image)

    def _unlike(self, name: str, value: Any, expected: str) -> InputError:
        return InputError(f"{self.plugin}: {name}={value}, expected {expected}")

    def _require_derivatives(self) -> None:
        self._require_thawed()
        if not self.differentiable:
            raise InputError(
                f"{self.plugin}: has no derivatives, expected the integrator 'nerf' or "
                "'nerf_path' for them"
            )

    def _require_thawed(self) -> None:
        """Refuses to be recorded: Dr.Jit cannot pack a network's weights there, either."""
        if dr.flag(dr.JitFlag.FreezingScope):
            raise InputError(
                f"{self.plugin}: inside dr.freeze a picture would be repeated with the numbers of "
                "samples and the places of fields that it has read once, expected mi.render "
                "outside of the frozen function"
            )

    def _weights(self, film: mi.Film, cameras: Iterable[CameraRays]) -> mi.ImageBlock:
        """The film's sums of an image that is black: only the weights of the samples."""
        block, zero = None, mi.Float(0)
        black: Channels = dict.fromkeys(self.known, zero)
        black |= {"color": Radiance([zero] * 3), "alpha": zero, "normal": mi.Normal3f(0)}
        for camera in cameras:
            block = self._splat(film, block, camera, black)
        return block

    # ---------------------------------- Camera rays ----------------------------------

    def _sensor(self, scene: mi.Scene, sensor: int | mi.Sensor) -> mi.Sensor:
        """The sensor meant by an index or given as such."""
        if isinstance(sensor, int):
            sensors = scene.sensors()
            if not 0 <= sensor < len(sensors):
                raise InputError(
                    f"{self.plugin}: sensor {sensor} of {len(sensors)}: the scene has no such "
                    "sensor"
                )
            sensor = sensors[sensor]
        medium = sensor.get_medium()
        if medium is not None and not is_field(medium):
            raise InputError(
                f"{self.plugin}: the sensor '{sensor.id()}' is in a medium, expected it outside "
                "of all but 'nerfmedium'"
            )
        return sensor

    def _passes(
        self, scene: mi.Scene, sensor: mi.Sensor, seed: Any, spp: int, limit: int
    ) -> Iterator[CameraRays]:
        """Camera rays, in passes of at most ``limit`` or one a pixel.

        Samplers that spread their samples evenly do so over all passes; the independent one
        has a seed for each.
        """
        film = sensor.film()
        spp = spp or sensor.sampler().sample_count()
        pixels = int(dr.prod(film.crop_size()))
        per_pass = max(1, min(spp, limit // max(pixels, 1)))
        for pass_seed, sampler, count in self._samplers(sensor, seed, spp, per_pass):
            ray, weight, position = self.sample_rays(scene, sensor, _Wavefront(sampler, count))
            width = dr.width(position)  # a radiance meter has one ray for all
            ray.o, ray.d = ray.o + dr.zeros(mi.Float, width), ray.d + dr.zeros(mi.Float, width)
            random = self._draw(sampler, dr.width(ray), pass_seed)
            dr.eval(ray, weight, position, random)
            sampler.schedule_state()
            dr.eval()
            yield CameraRays(ray, weight, position, random, sampler)

    def _samplers(
        self, sensor: mi.Sensor, seed: Any, spp: int, per_pass: int
    ) -> Iterator[tuple[Any, mi.Sampler, int]]:
        """For each pass of at most so many samples a pixel: a seed, a sampler, and how many."""
        spread = sensor.sampler().class_name() != "IndependentSampler"
        if per_pass == spp or not spread:
            passes = -(-spp // per_pass)
            for i in range(passes):
                count = spp if passes == 1 else min(per_pass, spp - i * per_pass)
                pass_seed = _seed_of(seed, i)
                yield pass_seed, *self.prepare(sensor, pass_seed, count, self.aov_names())
            return
        sampler = sensor.sampler().clone()
        sampler.set_sample_count(spp)
        spp = sampler.sample_count()  # as many as it can spread
        per_pass = max(d for d in range(1, per_pass + 1) if spp % d == 0)
        sensor.film().prepare(self.aov_names())
        sampler.set_samples_per_wavefront(per_pass)
        sampler.seed(seed, int(dr.prod(_sampled_size(sensor.film()))) * per_pass)
        for i in range(spp // per_pass):
            sampler.schedule_state()
            dr.eval()
            yield _seed_of(seed, i), sampler.clone(), per_pass
            sampler.next_1d()  # other places within the strata than in this pass
            sampler.advance()

    def _splat(
        self,
        film: mi.Film,
        block: mi.ImageBlock | None,
        camera: CameraRays,
        channels: Channels,
        evaluate: bool = True,
    ) -> mi.ImageBlock:
        """Adds the rays' values to the film's sums, through its reconstruction filter."""
        block = block or film.create_block()
        weight, wavelengths = unpolarized(camera.weight), camera.ray.wavelengths
        color, alpha = channels["color"], channels["alpha"]
        if mi.has_flag(film.flags(), mi.FilmFlags.Special):  # it knows what to do with spectra
            value = color.spectrum(wavelengths) * weight
            count = block.channel_count()
            values = film.prepare_sample(value, wavelengths, count, weight=1.0, alpha=alpha)
        else:
            values = [*color.on_film(weight, wavelengths)]
            values += [alpha] if mi.has_flag(film.flags(), mi.FilmFlags.Alpha) else []
            values += [mi.Float(1), *self._aov_values(channels)]
        block.put(camera.position, values)
        if evaluate:
            dr.eval(block.tensor())  # lets go of this pass before the next one
        return block

    def _aov_values(self, channels: Channels) -> list[Any]:
        return [
            value
            for _, kind in self.aovs
            for value in (channels[kind] if kind == "normal" else [channels[kind]])
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


@dataclass(frozen=True)
class _Shown:
    """What the last picture was made of, if its derivatives shall be those of the same samples."""

    scene: mi.Scene
    sensor: mi.Sensor
    seed_grad: Any
    spp: int
    view: TracedScene
    traced: Any

    def is_of(self, scene: mi.Scene, sensor: mi.Sensor, seed: Any, spp: int) -> bool:
        """Whether a derivative is that of this picture, with the seed that Mitsuba gives it."""
        same = self.scene is scene and self.sensor is sensor and self.spp == spp
        return same and isinstance(seed, int) and seed == self.seed_grad


def _seed_grad(seed: Any) -> Any:
    """The seed of the derivatives of a picture, as ``mi.render`` has it by default."""
    return mi.sample_tea_32(seed, 1)[0] if isinstance(seed, int) else None


class _Wavefront:
    """A sampler that says how many samples a pixel it draws now, not how many it spreads."""

    def __init__(self, sampler: mi.Sampler, count: int) -> None:
        self._sampler, self._count = sampler, count

    def sample_count(self) -> int:
        """Of one pass."""
        return self._count

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sampler, name)


def _seed_of(seed: Any, i: int) -> Any:
    """Of the i-th pass."""
    return seed if i == 0 else mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(i))[0]


def _sampled_size(film: mi.Film) -> Any:
    """Of the part of the film that is sampled, in pixels."""
    border = 2 * film.rfilter().border_size() if film.sample_border() else 0
    return film.crop_size() + border


class _Kept:
    """Camera rays that are gone through several times: made once if they are one pass."""

    def __init__(self, passes: Callable[[], Iterator[CameraRays]]) -> None:
        self._passes = passes
        self._only: CameraRays | None = None

    def __iter__(self) -> Iterator[CameraRays]:
        if self._only is not None:
            yield self._only
            return
        passes = self._passes()
        self._only = next(passes)
        yield self._only
        for camera in passes:
            self._only = None
            yield camera


def _pull(value: Any, gradient: Any) -> None:
    """Carries the gradient of a value to what it was made of."""
    dr.set_grad(value, gradient)
    dr.enqueue(dr.ADMode.Backward, value)
    dr.traverse(dr.ADMode.Backward)
