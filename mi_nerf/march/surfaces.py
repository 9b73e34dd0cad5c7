"""Where a field has its surface, as far as it has one: opacity, distance and normal of rays.

The distance is the mean under the weights of the quadrature, as everywhere; the normal the
mean, under the same weights, of the unit vectors −∇σ/∣∇σ∣ at the samples, as the AOVs of the
integrator ``nerf`` have it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike

from ..base.arrays import Floats, Image, Vectors, vector3_type
from ..cameras.pinhole import Intrinsics
from .marched import MarchedField
from .normals import density_gradient
from .placing import place_samples
from .quadrature import integrate
from .query import Evaluation
from .render import ray_chunks, slice_rays
from .view import camera_rays

_LEAST_WEIGHT = 1e-5  # of a sample that has a say in the normal


@dataclass(frozen=True)
class FieldSurfaces:
    """What the rays through the centres of a camera's pixels find of a field."""

    opacity: Image  # (H, W)
    depth: Image  # (H, W) mean distance along the unit ray, scene units; 0: nothing
    # (H, W, 3) mean outward vectors, of length 1 where all samples agree, 0 where nothing is;
    # none of a field in normalised device coordinates.
    normal: Image | None


def field_surfaces(
    marched: MarchedField,
    intrinsics: Intrinsics,
    cam_to_world: ArrayLike,
    backend: Any,
    *,
    normals: bool = True,
) -> FieldSurfaces:
    """The surfaces of a field from one camera.

    Args:
        cam_to_world: (4, 4), OpenGL axes.
        backend: ``drjit.llvm.ad`` or ``drjit.cuda.ad``.
        normals: whether they are wanted: they take derivatives of the density.
    """
    o, d = camera_rays(intrinsics, cam_to_world, backend)
    normals = normals and marched.field.ndc is None
    found = [np.array(v) for v in surfaces_along(marched, o, d, normals=normals)]
    shape = (intrinsics.height, intrinsics.width)
    opacity, depth = (v.reshape(shape) for v in found[:2])
    normal = np.stack(found[2:], axis=-1).reshape(*shape, 3) if normals else None
    return FieldSurfaces(opacity, depth, normal)


def surfaces_along(
    marched: MarchedField, o: Vectors, d: Vectors, *, normals: bool = True
) -> list[Floats]:
    """Opacity and mean distance of R rays, and with ``normals`` the three of their mean normal.

    Args:
        o, d: origins and unit directions.
    """
    float_type, settings = type(o[0]), marched.settings
    outputs = [dr.zeros(float_type, len(o[0])) for _ in range(5 if normals else 2)]
    dr.make_opaque(outputs)
    for start, size in ray_chunks(len(o[0]), settings):
        index, chunk_o, chunk_d, _ = slice_rays(o, d, None, start, size)
        with dr.suspend_grad():
            samples = place_samples(marched, chunk_o, chunk_d)
            evaluation = Evaluation(
                marched.field, samples, settings.block, stop=settings.stop, emission=False
            )
            seen = integrate(evaluation, samples)
        values = [seen.opacity, seen.depth]
        if normals:
            uint = type(samples.index)
            counts = uint(dr.compress(seen.weights > _LEAST_WEIGHT))
            gradient = density_gradient(marched.field, samples, counts, settings.block)
            length = dr.norm(vector3_type(float_type)(*gradient))
            inverse = dr.select(length > 0, -1 / dr.select(length > 0, length, 1), 0)
            shares = [dr.block_sum(seen.weights * g * inverse, samples.count) for g in gradient]
            visible = seen.opacity > 0
            values += [
                dr.select(visible, n / dr.select(visible, seen.opacity, 1), 0) for n in shares
            ]
        for output, value in zip(outputs, values, strict=True):
            dr.scatter(output, value, index)
        dr.eval(outputs)
    return outputs
