"""The volume-rendering integral by quadrature (Max 1995; NeRF Eq. 3).

With density σ constant over each interval of length δ,

    C = Σ_i w_i c_i + T_end · background,
    w_i = T_i (1 − exp(−σ_i δ_i)),    T_i = exp(−Σ_{j<i} σ_j δ_j).

The rules, of which docs/quadrature.md compares the errors:

- ``constant``: δ is the width of a sample's stratum, wherever in it the sample lies;
- ``cells``: δ reaches up to halfway to the neighbours. For samples in the middle of their
  strata that is the same;
- ``linear``: density is linear between samples (Uy et al. 2023), and so is the light
  emitted, σc: samples in empty space, which may never have been looked at, have no share
  in the colour.

Transmittance is the exponential of a sum, never a running product, and 1 − exp(−x)
keeps its digits for thin media. Nothing divides by T, so adjoints stay finite
behind opaque surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import drjit as dr

from ..base.arrays import Floats
from .strata import half_widths, neighbours

Rule = Literal["constant", "cells", "linear"]

# exp(−80) ≈ 2e-35: an optical depth beyond this is opaque to the last bit, while
# sums of a few thousand such terms are still far from overflow.
MAX_OPTICAL_DEPTH = 80.0

_MAX_DENSITY = 1e30  # its products with widths are finite


@dataclass
class Composite:
    """What R rays see of a medium."""

    color: list[Floats]  # R values a channel: emission weighted along the ray, no background
    opacity: Floats  # R values in [0, 1]: 1 − transmittance of the whole ray
    depth: Floats  # R values: mean t under the weights; 0 where the opacity is 0
    weights: Floats  # R·S values: the share of each sample, summing to the opacity


def one_minus_exp(x: Floats) -> Floats:
    """1 − exp(−x) for x ≥ 0, accurate to a few ulp where the formula itself cancels."""
    small = x < 0.25
    y = dr.select(small, x, 0)
    return dr.select(small, y * _mean_series(y), 1 - dr.exp(-dr.select(small, 1, x)))


def mean_transmittance(x: Floats) -> Floats:
    """(1 − exp(−x))/x for x ≥ 0: the mean of exp(−ux) over 0 ≤ u ≤ 1."""
    small = x < 0.25
    y = dr.select(small, 1, x)
    return dr.select(small, _mean_series(dr.select(small, x, 0)), (1 - dr.exp(-y)) / y)


def _mean_series(x: Floats) -> Floats:
    """(1 − exp(−x))/x for 0 ≤ x ≤ 1/4, as 1 − x/2(1 − x/3(1 − …))."""
    factor = type(x)(1)
    for n in (8, 7, 6, 5, 4, 3, 2):
        factor = 1 - x * (1 / n) * factor
    return factor


def sample_weights(density: Floats, delta: Floats, samples: int) -> tuple[Floats, Floats]:
    """Weights and opacities of the rules with constant density.

    Args:
        density: R·S values ≥ 0, in 1/unit of ``delta``.
        delta: R·S interval lengths ≥ 0.
        samples: S, the number of samples a ray.

    Returns:
        ``(weights, opacity)``, R·S and R values.
    """
    tau = _opaque_at_most(density * delta)
    transmittance = dr.exp(-dr.block_prefix_sum(tau, samples, exclusive=True))
    weights = transmittance * one_minus_exp(tau)
    return weights, one_minus_exp(dr.block_sum(tau, samples))


def linear_weights(
    density: Floats, t: Floats, near: Floats, far: Floats, samples: int
) -> tuple[Floats, Floats]:
    """Weights and opacities of the rule with linear density.

    Density is linear between samples and constant between the outer ones and the ends.
    In each half of a gap between samples, of width l with densities near its ends weighed
    3 : 1, a sample of density σ gains T · mean_transmittance(τ) · l · σ · ¾ or ¼ from it:
    transmittance is exact at both ends of the half, and the light emitted linear in it.
    Weights are not negative and sum to the opacity, which is that of the rule ``cells``.

    Args:
        density: R·S values ≥ 0, in 1/unit of ``t``.
        t: R·S ascending parameters.
        near, far: bounds of R rays.
        samples: S.

    Returns:
        ``(weights, opacity)``, R·S and R values.
    """
    density = dr.select(density > _MAX_DENSITY, _MAX_DENSITY, density)
    below, above = half_widths(t, near, far, samples)
    before, after = neighbours(density, samples)
    tau_below = below * (0.75 * density + 0.25 * before)
    tau_above = above * (0.75 * density + 0.25 * after)
    first = _opaque_at_most(tau_below)
    tau = first + _opaque_at_most(tau_above)
    start = dr.block_prefix_sum(tau, samples, exclusive=True)
    # How much of a half's width is seen.
    below = below * dr.exp(-start) * mean_transmittance(tau_below)
    above = above * dr.exp(-(start + first)) * mean_transmittance(tau_above)
    dr.eval(below, above, tau)
    from_above, _ = neighbours(above, samples, first=below)
    _, from_below = neighbours(below, samples, last=above)
    weights = density * (0.75 * (below + above) + 0.25 * (from_above + from_below))
    return weights, one_minus_exp(dr.block_sum(tau, samples))


def _opaque_at_most(tau: Floats) -> Floats:
    """Limits optical depths; lets NaN through."""
    return dr.select(tau > MAX_OPTICAL_DEPTH, MAX_OPTICAL_DEPTH, tau)


def composite(
    density: Floats,
    emission: list[Any],
    t: Floats,
    delta: Floats,
    samples: int,
    ends: tuple[Any, Any] | None = None,
) -> Composite:
    """Integrates emission and density along R rays of S samples each.

    Args:
        density: R·S values ≥ 0.
        emission: one array of R·S values a colour channel.
        t, delta: R·S sample parameters and interval lengths, in the same unit.
        samples: S.
        ends: bounds of the R rays, for linear density in place of ``delta``.
    """
    if ends is None:
        weights, opacity = sample_weights(density, delta, samples)
    else:
        weights, opacity = linear_weights(density, t, *ends, samples)
    dr.eval(weights, opacity)  # once, not in the kernel of every sum below
    color = [dr.block_sum(weights * channel, samples) for channel in emission]
    visible = opacity > 0
    mean_t = dr.block_sum(weights * t, samples) / dr.select(visible, opacity, 1)
    return Composite(color, opacity, dr.select(visible, mean_t, 0), weights)


def over_background(color: list[Floats], opacity: Floats, background: list[Floats]) -> list[Floats]:
    """Places what the rays saw in front of ``background`` (one value or array a channel)."""
    return [c + (1 - opacity) * b for c, b in zip(color, background, strict=True)]
