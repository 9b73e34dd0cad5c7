"""Moves NumPy arrays of vectors into Dr.Jit and back."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from mi_nerf.base.arrays import upload


def vectors(ad: Any, points: Any, precision: str = "32") -> Any:
    """N 3-vectors, (N, 3), as a Dr.Jit vector; ``ad`` is the module of a backend."""
    array, scalar = (ad.Array3f, ad.Float32) if precision == "32" else (ad.Array3f64, ad.Float64)
    number = np.float32 if precision == "32" else np.float64
    # Not NumPy's own memory: kernels depend on whether that happens to be aligned.
    result = array(*(upload(scalar, np.asarray(c, number)) for c in np.transpose(points)))
    dr.make_opaque(result)
    return result


def unit(directions: Any) -> np.ndarray:
    """3-vectors, (N, 3), brought to length 1."""
    d = np.asarray(directions, float)
    return d / np.linalg.norm(d, axis=1, keepdims=True)
