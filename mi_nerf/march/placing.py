"""Places samples along rays: stratified, culled by occupancy, refined by a coarse network."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr

from ..base.arrays import Floats, Mask, Vectors
from .importance import inverse_transform, merge_sorted
from .intervals import ray_segments
from .marched import MarchedField
from .occupancy import OccupancyGrid
from .query import Evaluation
from .rules import RULES, sample_weights
from .samples import Samples
from .strata import cell_widths, points_along


def place_samples(
    marched: MarchedField,
    o: Vectors,
    d: Vectors,
    *,
    jitter: Floats = None,
    bounds: tuple[Any, Any] | None = None,
) -> Samples:
    """Stratified samples of the rays ``o + t·d`` (unit ``d``) inside the field's box.

    ``jitter`` is passed on to :func:`mi_nerf.march.strata`; ``bounds`` limits t
    ray by ray, besides what the settings say. Sample positions carry no gradient. In
    normalised device coordinates samples are evenly spread in t' (NeRF, appendix C).
    """
    field, settings, occupancy = marched.field, marched.settings, marched.occupancy
    with dr.suspend_grad():
        within = ray_segments(field, o, d, (settings.near, settings.far), bounds or (None, None))
        o, d, near, far = within.o, within.d, within.near, within.far
        rule, count = RULES[settings.rule], settings.samples
        t, delta = rule.place(near, far, count, jitter)
        samples = Samples(o, d, within.view, t, delta, count, near, far, ndc=within.ndc, rule=rule)
        samples = _select(samples, within.hit, occupancy, settings.hidden)
        if field.coarse is None or not settings.fine:
            return samples
        evaluation = Evaluation(field.coarse, samples, settings.block, stop=settings.stop)
        weights, _ = sample_weights(evaluation.density, delta, settings.samples)
        shift = jitter if jitter is not None and len(jitter) == samples.rays else None
        samples.index = evaluation.asked
        return refine(samples, weights, settings.fine, occupancy, shift)


def refine(
    samples: Samples,
    weights: Floats,
    fine: int,
    occupancy: OccupancyGrid | None = None,
    jitter: Floats = None,
    hidden: float = 0.0,
) -> Samples:
    """Adds ``fine`` samples a ray where ``weights`` are large (NeRF Sec. 5.2).

    Args:
        samples: the coarse samples, one in each of equal strata.
        weights: theirs; without gradient.
        jitter: R·F numbers in [0, 1), or R to shift all of a ray alike; ``None`` for the
            middle of the strata of the cumulative distribution.
        hidden: as in :class:`mi_nerf.march.settings.MarchSettings`.
    """
    with dr.suspend_grad():
        near, far, count = samples.near, samples.far, samples.count
        more = inverse_transform(near, far, dr.detach(weights), count, fine, jitter)
        t = merge_sorted(samples.t, more, count, fine)
        delta = cell_widths(t, near, far, count + fine)
        merged = replace(
            samples,
            t=t,
            delta=delta,
            count=count + fine,
            coarse_queries=samples.queries,
            rule=samples.rule.refined,
        )
        return _select(merged, far > near, occupancy, hidden)


def _select(samples: Samples, hit: Mask, occupancy: OccupancyGrid | None, hidden: float) -> Samples:
    """Keeps for evaluation the samples that may lie in something, and may be seen."""
    dr.eval(samples.t, samples.delta, samples.near, samples.far)
    t = samples.t
    uint = dr.uint32_array_t(type(t))
    ray = dr.arange(uint, len(t)) // samples.count
    wanted = dr.gather(dr.mask_t(type(t)), hit, ray)
    if occupancy is not None:
        cell = occupancy.cell(points_along(samples.o, samples.d, t, ray))
        wanted &= occupancy.occupied(cell)
        if hidden > 0:
            tau = dr.select(wanted, occupancy.least_density(cell) * samples.delta, 0)
            before = dr.block_prefix_sum(tau, samples.count, exclusive=True)
            wanted &= before < dr.opaque(type(t), hidden)
    samples.index = uint(dr.compress(wanted))
    return samples
