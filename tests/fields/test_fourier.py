"""Fourier features against a float64 oracle whose arguments are reduced exactly."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerf.fields.fourier import FourierEncoding, sincos_octave, stack_rows
from tests.support.arrays import vectors

CONVENTIONS = ("pi", "one", "two_pi")
OCTAVES = range(25)  # all that an encoding may ask for

# Random points of [−8, 8] and all the places where a reduction might slip.
SPECIAL = [0.0, -0.0, 1e-30, -1e-30, 0.25, 0.5, -0.5, 1, -1, 1.5, 3, np.pi, 7.5, 8, -8]
SPECIAL += [np.nextafter(np.float32(x), np.float32(9)) for x in (0.5, 1, 2, 7.5)]
POINTS = np.concatenate([SPECIAL, np.random.default_rng(0).uniform(-8, 8, 400)])


def slow_phase(x: float, k: int, convention: str) -> float:
    """s·2^k·x, less a whole number of periods where s is a multiple of π."""
    octave = x * 2.0**k  # exact, and so is fmod
    if convention == "one":
        return octave  # Python's sine reduces any argument exactly
    half_turns = octave if convention == "pi" else 2 * octave
    return math.pi * math.fmod(half_turns, 2)


def slow_sincos(points: np.ndarray, octaves: range, convention: str) -> np.ndarray:
    """Sines and cosines of N numbers, (octaves, 2, N), one after another."""
    phases = [[slow_phase(float(x), k, convention) for x in points] for k in octaves]
    return np.array([[np.vectorize(f)(row) for f in (math.sin, math.cos)] for row in phases])


def fast_sincos(x: Any, octaves: range, convention: str) -> np.ndarray:
    """The same, (octaves, 2, N), by the code under test."""
    rows = [row for k in octaves for row in sincos_octave(x, k, convention)]
    return np.array(stack_rows(rows)).reshape(len(octaves), 2, len(x))


# ---- Values -----------------------------------------------------------------


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_single_precision(ad: Any, convention: str) -> None:
    points = POINTS.astype(np.float32)
    error = fast_sincos(ad.Float(points), OCTAVES, convention)
    error -= slow_sincos(points, OCTAVES, convention)
    assert np.abs(error).max() <= 1e-6


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_double_precision(ad: Any, convention: str) -> None:
    octaves = range(16)
    error = fast_sincos(ad.Float64(POINTS), octaves, convention)
    error -= slow_sincos(POINTS, octaves, convention)
    # The sum of three floats that stands for 2π is good to 1e-15 a turn.
    turns = 8 * 2**15 / (2 * math.pi) if convention == "one" else 0
    assert np.abs(error).max() <= 1e-13 + 1e-15 * turns


# ---- Layout -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("frequencies", "include_input"),
    [(0, True), (1, True), (4, True), (1, False), (4, False)],
)
def test_order_and_size(ad: Any, frequencies: int, include_input: bool) -> None:
    """p, then for each octave the sines of x, y, z, then their cosines."""
    points = np.array([[0.1, -0.2, 0.3], [0.7, 0.5, -0.9]], np.float32)
    encoding = FourierEncoding(frequencies, include_input=include_input)
    expected = list(points.T) if include_input else []
    for k in range(frequencies):
        phase = math.pi * 2**k * points.astype(float)
        expected += [*np.sin(phase).T, *np.cos(phase).T]
    p = vectors(ad, points)
    tensor = encoding(p)
    assert type(tensor) is ad.TensorXf
    assert tensor.shape == (encoding.size, 2) == np.shape(expected)
    assert np.array(tensor) == pytest.approx(np.array(expected), abs=1e-6)
    assert np.array_equal([np.array(row) for row in encoding.features(p)], np.array(tensor))


def test_published_sizes() -> None:
    assert FourierEncoding(10, include_input=False).size == 60
    assert FourierEncoding(10).size == 63
    assert FourierEncoding(4).size == 27
    assert FourierEncoding(0).size == 3


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"frequencies": -1}, "frequencies=-1"),
        ({"frequencies": 25}, "frequencies=25"),
        ({"convention": "tau"}, "'tau'"),
        ({"frequencies": 0, "include_input": False}, "no features"),
    ],
)
def test_settings_are_validated(change: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        FourierEncoding(**change)


@pytest.mark.slow
@given(values=st.lists(st.floats(width=32, allow_nan=False), min_size=12, max_size=12))
def test_stack_rows(ad: Any, values: list[float]) -> None:
    rows = np.array(values, np.float32).reshape(3, 4)
    tensor = stack_rows([ad.Float(row) for row in rows])
    assert np.array_equal(np.array(tensor), rows)


def test_stack_rows_repeats_single_values(ad: Any) -> None:
    tensor = stack_rows([ad.Float(7), ad.Float([1, 2, 3]), dr.opaque(ad.Float, 5)])
    assert np.array(tensor).tolist() == [[7, 7, 7], [1, 2, 3], [5, 5, 5]]


# ---- Derivatives ------------------------------------------------------------


@pytest.mark.parametrize(
    ("convention", "s"), [("pi", math.pi), ("one", 1), ("two_pi", 2 * math.pi)]
)
def test_gradients(ad: Any, convention: str, s: float) -> None:
    """d sin = s·2^k·cos and d cos = −s·2^k·sin, however often the phase has wrapped."""
    octaves, s = range(0, 16, 5), {"pi": math.pi, "one": 1, "two_pi": 2 * math.pi}[convention]
    points = POINTS.astype(np.float32)
    sines, cosines = np.random.default_rng(1).uniform(-1, 1, (2, len(octaves)))
    x, total, expected = ad.Float(points), ad.Float(0), np.zeros(len(points))
    dr.enable_grad(x)
    for k, a, b in zip(octaves, sines, cosines, strict=True):
        sine, cosine = sincos_octave(x, k, convention)
        slope = s * 2.0**k  # divided out, so that every octave counts alike
        total += sine * float(a / slope) + cosine * float(b / slope)
        exact = slow_sincos(points, range(k, k + 1), convention)[0]
        expected += a * exact[1] - b * exact[0]
    dr.backward(total)
    assert np.array(dr.grad(x)) == pytest.approx(expected, abs=5e-6)
