"""Pictures of a field from pinhole cameras, as arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike

from ..base.arrays import Image, vector3_type
from ..base.color import linear_to_srgb, srgb_to_linear
from ..cameras.pinhole import Intrinsics, pack_poses, pixel_rays
from .marched import MarchedField
from .render import render_rays


@dataclass(frozen=True)
class View:
    """What a camera sees of a field, without background."""

    color: Image  # (H, W, 3) in the field's colour space, premultiplied
    opacity: Image  # (H, W)
    depth: Image  # (H, W) distance along the ray, scene units; 0 where nothing is seen
    queries: int  # how often the field was asked

    def over(self, background: float) -> Image:
        """(H, W, 3) in front of a grey value of the field's colour space."""
        return self.color + (1 - self.opacity[..., None]) * background


def render_view(
    marched: MarchedField,
    intrinsics: Intrinsics,
    cam_to_world: ArrayLike,
    backend: Any,
    *,
    spp: int = 1,
) -> View:
    """Renders one view through pixel centres, or a regular grid of ``spp`` points a pixel.

    Args:
        cam_to_world: (4, 4), OpenGL axes.
        backend: ``drjit.llvm.ad`` or ``drjit.cuda.ad``.
        spp: rays a pixel, rounded down to a square number.
    """
    side = max(1, int(np.sqrt(spp)))
    passes, queries = [], 0
    for i in range(side * side):
        offset = ((i % side + 0.5) / side, (i // side + 0.5) / side)
        o, d = camera_rays(intrinsics, cam_to_world, backend, offset)
        seen = render_rays(marched, o, d)
        passes.append([np.array(v) for v in (*seen.color, seen.opacity, seen.depth)])
        queries += seen.queries
    total, shape = np.array(passes), (intrinsics.height, intrinsics.width)  # (passes, 5, H·W)
    planes = total[:, :4].mean(axis=0).reshape(4, *shape)
    opacity, depth = total[:, 3], total[:, 4]
    weight = opacity.sum(axis=0)  # empty rays have no depth
    mean = np.where(weight > 0, (opacity * depth).sum(axis=0) / np.maximum(weight, 1e-30), 0)
    return View(np.moveaxis(planes[:3], 0, -1), planes[3], mean.reshape(shape), queries)


def display_image(view: View, color_space: str, background: float = 1.0) -> Image:
    """(H, W, 3) sRGB values over a background, for looking at."""
    image = view.over(background)
    return linear_to_srgb(image) if color_space == "linear" else image


def linear_premultiplied(color: Image, opacity: Image, color_space: str) -> Image:
    """(H, W, 3) linear radiance of premultiplied colours in the field's colour space."""
    if color_space == "linear":
        return color
    alpha = opacity[..., None]
    straight = color / np.where(alpha > 0, alpha, 1)
    return np.where(alpha > 0, srgb_to_linear(straight) * alpha, 0)


def camera_rays(
    intrinsics: Intrinsics,
    cam_to_world: ArrayLike,
    backend: Any,
    offset: tuple[float, float] = (0.5, 0.5),
) -> tuple[Any, Any]:
    """Origins and unit directions of the rays through one point of every pixel, row by row.

    Args:
        cam_to_world: (4, 4), OpenGL axes.
        backend: ``drjit.llvm.ad`` or ``drjit.cuda.ad``.
        offset: the point, from the upper left corner of a pixel.
    """
    float_type, uint = backend.Float, backend.UInt32
    width = dr.opaque(uint, intrinsics.width)
    index = dr.arange(uint, intrinsics.width * intrinsics.height)
    row = index // width
    x = float_type(index - row * width) + dr.opaque(float_type, offset[0])
    y = float_type(row) + dr.opaque(float_type, offset[1])
    poses = float_type(pack_poses(np.asarray(cam_to_world)[None]))
    o, d = pixel_rays(poses, intrinsics, uint(0), x, y)
    # One origin for all rays: repeated, because chunks of rays are gathered from it.
    o = vector3_type(float_type)(*(o[i] + dr.zeros(float_type, len(index)) for i in range(3)))
    dr.eval(o, d)
    return o, d
