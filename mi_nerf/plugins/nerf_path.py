"""The ``nerf_path`` integrator: light transport among surfaces and radiance fields."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import mitsuba as mi

from .field_scene import FieldScene
from .marching import MarchingIntegrator
from .path_state import PathSettings
from .paths import PathsBehind
from .placement import find_fields
from .power import field_powers, field_share
from .sampled import SampledField
from .solid_scene import SolidScene, check_no_loose_field
from .wanted_gradients import check_gradients


class NerfPathIntegrator(MarchingIntegrator):
    r"""
    .. _integrator-nerf_path:

    Path tracer through radiance fields (:monosp:`nerf_path`)
    ---------------------------------------------------------

    .. pluginparameters::

     * - max_depth
       - |int|
       - Segments of the longest path, as in :monosp:`path`: 1 shows only what emits, fields
         included; 2 adds what surfaces reflect of that; −1 sets no limit. Fields add nothing
         to the depth. (Default: −1)
     * - rr_depth
       - |int|
       - Surfaces on a path from which on it may end at random, with a probability that follows
         from its throughput (Russian roulette). (Default: 5)
     * - hide_emitters
       - |bool|
       - Hide lights and environment from cameras; fields are seen. (Default: false)
     * - emitter_candidates
       - |int|
       - Points of light sources that every matt or glossy surface looks at; one of them is chosen,
         with a probability that follows what it would bring if nothing were between, and only
         for that one surfaces and fields between are looked for
         (:py:mod:`mi_nerf.plugins.light_choice`). (Default: 8)
     * - sample_fields
       - |string|
       - :monosp:`true` or :monosp:`false`, also as a boolean, or :monosp:`auto`: at matt and glossy
         surfaces, sample directions towards the fields besides those that the surface prefers
         and those of the scene's lights. Worth its time where fields are the lamps; among other
         lights a path costs several times as much and is hardly less noisy. With :monosp:`auto`,
         it is done if more than a quarter of the light around fields is theirs when a scene is
         first rendered (:py:mod:`mi_nerf.plugins.power`). The mean is the same. (Default: auto)
     * - paths
       - |int|
       - Paths that go on behind the fields for every camera ray. (Default: 1)
     * - samples
       - |int|
       - Strata along each segment between entry and exit of a field's box.
         (Default: what the field file suggests)
     * - fine
       - |int|
       - More samples along each segment, as in :monosp:`nerf`.
         (Default: what the field file suggests)
     * - near, far
       - |float|
       - Fixed bounds of the distance along camera rays, in world units, within the boxes. Neither
         these nor those of a field file bound other segments.
         (Default: what the field file suggests)
     * - rule
       - |string|
       - How density runs between samples, as in :monosp:`nerf`.
         (Default: what the field file suggests)
     * - stop
       - |float|
       - Paths end where fields let less than this share of them pass. 0 switches it off.
         (Default: what the field file suggests, 1e-3 as trained)
     * - jitter
       - |bool|
       - Shift the samples of every segment at random within their strata. (Default: true)
     * - aovs
       - |string|
       - Extra channels of camera rays: ``depth``, ``opacity``, ``normal``, ``index``, as in
         :monosp:`nerf`. (Default: none)

    Follows light paths among surfaces and lights, each segment of which passes the fields: they
    weaken it and add what they emit. So fields cast shadows, are seen in mirrors and through
    glass, and light up what stands around them; they do not scatter, so nothing lights *them*
    up: what they show is what they were trained to show. The cubes of fields are no surfaces.
    A scene without fields looks as :monosp:`path` shows it.

    Light sources are sampled as in :monosp:`path`, and the light that arrives is weakened by the
    fields between; only their densities are asked for that. Light from fields is found by the
    directions that the surface's BSDF prefers and, with ``sample_fields``, also by directions
    towards points spread evenly in the box around the occupied cells of a field
    (:py:mod:`mi_nerf.plugins.field_light`), combined by multiple importance sampling (Veach and
    Guibas 1995). Fields in normalised device coordinates have no such box: only the first of
    these finds them.

    The estimate is without bias apart from the quadrature along each segment, which is that of
    :monosp:`nerf`. All light is linear: on every segment, a field trained on sRGB images is
    composited in sRGB as it was in training and then decoded. With C its colour and A its opacity
    there, it adds A·srgb_to_linear(C/A) and lets pass 1 − A, so it looks in a mirror, or on the
    floor below, as it does to the camera. Where fields are partly transparent, what they add is
    not additive along the ray: a surface within such a field splits it, and both parts decoded
    on their own differ a little from the whole decoded at once.

    **Derivatives**, backward and forward, by path replay (Vicini et al. 2021,
    :py:mod:`mi_nerf.plugins.path_replay`): of weights and places of fields, of colours and
    textures of surfaces and of the power of lights; through shadows, mirrors, glass and the light
    that fields cast. Memory grows neither with the depth of paths nor with their number. Sampling
    is detached. As in :monosp:`prb`, edges of surfaces that move are left out; here surfaces,
    sensors and the positions of lights have no derivatives at all, and asking for one is an
    error. Left out, too: a channel of colour that is exactly 0, as to what is reflected more
    than once; mirrors or glass within :monosp:`blendbsdf`; and the alpha channel, as to fields
    behind surfaces that let light straight through. Russian roulette and ``stop`` apply to
    derivatives as they do to pictures.

    .. tabs::
        .. code-tab:: xml

            <integrator type="nerf_path">
                <integer name="max_depth" value="8"/>
            </integrator>

        .. code-tab:: python

            'type': 'nerf_path',
            'max_depth': 8
    """

    plugin = "nerf_path"
    differentiable = True
    rays_per_pass = 1 << 20  # paths remember more than rays do
    rays_per_adjoint = 1 << (18 if mi.variant().startswith("cuda") else 14)  # and more to go back

    def __init__(self, props: mi.Properties) -> None:
        # Checked before the base class reads and refuses them.
        self._integer(props, "max_depth", -1, least=0)
        self._integer(props, "rr_depth", 5, least=1)
        super().__init__(props)
        self.emitter_candidates = self._integer(props, "emitter_candidates", 8, least=1)
        if props.get("max_depth", -1) < 0:  # the base class has a default of its own
            self.max_depth = _UNLIMITED
        chosen = props.get("sample_fields", "auto")
        known = {True: True, False: False, "true": True, "false": False, "auto": "auto"}
        if chosen not in known:
            raise self._unlike("sample_fields", f"'{chosen}'", "true, false or auto")
        self.sample_fields = known[chosen]
        self._solid, self._keep = SolidScene(), False
        self._lamps: _Lamps | None = None

    def render_backward(self, scene: mi.Scene, *args: Any, **options: Any) -> None:
        """Carries the gradient of an image to the parameters; see :class:`FieldIntegrator`."""
        check_gradients(scene, self.plugin)
        with self._differentiating():
            super().render_backward(scene, *args, **options)

    def render_forward(self, scene: mi.Scene, *args: Any, **options: Any) -> Any:
        """The derivative of an image along the gradients of the scene's parameters."""
        check_gradients(scene, self.plugin)
        with self._differentiating():
            return super().render_forward(scene, *args, **options)

    @contextmanager
    def _differentiating(self) -> Iterator[None]:
        """Scenes keep what derivatives need."""
        self._keep = True
        try:
            yield
        finally:
            self._keep = False

    def to_string(self) -> str:
        """Lists the settings."""
        depth = "unlimited" if self.max_depth == _UNLIMITED else self.max_depth
        return (
            "NerfPathIntegrator[\n"
            f"  max_depth = {depth}, rr_depth = {self.rr_depth},\n"
            f"{self._settings()}"
            f"  emitter_candidates = {self.emitter_candidates},\n"
            f"  sample_fields = {self.sample_fields}\n"
            "]"
        )

    def _scene(self, scene: mi.Scene) -> FieldScene:
        """The scene as it is now."""
        found = find_fields(scene, least=0)
        if not found:
            check_no_loose_field(scene)
        fields = self._marched(found) if self.max_depth > 0 else []
        normals, solid = self._wants_normals(fields), self._solid.of(scene)
        powers = self._powers(solid, fields)
        settings = PathSettings(
            max_depth=self.max_depth,
            rr_depth=self.rr_depth,
            paths=self.paths,
            emitter_candidates=self.emitter_candidates,
            hide_lights=not self.show_background,
            field_powers=powers,
            jitter=self.jitter,
            stop=min((field.march.stop for field in fields), default=0.0),
            keep=self._keep,
        )
        return FieldScene(fields, PathsBehind(solid, fields, settings, normals), normals)

    def _powers(self, solid: mi.Scene, fields: list[SampledField]) -> list[float] | None:
        """Those of the fields if they are sampled as lights; as they were at first."""
        if self.sample_fields is False or not fields:
            return None
        media = [marched.placed.medium for marched in fields]
        if self._lamps is None or not self._lamps.are(media):
            powers = field_powers(fields)
            sampled = self.sample_fields is True or field_share(solid, fields, powers) > _SHARE
            self._lamps = _Lamps(media, powers if sampled else None)
        return self._lamps.powers


@dataclass(frozen=True)
class _Lamps:
    """What was found about the fields of a scene as light sources."""

    media: list[Any]
    powers: list[float] | None  # if they are to be sampled

    def are(self, media: list[Any]) -> bool:
        """Whether these were the fields."""
        same = len(self.media) == len(media)
        return same and all(a is b for a, b in zip(self.media, media, strict=True))


_UNLIMITED = 2**31 - 1
_SHARE = 0.25  # of the light around fields: if more is theirs, they are sampled as lights

mi.register_integrator("nerf_path", NerfPathIntegrator)
