"""Exact depth and normals: one ray through the centre of each pixel."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from ..base.arrays import Image, upload
from ..cameras.pinhole import Intrinsics, pack_poses, pixel_rays

_STEP = 1e-4  # past a surface, relative to the distance from the origin
_NEAR_QUANTILE, _FAR_QUANTILE = 0.001, 0.999
_MAX_INTERFACES = 64  # that a ray may pass before it counts as lost


def trace_surfaces(
    scene: Any, intrinsics: Intrinsics, pose: Image, *, hide_emitters: bool
) -> tuple[Image, Image]:
    """Where the pixels' central rays meet the first surface. A Mitsuba variant must be set.

    Boundaries of media and surfaces that let more than half of the light straight through
    do not count; nor do light sources seen directly, if they are hidden.

    Returns:
        Distance along the ray from the camera's centre in scene units, (H, W, 1), and the
        unit normal in world space on the side of the camera, (H, W, 3). Both are 0 where
        nothing is met.
    """
    import mitsuba as mi

    height, width = intrinsics.height, intrinsics.width
    index = dr.arange(mi.UInt32, height * width)
    row = index // dr.opaque(mi.UInt32, width)
    column = index - row * dr.opaque(mi.UInt32, width)
    poses = upload(mi.Float, pack_poses(np.asarray(pose)[None]))
    o, d = pixel_rays(poses, intrinsics, mi.UInt32(0), mi.Float(column) + 0.5, mi.Float(row) + 0.5)
    ray = mi.Ray3f(mi.Point3f(o), mi.Vector3f(d))
    depth, normal = _first_surface(scene, ray, hide_emitters)
    return (
        np.array(depth).reshape(height, width, 1),
        np.array(normal).T.reshape(height, width, 3),
    )


def depth_bounds(intrinsics: Intrinsics, depth: Image) -> tuple[float, float] | None:
    """Near and far z-depth of an image of distances along rays; ``None`` if all are 0."""
    y, x = np.mgrid[: intrinsics.height, : intrinsics.width] + 0.5
    right = (x - intrinsics.cx) / intrinsics.fx
    up = (y - intrinsics.cy) / intrinsics.fy
    z = depth[..., 0] / np.sqrt(1 + right**2 + up**2)
    seen = z[depth[..., 0] > 0]
    if not seen.size:
        return None
    near, far = np.quantile(seen, [_NEAR_QUANTILE, _FAR_QUANTILE])
    return float(near), float(far)


@dr.syntax  # type: ignore[untyped-decorator]
def _first_surface(scene: Any, ray: Any, hide_emitters: bool) -> tuple[Any, Any]:
    import mitsuba as mi

    origin = mi.Point3f(ray.o)
    ray = mi.Ray3f(ray)
    depth, normal = mi.Float(0), mi.Vector3f(0)
    direct = mi.Bool(True)  # nothing passed yet but hidden light sources
    passed = mi.UInt32(0)
    active = mi.Bool(True)
    while dr.hint(active, label="First surface"):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        bsdf = si.bsdf(ray)
        is_null = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
        through = dr.mean(bsdf.eval_null_transmission(si, active & is_null))
        hidden = mi.Bool(hide_emitters) & direct & (si.emitter(scene) != None)  # noqa: E711
        opens = (is_null & (through > 0.5)) & ~hidden
        found = active & ~hidden & ~opens
        depth[found] = dr.norm(si.p - origin)
        normal[found] = _facing(si, ray.d)
        direct &= ~opens
        # Along the ray: Mitsuba's own way on would leave the line through the pixel.
        ray.o = si.p + ray.d * (_STEP * (1 + dr.max(dr.abs(si.p))))
        passed += 1
        active &= ~found & (passed < _MAX_INTERFACES)
    return depth, normal


def _facing(si: Any, d: Any) -> Any:
    """The shading normal on the side that ``d`` comes from; where it bends away, the true one."""
    geometric = dr.select(dr.dot(si.n, d) > 0, -si.n, si.n)
    shading = dr.select(dr.dot(si.sh_frame.n, geometric) < 0, -si.sh_frame.n, si.sh_frame.n)
    return dr.normalize(dr.select(dr.dot(shading, d) < 0, shading, geometric))
