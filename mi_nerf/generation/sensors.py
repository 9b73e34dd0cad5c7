"""A scene's own sensors as cameras of a dataset."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..base.box import corners
from ..base.errors import InputError, Option
from ..cameras.pinhole import Intrinsics, project, sensor_dict
from ..cameras.poses import opengl_from_mitsuba
from .protocol import CAMERA_ANGLE_X

Array = np.ndarray[Any, Any]

CAMERAS = "perspective or thinlens"  # the plugins that are cameras of a dataset


@dataclass(frozen=True)
class Lens:
    """A thin lens, through which pictures are traced; transforms hold the pinhole in its centre."""

    radius: float  # of the aperture, scene units
    focus: float  # z-depth of what is sharp, scene units


@dataclass(frozen=True, eq=False)
class SensorCamera:
    """A sensor of a scene, as a pinhole camera and perhaps a lens."""

    name: str
    kind: str | None  # None: a pinhole or a lens; else what kept it from being one
    pose: Array  # (4, 4) OpenGL camera-to-world, rigid
    intrinsics: Intrinsics  # of the film's crop window
    lens: Lens | None
    full_angle_x: float  # horizontal field of view of the whole film, radians
    mirrored: bool  # the sensor's own pictures are the mirror images
    cropped: bool  # the window is not the whole film

    def share_of_frame(self, lower: Array, upper: Array) -> float | None:
        """How much of the picture's smaller side a box spans; None where it is not in view."""
        size = np.array([self.intrinsics.width, self.intrinsics.height])
        middle, depth = project((lower + upper) / 2, self.intrinsics, self.pose)
        if depth <= 0 or (middle < 0).any() or (middle > size).any():
            return None
        ends, depths = project(corners(lower, upper), self.intrinsics, self.pose)
        if (depths <= 0).any():
            return 1.0  # so near that it surrounds the camera
        return float(np.ptp(ends, axis=0).max() / size.min())


def read_sensors(scene: Any) -> list[SensorCamera]:
    """The sensors of a loaded scene that look somewhere, in the order of the file."""
    found = (_camera(sensor, number) for number, sensor in enumerate(scene.sensors(), 1))
    return [camera for camera in found if camera is not None]


def camera_dict(
    intrinsics: Intrinsics, lens: Lens | None, clips: tuple[float, float]
) -> dict[str, Any]:
    """The camera as a sensor of Mitsuba at the origin, for ``mi.load_dict``.

    Raises:
        InputError: if a lens is off the film's centre by no whole number of half pixels.
    """
    near, far = clips
    description = sensor_dict(intrinsics, np.eye(4), near_clip=near, far_clip=far)
    if lens is None:
        return description
    # Lenses know no shift of the film, but windows of a larger one, centred before the lens.
    size = np.array([intrinsics.width, intrinsics.height])
    middle = np.array([intrinsics.cx, intrinsics.cy])
    whole = 2 * np.maximum(middle, size - middle)
    offset = whole / 2 - middle
    if np.abs(np.concatenate([whole, offset]) - np.rint([*whole, *offset])).max() > 1e-3:
        raise InputError(
            "{}: the window of a lens would end between pixels, expected the size of the film",
            Option("size", (intrinsics.width, intrinsics.height)),
        )
    for key in ("principal_point_offset_x", "principal_point_offset_y"):
        del description[key]
    description["film"].update(
        {
            "width": round(whole[0]),
            "height": round(whole[1]),
            "crop_width": intrinsics.width,
            "crop_height": intrinsics.height,
            "crop_offset_x": round(offset[0]),
            "crop_offset_y": round(offset[1]),
        }
    )
    angle = 2 * math.atan(round(whole[0]) / (2 * intrinsics.fx))
    return {
        **description,
        "type": "thinlens",
        "fov": math.degrees(angle),
        "aperture_radius": lens.radius,
        "focus_distance": lens.focus,
    }


def in_size(camera: SensorCamera, size: tuple[int, int] | None) -> Intrinsics:
    """The camera's intrinsics at another size of the same picture.

    Raises:
        InputError: if the size has another shape than the sensor's film.
    """
    own = camera.intrinsics
    if size is None or size == (own.width, own.height):
        return own
    width, height = size
    # Of the same shape up to the rounding of either side to whole pixels.
    if abs(own.width * height - own.height * width) > max(own.width, own.height) / 2:
        raise InputError(
            "{}: the film of {} is {}x{}, expected a size of the same shape, such as {} {}",
            *(Option("size", size), camera.name, own.width, own.height),
            *(width, max(1, round(own.height * width / own.width))),
        )
    scale = width / own.width
    focal = own.fx * scale
    return Intrinsics(width, height, focal, focal, own.cx * scale, own.cy * height / own.height)


def _camera(sensor: Any, number: int) -> SensorCamera | None:
    """A sensor as a camera; None if it looks nowhere, like a meter on a surface."""
    import mitsuba as mi

    values = mi.traverse(sensor)
    kind = sensor.class_name()
    pinhole = "x_fov" in values
    if not pinhole and kind != "OrthographicCamera":
        return None
    film = sensor.film()
    size, crop = np.array(film.size()), np.array(film.crop_size())
    pose = opengl_from_mitsuba(np.array(sensor.world_transform().matrix).reshape(4, 4))
    pose[:3, :3] /= np.linalg.norm(pose[:3, :3], axis=0)
    angle = math.radians(_number(values["x_fov"])) if pinhole else CAMERA_ANGLE_X
    intrinsics = _intrinsics(angle, values, size, crop, np.array(film.crop_offset()))
    mirrored = bool(np.linalg.det(pose[:3, :3]) < 0)
    if mirrored:  # the same window, seen with the right hand on the right
        pose[:3, 0] *= -1
        intrinsics = replace(intrinsics, cx=intrinsics.width - intrinsics.cx)
    given = sensor.id() and not sensor.id().startswith("_")
    return SensorCamera(
        name=f"sensor '{sensor.id()}'" if given else f"sensor {number}",
        kind=kind if not pinhole else None,
        pose=pose,
        intrinsics=intrinsics,
        lens=_lens(values) if pinhole else None,
        full_angle_x=angle,
        mirrored=mirrored,
        cropped=bool((size != crop).any()),
    )


def _intrinsics(angle: float, values: Any, size: Array, crop: Array, offset: Array) -> Intrinsics:
    """Of a crop window, from the horizontal field of view of the whole film in radians."""
    focal = float(size[0]) / 2 / math.tan(angle / 2)
    shift = [
        _number(values[key]) if key in values else 0.0
        for key in ("principal_point_offset_x", "principal_point_offset_y")
    ]
    cx, cy = (size * (0.5 - np.array(shift)) - offset).tolist()
    return Intrinsics(int(crop[0]), int(crop[1]), focal, focal, cx, cy)


def _lens(values: Any) -> Lens | None:
    if "aperture_radius" not in values:
        return None
    return Lens(_number(values["aperture_radius"]), _number(values["focus_distance"]))


def _number(value: Any) -> float:
    return float(np.ravel(value)[0])
