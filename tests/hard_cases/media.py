"""Rows 1 to 5 and 13: the quadrature of thin, empty and opaque media."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from mi_nerf.fields.activations import bounded_exp
from mi_nerf.march.quadrature import composite
from mi_nerf.march.rules import one_minus_exp, sample_weights
from mi_nerf.march.strata import stratified
from tests.hard_cases import Finding, relative
from tests.support import naive

Weigh = Callable[[Any, Any, int], tuple[Any, Any]]


def slope(f: Callable[[Any], Any], x: Any) -> np.ndarray:
    """The derivatives of the sum of ``f`` at the numbers of ``x``."""
    dr.make_opaque(x)  # a constant 0 would be folded, and its history with it
    dr.enable_grad(x)
    dr.backward(dr.sum(f(x)))
    return np.array(dr.grad(x))


def thin_media(ad: Any) -> list[Finding]:
    """Row 1: opacities of 1e-8 to 1e-6 in single precision."""

    def errors(formula: Callable[[Any], Any]) -> list[float]:
        x = np.array([1e-8, 1e-7, 1e-6], np.float32)
        exact = -np.expm1(-x.astype(float))
        found = np.array(formula(ad.Float(x)))
        values = [relative(f, e) for f, e in zip(found, exact, strict=True)]
        # ∂ log α/∂x = exp(−x)/α, as a loss in the logarithm would ask for.
        slopes = slope(lambda x: dr.log(formula(x)), ad.Float(x[1:]))
        return [*values, relative(slopes, np.exp(-x[1:].astype(float)) / exact[1:])]

    what = [f"relative error of α at σδ = {x}" for x in ("1e-8", "1e-7", "1e-6")]
    what.append("of ∂ log α/∂σ at σδ ≥ 1e-7")
    pairs = zip(what, errors(naive.one_minus_exp), errors(one_minus_exp), strict=True)
    return [Finding(*pair) for pair in pairs]


def transmittance(ad: Any) -> list[Finding]:
    """Row 2: 4000 parts of 1e-6; and what comes through a wall."""
    parts, part = 4000, 1e-6
    exact = parts * float(np.float32(part))

    def errors(weigh: Weigh) -> tuple[float, float, float]:
        def opacity(density: Any) -> Any:
            return weigh(density, ad.Float(1), parts)[1]

        depth = relative(-math.log1p(-opacity(dr.full(ad.Float, part, parts))[0]), exact)
        slopes = slope(lambda s: dr.log(opacity(s)), dr.full(ad.Float, part, parts))
        # ∂ log(opacity)/∂σ = T(end)/opacity for every part of thickness 1.
        log_slope = relative(slopes, math.exp(-exact) / -math.expm1(-exact))
        wall, _ = weigh(ad.Float([1e3, 1]), ad.Float(1), 2)
        return depth, log_slope, float(wall[1])

    what = (
        "relative error of the optical depth of 4000 parts of 1e-6",
        "of ∂ log(opacity)/∂σ there",
        "weight of what stands behind a wall of optical depth 1000, and ∂C/∂c of it",
    )
    pairs = zip(what, errors(naive.product_weights), errors(sample_weights), strict=True)
    return [Finding(*pair) for pair in pairs]


def last_interval(ad: Any) -> list[Finding]:
    """Row 3: fog of optical depth 1e-6, and empty space, in 32 intervals."""
    _, delta = stratified(ad.Float(2), ad.Float(3), 32)

    def opacity(delta: Any) -> Callable[[Any], Any]:
        return lambda density: sample_weights(density, delta, 32)[1]

    def errors(delta: Any, infinite: Any) -> tuple[float, float, float]:
        thin = opacity(delta)(dr.full(ad.Float, 1e-6, 32))
        slopes = slope(opacity(delta), dr.zeros(ad.Float, 32))
        empty = opacity(infinite)(dr.opaque(ad.Float, 0, 32))
        return float(thin[0]), relative(slopes, np.full(32, 1 / 32)), float(empty[0])

    what = (
        "opacity of fog of optical depth 1e-6",
        "relative error of ∂ opacity/∂σ in empty space",
        "opacity of empty space with a last interval of ∞",
    )
    usual = errors(naive.endless(delta), naive.endless(delta, dr.inf))
    return [Finding(*pair) for pair in zip(what, usual, errors(delta, delta), strict=True)]


def density_overflow(ad: Any) -> list[Finding]:
    """Row 4: the activation exp of a raw density of 89."""

    def values(activation: Callable[[Any], Any]) -> tuple[float, float]:
        raw = ad.Float([89])
        return float(activation(raw)[0]), float(slope(activation, raw)[0])

    ours, clipped = values(bounded_exp), values(naive.clipped_exp)
    return [
        Finding("density of a raw 89 (any finite number)", values(dr.exp)[0], ours[0]),
        Finding("∂σ/∂raw there (any finite number but 0)", values(dr.exp)[1], ours[1]),
        Finding("the same of exp(min(x, 15))", clipped[1], ours[1]),
    ]


def opaque_walls(ad: Any) -> list[Finding]:
    """Row 5: fog, two samples of a wall, fog; the thickness of the wall from 1e2 to 1e6."""
    color = [1.0, 0.25, 0.0, 8.0]
    exact = math.exp(-0.5) * (1 - 0.25)  # fog in front: it takes the place of the wall

    def errors(weigh: Weigh) -> tuple[float, float]:
        def radiance(density: Any) -> Any:
            return weigh(density, ad.Float(1), 4)[0] * ad.Float(color)

        walls = (1e2, 1e4, 1e6)
        slopes = [slope(radiance, ad.Float([0.5, wall, wall, 0.5])) for wall in walls]
        front = relative([s[0] for s in slopes], [exact] * 3)
        return float(np.sum(~np.isfinite(slopes))), front

    what = ("∂C/∂σ not finite, of 12", "relative error of ∂C/∂σ in front of the wall")
    usual = errors(lambda *a: naive.product_weights(*a, pad=0))
    return [Finding(*pair) for pair in zip(what, usual, errors(sample_weights), strict=True)]


def empty_rays(ad: Any) -> list[Finding]:
    """Row 13: the depth of a ray that meets nothing."""
    t = ad.Float([1, 2, 3, 4])

    def usual(density: Any) -> Any:
        return naive.mean_distance(sample_weights(density, ad.Float(1), 4)[0], t, 4)

    def ours(density: Any) -> Any:
        return composite(density, [], t, ad.Float(1), 4).depth

    def errors(depth: Callable[[Any], Any]) -> tuple[float, float]:
        slopes = slope(depth, dr.zeros(ad.Float, 4))
        return float(depth(dr.zeros(ad.Float, 4))[0]), float(np.sum(~np.isfinite(slopes)))

    what = ("depth of an empty ray (0 by definition)", "∂ depth/∂σ not finite there, of 4")
    pairs = zip(what, errors(usual), errors(ours), strict=True)
    return [Finding(*pair) for pair in pairs]
