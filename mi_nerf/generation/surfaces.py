"""What camera rays meet first: exact depth and normals, and how much of a ray is covered."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from ..base.arrays import Floats, Image, Mask, upload
from ..cameras.pinhole import Intrinsics, pack_poses, pixel_rays
from .emitters import Hidden

# Past a surface, relative to the distance from the camera or, where it is larger, from the
# origin: 17 to 34 times what single precision can tell apart there.
_STEP = 2e-6
_AGAIN = 4  # steps, within which the same triangle is not met a second time
_NEAR_QUANTILE, _FAR_QUANTILE = 0.001, 0.999
_MAX_INTERFACES = 64  # that a ray may pass before it counts as lost
_NOTHING_LEFT = 1e-3  # of a ray's light, that passes all surfaces so far


def trace_surfaces(
    scene: Any, intrinsics: Intrinsics, pose: Image, *, hide_emitters: bool | Hidden
) -> tuple[Image, Image]:
    """Where the pixels' central rays meet the first surface. A Mitsuba variant must be set.

    Boundaries of media and surfaces that let more than half of the light straight through
    do not count; nor do light sources seen directly, if they are hidden.

    Args:
        hide_emitters: Whether light sources are hidden, or which.

    Returns:
        Distance along the ray from the camera's centre in scene units, (H, W, 1), and the
        unit normal in world space on the side of the camera, (H, W, 3). Both are 0 where
        nothing is met, or what is met is no number.
    """
    import mitsuba as mi

    hidden = Hidden(scene, hide_emitters) if isinstance(hide_emitters, bool) else hide_emitters
    height, width = intrinsics.height, intrinsics.width
    index = dr.arange(mi.UInt32, height * width)
    row = index // dr.opaque(mi.UInt32, width)
    column = index - row * dr.opaque(mi.UInt32, width)
    poses = upload(mi.Float, pack_poses(np.asarray(pose)[None]))
    o, d = pixel_rays(poses, intrinsics, mi.UInt32(0), mi.Float(column) + 0.5, mi.Float(row) + 0.5)
    ray = mi.Ray3f(mi.Point3f(o), mi.Vector3f(d))
    depth, normal, _ = _walk(scene, ray, mi.Bool(True), hidden, True)
    known = dr.isfinite(depth) & dr.all(dr.isfinite(normal))
    depth, normal = dr.select(known, depth, 0), dr.select(known, normal, 0)
    return (
        np.array(depth).reshape(height, width, 1),
        np.array(normal).T.reshape(height, width, 3),
    )


def coverage(scene: Any, ray: Any, active: Mask, hidden: Hidden) -> Floats:
    """How much of each ray's light comes from surfaces that are there for the camera.

    One less what surfaces let straight through; 1 where the ray ends in surroundings that
    are not hidden.
    """
    import mitsuba as mi

    _, _, passing = _walk(scene, mi.Ray3f(ray), active, hidden, False)
    if scene.environment() is not None and not hidden.environment:
        return mi.Float(1)
    return 1 - passing


def past_hidden(scene: Any, ray: Any, active: Mask, hidden: Hidden) -> tuple[Any, Mask]:
    """Where rays begin behind the hidden light sources before them, and whether they meet more."""
    import mitsuba as mi

    return _past(scene, mi.Ray3f(ray), mi.Bool(active), hidden)


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
def _walk(
    scene: Any, ray: Any, active: Any, hidden: Hidden, opaque: bool
) -> tuple[Floats, Any, Floats]:
    """Follows rays to the first surface that is there, or, not ``opaque``, as far as light goes.

    Returns:
        Distance and normal of that surface, and the light that passes all surfaces.
    """
    import mitsuba as mi

    origin = mi.Point3f(ray.o)
    ray = mi.Ray3f(ray)
    depth, normal, passing = mi.Float(0), mi.Vector3f(0), mi.Float(1)
    direct = mi.Bool(True)  # nothing passed yet but hidden light sources
    passed = mi.UInt32(0)
    active = mi.Bool(active)
    step = mi.Float(0)
    shape, primitive = dr.zeros(mi.ShapePtr), mi.UInt32(0)
    while dr.hint(active, label="First surface"):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        again = (si.shape == shape) & (si.prim_index == primitive) & (si.t < _AGAIN * step)
        bsdf = si.bsdf(ray)
        emitter = si.emitter(scene)
        is_null = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) & (emitter == None)  # noqa: E711
        through = _mean(bsdf.eval_null_transmission(si, active & is_null))
        through = dr.select(is_null, through, 0)
        unseen = again | (direct & hidden(emitter))
        opens = is_null & (through > (0.5 if dr.hint(opaque, mode="scalar") else 0)) & ~unseen
        distance = dr.norm(si.p - origin)
        found = active & ~unseen & ~opens
        depth[found] = distance
        normal[found] = _facing(si, ray.d)
        passing[active & ~unseen] *= through
        direct &= ~opens
        # Along the same ray: Mitsuba's own way on would leave the line through the pixel.
        step = _STEP * dr.maximum(dr.max(dr.abs(si.p)), distance)
        ray.o = origin + ray.d * (distance + step)
        shape, primitive = si.shape, si.prim_index
        passed += 1
        active &= ~found & (passed < _MAX_INTERFACES) & (passing > _NOTHING_LEFT)
    return depth, normal, passing


@dr.syntax  # type: ignore[untyped-decorator]
def _past(scene: Any, ray: Any, active: Any, hidden: Hidden) -> tuple[Any, Any]:
    import mitsuba as mi

    origin = mi.Point3f(ray.o)
    passed = mi.UInt32(0)
    meets = mi.Bool(False)
    while dr.hint(active, label="Past hidden light sources"):
        si = scene.ray_intersect(ray, mi.RayFlags.Minimal, False, active)
        active &= si.is_valid()
        meets |= active
        active &= hidden(si.emitter(scene)) & (passed < _MAX_INTERFACES)
        meets &= ~active
        distance = dr.norm(si.p - origin)
        step = _STEP * dr.maximum(dr.max(dr.abs(si.p)), distance)
        ray.o[active] = origin + ray.d * (distance + step)
        passed += 1
    return ray.o, meets


def _mean(spectrum: Any) -> Floats:
    """The mean over the colours that a variant knows."""
    import mitsuba as mi

    return dr.mean(mi.unpolarized_spectrum(spectrum) if mi.is_polarized else spectrum)


def _facing(si: Any, d: Any) -> Any:
    """The shading normal on the side that ``d`` comes from; where it bends away, the true one."""
    geometric = dr.select(dr.dot(si.n, d) > 0, -si.n, si.n)
    shading = dr.select(dr.dot(si.sh_frame.n, geometric) < 0, -si.sh_frame.n, si.sh_frame.n)
    return dr.normalize(dr.select(dr.dot(shading, d) < 0, shading, geometric))
