"""The ``nerf`` integrator: shows a radiance field by quadrature along camera rays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, get_args

import drjit as dr
import mitsuba as mi
from mitsuba.ad.integrators.common import ADIntegrator

from ..color import srgb_to_linear
from ..errors import InputError
from ..quadrature import Rule, over_background
from ..volume import (
    Evaluation,
    MarchSettings,
    integrate,
    place_samples,
    ray_chunks,
    slice_rays,
)
from .placement import PlacedField, find_field

# Camera rays traced at a time; more samples per pixel take several passes.
_RAYS_PER_PASS = 1 << 22
_AOVS = ("depth", "opacity")


@dataclass
class _Wave:
    """The camera rays of one pass, and what they returned."""

    ray: Any
    weight: Any
    position: Any  # on the film
    jitter: Any  # one offset a ray, or None
    outputs: list[Any]  # R, G, B, opacity, depth


class NerfIntegrator(ADIntegrator):
    r"""
    .. _integrator-nerf:

    Neural radiance field (:monosp:`nerf`)
    --------------------------------------

    .. pluginparameters::

     * - samples
       - |int|
       - Strata along each ray between entry and exit of the field's box.
         (Default: what the field file suggests)
     * - near, far
       - |float|
       - Fixed bounds of the distance along the ray, in world units, within the box.
         (Default: what the field file suggests)
     * - rule
       - |string|
       - How density runs between samples: ``constant`` over strata, over ``cells`` that
         reach halfway to the next sample, or ``linear`` from sample to sample.
         (Default: what the field file suggests)
     * - stop
       - |float|
       - A ray ends where less than this share of the light behind passes, which changes
         the opacity by less than it, and a colour by less than it times the largest
         radiance. Derivatives always take all samples. 0 switches it off.
         (Default: what the field file suggests, 1e-3 as trained)
     * - jitter
       - |bool|
       - Shift the samples of every camera ray at random within their strata. Without
         it, all randomness comes from the film position. (Default: true)
     * - aovs
       - |string|
       - Extra channels, a comma-separated list of ``depth`` (mean distance along the
         ray, weighted by contribution; 0 where the field is not seen) and ``opacity``,
         each perhaps with a channel name in front as in ``z:depth``. (Default: none)
     * - hide_emitters
       - |bool|
       - Leave out the environment emitter behind the field. (Default: false)

    Estimates the volume-rendering integral (NeRF, Eq. 3) of the scene's ``nerfmedium``,
    in front of the scene's environment emitter if it has one and of black otherwise.
    The alpha channel of an RGBA film is the field's opacity. The colour of a field
    trained on sRGB images is composited as in training and then decoded: with C the
    composited colour and A the opacity of a ray, the linear radiance is
    A·srgb_to_linear(C/A). Images are differentiable with respect to the field's weights.

    .. tabs::
        .. code-tab:: xml

            <integrator type="nerf">
                <string name="aovs" value="depth,opacity"/>
            </integrator>

        .. code-tab:: python

            'type': 'nerf',
            'aovs': 'depth,opacity'
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        if not mi.variant().endswith("_rgb"):
            raise InputError(
                f"nerf: variant '{mi.variant()}' is not supported, "
                "expected 'llvm_ad_rgb' or 'cuda_ad_rgb'"
            )
        self.samples = int(props.get("samples", 0))
        if self.samples < 0:
            raise InputError(f"nerf: samples={self.samples}, expected 1 or more")
        self.near, self.far = props.get("near", None), props.get("far", None)
        self.rule = props.get("rule", None)
        if self.rule not in (None, *get_args(Rule)):
            raise InputError(f"nerf: rule='{self.rule}', expected {' or '.join(get_args(Rule))}")
        self.stop = props.get("stop", None)
        if self.stop is not None and not 0 <= self.stop < 1:
            raise InputError(f"nerf: stop={self.stop}, expected 0 to less than 1")
        self.jitter = bool(props.get("jitter", True))
        # Read by the base class in C++; kept here for the background.
        self.show_background = not bool(props.get("hide_emitters", False))
        self.aovs = _parse_aovs(str(props.get("aovs", "")))

    def aov_names(self) -> list[str]:
        """Names of the extra channels."""
        return [name for name, _ in self.aovs]

    def to_string(self) -> str:
        """Lists the settings."""
        return (
            "NerfIntegrator[\n"
            f"  samples = {self.samples or 'from field file'},\n"
            f"  near = {self.near}, far = {self.far},\n"
            f"  rule = {self.rule or 'from field file'},\n"
            f"  stop = {'from field file' if self.stop is None else self.stop},\n"
            f"  jitter = {self.jitter},\n"
            f"  aovs = {self.aov_names()}\n"
            "]"
        )

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
        sensor = _sensor(scene, sensor)
        with dr.suspend_grad():
            placed = find_field(scene)
            waves = self._waves(scene, sensor, seed, spp)
            image = self._develop(sensor.film(), self._traced(scene, placed, waves), develop)
            if evaluate and develop:
                dr.eval(image)
        return image

    def render_backward(
        self,
        scene: mi.Scene,
        params: Any,
        grad_in: Any,
        sensor: int | mi.Sensor = 0,
        seed: Any = 0,
        spp: int = 0,
    ) -> None:
        """Carries the gradient of an image to the weights of the field.

        First to the values of the camera rays, through reconstruction filter and film,
        then chunk by chunk through quadrature and network: memory does not grow with
        the image.
        """
        sensor = _sensor(scene, sensor)
        with dr.suspend_grad():
            placed = find_field(scene)
            waves = list(self._traced(scene, placed, self._waves(scene, sensor, seed, spp)))
            with dr.resume_grad():
                for wave in waves:
                    for output in wave.outputs:
                        dr.enable_grad(output)
                image = self._develop(sensor.film(), waves, True)
                dr.set_grad(image, grad_in)
                dr.enqueue(dr.ADMode.Backward, image)
                dr.traverse(dr.ADMode.Backward)
                adjoints = [[dr.grad(output) for output in wave.outputs] for wave in waves]
            dr.eval(adjoints)
            for wave, gradients in zip(waves, adjoints, strict=True):
                for chunk in self._chunks(placed, wave):
                    self._chunk_backward(scene, placed, wave, chunk, gradients)

    def render_forward(
        self,
        scene: mi.Scene,
        params: Any,
        sensor: int | mi.Sensor = 0,
        seed: Any = 0,
        spp: int = 0,
    ) -> Any:
        """The derivative of an image along the gradients of the field's weights."""
        sensor = _sensor(scene, sensor)
        with dr.suspend_grad():
            placed = find_field(scene)
            waves = list(self._traced(scene, placed, self._waves(scene, sensor, seed, spp)))
            for wave in waves:
                tangents = [dr.zeros(mi.Float, len(o)) for o in wave.outputs]
                for chunk in self._chunks(placed, wave):
                    self._chunk_forward(scene, placed, wave, chunk, tangents)
                with dr.resume_grad():
                    for output, tangent in zip(wave.outputs, tangents, strict=True):
                        dr.enable_grad(output)
                        dr.set_grad(output, tangent)
            with dr.resume_grad():
                image = self._develop(sensor.film(), waves, True)
                dr.forward_to(image)
                return dr.grad(image)

    def sample(
        self, mode: Any, scene: mi.Scene, sampler: mi.Sampler, ray: Any, **kwargs: Any
    ) -> tuple[Any, Any, list[Any], Any]:
        """Radiance along single rays, for integrators that nest this one."""
        with dr.suspend_grad():
            placed = find_field(scene)
            jitter = sampler.next_1d() if self.jitter else None
            wave = _Wave(ray, None, None, jitter, [])
            self._trace(scene, placed, wave)
        color, opacity, depth = wave.outputs[:3], wave.outputs[3], wave.outputs[4]
        aovs = self._aov_values(opacity, depth)
        return mi.Color3f(*color), opacity > 0, aovs, None

    # ---------------------------------- Camera rays ----------------------------------

    def _waves(self, scene: mi.Scene, sensor: mi.Sensor, seed: Any, spp: int) -> Iterator[_Wave]:
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
            jitter = sampler.next_1d() if self.jitter else None
            dr.eval(ray, weight, position, jitter)
            yield _Wave(ray, weight, position, jitter, [])

    def _develop(self, film: mi.Film, waves: Any, develop: bool) -> Any:
        """Splats the rays' values through the film's reconstruction filter."""
        block = None
        for wave in waves:
            block = block or film.create_block()
            r, g, b, opacity, depth = wave.outputs
            ADIntegrator._splat_to_block(
                block,
                film,
                wave.position,
                value=mi.Color3f(r, g, b) * wave.weight,
                weight=1.0,
                alpha=opacity,
                aovs=self._aov_values(opacity, depth),
                wavelengths=wave.ray.wavelengths,
            )
            dr.eval(block.tensor())  # lets go of this pass before the next one
        film.put_block(block)
        return film.develop() if develop else None

    def _aov_values(self, opacity: Any, depth: Any) -> list[Any]:
        values = {"depth": depth, "opacity": opacity}
        return [values[kind] for _, kind in self.aovs]

    # ---------------------------------- Field ----------------------------------

    def _march(self, placed: PlacedField) -> MarchSettings:
        march = placed.medium.march
        samples = self.samples or march.samples
        stop = march.stop if self.stop is None else self.stop
        rule = self.rule or march.rule
        return replace(march, samples=samples, near=None, far=None, rule=rule, stop=stop)

    def _bounds(self, placed: PlacedField, ray: Any, scale: Any) -> tuple[Any, Any]:
        """Per-ray bounds of t in field units: the integrator's, the file's, the sensor's."""
        march = placed.medium.march
        near = mi.Float(march.near or 0) if self.near is None else self.near * scale
        far = mi.Float(dr.inf if march.far is None else march.far)
        if self.far is not None:
            far = self.far * scale
        return near, dr.fmin(far, ray.maxt * scale)

    def _traced(self, scene: mi.Scene, placed: PlacedField, waves: Any) -> Iterator[_Wave]:
        for wave in waves:
            self._trace(scene, placed, wave)
            yield wave

    def _trace(self, scene: mi.Scene, placed: PlacedField, wave: _Wave) -> None:
        """Fills in ``wave.outputs``, without derivatives."""
        rays = dr.width(wave.ray)
        wave.outputs = [dr.zeros(mi.Float, rays) for _ in range(5)]
        for chunk in self._chunks(placed, wave):
            index, values, _ = self._render_chunk(scene, placed, wave, chunk)
            for output, value in zip(wave.outputs, values, strict=True):
                dr.scatter(output, value, index)
            dr.eval(wave.outputs)

    def _chunks(self, placed: PlacedField, wave: _Wave) -> Iterator[tuple[int, int]]:
        return ray_chunks(dr.width(wave.ray), self._march(placed))

    def _render_chunk(
        self,
        scene: mi.Scene,
        placed: PlacedField,
        wave: _Wave,
        chunk: tuple[int, int],
        mode: dr.ADMode = dr.ADMode.Primal,
    ) -> tuple[Any, list[Any], Evaluation]:
        """R, G, B, opacity and depth of some rays; leaves of the field are attached."""
        index, o, d, jitter = slice_rays(wave.ray.o, wave.ray.d, wave.jitter, *chunk)
        ray = mi.Ray3f(mi.Point3f(o), mi.Vector3f(d))
        ray.maxt = dr.gather(mi.Float, wave.ray.maxt, index)
        local_o, local_d, scale = placed.to_local(ray.o, ray.d)
        dr.eval(local_o, local_d, scale)
        march, field = self._march(placed), placed.medium.field
        samples = place_samples(
            field,
            local_o,
            local_d,
            march,
            occupancy=placed.medium.occupancy,
            jitter=jitter,
            bounds=self._bounds(placed, ray, scale),
        )
        background = self._background(scene, ray)
        with dr.resume_grad(when=mode != dr.ADMode.Primal):
            stop = march.stop if mode == dr.ADMode.Primal else 0.0
            evaluation = Evaluation(field, samples, march.block, stop=stop)
            if mode != dr.ADMode.Primal:
                evaluation.enable_grad()
            if mode == dr.ADMode.Forward:
                evaluation.forward()
            seen = integrate(evaluation, samples)
            color = _linear(seen.color, seen.opacity) if field.color_space == "srgb" else seen.color
            values = over_background(color, seen.opacity, background)
            values += [seen.opacity, seen.depth / scale]
        return index, values, evaluation

    def _chunk_backward(
        self, scene: mi.Scene, placed: PlacedField, wave: _Wave, chunk: Any, gradients: list[Any]
    ) -> None:
        index, values, evaluation = self._render_chunk(
            scene, placed, wave, chunk, dr.ADMode.Backward
        )
        with dr.resume_grad():
            for value, gradient in zip(values, gradients, strict=True):
                dr.set_grad(value, dr.gather(mi.Float, gradient, index))
                dr.enqueue(dr.ADMode.Backward, value)
            dr.traverse(dr.ADMode.Backward)
            evaluation.backward()

    def _chunk_forward(
        self, scene: mi.Scene, placed: PlacedField, wave: _Wave, chunk: Any, tangents: list[Any]
    ) -> None:
        index, values, _ = self._render_chunk(scene, placed, wave, chunk, dr.ADMode.Forward)
        with dr.resume_grad():
            # The opacity is an output and an input of the colours: keep interior gradients.
            dr.forward_to(values, flags=dr.ADFlag.ClearEdges)
            slopes = [dr.grad(value) for value in values]
        for tangent, slope in zip(tangents, slopes, strict=True):
            dr.scatter(tangent, slope, index)
        dr.eval(tangents)

    def _background(self, scene: mi.Scene, ray: Any) -> list[Any]:
        """Radiance of the environment emitter along rays, zero without one."""
        emitter = scene.environment() if self.show_background else None
        if emitter is None:
            return [mi.Float(0)] * 3
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray))
        si.wi = -ray.d
        radiance = emitter.eval(si)
        return [radiance.x, radiance.y, radiance.z]


def _parse_aovs(text: str) -> list[tuple[str, str]]:
    """Channel names and kinds of a list such as ``depth, a:opacity``."""
    aovs = []
    for item in text.replace(" ", "").split(","):
        name, _, kind = item.rpartition(":")
        if item and kind not in _AOVS:
            raise InputError(f"nerf: aov '{item}' is unknown, expected {' or '.join(_AOVS)}")
        if item:
            aovs.append((name or kind, kind))
    return aovs


def _linear(color: list[Any], opacity: Any) -> list[Any]:
    """Premultiplied linear radiance of premultiplied sRGB colour."""
    visible = opacity > 0
    inverse = dr.select(visible, 1 / dr.select(visible, opacity, 1), 0)
    return [srgb_to_linear(c * inverse) * opacity for c in color]


def _sensor(scene: mi.Scene, sensor: int | mi.Sensor) -> mi.Sensor:
    """The sensor meant by an index or given as such."""
    if not isinstance(sensor, int):
        return sensor
    sensors = scene.sensors()
    if sensor >= len(sensors):
        raise InputError(f"nerf: sensor {sensor} of {len(sensors)}: the scene has no such sensor")
    return sensors[sensor]


mi.register_integrator("nerf", NerfIntegrator)
