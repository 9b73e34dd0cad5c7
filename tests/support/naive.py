"""The formulas as they are usually written, to be compared with those of mi_nerf.

Each of them is right on paper, and was in use in one radiance-field code or another; where
it fails is measured in :mod:`tests.hard_cases`. Arrays and layouts are those of mi_nerf.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np

from mi_nerf.base.arrays import vector3_type

# ---- Quadrature (rows 1 to 5, 13) ----------------------------------------------


def one_minus_exp(x: Any) -> Any:
    """1 − exp(−x): digits cancel where x is small."""
    return 1 - dr.exp(-x)


class _RunningProduct(dr.CustomOp):
    """Products of what lies before each sample of a ray.

    The adjoint divides by the factors, as that of ``tf.math.cumprod`` does.
    """

    def eval(self, x: Any, samples: int) -> Any:
        dr.make_opaque(x)  # Dr.Jit 1.5 crashes on products of a literal
        self._x, self._samples = x, samples
        self._product = dr.block_prefix_reduce(dr.ReduceOp.Mul, x, samples, exclusive=True)
        return self._product

    def backward(self) -> None:
        share = self.grad_out() * self._product
        behind = dr.block_prefix_sum(share, self._samples, exclusive=True, reverse=True)
        self.set_grad_in("x", behind / self._x)

    def name(self) -> str:
        return "RunningProduct"


def product_weights(density: Any, delta: Any, samples: int, pad: float = 1e-10) -> tuple[Any, Any]:
    """Weights α·Π(1 − α + pad), as in the code of the paper, and their sums."""
    alpha = one_minus_exp(density * delta)
    weights = alpha * dr.custom(_RunningProduct, 1 - alpha + pad, samples)
    return weights, dr.block_sum(weights, samples)


def endless(delta: Any, last: float = 1e10) -> Any:
    """Interval lengths of one ray of which the last has no end, as in the code of the paper."""
    return dr.select(
        dr.arange(dr.uint32_array_t(type(delta)), len(delta)) < len(delta) - 1, delta, last
    )


def mean_distance(weights: Any, t: Any, samples: int) -> Any:
    """Σ w t / Σ w."""
    return dr.block_sum(weights * t, samples) / dr.block_sum(weights, samples)


# ---- Networks (rows 4, 6, 9, 10, 17) ----------------------------------------------


def initial_weights(shapes: dict[str, tuple[int, ...]], seed: int) -> dict[str, np.ndarray]:
    """As ``drjit.nn.Linear``: uniform within ±1/√outputs, biases of 0."""
    rng = np.random.default_rng(seed)
    return {
        name: rng.uniform(-1, 1, shape).astype(np.float32) / np.float32(math.sqrt(shape[0]))
        if len(shape) == 2
        else np.zeros(shape, np.float32)
        for name, shape in shapes.items()
    }


def doubled_sincos(x: Any, octave: int) -> tuple[Any, Any]:
    """sin and cos of π·2^k·x by k times the double-angle formula."""
    sine, cosine = dr.sincos(x * math.pi)
    for _ in range(octave):
        sine, cosine = 2 * sine * cosine, dr.square(cosine) - dr.square(sine)
    return sine, cosine


def plain_sincos(x: Any, octave: int) -> tuple[Any, Any]:
    """sin and cos of π·2^k·x as it stands."""
    return dr.sincos(x * (2.0**octave * math.pi))


def clipped_exp(x: Any) -> Any:
    """exp(x) up to x = 15, then constant: dead beyond."""
    return dr.exp(dr.minimum(x, 15))


def relu(x: Any) -> Any:
    """max(x, 0) by a comparison that NaN does not pass."""
    return dr.select(x > 0, x, 0)


def sigmoid(x: Any) -> Any:
    """1 / (1 + exp(−x)): for large −x, inf · 0 in the derivative."""
    return 1 / (1 + dr.exp(-x))


# ---- Rays (rows 7, 11, 12, 15, 18) ----------------------------------------------


def inverse_transform(edges: np.ndarray, weights: np.ndarray, u: np.ndarray) -> np.ndarray:
    """``sample_pdf`` of the code of the paper for one ray, in single precision."""
    single = np.float32
    weights = weights.astype(single) + single(1e-5)
    cdf = cumulative(weights)
    above = np.searchsorted(cdf, u, side="right")
    below, above = np.maximum(0, above - 1), np.minimum(len(cdf) - 1, above)
    width = cdf[above] - cdf[below]
    t = (u.astype(single) - cdf[below]) / np.where(width < single(1e-5), single(1), width)
    return edges[below] + t * (edges[above] - edges[below])


def cumulative(weights: np.ndarray) -> np.ndarray:
    """Sums of normalised weights, from 0 to about 1."""
    sums = np.cumsum(weights / np.sum(weights), dtype=np.float32)
    return np.concatenate([np.zeros(1, np.float32), sums])


def box_interval(o: Any, d: Any, lower: Any, upper: Any) -> tuple[Any, Any]:
    """Slabs without any care: 0 · ∞ in faces, and what lies behind the origin counts."""
    float_type = type(o[0])
    near, far = float_type(-dr.inf), float_type(dr.inf)
    for i in range(3):
        first, second = (lower[i] - o[i]) * (1 / d[i]), (upper[i] - o[i]) * (1 / d[i])
        near = dr.maximum(near, dr.minimum(first, second))
        far = dr.minimum(far, dr.maximum(first, second))
    return near, far


def linspace(near: Any, far: Any, samples: int) -> Any:
    """``samples`` parameters of one ray, both ends included: 0/0 for one of them."""
    float_type = type(near)
    index = float_type(dr.arange(dr.uint32_array_t(float_type), samples))
    share = index / dr.opaque(float_type, samples - 1)
    return near * (1 - share) + far * share


def ndc_rays(o: Any, d: Any) -> tuple[Any, Any]:
    """Origins and directions of appendix C, near plane 1 and scale 1, for any direction."""
    vector3 = vector3_type(type(o[0]))
    o = o + -(1 + o[2]) / d[2] * d
    return (
        vector3(-o[0] / o[2], -o[1] / o[2], 1 + 2 / o[2]),
        vector3(-(d[0] / d[2] - o[0] / o[2]), -(d[1] / d[2] - o[1] / o[2]), -2 / o[2]),
    )


# ---- Training (row 20) -----------------------------------------------------------


def summed_progress(steps: int, done: int) -> float:
    """Share of a run of ``steps`` after some, added up step by step in single precision."""
    return float(np.cumsum(np.full(done, 1 / steps, np.float32), dtype=np.float32)[-1])
