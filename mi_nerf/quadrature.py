"""The volume-rendering integral by quadrature (Max 1995; NeRF Eq. 3).

With density σ constant over each interval of length δ,

    C = Σ_i w_i c_i + T_end · background,
    w_i = T_i (1 − exp(−σ_i δ_i)),    T_i = exp(−Σ_{j<i} σ_j δ_j).

Transmittance is the exponential of a sum, never a running product, and 1 − exp(−x)
keeps its digits for thin media. Nothing divides by T, so adjoints stay finite
behind opaque surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

# exp(−80) ≈ 2e-35: an optical depth beyond this is opaque to the last bit, while
# sums of a few thousand such terms are still far from overflow.
MAX_OPTICAL_DEPTH = 80.0


@dataclass
class Composite:
    """What R rays see of a medium."""

    color: list[Any]  # R values a channel: emission weighted along the ray, no background
    opacity: Any  # R values in [0, 1]: 1 − transmittance of the whole ray
    depth: Any  # R values: mean t under the weights; 0 where the opacity is 0
    weights: Any  # R·S values: the share of each sample, summing to the opacity


def one_minus_exp(x: Any) -> Any:
    """1 − exp(−x) for x ≥ 0, accurate to a few ulp where the formula itself cancels."""
    small = x < 0.25
    y = dr.select(small, x, 0)
    factor = type(x)(1)
    for n in (8, 7, 6, 5, 4, 3, 2):  # x(1 − x/2(1 − x/3(1 − …)))
        factor = 1 - y * (1 / n) * factor
    return dr.select(small, y * factor, 1 - dr.exp(-dr.select(small, 1, x)))


def sample_weights(density: Any, delta: Any, samples: int) -> tuple[Any, Any]:
    """Weights and opacities of the constant-per-interval rule.

    Args:
        density: R·S values ≥ 0, in 1/unit of ``delta``.
        delta: R·S interval lengths ≥ 0.
        samples: S, the number of samples a ray.

    Returns:
        ``(weights, opacity)``, R·S and R values.
    """
    tau = density * delta
    tau = dr.select(tau > MAX_OPTICAL_DEPTH, MAX_OPTICAL_DEPTH, tau)  # lets NaN through
    transmittance = dr.exp(-dr.block_prefix_sum(tau, samples, exclusive=True))
    weights = transmittance * one_minus_exp(tau)
    return weights, one_minus_exp(dr.block_sum(tau, samples))


def composite(density: Any, emission: list[Any], t: Any, delta: Any, samples: int) -> Composite:
    """Integrates emission and density along R rays of S samples each.

    Args:
        density: R·S values ≥ 0.
        emission: one array of R·S values a colour channel.
        t, delta: R·S sample parameters and interval lengths, in the same unit.
        samples: S.
    """
    weights, opacity = sample_weights(density, delta, samples)
    dr.eval(weights, opacity)  # once, not in the kernel of every sum below
    color = [dr.block_sum(weights * channel, samples) for channel in emission]
    visible = opacity > 0
    mean_t = dr.block_sum(weights * t, samples) / dr.select(visible, opacity, 1)
    return Composite(color, opacity, dr.select(visible, mean_t, 0), weights)


def over_background(color: list[Any], opacity: Any, background: list[Any]) -> list[Any]:
    """Places what the rays saw in front of ``background`` (one value or array a channel)."""
    return [c + (1 - opacity) * b for c, b in zip(color, background, strict=True)]
