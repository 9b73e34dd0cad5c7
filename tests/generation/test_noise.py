"""The estimate of ground-truth noise, against errors that are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerf.generation.noise import Noise, estimate, mean_image
from mi_nerf.images.metrics import to_8bit
from mi_nerf.images.write import on_white


def noisy(truth: np.ndarray, sigma: float, samples: int, rng: np.random.Generator) -> np.ndarray:
    """A mean of ``samples`` Gaussian samples around the colours of ``truth``."""
    image = truth.copy()
    image[..., :3] += rng.normal(0, sigma / math.sqrt(samples), truth[..., :3].shape)
    return image


def true_errors(image: np.ndarray, truth: np.ndarray) -> tuple[float, float, float]:
    """What the three figures estimate, from the converged image itself."""
    a, b = on_white(image), on_white(truth)
    return (
        float(np.mean((image - truth)[..., :3] ** 2)),
        float(np.mean((a - b) ** 2)),
        float(np.mean((to_8bit(a) - to_8bit(b)) ** 2)),
    )


@pytest.mark.slow
@given(
    st.integers(0, 1000),
    st.sampled_from([(1, 1), (8, 8), (3, 4), (1, 15)]),
    st.floats(0.005, 0.3),
)
def test_the_estimate_is_the_true_error(seed: int, samples: tuple[int, int], sigma: float) -> None:
    rng = np.random.default_rng(seed)
    truth = rng.uniform(0.25, 0.6, (96, 96, 4))
    truth[..., 3] = 1
    n = sum(samples)
    sigma = min(sigma, 0.05 * math.sqrt(min(samples)))  # so that nothing clips
    a, b = (noisy(truth, sigma, count, rng) for count in samples)
    image = mean_image(a, b, samples)
    expected = np.mean([a, b], axis=0, keepdims=False) if samples[0] == samples[1] else None
    if expected is not None:
        assert image == pytest.approx(expected, abs=1e-6)
    noise = estimate(a, b, samples)
    linear, srgb, rounded = true_errors(image.astype(np.float64), truth)
    assert linear == pytest.approx(sigma**2 / n, rel=0.05)
    assert noise.mse_linear == pytest.approx(linear, rel=0.08)
    assert noise.mse_srgb == pytest.approx(srgb, rel=0.15)
    assert noise.mse_8bit == pytest.approx(rounded, rel=0.15)
    ceiling = noise.psnr_ceiling
    assert ceiling == pytest.approx(-10 * math.log10(rounded), abs=0.7)


def test_rounding_counts_where_noise_is_finer_than_eight_bits() -> None:
    """Errors of a tenth of a step: most vanish, a few become a whole step."""
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.3, 0.5, (200, 200, 4))
    truth[..., 3] = 1
    a, b = (noisy(truth, 2e-4, 1, rng) for _ in range(2))
    noise = estimate(a, b, (1, 1))
    _, srgb, rounded = true_errors(mean_image(a, b, (1, 1)).astype(np.float64), truth)
    assert rounded > 4 * srgb
    assert noise.mse_8bit == pytest.approx(rounded, rel=0.05)
    assert noise.mse_srgb == pytest.approx(srgb, rel=0.05)


def test_no_noise_has_no_ceiling() -> None:
    image = np.full((4, 4, 4), 0.5)
    noise = estimate(image, image, (2, 2))
    assert noise == Noise(0, 0, 0)
    assert noise.psnr_ceiling is None and noise.record()["psnr_ceiling"] is None


def test_on_white_is_the_protocol() -> None:
    """Straight sRGB over white, composited in sRGB; no colour without alpha."""
    image = np.array([[[0.5, 0.25, 0.0, 0.5], [0.3, 0.3, 0.3, 0.0], [9.0, 0.0, 0.0, 1.0]]])
    encoded = 1.055 * 0.5 ** (1 / 2.4) - 0.055
    expected = [[1, 0.5 * encoded + 0.5, 0.5], [1, 1, 1], [1, 0, 0]]
    assert on_white(image)[0] == pytest.approx(np.array(expected))
