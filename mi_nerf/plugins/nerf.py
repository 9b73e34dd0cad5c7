"""The ``nerf`` integrator: radiance fields among surfaces, by quadrature along camera rays."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ..base.errors import InputError
from .backdrop import Backdrop, Environment, Surfaces, check_nested, knows_media
from .colors import check_encoded
from .field_scene import FieldScene
from .film import FieldIntegrator, TracedScene
from .fog_scene import FogScene
from .marching import MarchingIntegrator
from .media import media_of
from .placement import find_fields
from .solid_scene import SolidScene, has_surfaces
from .wanted_gradients import check_gradients

# Camera rays up to which a picture of fields in training keeps what its derivatives need.
_BATCH = 1 << 14


class NerfIntegrator(MarchingIntegrator):
    r"""
    .. _integrator-nerf:

    Neural radiance field (:monosp:`nerf`)
    --------------------------------------

    .. pluginparameters::

     * - (Nested plugin)
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
     * - fine
       - |int|
       - More samples along each ray, where the field's coarse network sees something (hierarchical
         sampling, NeRF Sec. 5.2); 0 switches it off. (Default: what the field file suggests)
     * - network
       - |string|
       - Which one of a field with two networks is shown: ``fine``, whose samples the other one
         places, or ``coarse`` itself, at ``samples`` places. A training loop renders both.
         (Default: ``fine``)
     * - near, far
       - |float|
       - Fixed bounds of the distance along the ray, in world units, within the boxes.
         (Default: what the field file suggests)
     * - rule
       - |string|
       - How density runs between samples: ``constant`` over strata, over ``cells`` that
         reach halfway to the next sample, or ``linear`` from sample to sample, which counts
         as ``cells`` where a scene holds several fields.
         (Default: what the field file suggests)
     * - stop
       - |float|
       - A ray ends where a field lets pass less than this share of the light behind, which
         changes the opacity by less than it, and a colour by less than it times the largest
         radiance; derivatives end there, too. 0 switches it off.
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
     * - encoded
       - |bool|
       - Leave the colour of a field trained on sRGB images as it was composited, in sRGB,
         with the environment encoded likewise; for a single field without a nested
         integrator. (Default: false)

    Estimates the volume-rendering integral (NeRF, Eq. 3) of all ``nerfmedium`` of the scene.
    Where several overlap, densities add up and the emission is the mean by density,
    c = Σ σ_k c_k / Σ σ_k: the samples of all fields along a ray are merged in depth and
    integrated once (:py:mod:`mi_nerf.march.merging`). The integral ends exactly at the first
    surface, and the nested integrator's radiance of the ray, weakened by the fields before it,
    is added. The nested integrator does not know the fields: it sees the scene without their
    cubes, so fields cast no shadows and are missing in mirrors; :monosp:`nerf_path` has both. What
    is seen through a surface that is not opaque is likewise without fields.

    Media of Mitsuba's own, homogeneous or heterogeneous, may stand beside fields where
    :monosp:`volpath`, :monosp:`volpathmis` or :monosp:`prbvolpath` is nested: what lies behind
    them is weakened by them, what they scatter towards the camera by the fields before them
    (:py:mod:`mi_nerf.plugins.fog_scene`). They are not lit or shaded by fields. Their shapes have
    the BSDF :monosp:`null`. A ray that comes to a field through fog asks the nested integrator
    twice, and a single sample may be negative there. With :monosp:`volpath` or
    :monosp:`volpathmis`, media may reach into the boxes of fields or surround them: both weaken
    light there, and along each ray the field counts at its mean depth in the medium.

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

    plugin = "nerf"
    differentiable = True

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.encoded = bool(props.get("encoded", False))
        self.network = str(props.get("network", "fine"))
        if self.network not in ("fine", "coarse"):
            raise self._unlike("network", f"'{self.network}'", "fine or coarse")
        self.nested = self._find_nested(props)
        self._solid, self._warned = SolidScene(), False

    @staticmethod
    def _find_nested(props: mi.Properties) -> Any:
        """The integrator among the properties, or ``None``."""
        values = [props[key] for key in props.unqueried()]
        found = [value for value in values if isinstance(value, mi.Integrator)]
        if len(found) > 1:
            raise InputError(f"nerf: {len(found)} nested integrators, expected at most one")
        for nested in found:
            if isinstance(nested, FieldIntegrator):
                raise InputError(
                    f"nerf: '{nested.plugin}' nested in 'nerf', expected one like 'path' or 'prb'"
                )
            check_nested(nested)
        return found[0] if found else None

    def render_backward(self, scene: mi.Scene, *args: Any, **options: Any) -> None:
        """Carries the gradient of an image to the parameters; see :class:`FieldIntegrator`."""
        check_gradients(scene, self.plugin)
        super().render_backward(scene, *args, **options)

    def render_forward(self, scene: mi.Scene, *args: Any, **options: Any) -> Any:
        """The derivative of an image along the gradients of the scene's parameters."""
        check_gradients(scene, self.plugin)
        return super().render_forward(scene, *args, **options)

    def traverse(self, callback: Any) -> None:
        """Exposes the nested integrator."""
        if self.nested is not None:
            callback.put("nested", self.nested, mi.ParamFlags.Differentiable)

    def to_string(self) -> str:
        """Lists the settings."""
        return (
            "NerfIntegrator[\n"
            f"{self._settings()}"
            f"  network = {self.network}, encoded = {self.encoded},\n"
            f"  nested = {self.nested}\n"
            "]"
        )

    def _scene(self, scene: mi.Scene) -> TracedScene:
        """The scene as it is now."""
        found = find_fields(scene, others=knows_media(self.nested))
        encoded = self.encoded and found[0].medium.field.color_space == "srgb"
        if self.encoded and (len(found) > 1 or self.nested is not None):
            raise InputError(
                "nerf: encoded=true with several fields or a nested integrator, expected a "
                "single field: light mixes in linear radiance"
            )
        if encoded:
            check_encoded(self.plugin)
        fields = self._marched(found, encoded, self.network == "coarse")
        normals = self._wants_normals(fields)
        backdrop: Backdrop
        if self.nested is None:
            self._warn_of_surfaces(scene)
            backdrop = Environment(scene, self.show_background, encoded)
        else:
            solid = self._solid.of(scene)
            backdrop = Surfaces(solid, self.nested, self.paths, normals)
            if media_of(solid):
                return FogScene(fields, solid, backdrop, normals)
        return FieldScene(fields, backdrop, normals)

    def _trains(self, view: FieldScene | FogScene, sensor: mi.Sensor, spp: int) -> bool:
        rays = int(dr.prod(sensor.film().crop_size())) * (spp or sensor.sampler().sample_count())
        frozen = dr.flag(dr.JitFlag.FreezingScope)
        return view.trained and rays <= _BATCH and not self.aovs and not frozen

    def _warn_of_surfaces(self, scene: mi.Scene) -> None:
        if not self._warned and has_surfaces(scene):
            mi.Log(
                mi.LogLevel.Warn,
                "nerf: the scene's surfaces and lights are left out without an integrator to "
                'show them: nest one, as in <integrator type="nerf"><integrator type="path"/>'
                "</integrator>",
            )
        self._warned = True


mi.register_integrator("nerf", NerfIntegrator)
