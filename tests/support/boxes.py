"""Rays against boxes in exact rational arithmetic."""

from __future__ import annotations

import itertools
from fractions import Fraction
from typing import Any

import numpy as np


def slow_interval(o: Any, d: Any, lower: Any, upper: Any) -> tuple[Fraction, Fraction] | None:
    """Where one ray is inside the box at t ≥ 0, without rounding; None if nowhere."""
    near, far = Fraction(0), None
    for oi, di, low, high in zip(o, d, lower, upper, strict=True):
        oi, di, low, high = (Fraction(float(v)) for v in (oi, di, low, high))
        if di == 0:
            if not low <= oi <= high:
                return None
            continue
        first, second = sorted([(low - oi) / di, (high - oi) / di])
        near, far = max(near, first), second if far is None else min(far, second)
    return None if far is None or far <= near else (near, far)


def awkward_rays(lower: Any, upper: Any, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions, (count, 3) each, for which float32 makes no error.

    Origins lie before, on, inside and behind each pair of faces; directions are
    parallel to faces, with zeros of both signs, or run exactly into edges and corners.
    The corners of the box must be numbers of few digits.
    """
    extent = zip(lower, upper, strict=True)
    places = [(low - 1, low, (low + high) / 2, high, high + 0.5) for low, high in extent]
    slopes = [0.0, -0.0, 1, -1, 0.5, -2]
    origins = np.array(list(itertools.product(*places)), np.float32)
    directions = np.array(list(itertools.product(slopes, repeat=3)), np.float32)
    pairs = np.random.default_rng(0).permutation(len(origins) * len(directions))[:count]
    return origins[pairs // len(directions)], directions[pairs % len(directions)]
