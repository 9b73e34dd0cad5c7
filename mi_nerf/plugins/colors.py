"""The light of fields, linear RGB, in the colours of the active variant.

An RGB variant takes it as it is, a monochromatic one its luminance. Spectral ones carry four
wavelengths along each ray. There, as for Mitsuba's emitters of RGB colours, a field shines with a
smooth spectrum times the daylight D65:

    S(λ) = D65(λ) Σ_k c_k w_k(λ),    w = softmax(q_R(λ), 0, q_B(λ)),

with quadratic polynomials q whose six coefficients are such that the film, which weighs S by
the matching functions of the CIE and turns the sums into sRGB, gets back c. The weights are
positive and add up to one: white is D65 itself. Mitsuba fits a sigmoid of a quadratic to every
colour instead (Jakob and Hanika 2019), which is not linear in c. This is (as are the tabulated
bases of Mallett and Yuksel 2019), so it does not matter whether samples are upsampled or what is
composited of them, colours may be negative or as bright as you like, and derivatives are exact.

What the camera sees of fields directly needs no spectrum: the film would turn it back into c, on
average over wavelengths. So c goes to the film as it is, without that noise
(:class:`Radiance`).

In polarised variants all is unpolarised: of what surfaces and lights do to light, only the
first entry of their Mueller matrices counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..base.errors import InputError

Spectrum = mi.UnpolarizedSpectrum  # a number for each colour that the variant knows
CHANNELS = dr.size_v(Spectrum)

_LUMINANCE = (0.212671, 0.715160, 0.072169)  # of linear sRGB, as in mi.luminance

# q in (λ − 595 nm) / 235 nm, which runs from −1 to 1 over the wavelengths of Mitsuba; the highest
# power first.
_CENTER, _HALF_WIDTH = 595.0, 235.0
_RED = (71.855202, 42.37307181, 0.55937779)
_BLUE = (49.94202758, 17.03685847, -2.65495896)


@dataclass(frozen=True)
class Radiance:
    """Light along rays: of fields that are seen directly, and any other in the same direction."""

    fields: list[Any]  # R, G, B, linear
    other: Any = 0  # in the colours of the variant

    def spectrum(self, wavelengths: Any) -> Any:
        """In the colours of the variant."""
        return emission(self.fields, wavelengths) + self.other

    def on_film(self, weight: Any, wavelengths: Any) -> Any:
        """The RGB values that a film adds up, where the camera weighs rays by ``weight``."""
        if mi.is_spectral:
            # The weight is one over the density of the wavelengths, apart from what is left.
            own = dr.mean(weight * mi.pdf_rgb_spectrum(wavelengths))
            other = mi.spectrum_to_srgb(Spectrum(self.other) * weight, wavelengths)
            return mi.Color3f(*self.fields) * own + other
        value = self.spectrum(wavelengths) * weight
        return mi.Color3f(value[0]) if mi.is_monochromatic else value


def emission(rgb: list[Any], wavelengths: Any) -> Any:
    """Light of linear RGB values in the colours of the variant; linear in them."""
    if mi.is_monochromatic:
        return Spectrum(sum(w * c for w, c in zip(_LUMINANCE, rgb, strict=True)))
    if not mi.is_spectral:
        return Spectrum(*rgb)
    return sum(c * basis for c, basis in zip(rgb, _bases(wavelengths), strict=True))


def emission_adjoint(gradient: Any, wavelengths: Any) -> list[Any]:
    """The gradients of RGB values by those of their :func:`emission`."""
    if mi.is_monochromatic:
        return [w * gradient[0] for w in _LUMINANCE]
    if not mi.is_spectral:
        return list(gradient)
    return [dr.sum(gradient * basis) for basis in _bases(wavelengths)]


def check_encoded(plugin: str) -> None:
    """Refuses light encoded as sRGB where the film takes anything but RGB.

    Raises:
        InputError: naming the variant.
    """
    if mi.is_spectral or mi.is_monochromatic:
        raise InputError(
            f"{plugin}: encoded=true in variant '{mi.variant()}', expected one of RGB: there is no "
            "luminance or spectrum of values encoded as sRGB"
        )


def unpolarized(value: Any) -> Any:
    """Light as it is without polarisation."""
    return mi.unpolarized_spectrum(value) if mi.is_polarized else value


def polarized(value: Any) -> Any:
    """Unpolarised light, as Mitsuba's integrators of the variant hold it."""
    return mi.mueller.depolarizer(value) if mi.is_polarized else value


def _bases(wavelengths: Any) -> list[Any]:
    """The spectra of red, green and blue."""
    x = (Spectrum(wavelengths) - _CENTER) / _HALF_WIDTH
    red, blue = (dr.fma(dr.fma(a, x, b), x, c) for a, b, c in (_RED, _BLUE))
    most = dr.maximum(dr.maximum(red, blue), 0)
    weights = [dr.exp(red - most), dr.exp(-most), dr.exp(blue - most)]
    share = Spectrum(*(mi.cie_d65(w) for w in wavelengths)) / sum(weights)
    return [w * share for w in weights]
