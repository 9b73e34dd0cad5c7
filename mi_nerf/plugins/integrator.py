"""The ``nerf`` integrator: shows a radiance field by quadrature along camera rays."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, get_args

import drjit as dr
import mitsuba as mi

from ..errors import InputError
from ..quadrature import Rule
from ..volume import (
    Evaluation,
    MarchSettings,
    integrate,
    place_samples,
    ray_chunks,
    slice_rays,
)
from .camera import FieldIntegrator, Wave
from .placement import PlacedField, find_field


class NerfIntegrator(FieldIntegrator):
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
     * - encoded
       - |bool|
       - Leave the colour of a field trained on sRGB images as it was composited, in sRGB,
         with the environment encoded likewise. (Default: false)

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

    plugin = "nerf"
    known = ("opacity", "depth")

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.samples = int(props.get("samples", 0))
        if self.samples < 0:
            raise InputError(f"nerf: samples={self.samples}, expected 1 or more")
        self.rule = props.get("rule", None)
        if self.rule not in (None, *get_args(Rule)):
            raise InputError(f"nerf: rule='{self.rule}', expected {' or '.join(get_args(Rule))}")
        self.stop = props.get("stop", None)
        if self.stop is not None and not 0 <= self.stop < 1:
            raise InputError(f"nerf: stop={self.stop}, expected 0 to less than 1")
        self.jitter = bool(props.get("jitter", True))

    def to_string(self) -> str:
        """Lists the settings."""
        return (
            "NerfIntegrator[\n"
            f"  samples = {self.samples or 'from field file'},\n"
            f"  near = {self.near}, far = {self.far},\n"
            f"  rule = {self.rule or 'from field file'},\n"
            f"  stop = {'from field file' if self.stop is None else self.stop},\n"
            f"  jitter = {self.jitter}, encoded = {self.encoded},\n"
            f"  aovs = {self.aov_names()}\n"
            "]"
        )

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
        """Carries the gradient of an image to the weights of the field.

        First to the values of the camera rays, through reconstruction filter and film,
        then chunk by chunk through quadrature and network: memory does not grow with
        the image.
        """
        sensor = self._sensor(scene, sensor)
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
        sensor = self._sensor(scene, sensor)
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

    # ---------------------------------- Field ----------------------------------

    def _draw(self, sampler: mi.Sampler, rays: int, seed: Any) -> Any:
        """One offset a ray, or ``None``."""
        return sampler.next_1d() if self.jitter else None

    def _traced(
        self, scene: mi.Scene, placed: PlacedField, waves: Iterable[Wave]
    ) -> Iterator[Wave]:
        for wave in waves:
            self._trace(scene, placed, wave)
            yield wave

    def _march(self, placed: PlacedField) -> MarchSettings:
        march = placed.medium.march
        samples = self.samples or march.samples
        stop = march.stop if self.stop is None else self.stop
        rule = self.rule or march.rule
        return replace(march, samples=samples, near=None, far=None, rule=rule, stop=stop)

    def _trace(self, scene: mi.Scene, placed: PlacedField, wave: Wave) -> None:
        """Fills in ``wave.outputs``, without derivatives."""
        rays = dr.width(wave.ray)
        wave.outputs = [dr.zeros(mi.Float, rays) for _ in range(5)]
        for chunk in self._chunks(placed, wave):
            index, values, _ = self._render_chunk(scene, placed, wave, chunk)
            for output, value in zip(wave.outputs, values, strict=True):
                dr.scatter(output, value, index)
            dr.eval(wave.outputs)

    def _chunks(self, placed: PlacedField, wave: Wave) -> Iterator[tuple[int, int]]:
        return ray_chunks(dr.width(wave.ray), self._march(placed))

    def _render_chunk(
        self,
        scene: mi.Scene,
        placed: PlacedField,
        wave: Wave,
        chunk: tuple[int, int],
        mode: dr.ADMode = dr.ADMode.Primal,
    ) -> tuple[Any, list[Any], Evaluation]:
        """R, G, B, opacity and depth of some rays; leaves of the field are attached."""
        index, o, d, jitter = slice_rays(wave.ray.o, wave.ray.d, wave.random, *chunk)
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
            values = self._in_front(field, seen.color, seen.opacity, background)
            values += [seen.opacity, seen.depth / scale]
        return index, values, evaluation

    def _chunk_backward(
        self, scene: mi.Scene, placed: PlacedField, wave: Wave, chunk: Any, gradients: list[Any]
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
        self, scene: mi.Scene, placed: PlacedField, wave: Wave, chunk: Any, tangents: list[Any]
    ) -> None:
        index, values, _ = self._render_chunk(scene, placed, wave, chunk, dr.ADMode.Forward)
        with dr.resume_grad():
            # The opacity is an output and an input of the colours: keep interior gradients.
            dr.forward_to(values, flags=dr.ADFlag.ClearEdges)
            slopes = [dr.grad(value) for value in values]
        for tangent, slope in zip(tangents, slopes, strict=True):
            dr.scatter(tangent, slope, index)
        dr.eval(tangents)


mi.register_integrator("nerf", NerfIntegrator)
