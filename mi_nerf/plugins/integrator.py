"""The ``nerf`` integrator: radiance fields among surfaces, by quadrature along camera rays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
from mitsuba.ad.integrators.common import ADIntegrator

from ..errors import InputError
from ..volume import MarchSettings
from .backdrop import Environment, SolidScene, Surfaces, check_nested, has_surfaces
from .crossing import Marched
from .placement import PlacedField, find_fields
from .stage import Stage, Wave

# Camera rays traced at a time; more samples per pixel take several passes.
_RAYS_PER_PASS = 1 << 22
_AOVS = ("depth", "opacity", "normal", "index")
_AXES = (".X", ".Y", ".Z")


class NerfIntegrator(ADIntegrator):
    r"""
    .. _integrator-nerf:

    Neural radiance field (:monosp:`nerf`)
    --------------------------------------

    .. pluginparameters::

     * - (nested plugin)
       - |integrator|
       - What shows surfaces and lights, such as :monosp:`path` or :monosp:`prb`: any integrator
         that returns the radiance along a ray. Without one, the scene's surfaces are left out,
         and only its environment emitter is seen. (Default: none)
     * - paths
       - |int|
       - How often the nested integrator is asked about each camera ray. A ray through a field
         costs many times as much as a path: with 4 samples a pixel and ``paths`` 16, surfaces
         get 64 paths a pixel for the price of 4 rays through the fields. (Default: 1)
     * - samples
       - |int|
       - Strata along each ray between entry and exit of a field's box.
         (Default: what the field file suggests)
     * - near, far
       - |float|
       - Fixed bounds of the distance along the ray, in world units, within the boxes.
         (Default: what the field file suggests)
     * - stop
       - |float|
       - A ray ends where a field lets pass less than this share of the light behind, which
         changes the opacity by less than it, and a colour by less than it times the largest
         radiance. Derivatives always take all samples. 0 switches it off.
         (Default: what the field file suggests, 1e-3 as trained)
     * - jitter
       - |bool|
       - Shift the samples of every camera ray at random within their strata. Without
         it, all randomness comes from the film position. (Default: true)
     * - aovs
       - |string|
       - Extra channels, a comma-separated list of the following, each perhaps with a channel
         name in front as in ``z:depth``. (Default: none)

         - ``depth``: mean distance along the ray of fields and the first surface, weighted by
           what each contributes; 0 where nothing is seen.
         - ``opacity``: that of the fields before the first surface.
         - ``normal``: mean of the unit normals −∇σ/|∇σ| of fields, in world coordinates, and
           the shading normal of the first surface, weighted likewise; three channels. It
           carries no derivatives.
         - ``index``: number of the field that contributes most, counted from 1 in the
           alphabetical order of the ids of the cubes; 0 where no field is seen. Averaged like
           everything else over the samples of a pixel, without derivatives.
     * - hide_emitters
       - |bool|
       - Leave out the environment emitter behind the fields. A nested integrator has an option
         of its own for that. (Default: false)

    Estimates the volume-rendering integral (NeRF, Eq. 3) of all ``nerfmedium`` of the scene.
    Where several overlap, densities add up and the emission is the mean by density,
    c = Σ σ_k c_k / Σ σ_k: the samples of all fields along a ray are merged in depth and
    integrated once (:py:mod:`mi_nerf.merging`). The integral ends exactly at the first
    surface, and the nested integrator's radiance of the ray, weakened by the fields before it,
    is added. The nested integrator does not know the fields: it sees the scene without their
    cubes, so fields cast no shadows and are missing in mirrors. What is seen through a surface
    that is not opaque is likewise without fields.

    The alpha channel of an RGBA film is the opacity of the fields; with a nested integrator,
    its alpha channel with the fields in front. The colour of a field trained on sRGB images is
    composited as in training and then decoded: with C the colour under the field's weights and
    A their sum, the linear radiance is A·srgb_to_linear(C/A). Other fields and surfaces are
    mixed with that in linear radiance: each field on its own looks just as it does alone, and
    where it is partly transparent, as at its edges, it is blended with what lies behind it as
    light is, not as the numbers of an sRGB image are. Compositing the same field in sRGB over a
    bright background, as training on white does, gives darker edges.

    Images are differentiable with respect to the weights of the fields and their places (the
    medium's ``to_world``, the vertices of its cube), and to whatever the nested integrator
    differentiates, such as colours of surfaces and lights; not with respect to where surfaces
    or the camera are. Mitsuba's C++ integrators are differentiated by recording their paths,
    which takes memory for every bounce; :monosp:`prb` spares that.

    .. tabs::
        .. code-tab:: xml

            <integrator type="nerf">
                <string name="aovs" value="depth,opacity"/>
                <integrator type="path"/>
            </integrator>

        .. code-tab:: python

            'type': 'nerf',
            'aovs': 'depth,opacity',
            'nested': {'type': 'path'}
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
        self.stop = props.get("stop", None)
        if self.stop is not None and not 0 <= self.stop < 1:
            raise InputError(f"nerf: stop={self.stop}, expected 0 to less than 1")
        self.jitter = bool(props.get("jitter", True))
        # Read by the base class in C++; kept here for the background.
        self.show_background = not bool(props.get("hide_emitters", False))
        self.aovs = _parse_aovs(str(props.get("aovs", "")))
        self.nested = self._find_nested(props)
        self.paths = int(props.get("paths", 1))
        if self.paths < 1:
            raise InputError(f"nerf: paths={self.paths}, expected 1 or more")
        self._solid, self._warned = SolidScene(), False

    @staticmethod
    def _find_nested(props: mi.Properties) -> Any:
        """The integrator among the properties, or ``None``."""
        found = [(key, props[key]) for key in props.unqueried()]
        found = [(key, value) for key, value in found if isinstance(value, mi.Integrator)]
        if len(found) > 1:
            raise InputError(f"nerf: {len(found)} nested integrators, expected at most one")
        for _, nested in found:
            if isinstance(nested, NerfIntegrator):
                raise InputError("nerf: nested in 'nerf', expected one like 'path' or 'prb'")
            check_nested(nested)
            return nested
        return None

    def traverse(self, callback: Any) -> None:
        """Exposes the nested integrator."""
        if self.nested is not None:
            callback.put("nested", self.nested, mi.ParamFlags.Differentiable)

    def aov_names(self) -> list[str]:
        """Names of the extra channels."""
        return [
            name + part
            for name, kind in self.aovs
            for part in (_AXES if kind == "normal" else ("",))
        ]

    def to_string(self) -> str:
        """Lists the settings."""
        return (
            "NerfIntegrator[\n"
            f"  samples = {self.samples or 'from field file'},\n"
            f"  near = {self.near}, far = {self.far},\n"
            f"  stop = {'from field file' if self.stop is None else self.stop},\n"
            f"  jitter = {self.jitter},\n"
            f"  aovs = {self.aov_names()},\n"
            f"  nested = {self.nested}, paths = {self.paths}\n"
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
            stage = self._stage(scene)
            waves = self._waves(scene, sensor, seed, spp)
            image = self._develop(sensor.film(), _traced(stage, waves), develop)
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
        """Carries the gradient of an image to the parameters of fields, surfaces and lights.

        First to the values of the camera rays, through reconstruction filter and film,
        then chunk by chunk through quadrature and network: memory does not grow with
        the image.
        """
        sensor = _sensor(scene, sensor)
        with dr.suspend_grad():
            stage = self._stage(scene)
            waves = list(_traced(stage, self._waves(scene, sensor, seed, spp)))
            with dr.resume_grad():
                for wave in waves:
                    dr.enable_grad(wave.outputs)
                image = self._develop(sensor.film(), waves, True)
                dr.set_grad(image, grad_in)
                dr.enqueue(dr.ADMode.Backward, image)
                dr.traverse(dr.ADMode.Backward)
                adjoints = [[dr.grad(output) for output in wave.outputs] for wave in waves]
            dr.eval(adjoints)
            for wave, gradients in zip(waves, adjoints, strict=True):
                dr.disable_grad(wave.outputs)
                stage.backward(wave, gradients)

    def render_forward(
        self,
        scene: mi.Scene,
        params: Any,
        sensor: int | mi.Sensor = 0,
        seed: Any = 0,
        spp: int = 0,
    ) -> Any:
        """The derivative of an image along the gradients of the scene's parameters."""
        sensor = _sensor(scene, sensor)
        with dr.suspend_grad():
            stage = self._stage(scene)
            waves = list(_traced(stage, self._waves(scene, sensor, seed, spp)))
            for wave in waves:
                tangents = stage.forward(wave)
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
            jitter = sampler.next_1d() if self.jitter else None
            wave = Wave(ray, None, None, jitter, sampler)
            self._stage(scene).trace(wave)
            shown = wave.shown()
        return shown["color"], shown["alpha"] > 0, self._aov_values(shown), None

    # ---------------------------------- Scene ----------------------------------

    def _stage(self, scene: mi.Scene) -> Stage:
        """The scene as it is now."""
        fields = [
            Marched(placed, self._march(placed), self.near, self.far)
            for placed in find_fields(scene)
        ]
        normals = any(kind == "normal" for _, kind in self.aovs)
        if normals and any(marched.field.ndc is not None for marched in fields):
            raise InputError(
                "nerf: aov 'normal' of a field in normalised device coordinates, expected none"
            )
        backdrop: Environment | Surfaces
        if self.nested is None:
            self._warn_of_surfaces(scene)
            backdrop = Environment(scene, self.show_background)
        else:
            backdrop = Surfaces(self._solid.of(scene), self.nested, self.paths, normals)
        return Stage(fields, backdrop, normals)

    def _march(self, placed: PlacedField) -> MarchSettings:
        march = placed.medium.march
        samples = self.samples or march.samples
        stop = march.stop if self.stop is None else self.stop
        return replace(march, samples=samples, near=None, far=None, stop=stop)

    def _warn_of_surfaces(self, scene: mi.Scene) -> None:
        if not self._warned and has_surfaces(scene):
            mi.Log(
                mi.LogLevel.Warn,
                "nerf: the scene's surfaces and lights are left out without an integrator to "
                'show them: nest one, as in <integrator type="nerf"><integrator type="path"/>'
                "</integrator>",
            )
        self._warned = True

    # ---------------------------------- Camera rays ----------------------------------

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
            jitter = sampler.next_1d() if self.jitter else None
            dr.eval(ray, weight, position, jitter)
            sampler.schedule_state()
            dr.eval()
            yield Wave(ray, weight, position, jitter, sampler)

    def _develop(self, film: mi.Film, waves: Any, develop: bool) -> Any:
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


def _traced(stage: Stage, waves: Iterator[Wave]) -> Iterator[Wave]:
    for wave in waves:
        stage.trace(wave)
        yield wave


def _parse_aovs(text: str) -> list[tuple[str, str]]:
    """Channel names and kinds of a list such as ``depth, a:opacity``."""
    aovs = []
    for item in text.replace(" ", "").split(","):
        name, _, kind = item.rpartition(":")
        if item and kind not in _AOVS:
            expected = ", ".join(_AOVS[:-1])
            raise InputError(f"nerf: aov '{item}' is unknown, expected {expected} or {_AOVS[-1]}")
        if item:
            aovs.append((name or kind, kind))
    return aovs


def _sensor(scene: mi.Scene, sensor: int | mi.Sensor) -> mi.Sensor:
    """The sensor meant by an index or given as such."""
    if not isinstance(sensor, int):
        return sensor
    sensors = scene.sensors()
    if sensor >= len(sensors):
        raise InputError(f"nerf: sensor {sensor} of {len(sensors)}: the scene has no such sensor")
    return sensors[sensor]


mi.register_integrator("nerf", NerfIntegrator)
