"""Inverse transform sampling, merging and cell widths, against NumPy in float64."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from mi_nerf.base.variants import array_module, choose_variant
from mi_nerf.march.importance import PADDING, inverse_transform, merge_sorted
from mi_nerf.march.strata import cell_widths

BACKEND = array_module(choose_variant())
Float = BACKEND.Float

weights_of = hnp.arrays(
    np.float32,
    st.tuples(st.integers(1, 4), st.integers(1, 40)),
    elements=st.one_of(st.just(0.0), st.floats(0, 1, width=32), st.just(1.0)),
)


def invert(weights: np.ndarray, samples: int, near: Any = 2.0, far: Any = 6.0) -> np.ndarray:
    rays, bins = weights.shape
    bounds = [Float(np.broadcast_to(b, rays).astype(np.float32)) for b in (near, far)]
    t = inverse_transform(*bounds, Float(weights.ravel()), bins, samples)
    return np.array(t).reshape(rays, samples)


def oracle(weights: np.ndarray, samples: int, near: float, far: float) -> np.ndarray:
    """numpy.interp on the cumulative distribution, in float64."""
    u = (np.arange(samples) + 0.5) / samples
    edges = np.linspace(near, far, weights.shape[1] + 1)
    rows = []
    for row in weights.astype(np.float64) + PADDING:
        cdf = np.concatenate([[0], np.cumsum(row) / row.sum()])
        rows.append(np.interp(u, cdf, edges))
    return np.array(rows)


@pytest.mark.slow
@given(weights_of, st.integers(1, 50))
def test_inversion_agrees_with_float64(weights: np.ndarray, samples: int) -> None:
    found, expected = invert(weights, samples), oracle(weights, samples, 2, 6)
    # Where the distribution is flat, its inverse is steep: compare what they are the inverse of.
    for row, t, reference in zip(
        weights.astype(np.float64) + PADDING, found, expected, strict=True
    ):
        cdf = np.concatenate([[0], np.cumsum(row) / row.sum()])
        edges = np.linspace(2, 6, len(row) + 1)
        assert np.interp(t, edges, cdf) == pytest.approx(np.interp(reference, edges, cdf), abs=1e-5)
    assert (np.diff(found, axis=1) >= 0).all()
    assert (found >= 2).all() and (found <= 6).all()


def test_all_zero_weights_are_uniform() -> None:
    assert invert(np.zeros((2, 7), np.float32), 14)[1] == pytest.approx(
        2 + 4 * (np.arange(14) + 0.5) / 14, abs=1e-5
    )


@pytest.mark.parametrize("power", [0, 8])
@pytest.mark.parametrize("offset", [0.0, 1.0])
def test_ends_are_exact(offset: float, power: int) -> None:
    """u in the first and the last instant of [0, 1), with sums that are not quite 1."""
    rng = np.random.default_rng(0)
    near, far = np.float32(1.3), np.float32(7.9)
    weights = rng.random((500, 61)).astype(np.float32) ** power
    bounds = [Float(np.full(500, v, np.float32)) for v in (near, far)]
    jitter = Float(np.full(500, offset, np.float32))
    t = np.array(inverse_transform(*bounds, Float(weights.ravel()), 61, 1, jitter))
    assert (t <= far).all() and (t >= near).all()
    # Within rounding of u: a place near the end where weights are not small, not where they are.
    shares = (weights + PADDING) / np.sum(weights + PADDING, axis=1, dtype=float, keepdims=True)
    edge = shares[:, -1 if offset else 0] * 61 / (far - near)  # slope of the distribution there
    assert (np.abs(t - (far if offset else near)) * edge <= 1e-6).all()
    if power == 0:
        assert np.abs(t - (far if offset else near)).max() <= 2e-6 * far


@pytest.mark.slow
@given(st.integers(0, 1000))
def test_the_samples_follow_the_weights(seed: int) -> None:
    rng = np.random.default_rng(seed)
    weights = rng.random((1, 12)).astype(np.float32)
    t = invert(weights, 4000, 0.0, 12.0)[0]
    share = np.histogram(t, 12, (0, 12))[0] / 4000
    assert share == pytest.approx(weights[0] / weights.sum(), abs=2e-3)


rows = st.integers(1, 3).flatmap(
    lambda rays: st.tuples(
        *[
            hnp.arrays(
                np.float32,
                st.tuples(st.just(rays), st.integers(1, 12)),
                elements=st.sampled_from([0.0, 0.5, 1.0, 1.5, 2.0, 1 / 3]),
            )
            for _ in range(2)
        ]
    )
)


@pytest.mark.slow
@given(rows)
def test_merging_is_sorting(pair: tuple[np.ndarray, np.ndarray]) -> None:
    a, b = (np.sort(x, axis=1) for x in pair)
    merged = merge_sorted(Float(a.ravel()), Float(b.ravel()), a.shape[1], b.shape[1])
    expected = np.sort(np.concatenate([a, b], axis=1), axis=1)
    assert (np.array(merged).reshape(expected.shape) == expected).all()


@pytest.mark.slow
@given(
    hnp.arrays(
        np.float32,
        st.tuples(st.integers(1, 4), st.integers(1, 20)),
        elements=st.floats(1, 3, width=32),
    )
)
def test_cells_fill_the_ray(t: np.ndarray) -> None:
    t = np.sort(t, axis=1)
    bounds = Float(np.full(len(t), 1.0)), Float(np.full(len(t), 3.0))
    widths = np.array(cell_widths(Float(t.ravel()), *bounds, t.shape[1])).reshape(t.shape)
    middle = (t[:, 1:].astype(np.float64) + t[:, :-1]) / 2
    ends = np.ones((len(t), 1))
    expected = np.diff(np.concatenate([ends, middle, 3 * ends], axis=1), axis=1)
    assert widths == pytest.approx(expected, abs=1e-6)
    assert (widths >= 0).all()
    assert dr.allclose(widths.sum(axis=1), 2)
