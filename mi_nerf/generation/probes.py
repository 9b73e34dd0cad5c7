"""Rays that ask a scene what is where, before anything is rendered."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from ..base.arrays import Mask
from ..cameras.pinhole import Intrinsics, film_directions

Array = np.ndarray[Any, Any]
Hides = bool | Callable[[Any], Mask]  # which light sources are not seen

_MAX_INTERFACES = 64  # that a ray may pass before it counts as lost
_RAYS = 1 << 20  # at once


@dataclass(frozen=True)
class Hits:
    """What rays meet first; arrays have one entry a ray."""

    distance: Array  # float32, scene units; infinite where nothing is met
    dark: Array  # bool: it is the back of a surface that shines on its front alone
    fog: Array  # float32: distance of the first medium before that, else infinite

    @property
    def something(self) -> Array:
        """Whether anything is met, a surface or a medium."""
        return np.isfinite(self.distance) | np.isfinite(self.fog)

    @property
    def nearest(self) -> Array:
        """Distance of what is met, surface or medium."""
        return np.minimum(self.distance, self.fog)


def first_hits(scene: Any, origins: Array, directions: Array, *, hide_emitters: Hides) -> Hits:
    """Follows rays to the first surface. A Mitsuba variant must be set.

    Surfaces that let more than half of the light straight through do not count; nor do light
    sources met before any of them, if they are hidden.

    Args:
        origins, directions: (N, 3); directions of unit length.
        hide_emitters: Whether all, or a function of light sources that says which.
    """
    found = []
    for start in range(0, len(origins), _RAYS):
        chunk = slice(start, start + _RAYS)
        ray = _rays(origins[chunk], directions[chunk])
        found.append([np.array(values) for values in _follow(scene, ray, hide_emitters)])
    distance, dark, fog = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return Hits(distance, dark, fog)


def _hides(hide: Hides, emitter: Any) -> Mask:
    import mitsuba as mi

    return mi.Bool(hide) & (emitter != None) if isinstance(hide, bool) else hide(emitter)  # noqa: E711


def blocked(scene: Any, origins: Array, targets: Array) -> Array:
    """Whether anything solid stands between points, (N,). Both are (N, 3)."""
    offset = np.asarray(targets) - origins
    length = np.linalg.norm(offset, axis=-1)
    directions = offset / np.maximum(length, 1e-30)[:, None]
    hits = first_hits(scene, origins, directions, hide_emitters=True)
    return np.asarray(hits.distance < length * (1 - 1e-3))


def camera_rays(
    poses: Sequence[Array], intrinsics: Sequence[Intrinsics], grid: int
) -> tuple[Array, Array]:
    """Origins and directions of rays through a grid of points on each film, (V, grid², 3)."""
    origins, directions = [], []
    steps = (np.arange(grid) + 0.5) / grid
    for pose, camera in zip(poses, intrinsics, strict=True):
        y, x = np.meshgrid(steps * camera.height, steps * camera.width, indexing="ij")
        d = film_directions(x, y, camera).reshape(-1, 3) @ np.asarray(pose)[:3, :3].T
        directions.append(d / np.linalg.norm(d, axis=-1, keepdims=True))
        origins.append(np.broadcast_to(np.asarray(pose)[:3, 3], d.shape))
    return np.array(origins), np.array(directions)


def all_around(count: int) -> Array:
    """``count`` unit vectors evenly over the sphere, (count, 3): a Fibonacci spiral."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.arange(count) * math.pi * (3 - math.sqrt(5))
    level = np.sqrt(1 - z * z)
    return np.stack([level * np.cos(angle), level * np.sin(angle), z], axis=-1)


def _rays(origins: Array, directions: Array) -> Any:
    import mitsuba as mi

    o, d = (np.ascontiguousarray(np.asarray(v, np.float32).T) for v in (origins, directions))
    return mi.Ray3f(mi.Point3f(o), mi.Vector3f(d))


@dr.syntax  # type: ignore[untyped-decorator]
def _follow(scene: Any, ray: Any, hide_emitters: Hides) -> tuple[Any, Any, Any]:
    """Distance of the first solid surface, whether it is dark, distance of the first medium."""
    import mitsuba as mi

    origin = mi.Point3f(ray.o)
    ray = mi.Ray3f(ray)
    distance, fog = mi.Float(dr.inf), mi.Float(dr.inf)
    dark = mi.Bool(False)
    direct = mi.Bool(True)  # nothing passed yet but hidden light sources
    passed = mi.UInt32(0)
    active = mi.Bool(True)
    while dr.hint(active, label="First hit"):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        bsdf = si.bsdf(ray)
        flags = bsdf.flags()
        is_null = mi.has_flag(flags, mi.BSDFFlags.Null)
        through = dr.mean(bsdf.eval_null_transmission(si, active & is_null))
        hidden = _hides(hide_emitters, si.emitter(scene)) & direct
        opens = is_null & (through > 0.5) & ~hidden
        found = active & ~hidden & ~opens
        away = dr.norm(si.p - origin)
        fog[active & opens & si.is_medium_transition()] = dr.minimum(fog, away)
        distance[found] = away
        dark[found] = (
            (si.wi.z < 0) & ~mi.has_flag(flags, mi.BSDFFlags.BackSide) & (si.emitter(scene) == None)  # noqa: E711
        )
        direct &= ~opens
        ray = si.spawn_ray(ray.d)
        passed += 1
        active &= ~found & (passed < _MAX_INTERFACES)
    return distance, dark, fog
