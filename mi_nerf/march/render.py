"""Renders rays through a field: the one path that training, evaluation and plugins share.

    rays → (normalised device coordinates) → interval in the box → strata
         → (cells that may hold something) → (where the coarse network sees something)
         → field, in blocks of constant size, front to back → quadrature

The field sees its queries in blocks of a constant number of columns, so tensor-mode
kernels are compiled once whatever the number of samples a ray batch needs. The
quadrature works on all samples at once. Its adjoint reaches the field block by
block, which is what bounds the memory of a gradient.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr

from ..base.arrays import Floats, Vectors, gather_vector3
from .marched import MarchedField
from .placing import place_samples
from .quadrature import integrate
from .query import Evaluation
from .settings import MarchSettings
from .walk import can_walk, walk_rays


@dataclass
class RayImage:
    """What R rays see, without background, in the field's colour space."""

    color: list[Floats]  # three arrays of R values, premultiplied by the opacity
    opacity: Floats
    depth: Floats  # distance along the unit ray, scene units; 0 where nothing is seen
    queries: int  # how often its networks were asked


def ray_chunks(rays: int, settings: MarchSettings) -> Iterator[tuple[int, int]]:
    """Splits R rays into ranges whose samples fit in ``settings.chunk``."""
    size = max(1, settings.chunk // (settings.samples + settings.fine))
    for start in range(0, rays, size):
        yield start, min(size, rays - start)


def render_rays(
    marched: MarchedField, o: Vectors, d: Vectors, *, jitter: Floats = None
) -> RayImage:
    """Renders R rays without derivatives: in one kernel, or in chunks of bounded memory.

    Args:
        o, d: origins and unit directions, in the field's coordinates.
        jitter: R numbers in [0, 1) that shift the samples of each ray within their
            strata; ``None`` for the middle of each stratum.
    """
    float_type, settings = type(o[0]), marched.settings
    rays = max(len(o[0]), len(d[0]))
    one_a_ray = jitter is None or len(jitter) == rays
    if rays and one_a_ray and can_walk(marched):
        walked = walk_rays(marched, o, d, jitter=jitter)
        queries = int(dr.sum(walked.queries)[0])
        return RayImage(walked.color, walked.opacity, walked.depth, queries)
    outputs = [dr.zeros(float_type, rays) for _ in range(5)]
    queries = 0
    with dr.suspend_grad():
        for start, size in ray_chunks(rays, settings):
            index, chunk_o, chunk_d, offset = slice_rays(o, d, jitter, start, size)
            samples = place_samples(marched, chunk_o, chunk_d, jitter=offset)
            evaluation = Evaluation(marched.field, samples, settings.block, stop=settings.stop)
            result = integrate(evaluation, samples)
            values = [*result.color, result.opacity, result.depth]
            for output, value in zip(outputs, values, strict=True):
                dr.scatter(output, value, index)
            dr.eval(outputs)
            queries += len(evaluation.asked) + samples.coarse_queries
    return RayImage(outputs[:3], outputs[3], outputs[4], queries)


def slice_rays(
    o: Vectors, d: Vectors, jitter: Floats, start: int, size: int
) -> tuple[Any, Any, Any, Any]:
    """Rays ``start … start + size`` of a batch, with their indices and jitter."""
    float_type = type(o[0])
    uint = dr.uint32_array_t(float_type)
    index = dr.arange(uint, size) + dr.opaque(uint, start)
    part_o, part_d = gather_vector3(o, index), gather_vector3(d, index)
    offset = None if jitter is None else dr.gather(float_type, jitter, index)
    dr.eval(index, part_o, part_d, offset)
    return index, part_o, part_d, offset
