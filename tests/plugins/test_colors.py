"""RGB in the colours of each variant, against the film and against sums in NumPy."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import mi_nerf
from tests.support.variants import EVERY, MONO, SPECTRAL, plugin_module, variant

STEP = 0.25  # nm
WAVELENGTHS = np.arange(360.0, 830.0 + STEP / 2, STEP)
COLORS = st.lists(st.floats(-2, 50, width=32), min_size=3, max_size=3)


@pytest.fixture(params=SPECTRAL)
def spectral(request: pytest.FixtureRequest) -> Iterator[Any]:
    with variant(request.param):
        yield plugin_module("colors")


def spectra(colors: Any, rgb: Any) -> np.ndarray:
    """The light of RGB values at ``WAVELENGTHS``."""
    values = [dr.opaque(mi.Float, float(c)) for c in rgb]
    return np.array(colors.emission(values, mi.UnpolarizedSpectrum(mi.Float(WAVELENGTHS))))[0]


def rgb_of(values: np.ndarray) -> np.ndarray:
    """Linear sRGB of a spectrum at ``WAVELENGTHS``: the definition, by trapezoids in float64."""
    return film() @ values


@cache
def film() -> np.ndarray:
    """(3, wavelengths): what turns a spectrum into linear sRGB."""
    weights = np.full(len(WAVELENGTHS), STEP)
    weights[[0, -1]] /= 2
    matching = np.array(mi.cie1931_xyz(mi.Float(WAVELENGTHS)), np.float64)
    to_srgb = np.array(mi.xyz_to_srgb(mi.Color3f(np.eye(3, dtype=np.float32))), np.float64)
    return to_srgb @ (matching * weights) * mi.MI_CIE_Y_NORMALIZATION


def daylight() -> np.ndarray:
    return np.array(mi.cie_d65(mi.Float(WAVELENGTHS)), np.float64)


def random_rays(count: int, seed: int = 0) -> tuple[Any, Any]:
    """Wavelengths as a camera draws them, and their weights."""
    sample = np.random.default_rng(seed).random(count).astype(np.float32)
    shift = [mi.Float((sample + i / 4) % 1) for i in range(4)]
    return mi.sample_rgb_spectrum(mi.UnpolarizedSpectrum(*shift))


def test_the_film_gets_back_the_color(spectral: Any) -> None:
    """To 2e-5, next to how far Mitsuba's own D65 is from white (2e-4)."""
    white = rgb_of(daylight())
    np.testing.assert_allclose(white, 1, atol=3e-4)
    for rgb in np.eye(3):
        np.testing.assert_allclose(rgb_of(spectra(spectral, rgb)), rgb * white, atol=2e-5)


def test_white_is_daylight_and_no_color_takes_light_away(spectral: Any) -> None:
    parts = np.stack([spectra(spectral, rgb) for rgb in np.eye(3).tolist()])
    assert parts.min() >= 0
    np.testing.assert_allclose(parts.sum(axis=0), daylight(), rtol=1e-5)
    roughness = np.abs(np.diff(parts / daylight(), axis=1)).max() / STEP
    assert roughness < 0.05  # a change by less than a twentieth in a nanometre


@pytest.mark.slow
def test_it_is_linear() -> None:
    """Also where colours are negative, as single estimates may be, or very bright."""

    @given(colors=st.lists(COLORS, min_size=1, max_size=5), wavelength=st.floats(360, 830))
    def check(colors: list[list[float]], wavelength: float) -> None:
        rgb = np.array([*colors, *np.eye(3)], np.float32)
        rays = mi.UnpolarizedSpectrum(mi.Float(np.full(len(rgb), wavelength)))
        light = np.array(emission([mi.Float(c) for c in rgb.T], rays), np.float64)[0]
        expected = rgb[:-3].astype(np.float64) @ light[-3:]
        assert np.abs(light[:-3] - expected).max() <= 1e-5 * max(1.0, np.abs(rgb).max())

    with variant("llvm_ad_spectral"):
        emission = plugin_module("colors").emission
        check()


@pytest.mark.slow
def test_products_with_reflectances_are_no_further_from_rgb_than_mitsubas_emitters(
    spectral: Any,
) -> None:
    """Light of one colour on a surface of another: spectra and RGB differ, by how much?"""
    rng = np.random.default_rng(1)
    basis = np.stack([spectra(spectral, unit) for unit in np.eye(3).tolist()])

    def mitsubas(rgb: np.ndarray) -> np.ndarray:  # Jakob and Hanika 2019
        color = mi.ScalarColor3f(rgb.tolist())
        x = np.polyval(np.array(mi.srgb_model_fetch(color), np.float64).ravel(), WAVELENGTHS)
        return 0.5 + 0.5 * x / np.sqrt(1 + x * x)

    ours, theirs = [], []
    for _ in range(300):
        light, reflectance = rng.random((2, 3))
        surface = mitsubas(reflectance)
        scale = 2 * light.max()  # as emitters are upsampled
        emitter = mitsubas(light / scale) * scale * daylight()
        theirs.append(np.abs(rgb_of(emitter * surface) - light * reflectance).max())
        ours.append(np.abs(rgb_of((light @ basis) * surface) - light * reflectance).max())
    assert np.mean(ours) < np.mean(theirs)
    assert np.percentile(ours, 90) < np.percentile(theirs, 90) < 0.08


@pytest.mark.parametrize("name", MONO)
def test_luminance(name: str) -> None:
    with variant(name):
        rgb = np.random.default_rng(2).random((3, 50)).astype(np.float32)
        light = plugin_module("colors").emission([mi.Float(c) for c in rgb], None)
        np.testing.assert_allclose(np.array(light)[0], mi.luminance(mi.Color3f(rgb)), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", EVERY)
def test_the_adjoint(name: str) -> None:
    """⟨emission(c), g⟩ = ⟨c, adjoint(g)⟩, and the same as by automatic differentiation."""
    with variant(name):
        colors = plugin_module("colors")
        rng = np.random.default_rng(3)
        count = 40
        wavelengths = random_rays(count)[0] if "_spectral" in name else mi.Color0f()
        rgb = [mi.Float(rng.normal(size=count)) for _ in range(3)]
        pull = colors.Spectrum(*(mi.Float(rng.normal(size=count)) for _ in range(colors.CHANNELS)))
        adjoint = colors.emission_adjoint(pull, wavelengths)
        dr.enable_grad(rgb)
        light = colors.emission(rgb, wavelengths)
        np.testing.assert_allclose(
            np.array(dr.sum(light * pull)),
            sum(np.array(c) * np.array(a) for c, a in zip(rgb, adjoint, strict=True)),
            atol=1e-5,
        )
        dr.backward(dr.sum(light * pull))
        np.testing.assert_allclose(
            np.array([dr.grad(c) for c in rgb]), np.array(adjoint), atol=1e-5
        )


@pytest.mark.slow
@pytest.mark.parametrize("name", EVERY)
def test_what_is_seen_directly_reaches_the_film_without_noise(name: str) -> None:
    """Its spectrum does so on average."""
    with variant(name):
        colors = plugin_module("colors")
        count = 1 << 16
        rgb = [0.8, 0.4, 0.1]
        fields = [dr.full(mi.Float, c, count) for c in rgb]
        if "_spectral" in name:
            wavelengths, weight = random_rays(count)
        else:
            wavelengths, weight = mi.Color0f(), colors.Spectrum(1)
        expected = np.array(rgb)
        if "_mono" in name:
            expected = np.full(3, np.array([0.212671, 0.715160, 0.072169]) @ expected)
        seen = np.array(colors.Radiance(fields).on_film(weight, wavelengths))
        np.testing.assert_allclose(seen, np.tile(expected[:, None], count), rtol=1e-5)
        behind = colors.Radiance([mi.Float(0)] * 3, colors.emission(fields, wavelengths))
        seen = np.array(behind.on_film(weight, wavelengths), np.float64)
        error = seen.std(axis=1) / np.sqrt(count)
        assert (np.abs(seen.mean(axis=1) - expected) <= 4 * error + 3e-4 * expected).all()


@pytest.mark.parametrize("name", EVERY)
def test_without_polarisation(name: str) -> None:
    with variant(name):
        colors = plugin_module("colors")
        light = colors.Spectrum(0.7)
        assert type(colors.polarized(light)) is type(mi.Spectrum(1))
        assert type(colors.unpolarized(colors.polarized(light))) is colors.Spectrum
        again = np.array(colors.unpolarized(colors.polarized(light)))
        np.testing.assert_array_equal(again, np.array(light))


@pytest.mark.parametrize("name", EVERY)
def test_encoded_light_is_rgb(name: str) -> None:
    with variant(name):
        check = plugin_module("colors").check_encoded
        if name.endswith("_rgb"):
            check("nerf")
        else:
            with pytest.raises(mi_nerf.InputError, match=f"encoded=true in variant '{name}', exp"):
                check("nerf")
