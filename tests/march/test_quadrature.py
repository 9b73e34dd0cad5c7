"""The volume-rendering integral against a float64 oracle and closed forms."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerf.march.quadrature import composite, over_background
from mi_nerf.march.rules import one_minus_exp
from mi_nerf.march.strata import stratified


def slow_composite(
    density: np.ndarray, emission: np.ndarray, t: np.ndarray, delta: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Weights, colour, opacity and depth of one ray: S samples, emission (3, S)."""
    depth_so_far, weights = 0.0, []
    for sigma, width in zip(density, delta, strict=True):
        transmittance = math.exp(-depth_so_far)
        weights.append(transmittance * -math.expm1(-float(sigma) * float(width)))
        depth_so_far += float(sigma) * float(width)
    w = np.array(weights)
    opacity = -math.expm1(-depth_so_far)
    depth = float(np.sum(w * t)) / opacity if opacity > 0 else 0.0
    return w, emission @ w, opacity, depth


def medium(
    ad: Any, density: Callable, emission: Callable, far: float, samples: int, near: float = 0.0
) -> Any:
    """One ray through a medium given by functions of t, in float64."""
    t, delta = stratified(ad.Float64(near), ad.Float64(far), samples)
    return composite(density(t), [emission(t)], t, delta, samples)


def constant(value: float) -> Callable:
    return lambda t: dr.full(type(t), value, len(t))


# ---- 1 − exp(−x) ------------------------------------------------------------

THICKNESSES = np.concatenate([np.logspace(-12, 4, 3000), [0.25, np.nextafter(0.25, 0)]])


def test_one_minus_exp(ad: Any) -> None:
    x = THICKNESSES.astype(np.float32)
    exact = -np.expm1(-x.astype(float))
    assert np.array(one_minus_exp(ad.Float(x))) == pytest.approx(exact, rel=1e-6, abs=0)


def test_one_minus_exp_in_double_precision(ad: Any) -> None:
    exact = -np.expm1(-THICKNESSES)
    assert np.array(one_minus_exp(ad.Float64(THICKNESSES))) == pytest.approx(exact, rel=1e-10)


def test_slope_of_one_minus_exp(ad: Any) -> None:
    x = ad.Float(np.append(THICKNESSES.astype(np.float32), 0))
    dr.enable_grad(x)
    dr.backward(one_minus_exp(x))
    exact = np.exp(-np.append(THICKNESSES.astype(np.float32), 0).astype(float))
    assert np.array(dr.grad(x)) == pytest.approx(exact, rel=2e-6, abs=1e-37)


# ---- Against the oracle -----------------------------------------------------

RAYS, SAMPLES = 4, 16
exponent = st.floats(-12, 12)
densities = st.lists(st.just(-math.inf) | exponent, min_size=64, max_size=64)
widths = st.lists(st.sampled_from([0.0, 1e-6, 0.01, 0.3, 10.0]), min_size=64, max_size=64)


@pytest.mark.slow
@given(exponents=densities, widths=widths)
def test_any_medium(ad: Any, exponents: list[float], widths: list[float]) -> None:
    """Densities of 0 and 1e-12 to 1e12 in any order, intervals of any length."""
    density = (10.0 ** np.array(exponents)).astype(np.float32)
    delta = np.array(widths, np.float32)
    rng = np.random.default_rng(0)
    t, emission = np.linspace(1, 5, 64, dtype=np.float32), rng.random((3, 64), np.float32)
    leaves = [ad.Float(density), *(ad.Float(channel) for channel in emission)]
    dr.enable_grad(leaves)
    seen = composite(leaves[0], leaves[1:], ad.Float(t), ad.Float(delta), SAMPLES)
    weights, opacity = np.array(seen.weights).reshape(RAYS, -1), np.array(seen.opacity)
    assert (weights >= 0).all() and (opacity >= 0).all() and (opacity <= 1).all()
    assert weights.sum(axis=1, dtype=float) == pytest.approx(opacity, rel=1e-5, abs=1e-30)
    for r in range(RAYS):
        part = slice(r * SAMPLES, (r + 1) * SAMPLES)
        w, color, alpha, depth = slow_composite(
            density[part], emission[:, part], t[part], delta[part]
        )
        # A relative error of the optical depth is an absolute one of log T.
        assert weights[r] == pytest.approx(w, rel=1e-4, abs=1e-30)
        assert [c[r] for c in seen.color] == pytest.approx(color, rel=2e-5, abs=1e-30)
        assert opacity[r] == pytest.approx(alpha, rel=2e-6, abs=1e-30)
        assert seen.depth[r] == pytest.approx(depth, rel=2e-5)
    dr.backward(sum(seen.color) + seen.opacity + seen.depth)
    for leaf in leaves:
        assert np.isfinite(np.array(dr.grad(leaf))).all()


def test_over_background(ad: Any) -> None:
    color, opacity = [ad.Float([0.25, 0.0]), ad.Float([0.5, 1.0])], ad.Float([0.75, 1.0])
    result = over_background(color, opacity, [2.0, ad.Float([4.0, 8.0])])
    assert [list(channel) for channel in result] == [[0.75, 0.0], [1.5, 1.0]]


def test_nothing_seen(ad: Any) -> None:
    zero, one = dr.zeros(ad.Float, 6), dr.full(ad.Float, 1, 6)
    seen = composite(zero, [one], one, one, 3)
    assert list(seen.color[0]) == list(seen.opacity) == list(seen.depth) == [0, 0]


@pytest.mark.parametrize("sigma", [1e-30, 1e-10, 1e-3, 1.0])
def test_depth_needs_no_opacity(ad: Any, sigma: float) -> None:
    """It is the mean of t, however little there is to be seen."""
    t, delta = ad.Float([1, 2, 3, 10]), dr.full(ad.Float, 1, 4)
    density = ad.Float([0, sigma, 0, 0])
    assert composite(density, [], t, delta, 4).depth[0] == pytest.approx(2, rel=1e-6)


def test_nan_is_not_hidden(ad: Any) -> None:
    """A spoilt density must show in the loss, where the trainer looks for it."""
    density = ad.Float([1, np.nan, 1, 1])
    seen = composite(density, [ad.Float(1)], ad.Float([1, 2, 1, 2]), ad.Float(1), 2)
    assert np.isnan([seen.color[0][0], seen.opacity[0]]).all()
    assert np.isfinite([seen.color[0][1], seen.opacity[1]]).all()


# ---- Closed forms -----------------------------------------------------------


@pytest.mark.parametrize("samples", [1, 2, 7, 64])
@pytest.mark.parametrize("sigma", [1e-9, 0.3, 4.0, 50.0])
def test_constant_slab_is_exact_at_any_sample_count(ad: Any, sigma: float, samples: int) -> None:
    seen = medium(ad, constant(sigma), constant(0.8), far=1.5, samples=samples)
    exact = -math.expm1(-sigma * 1.5)
    assert seen.opacity[0] == pytest.approx(exact, rel=1e-9)
    assert seen.color[0][0] == pytest.approx(0.8 * exact, rel=1e-9)


def test_two_layers_are_exact_where_strata_meet_their_border(ad: Any) -> None:
    sigma, color = (0.7, 3.0), (0.9, 0.2)
    seen = medium(
        ad,
        lambda t: dr.select(t < 1, *map(ad.Float64, sigma)),
        lambda t: dr.select(t < 1, *map(ad.Float64, color)),
        far=4,
        samples=8,
    )
    first, second = -math.expm1(-sigma[0] * 1), -math.expm1(-sigma[1] * 3)
    assert seen.color[0][0] == pytest.approx(color[0] * first + color[1] * (1 - first) * second)
    assert seen.opacity[0] == pytest.approx(1 - (1 - first) * (1 - second), rel=1e-10)


def test_exponential_fog_converges_with_the_square_of_the_step(ad: Any) -> None:
    """σ = a·exp(−b·t) has the optical depth a/b·(1 − exp(−b·L))."""
    a, b, far = 2.0, 1.3, 3.0
    exact = -math.expm1(-a / b * -math.expm1(-b * far))
    errors = [
        abs(medium(ad, lambda t: a * dr.exp(-b * t), constant(1), far, s).opacity[0] - exact)
        for s in (8, 16, 32, 64)
    ]
    assert errors[0] < 0.01
    for coarse, fine in zip(errors, errors[1:], strict=False):
        assert coarse / fine == pytest.approx(4, rel=0.1)


def test_depth_of_a_constant_medium(ad: Any) -> None:
    """The mean of t under σ·exp(−σt) on [0, L] is 1/σ − L/(exp(σL) − 1)."""
    seen = medium(ad, constant(2.0), constant(1), far=3, samples=4000)
    assert seen.depth[0] == pytest.approx(0.5 - 3 / math.expm1(6), rel=1e-6)


# ---- Derivatives ------------------------------------------------------------


def test_gradients_against_finite_differences(ad: Any) -> None:
    """Every density and emission; the loss weighs colour, opacity and depth."""
    rng = np.random.default_rng(4)
    density = 10 ** rng.uniform(-3, 1.5, 40)
    density[[0, 17]] = 0
    emission, t = rng.random((3, 40)), np.sort(rng.uniform(1, 4, (4, 10))).ravel()
    delta = rng.uniform(0, 0.5, 40)
    mix = rng.normal(size=(5, 4))

    def loss(x: Any) -> Any:
        """One for each ray, from the 160 numbers of density and emission."""
        index = dr.arange(ad.UInt32, 40)
        values = [dr.gather(ad.Float64, x, index + 40 * i) for i in range(4)]
        seen = composite(values[0], values[1:], ad.Float64(t), ad.Float64(delta), 10)
        outputs = [*seen.color, seen.opacity, seen.depth]
        return sum(ad.Float64(m) * output for m, output in zip(mix, outputs, strict=True))

    start = np.concatenate([density, *emission])
    x = ad.Float64(start)
    dr.enable_grad(x)
    dr.backward(loss(x))
    numeric, step = [], 1e-5
    for i in range(len(start)):
        moved = [start + sign * step * np.eye(160)[i] for sign in (1, -1)]
        high, low = (np.array(loss(ad.Float64(m))).sum() for m in moved)
        numeric.append((high - low) / (2 * step))
    assert np.array(dr.grad(x)) == pytest.approx(np.array(numeric), rel=1e-6, abs=1e-8)


@pytest.mark.parametrize(("output", "expected"), [(0, [0.1, 0.2, 0.3]), (1, [0.1, 0.4, 0.9])])
def test_gradient_in_empty_space(ad: Any, output: int, expected: list[float]) -> None:
    """Where nothing is, ∂opacity/∂σ = δ and ∂C/∂σ = δ·c, nothing less."""
    density = dr.zeros(ad.Float, 3)
    dr.enable_grad(density)
    color, delta = [ad.Float([1, 2, 3])], ad.Float([0.1, 0.2, 0.3])
    seen = composite(density, color, ad.Float([1, 2, 3]), delta, 3)
    dr.backward([seen.opacity, seen.color[0]][output])
    assert list(dr.grad(density)) == pytest.approx(expected)
