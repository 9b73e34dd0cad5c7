"""Metrics and colour transfer functions against closed forms and slow oracles."""

from __future__ import annotations

import math
from importlib import import_module

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerf.base.color import linear_to_srgb, srgb_to_linear
from mi_nerf.images.metrics import (
    psnr,
    psnr_log,
    psnr_tone_mapped,
    ssim,
    to_8bit,
    tone_mapped,
)


def image_pair(height: int, width: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A smooth image and a noisy copy of it."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width]
    smooth = 0.5 + 0.4 * np.stack([np.sin(x / 3), np.cos(y / 4), np.sin((x + y) / 5)], axis=-1)
    return smooth, np.clip(smooth + rng.normal(0, 0.1, smooth.shape), 0, 1)


def slow_ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Wang et al. 2004, Eq. 13, window by window."""
    taps = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window = np.outer(taps, taps) / taps.sum() ** 2
    c1, c2 = 0.01**2, 0.03**2
    values = []
    for i in range(a.shape[0] - 10):
        for j in range(a.shape[1] - 10):
            for c in range(a.shape[2]):
                x, y = a[i : i + 11, j : j + 11, c], b[i : i + 11, j : j + 11, c]
                mx, my = (window * x).sum(), (window * y).sum()
                vx, vy = (window * (x - mx) ** 2).sum(), (window * (y - my) ** 2).sum()
                cov = (window * (x - mx) * (y - my)).sum()
                numerator = (2 * mx * my + c1) * (2 * cov + c2)
                values.append(numerator / ((mx**2 + my**2 + c1) * (vx + vy + c2)))
    return float(np.mean(values))


# ---- PSNR ------------------------------------------------------------------


def test_psnr_by_hand() -> None:
    black = np.zeros((2, 2, 3))
    assert psnr(black, black + 0.1) == pytest.approx(20.0, abs=1e-12)
    assert psnr(black, black + 1.0) == pytest.approx(0.0, abs=1e-12)
    one_off = black.copy()
    one_off[0, 0, 0] = 0.5  # mean squared error 0.25/12
    assert psnr(black, one_off) == pytest.approx(10 * math.log10(48), abs=1e-12)


def test_psnr_of_identical_images_is_infinite() -> None:
    a, _ = image_pair(4, 5)
    assert psnr(a, a) == math.inf


@pytest.mark.slow
def test_psnr_agrees_with_scikit_image() -> None:
    from skimage.metrics import peak_signal_noise_ratio

    a, b = image_pair(17, 23)
    assert psnr(a, b) == pytest.approx(peak_signal_noise_ratio(a, b, data_range=1), abs=1e-6)


def test_psnr_is_computed_in_double_precision() -> None:
    a = np.full((64, 64, 3), 1.0, np.float32)
    b = np.nextafter(a, np.float32(0))
    assert psnr(a, b) == pytest.approx(20 * math.log10(2**24), abs=1e-9)


def test_psnr_refuses_to_broadcast() -> None:
    with pytest.raises(ValueError, match=r"\(2, 2, 3\).*\(2, 2, 1\)"):
        psnr(np.zeros((2, 2, 3)), np.zeros((2, 2, 1)))


# ---- SSIM ------------------------------------------------------------------


@pytest.mark.parametrize("size", [(11, 11), (11, 14), (19, 16)])
def test_ssim_agrees_with_explicit_windows(size: tuple[int, int]) -> None:
    a, b = image_pair(*size)
    expected = slow_ssim(a, b)
    assert 0.1 < expected < 0.95  # a pair that tells something
    assert ssim(a, b) == pytest.approx(expected, abs=1e-6)
    assert ssim(a.astype(np.float32), b.astype(np.float32)) == pytest.approx(expected, abs=1e-6)


def test_ssim_of_identical_images_is_one() -> None:
    a, _ = image_pair(16, 16)
    assert ssim(a, a) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("size", [(10, 30), (30, 10), (1, 1)])
def test_ssim_of_images_below_the_window_is_undefined(size: tuple[int, int]) -> None:
    a, b = image_pair(*size)
    assert math.isnan(ssim(a, b))


def test_ssim_wants_channels() -> None:
    with pytest.raises(ValueError, match=r"\(H, W, C\)"):
        ssim(np.zeros((16, 16)), np.zeros((16, 16)))


# ---- 8-bit rounding --------------------------------------------------------


def test_to_8bit() -> None:
    image = np.array([-1.0, 0.0, 0.49 / 255, 0.51 / 255, 100.4 / 255, 1.0, 7.0])
    assert np.array_equal(to_8bit(image) * 255, [0, 0, 0, 1, 100, 255, 255])
    assert np.isnan(to_8bit(np.array([np.nan]))).all()


def test_to_8bit_keeps_8bit_images() -> None:
    levels = np.arange(256)
    assert np.array_equal(to_8bit(levels / 255), levels / 255)
    single = levels.astype(np.float32) / np.float32(255)
    assert np.array_equal(to_8bit(single), levels / 255)


# ---- Colour ----------------------------------------------------------------


def slow_srgb_to_linear(x: float) -> float:
    """IEC 61966-2-1."""
    return x / 12.92 if x <= 0.04045 else ((x + 0.055) / 1.055) ** 2.4


def test_srgb_known_values() -> None:
    assert srgb_to_linear(np.array([0.0, 1.0, -0.5])) == pytest.approx([0, 1, -0.5 / 12.92])
    assert linear_to_srgb(np.array([0.0, 1.0, -0.5])) == pytest.approx([0, 1, -0.5 * 12.92])
    assert srgb_to_linear(np.array(0.5)) == pytest.approx(0.21404114048223255, abs=1e-15)


@given(st.floats(-2, 16))
def test_srgb_against_the_standard(x: float) -> None:
    assert srgb_to_linear(np.array(x)) == pytest.approx(slow_srgb_to_linear(x), rel=1e-14)
    # The constants of the standard are rounded, so its two branches meet only nearly.
    assert linear_to_srgb(srgb_to_linear(np.array(x))) == pytest.approx(x, abs=1e-7)


def test_srgb_keeps_type_and_shape() -> None:
    x = np.linspace(-1, 2, 12, dtype=np.float32).reshape(3, 4)
    for function in (srgb_to_linear, linear_to_srgb):
        assert function(x).dtype == np.float32
        assert function(x).shape == x.shape


@pytest.mark.parametrize("name", ["Float", "Float64", "Array3f", "TensorXf"])
@pytest.mark.parametrize("function", [srgb_to_linear, linear_to_srgb])
def test_srgb_of_drjit_arrays(name: str, function) -> None:
    if not dr.has_backend(dr.JitBackend.LLVM):
        pytest.skip("no LLVM")
    cls = getattr(import_module("drjit.llvm.ad"), name)
    values = np.linspace(-1, 3, 24).astype(np.float64 if name == "Float64" else np.float32)
    values[:5] = 0, 0.0403, 0.0406, 0.0030, 0.0032  # zero, and around where the branches meet
    x = cls(values.reshape(3, 8)) if name in ("Array3f", "TensorXf") else cls(values)
    dr.enable_grad(x)
    y = function(x)
    assert type(y) is cls
    dr.backward(y)
    step = 1e-6
    exact = values.astype(np.float64)
    slope = (function(exact + step) - function(exact - step)) / (2 * step)
    assert np.asarray(y).reshape(-1) == pytest.approx(function(exact), rel=1e-6, abs=1e-7)
    assert np.asarray(dr.grad(x)).reshape(-1) == pytest.approx(slope, rel=1e-4)


# ---- Radiance ---------------------------------------------------------------------


def test_radiance_by_loops() -> None:
    rng = np.random.default_rng(0)
    a, b = 10 ** rng.uniform(-4, 4, (2, 3, 4, 3))
    logs, tones = [], []
    for x, y in zip(a.ravel(), b.ravel(), strict=True):
        logs.append((math.log10(x + 1e-3) - math.log10(y + 1e-3)) ** 2)
        mapped = [v / (1 + v) for v in (x, y)]
        coded = [12.92 * v if v <= 0.0031308 else 1.055 * v ** (1 / 2.4) - 0.055 for v in mapped]
        tones.append((coded[0] - coded[1]) ** 2)
    assert psnr_log(a, b) == pytest.approx(-10 * math.log10(np.mean(logs)))
    assert psnr_tone_mapped(a, b) == pytest.approx(-10 * math.log10(np.mean(tones)))


@pytest.mark.parametrize("level", [1.0, 1e2, 1e4])
def test_the_same_factor_counts_the_same_at_any_brightness(level: float) -> None:
    """A tenth of a decade is 20 dB; brightness far from black does not matter."""
    image = np.full((4, 5, 3), level)
    assert psnr_log(image * 10**0.1, image) == pytest.approx(20, abs=0.01)
    assert psnr_log(image / 10**0.1, image) == pytest.approx(20, abs=0.01)


def test_tone_mapping_stays_below_one() -> None:
    radiance = np.array([0.0, -1.0, 1.0, 1e4, np.nan])
    mapped = tone_mapped(radiance)
    assert mapped[:2].tolist() == [0, 0] and np.isnan(mapped[4])
    assert mapped[2] == pytest.approx(linear_to_srgb(np.float64(0.5))) and 0.999 < mapped[3] < 1


def test_equal_radiance() -> None:
    image = np.full((2, 2, 3), 7.0)
    assert psnr_log(image, image) == psnr_tone_mapped(image, image) == math.inf
    with pytest.raises(ValueError, match="agree in shape"):
        psnr_log(image, image[:1])
