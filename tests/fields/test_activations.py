"""Activations and their slopes against float64, at both ends of the range too."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
import pytest

from mi_nerf.fields.activations import apply_activation, bounded_exp, relu, sigmoid, softplus

# ±100, every place where a formula changes, and much in between.
INPUTS = np.concatenate(
    [
        np.linspace(-100, 100, 4001),
        np.random.default_rng(0).uniform(-6, 6, 1000),
        [0.0, -0.0, 1e-30, -1e-30, 15, 20, -20, math.log(0.02), -math.log(0.02)],
        [np.nextafter(np.float32(x), np.float32(y)) for x in (15, 20, -20) for y in (-99, 99)],
    ]
).astype(np.float32)


def value_and_slope(ad: Any, f: Callable, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    x = ad.Float(inputs)
    dr.enable_grad(x)
    y = f(x)
    value = np.array(dr.detach(y))
    dr.backward(y)
    slope = np.array(dr.grad(x))
    assert np.isfinite(value).all() and np.isfinite(slope).all()
    return value, slope


def test_relu(ad: Any) -> None:
    value, slope = value_and_slope(ad, relu, INPUTS)
    assert np.array_equal(value, np.maximum(INPUTS, 0))
    assert np.array_equal(slope[INPUTS != 0], INPUTS[INPUTS != 0] > 0)


def test_softplus(ad: Any) -> None:
    x = INPUTS.astype(float)
    value, slope = value_and_slope(ad, softplus, INPUTS)
    normal = x > -87  # below, float32 has fewer digits
    # log(1 + e) as such loses a little where the series takes over, at e = 0.02.
    assert value[normal] == pytest.approx(np.log1p(np.exp(x))[normal], rel=5e-6, abs=0)
    assert slope[normal] == pytest.approx((1 / (1 + np.exp(-x)))[normal], rel=5e-6, abs=0)
    assert (value[~normal] < 1e-37).all() and (slope[~normal] < 1e-37).all()


def test_softplus_keeps_its_tail(ad: Any) -> None:
    """As it is usually written, it is 0 from x = −17 on, and so is its slope."""
    x = np.linspace(-80, -20, 200).astype(np.float32)
    value, slope = value_and_slope(ad, softplus, x)
    assert value == pytest.approx(np.exp(x.astype(float)), rel=1e-6, abs=0)
    assert slope == pytest.approx(np.exp(x.astype(float)), rel=1e-6, abs=0)
    assert not np.log(np.float32(1) + np.exp(x)).any()


def test_bounded_exp(ad: Any) -> None:
    x = INPUTS.astype(float)
    value, slope = value_and_slope(ad, bounded_exp, INPUTS)
    normal, top = x > -87, math.exp(15)
    expected = np.where(x <= 15, np.exp(x), top * (x - 14))
    assert value[normal] == pytest.approx(expected[normal], rel=1e-6, abs=0)
    assert slope[normal] == pytest.approx(np.exp(np.minimum(x, 15))[normal], rel=1e-6, abs=0)


def test_bounded_exp_has_no_step(ad: Any) -> None:
    """One float below 15, 15, one float above: values and slopes pass smoothly."""
    fifteen = np.float32(15)
    x = np.array([np.nextafter(fifteen, 0), fifteen, np.nextafter(fifteen, 16)], np.float32)
    value, slope = value_and_slope(ad, bounded_exp, x)
    assert value == pytest.approx(np.full(3, math.exp(15)), rel=3e-6)
    assert slope == pytest.approx(np.full(3, math.exp(15)), rel=3e-6)
    assert bounded_exp(ad.Float(1e30))[0] == pytest.approx(1e30 * math.exp(15), rel=1e-6)


def test_sigmoid(ad: Any) -> None:
    x = INPUTS.astype(float)
    value, slope = value_and_slope(ad, sigmoid, INPUTS)
    bounded = np.clip(x, -20, 20)
    expected = 1 / (1 + np.exp(-bounded))
    assert value == pytest.approx(expected, rel=1e-6, abs=0)
    assert (value > 0).all()
    inside = np.abs(x) < 20
    exact = np.exp(-np.abs(x)) / (1 + np.exp(-np.abs(x))) ** 2
    assert slope[inside] == pytest.approx(exact[inside], rel=1e-5)
    assert not slope[np.abs(x) > 20].any()


@pytest.mark.parametrize("name", ["relu", "softplus", "exp", "sigmoid"])
def test_nan_passes(ad: Any, name: str) -> None:
    """The trainer can only skip a spoilt step if it can see it in the loss."""
    result = np.array(apply_activation(name, ad.Float([1, np.nan, -1])))
    assert np.isnan(result).tolist() == [False, True, False]


def test_names(ad: Any) -> None:
    x = ad.Float([-1.5, 2.5])
    functions = {"relu": relu, "softplus": softplus, "exp": bounded_exp, "sigmoid": sigmoid}
    for name, function in functions.items():
        assert list(apply_activation(name, x)) == list(function(x))
