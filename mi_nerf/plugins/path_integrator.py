"""The ``nerf_path`` integrator: light transport among surfaces and radiance fields."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from ..errors import InputError
from .backdrop import SolidScene, check_no_loose_field
from .marching import MarchingIntegrator
from .paths import PathsBehind, PathSettings
from .placement import find_fields
from .stage import Stage


class NerfPathIntegrator(MarchingIntegrator):
    r""" """

    plugin = "nerf_path"
    rays_per_pass = 1 << 20  # paths remember more than rays do

    def __init__(self, props: mi.Properties) -> None:
        # Checked before the base class reads and refuses them.
        self._integer(props, "max_depth", -1, least=0)
        self._integer(props, "rr_depth", 5, least=1)
        super().__init__(props)
        self.sample_fields = bool(props.get("sample_fields", True))
        self._solid = SolidScene()

    def to_string(self) -> str:
        """Lists the settings."""
        return (
            "NerfPathIntegrator[\n"
            f"  max_depth = {self.max_depth}, rr_depth = {self.rr_depth},\n"
            f"{self._settings()}"
            f"  sample_fields = {self.sample_fields}\n"
            "]"
        )

    def render_backward(self, *args: Any, **kwargs: Any) -> None:
        """Refused: there are no derivatives."""
        raise InputError(_NO_DERIVATIVES)

    def render_forward(self, *args: Any, **kwargs: Any) -> Any:
        """Refused: there are no derivatives."""
        raise InputError(_NO_DERIVATIVES)

    def _stage(self, scene: mi.Scene) -> Stage:
        """The scene as it is now."""
        found = find_fields(scene, least=0)
        if not found:
            check_no_loose_field(scene)
        fields = self._marched(found) if self.max_depth > 0 else []
        normals = self._wants_normals(fields)
        settings = PathSettings(
            max_depth=self.max_depth,
            rr_depth=self.rr_depth,
            paths=self.paths,
            hide_lights=not self.show_background,
            sample_fields=self.sample_fields,
            jitter=self.jitter,
            stop=min((field.march.stop for field in fields), default=0.0),
        )
        solid = self._solid.of(scene)
        return Stage(fields, PathsBehind(solid, fields, settings, normals), normals)


_NO_DERIVATIVES = "nerf_path: has no derivatives, expected the integrator 'nerf' for them"

mi.register_integrator("nerf_path", NerfPathIntegrator)
