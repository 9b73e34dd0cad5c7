"""Pinhole cameras: axis conventions, intrinsics, rays and Mitsuba sensors.

Poses are camera-to-world matrices ``c2w``: their columns are the camera's axes
and its position in world space. Three conventions for the axes meet here; the
world is the same in all of them:

========================  =======  =====  ==============
convention                +x       +y     looks along
========================  =======  =====  ==============
OpenGL (Blender, NeRF)    right    up     -z
OpenCV (COLMAP)           right    down   +z
Mitsuba                   left     up     +z
========================  =======  =====  ==============

Everything in this package that holds a pose holds the OpenGL one; the others
exist at the borders only.

Pixel coordinates are continuous: x runs from 0 at the left edge of the film to
``width``, y from 0 at the top edge to ``height``, and the centre of pixel (i, j)
is (i + 0.5, j + 0.5). Mitsuba, instant-ngp and nerfstudio agree on this; the
original NeRF code sends its rays through the corners (i, j) instead.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.arrays import vector3_type
from ..base.errors import InputError
from .poses import mitsuba_from_opengl

# ---- Intrinsics --------------------------------------------------------------


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without distortion. All lengths are in pixels.

    Raises:
        InputError: The film is empty, or a length is not finite or a focal
            length not positive.
    """

    width: int  # film size
    height: int
    fx: float  # focal lengths
    fy: float
    cx: float  # principal point; (width/2, height/2) is the centre of the film
    cy: float

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            if not (value >= 1 and int(value) == value):
                raise InputError(f"camera: {name} must be a whole number of pixels, got {value}")
        for name in ("fx", "fy", "cx", "cy"):
            value = getattr(self, name)
            if not math.isfinite(value) or (name.startswith("f") and value <= 0):
                expected = "positive and finite" if name.startswith("f") else "finite"
                raise InputError(f"camera: {name} must be {expected}, got {value}")

    @classmethod
    def from_angle_x(cls, width: int, height: int, camera_angle_x: float) -> Intrinsics:
        """Centred camera with square pixels and a horizontal view angle in radians.

        Raises:
            InputError: The angle is not between 0 and pi, or the film is empty.
        """
        if not 0 < camera_angle_x < math.pi:
            raise InputError(f"camera_angle_x must be in (0, pi) radians, got {camera_angle_x}")
        focal = 0.5 * width / math.tan(0.5 * camera_angle_x)
        return cls(width, height, focal, focal, 0.5 * width, 0.5 * height)

    def downscale(self, k: int) -> Intrinsics:
        """The camera whose pixels are this one's blocks of k×k pixels.

        A remainder that fills no block is cropped at the right and the bottom
        edge: the view angle shrinks by it, the rays stay the same.

        Raises:
            InputError: ``k`` is below 1 or larger than the film.
        """
        if k < 1 or k != int(k):
            raise InputError(f"downscale must be a whole number, 1 or more, got {k}")
        if k > min(self.width, self.height):
            raise InputError(f"downscale {k} leaves no pixel of {self.width}x{self.height}")
        return Intrinsics(
            self.width // k, self.height // k, self.fx / k, self.fy / k, self.cx / k, self.cy / k
        )

    @property
    def angle_x(self) -> float:
        """Horizontal view angle of a centred film this wide, in radians."""
        return 2.0 * math.atan(0.5 * self.width / self.fx)

    @property
    def fov_x(self) -> float:
        """Horizontal view angle in degrees: Mitsuba's ``fov`` with ``fov_axis = x``."""
        return math.degrees(self.angle_x)

    @property
    def principal_point_offset(self) -> tuple[float, float]:
        """Mitsuba's ``principal_point_offset_x`` and ``_y``, in film sizes.

        Mitsuba shifts the film, not the point, hence the sign.
        """
        return 0.5 - self.cx / self.width, 0.5 - self.cy / self.height


# ---- Rays and projection -----------------------------------------------------


def pack_poses(c2w: ArrayLike) -> NDArray[np.float32]:
    """Lays camera-to-world matrices out for :func:`pixel_rays`.

    Args:
        c2w: Matrices, (N, 4, 4). The last row is dropped.

    Returns:
        The upper 3×4 of each, row by row, camera after camera, (N·12,).

    Raises:
        ValueError: ``c2w`` is not a stack of 4×4 matrices.
    """
    matrices = np.asarray(c2w)
    if matrices.ndim != 3 or matrices.shape[1:] != (4, 4):
        raise ValueError(f"expected poses of shape (N, 4, 4), got {matrices.shape}")
    return np.ascontiguousarray(matrices[:, :3], np.float32).reshape(-1)


def pixel_rays(poses: Any, intrinsics: Intrinsics, camera: Any, x: Any, y: Any) -> tuple[Any, Any]:
    """World-space rays through points of the film.

    The array types follow ``x``: any backend and either precision will do. The
    intrinsics reach the kernel as data, so that another camera reuses it.

    Args:
        poses: OpenGL camera-to-world matrices as :func:`pack_poses` lays them
            out: a Dr.Jit array of the type of ``x``, (N·12,).
        intrinsics: The camera that all poses share.
        camera: Index of each ray's pose, an unsigned Dr.Jit array, (R,) or (1,).
            The caller keeps it below N.
        x: Horizontal pixel coordinate, 0 at the left edge, a Dr.Jit array, (R,).
        y: Vertical pixel coordinate, 0 at the **top** edge, (R,).

    Returns:
        Origin (the camera's centre) and direction, both 3-vectors of R entries.
        The directions have unit length: distances along these rays are lengths in
        scene units and not the z-depths of the original NeRF code.
    """
    Float = type(x)
    Vector3 = vector3_type(Float)

    # ---- Direction in the camera's frame: +x right, +y up, looks along -z ----
    right = (x - dr.opaque(Float, intrinsics.cx)) * dr.opaque(Float, 1 / intrinsics.fx)
    up = (dr.opaque(Float, intrinsics.cy) - y) * dr.opaque(Float, 1 / intrinsics.fy)

    # ---- To world space, m being the rows of the pose one after another ----
    m = [dr.gather(Float, poses, camera * 12 + i) for i in range(12)]
    o = Vector3(m[3], m[7], m[11])
    d = Vector3(*(m[row] * right + m[row + 1] * up - m[row + 2] for row in (0, 4, 8)))
    return o, dr.normalize(d)


def project(
    points: ArrayLike, intrinsics: Intrinsics, c2w: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where world-space points appear on the film. The inverse of :func:`pixel_rays`.

    Args:
        points: Points in world space, (..., 3).
        intrinsics: The camera.
        c2w: Its OpenGL camera-to-world matrix, (4, 4).

    Returns:
        Pixel coordinates (x, y), (..., 2), and z-depth in scene units, (...).
        Points at or behind the camera have z-depth ≤ 0; their pixel coordinates
        mean nothing.
    """
    pose = np.asarray(c2w, np.float64)
    # Rigid: the inverse of the rotation is its transpose.
    local = (np.asarray(points, np.float64) - pose[:3, 3]) @ pose[:3, :3]
    depth = -local[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        x = intrinsics.cx + intrinsics.fx * local[..., 0] / depth
        y = intrinsics.cy - intrinsics.fy * local[..., 1] / depth
    return np.stack([x, y], axis=-1), depth


def film_directions(x: ArrayLike, y: ArrayLike, intrinsics: Intrinsics) -> NDArray[np.float64]:
    """Which ways a camera sees points of its film: vectors in its space, (..., 3), of any length.

    Args:
        x, y: Pixel coordinates; the camera looks along −z (OpenGL axes).
    """
    right = (np.asarray(x, np.float64) - intrinsics.cx) / intrinsics.fx
    up = (intrinsics.cy - np.asarray(y, np.float64)) / intrinsics.fy
    return np.stack([right, up, -np.ones_like(right)], axis=-1)


# ---- Mitsuba -----------------------------------------------------------------


def sensor_dict(
    intrinsics: Intrinsics,
    c2w: ArrayLike,
    spp: int = 1,
    pixel_format: str = "rgba",
    rfilter: str = "box",
    near_clip: float = 1e-2,
    far_clip: float = 1e4,
) -> dict[str, Any]:
    """The same camera as a Mitsuba ``perspective`` sensor, for ``mi.load_dict``.

    A Mitsuba variant must be set.

    Args:
        intrinsics: The camera; ``fx`` and ``fy`` must agree.
        c2w: Its OpenGL camera-to-world matrix, (4, 4), rigid.
        spp: Samples per pixel of its ``independent`` sampler.
        pixel_format: Channels of its ``hdrfilm``.
        rfilter: Plugin name of the reconstruction filter.
        near_clip: z-depth at which its rays start, in scene units.
        far_clip: z-depth at which they end.

    Raises:
        InputError: The pixels are not square; Mitsuba's cameras have no others.
    """
    import mitsuba as mi

    if not math.isclose(intrinsics.fx, intrinsics.fy, rel_tol=1e-6):
        raise InputError(
            "Mitsuba's perspective sensor needs square pixels, "
            f"got fx = {intrinsics.fx:g} and fy = {intrinsics.fy:g}"
        )
    offset_x, offset_y = intrinsics.principal_point_offset
    return {
        "type": "perspective",
        "fov": intrinsics.fov_x,
        "fov_axis": "x",
        "principal_point_offset_x": offset_x,
        "principal_point_offset_y": offset_y,
        "near_clip": near_clip,
        "far_clip": far_clip,
        "to_world": mi.ScalarTransform4f(mitsuba_from_opengl(c2w).tolist()),
        "film": {
            "type": "hdrfilm",
            "width": intrinsics.width,
            "height": intrinsics.height,
            "pixel_format": pixel_format,
            "component_format": "float32",
            "rfilter": {"type": rfilter},
        },
        "sampler": {"type": "independent", "sample_count": spp},
    }
