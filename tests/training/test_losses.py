"""Losses of rays against sums in NumPy."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mi_nerf.images.metrics import tone_mapped
from mi_nerf.training.batches import RayBatch
from mi_nerf.training.losses import (
    RayLoss,
    mean_squared_error,
    relative_error,
    relative_error_and_alpha,
    tone_mapped_error,
)

NUMBER = st.floats(-1, 2, width=32)


@given(
    st.lists(NUMBER, min_size=3, max_size=3),
    st.lists(NUMBER, min_size=3, max_size=3),
    NUMBER,
    NUMBER,
)
@settings(
    max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_error_over_all_backgrounds_is_the_mean_over_many(
    variant: str, color: list[float], true: list[float], alpha: float, true_alpha: float
) -> None:
    found = mean_squared_error(
        [mi.Float(c) for c in color], mi.Float(alpha), [mi.Float(c) for c in true],
        mi.Float(true_alpha),
    )  # fmt: skip
    node, weight = np.polynomial.legendre.leggauss(3)  # exact for squares
    errors = []
    for b, w in zip((node + 1) / 2, weight / 2, strict=True):
        off = np.asarray(color) + (1 - alpha) * b - np.asarray(true) - (1 - true_alpha) * b
        errors.append(w * np.mean(off**2))
    assert found[0] == pytest.approx(sum(errors), abs=1e-5)


# ---- Radiance ---------------------------------------------------------------------

RADIANCE = st.floats(0, 2**14, width=32)
COLOR = st.lists(RADIANCE, min_size=3, max_size=3)


def limited(x: np.ndarray) -> np.ndarray:
    return np.where(np.abs(x) > 1, 2 * np.abs(x) - 1, x * x)


@given(COLOR, COLOR, st.floats(0, 1, width=32), st.floats(0, 1, width=32))
@settings(
    max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_relative_error_in_float64(
    variant: str, color: list[float], true: list[float], alpha: float, true_alpha: float
) -> None:
    c, t = np.array(color), np.array(true)
    expected = limited((c - t) / (c + 0.01)).mean()
    arrays = [mi.Float(x) for x in color], [mi.Float(x) for x in true]
    assert relative_error(*arrays, 0.01)[0] == pytest.approx(expected, rel=1e-4, abs=1e-6)
    both = relative_error_and_alpha(
        arrays[0], mi.Float(alpha), arrays[1], mi.Float(true_alpha), 0.01
    )
    expected += 10 * (alpha - true_alpha) ** 2
    assert both[0] == pytest.approx(expected, rel=1e-4, abs=1e-6)


def gradient(color: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Of the relative error of grey rays, by their radiance."""
    grey = mi.Float(color)
    dr.enable_grad(grey)
    dr.backward(dr.sum(relative_error([grey] * 3, [mi.Float(true)] * 3)))
    return np.array(dr.grad(grey), np.float64)


def test_slope_of_the_relative_error(variant: str) -> None:
    """2 (c − C)/(c + ε)² (RawNeRF, Eq. 4); ∓2/(c + ε) where the error is limited."""
    c = np.array([0.01, 1.0, 1.0, 5e3, 0.0, 0.5], np.float32)
    true = np.array([0.011, 0.5, 1.5, 4e3, 0.0, 1e4], np.float32)
    expected = 2 * (c - true) / (c + 1e-3) ** 2
    expected[-1] = -2 / (c[-1] + 1e-3)
    assert gradient(c, true) == pytest.approx(expected, rel=1e-3)


def test_lamps_do_not_outweigh_the_dark(variant: str) -> None:
    """Steps of log(c) are as long under a lamp of 1e4 as under one of twice the prediction."""
    c = np.full(3, 0.5, np.float32)
    steps = c * gradient(c, np.array([1.1, 10.0, 1e4], np.float32))
    assert steps == pytest.approx(np.full(3, -2), rel=0.01)


def test_noisy_targets_settle_at_their_mean(variant: str) -> None:
    """As those of any prediction do that weighs its errors by itself alone."""
    rng = np.random.default_rng(0)
    noisy = rng.uniform(0.5, 1.5, 1000).astype(np.float32)
    level = 0.8
    for _ in range(200):
        level -= 0.1 * gradient(np.full(1000, level, np.float32), noisy).mean()
    assert level == pytest.approx(noisy.mean(), rel=1e-3)


@given(COLOR, COLOR)
@settings(
    max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_tone_mapped_error_is_that_of_the_metric(
    variant: str, color: list[float], true: list[float]
) -> None:
    found = tone_mapped_error([mi.Float(x) for x in color], [mi.Float(x) for x in true])[0]
    expected = np.mean((tone_mapped(np.array(color)) - tone_mapped(np.array(true))) ** 2)
    assert found == pytest.approx(expected, rel=1e-3, abs=1e-7)


@pytest.mark.parametrize("background", ["white", "black", "random"])
@pytest.mark.parametrize("kind", ["mse", "relative"])
def test_loss_and_error_of_rays(variant: str, kind: str, background: str) -> None:
    rng = np.random.default_rng(3)
    color, true = rng.uniform(0, 3, (2, 3, 50)).astype(np.float32)
    alpha, true_alpha = rng.uniform(0, 1, (2, 50)).astype(np.float32)
    behind = {"white": np.ones((3, 50)), "black": np.zeros((3, 50))}
    drawn = behind.get(background, rng.random((3, 50))).astype(np.float32)
    batch = RayBatch(
        None, None, list(map(mi.Float, true)), mi.Float(true_alpha), list(map(mi.Float, drawn))
    )
    loss = RayLoss(kind, background, 0.02)
    seen, target = color + (1 - alpha) * drawn, true + (1 - true_alpha) * drawn
    relative = limited((seen - target) / (seen + 0.02)).mean(axis=0)
    squared = ((seen - target) ** 2).mean(axis=0)
    mapped = ((tone_mapped(seen) - tone_mapped(target)) ** 2).mean(axis=0)
    before = {"mse": (squared, squared), "relative": (relative, mapped)}[kind]
    expected = before
    if background == "random" and kind == "mse":
        da = alpha - true_alpha
        mean = np.mean((color - true) ** 2 - (color - true) * da, axis=0) + da**2 / 3
        expected = (mean, mean)
    elif background == "random":
        mapped = ((tone_mapped(color) - tone_mapped(true)) ** 2).mean(axis=0)
        over_black = limited((color - true) / (color + 0.02)).mean(axis=0)
        expected = (over_black + 10 * (alpha - true_alpha) ** 2, mapped)
    colors = list(map(mi.Float, color))
    for found, values in (
        (loss(colors, mi.Float(alpha), batch), expected),
        (loss.before(colors, mi.Float(alpha), batch), before),
    ):
        for a, b in zip(found, values, strict=True):
            assert np.array(a) == pytest.approx(b, rel=1e-3, abs=1e-5)
