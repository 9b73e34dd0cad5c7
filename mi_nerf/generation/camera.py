"""The camera of a dataset: one Mitsuba sensor that moves from view to view."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..base.arrays import Image
from ..cameras.pinhole import Intrinsics, sensor_dict
from ..cameras.poses import mitsuba_from_opengl


class Camera:
    """A sensor that moves, and whose film may be a part of a larger one."""

    def __init__(self, intrinsics: Intrinsics, scale: float, sampler: Any) -> None:
        import mitsuba as mi

        self._intrinsics, self._scale = intrinsics, scale
        description = sensor_dict(
            intrinsics, np.eye(4), near_clip=1e-3 * scale, far_clip=1e3 * scale
        )
        self.sensor = mi.load_dict({**description, "sampler": sampler})
        self._parameters = mi.traverse(self.sensor)
        self._pose: Any = None

    @property
    def can_shift(self) -> bool:
        """Whether the principal point moves: otherwise no part of a picture is seen alone."""
        return "principal_point_offset_x" in self._parameters

    def move(self, pose: Image, intrinsics: Intrinsics | None = None) -> None:
        """Moves the camera, and with ``intrinsics``, of the same size, its principal point."""
        import mitsuba as mi

        self._pose = pose
        to_world = mi.ScalarTransform4f(mitsuba_from_opengl(pose).tolist())
        self._parameters["to_world"] = mi.Transform4f(to_world)
        if intrinsics is not None:
            self._intrinsics = intrinsics
            x, y = intrinsics.principal_point_offset
            self._parameters["principal_point_offset_x"] = x
            self._parameters["principal_point_offset_y"] = y
        self._parameters.update()

    def with_sampler(self, sampler: Any) -> Camera:
        """The same camera with another sampler."""
        other = Camera(self._intrinsics, self._scale, sampler)
        other.move(self._pose)
        return other
