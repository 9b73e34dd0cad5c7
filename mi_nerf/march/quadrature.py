"""The volume-rendering integral by quadrature (Max 1995; NeRF Eq. 3).

    C = Σ_i w_i c_i + T_end · background

with the weights w of a rule (:mod:`mi_nerf.march.rules`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr

from ..base.arrays import Floats
from .query import Evaluation
from .rules import RULES, CellRule
from .samples import Samples


@dataclass
class Composite:
    """What R rays see of a medium."""

    color: list[Floats]  # R values a channel: emission weighted along the ray, no background
    opacity: Floats  # R values in [0, 1]: 1 − transmittance of the whole ray
    depth: Floats  # R values: mean t under the weights; 0 where the opacity is 0
    weights: Floats  # R·S values: the share of each sample, summing to the opacity


def integrate(evaluation: Evaluation, samples: Samples) -> Composite:
    """Quadrature of an evaluated batch; differentiable in density and emission.

    Depth is a distance in scene space: in normalised device coordinates, that of the
    mean t'.
    """
    seen = composite(
        evaluation.density,
        evaluation.emission,
        samples.t,
        samples.delta,
        samples.count,
        samples.rule,
        (samples.near, samples.far),
    )
    if samples.ndc is None:
        return seen
    distance = samples.ndc.to_distance(seen.depth)
    return replace(seen, depth=dr.select(seen.opacity > 0, distance, 0))


def composite(
    density: Floats,
    emission: list[Any],
    t: Floats,
    delta: Floats,
    samples: int,
    rule: CellRule = RULES["constant"],
    bounds: tuple[Any, Any] = (None, None),
) -> Composite:
    """Integrates emission and density along R rays of S samples each.

    Args:
        density: R·S values ≥ 0.
        emission: one array of R·S values a colour channel.
        t, delta: R·S sample parameters and interval lengths, in the same unit.
        samples: S.
        rule: whose weights the samples have; ``linear`` reads ``bounds``, near and far of
            the R rays, in place of ``delta``.
    """
    weights, opacity = rule.weights(density, t, delta, bounds, samples)
    dr.eval(weights, opacity)  # once, not in the kernel of every sum below
    color = [dr.block_sum(weights * channel, samples) for channel in emission]
    visible = opacity > 0
    mean_t = dr.block_sum(weights * t, samples) / dr.select(visible, opacity, 1)
    return Composite(color, opacity, dr.select(visible, mean_t, 0), weights)


def over_background(color: list[Floats], opacity: Floats, background: list[Floats]) -> list[Floats]:
    """Places what the rays saw in front of ``background`` (one value or array a channel)."""
    return [c + (1 - opacity) * b for c, b in zip(color, background, strict=True)]
