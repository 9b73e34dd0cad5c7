"""The camera of a dataset: one Mitsuba sensor that moves from view to view."""

from __future__ import annotations

from typing import Any

from ..base.arrays import Image
from ..cameras.pinhole import Intrinsics
from ..cameras.poses import mitsuba_from_opengl
from .sensors import Lens, camera_dict


class Camera:
    """A sensor that moves, and whose film may be a part of a larger one."""

    def __init__(
        self, intrinsics: Intrinsics, lens: Lens | None, clips: tuple[float, float], sampler: Any
    ) -> None:
        """``clips`` are the z-depths between which it sees."""
        import mitsuba as mi

        self._intrinsics, self._lens, self._clips = intrinsics, lens, clips
        description = camera_dict(intrinsics, lens, clips)
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
        other = Camera(self._intrinsics, self._lens, self._clips, sampler)
        other.move(self._pose)
        return other
