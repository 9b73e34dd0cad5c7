"""Rules of quadrature: which part of a ray a sample stands for, and its share of the light.

With density σ constant over each interval of length δ,

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

from typing import Any, Literal

import drjit as dr

from ..base.arrays import Floats
from .strata import cell_edges, cell_widths, half_widths, neighbours, stratified, stratum_edges

Rule = Literal["constant", "cells", "linear"]

# exp(−80) ≈ 2e-35: an optical depth beyond this is opaque to the last bit, while
# sums of a few thousand such terms are still far from overflow.
MAX_OPTICAL_DEPTH = 80.0

_MAX_DENSITY = 1e30  # its products with widths are finite


class CellRule:
    """A sample stands for what is nearest to it, with density constant: ``cells``."""

    name: Rule = "cells"  # in files and settings
    reads_bounds = False  # whether weights depend on where the ray enters and leaves

    @property
    def refined(self) -> CellRule:
        """The rule of samples that are no longer one in each of equal strata."""
        return self

    def place(self, near: Floats, far: Floats, samples: int, jitter: Floats) -> tuple[Any, Any]:
        """Samples and widths of R rays; arguments as for :func:`.strata.stratified`."""
        t, _ = stratified(near, far, samples, jitter)
        return t, cell_widths(t, near, far, samples)

    def edges(self, t: Floats, near: Floats, far: Floats, samples: int) -> Floats:
        """R·(S + 1) ascending ends of the intervals: sample s lies between s and s + 1."""
        return cell_edges(t, near, far, samples)

    def weights(
        self, density: Floats, t: Floats, delta: Floats, bounds: tuple[Any, Any], samples: int
    ) -> tuple[Any, Any]:
        """Weights (R·S) and opacities (R) of densities at samples ``t`` of widths ``delta``."""
        return sample_weights(density, delta, samples)


class StratumRule(CellRule):
    """A sample stands for its stratum, wherever in it it lies: ``constant``."""

    name = "constant"

    @property
    def refined(self) -> CellRule:
        return RULES["cells"]

    def place(self, near: Floats, far: Floats, samples: int, jitter: Floats) -> tuple[Any, Any]:
        return stratified(near, far, samples, jitter)

    def edges(self, t: Floats, near: Floats, far: Floats, samples: int) -> Floats:
        return stratum_edges(near, far, samples)


class LinearRule(CellRule):
    """Density is linear between samples: ``linear``."""

    name = "linear"
    reads_bounds = True

    def weights(
        self, density: Floats, t: Floats, delta: Floats, bounds: tuple[Any, Any], samples: int
    ) -> tuple[Any, Any]:
        return linear_weights(density, t, *bounds, samples)


RULES: dict[Rule, CellRule] = {
    rule.name: rule for rule in (StratumRule(), CellRule(), LinearRule())
}


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
    tau = opaque_at_most(density * delta)
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

    Arguments and results as in :func:`sample_weights`, besides:

    Args:
        t: R·S ascending parameters.
        near, far: bounds of R rays.
    """
    density = dr.select(density > _MAX_DENSITY, _MAX_DENSITY, density)
    below, above = half_widths(t, near, far, samples)
    before, after = neighbours(density, samples)
    tau_below = below * (0.75 * density + 0.25 * before)
    tau_above = above * (0.75 * density + 0.25 * after)
    first = opaque_at_most(tau_below)
    tau = first + opaque_at_most(tau_above)
    start = dr.block_prefix_sum(tau, samples, exclusive=True)
    # How much of a half's width is seen.
    below = below * dr.exp(-start) * mean_transmittance(tau_below)
    above = above * dr.exp(-(start + first)) * mean_transmittance(tau_above)
    dr.eval(below, above, tau)
    from_above, _ = neighbours(above, samples, first=below)
    _, from_below = neighbours(below, samples, last=above)
    weights = density * (0.75 * (below + above) + 0.25 * (from_above + from_below))
    return weights, one_minus_exp(dr.block_sum(tau, samples))


def opaque_at_most(tau: Floats) -> Floats:
    """Limits optical depths; lets NaN through."""
    return dr.select(tau > MAX_OPTICAL_DEPTH, MAX_OPTICAL_DEPTH, tau)
