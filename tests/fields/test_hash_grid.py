"""Features of hash grids against a slow reference, and fields that use them."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from threading import Thread
from typing import Any

import drjit as dr
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mi_nerf import FieldFile, NeuralFieldConfig, load_field, save_field
from mi_nerf.fields.fourier import FourierEncoding
from mi_nerf.fields.hash_grid import HashGrid, HashGridConfig
from mi_nerf.fields.network import GRID, NetworkConfig, initial_weights
from mi_nerf.fields.neural import NeuralField
from tests.support.arrays import vectors

CONFIG = HashGridConfig(levels=4, features=2, log2_entries=7, coarsest=3, finest=24)
FIELD = NeuralFieldConfig(
    lower=(-1.0, -2.0, 0.0),
    upper=(1.0, 2.0, 3.0),
    position=FourierEncoding(frequencies=0),
    grid=CONFIG,
    direction=FourierEncoding(frequencies=1),
    network=NetworkConfig(depth=1, width=8, skip=-1, feature_layer=False, view_width=8),
).in_box((-1.0, -2.0, 0.0), (1.0, 2.0, 3.0))


def slow_levels(config: HashGridConfig) -> list[tuple[int, float, int]]:
    """First entry, scale and number of entries of every level."""
    result, first = [], 0
    for level in range(config.levels):
        scale = config.coarsest * (config.finest / config.coarsest) ** (
            level / max(config.levels - 1, 1)
        )
        scale -= 1
        vertices = int(np.ceil(scale - 1e-9) + 1) ** 3
        vertices = -(-vertices // config.features) * config.features
        size = min(vertices, 2**config.log2_entries)
        result.append((first, scale, size))
        first += size
    return result


def slow_features(config: HashGridConfig, table: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Trilinear interpolation point by point (Müller et al. 2022, Eq. 1 to 4), float64."""
    rows = []
    for point in 0.5 * p.astype(np.float64) + 0.5:
        row = []
        for first, scale, size in slow_levels(config):
            side = int(np.ceil(scale - 1e-9)) + 1
            x = point * scale + 0.5
            cell = np.floor(x).astype(int)
            total = np.zeros(config.features)
            for corner in np.ndindex(2, 2, 2):
                vertex = cell + corner
                weight = np.prod(np.where(corner, x - cell, 1 - (x - cell)))
                if side**3 <= size:
                    index = vertex @ [1, side, side * side]
                else:
                    factors = (1, 2654435761, 805459861)
                    hashed = 0
                    for v, factor in zip(vertex, factors, strict=True):
                        hashed ^= int(v) * factor & 0xFFFFFFFF
                    index = hashed
                total += weight * table[first + index % size]
            row.append(total)
        rows.append(np.concatenate(row))
    return np.array(rows).T


def table(config: HashGridConfig, seed: int = 0) -> np.ndarray:
    shape = (config.entries(), config.features)
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def evaluate(ad: Any, config: HashGridConfig, numbers: np.ndarray, p: np.ndarray) -> np.ndarray:
    grid = HashGrid(config, ad.Float)
    found = grid.features(vectors(ad, p), ad.TensorXf(numbers))
    return np.stack([np.array(f) for f in found])


@pytest.mark.slow
@settings(max_examples=12)
@given(
    seed=st.integers(0, 2**31),
    levels=st.sampled_from([1, 3, 5]),
    finest=st.sampled_from([4, 17, 32]),
)
def test_features_against_the_reference(seed: int, levels: int, finest: int) -> None:
    import drjit.llvm.ad as ad

    config = HashGridConfig(levels, 2, 8, 4, finest)
    numbers = table(config, seed)
    p = np.random.default_rng(seed).uniform(-1, 1, (20, 3)).astype(np.float32)
    expected = slow_features(config, numbers, p)
    np.testing.assert_allclose(evaluate(ad, config, numbers, p), expected, atol=2e-5)


def test_the_reference_knows_vertices(ad: Any) -> None:
    """At a vertex of a dense level stands its entry, and nothing else."""
    config = HashGridConfig(levels=1, features=2, log2_entries=12, coarsest=5, finest=5)
    numbers = table(config)
    vertex = np.array([[1, 2, 3]])
    p = (2 * (vertex - 0.5) / 4 - 1).astype(np.float32)
    expected = numbers[1 + 5 * 2 + 25 * 3]
    np.testing.assert_allclose(evaluate(ad, config, numbers, p)[:, 0], expected, atol=1e-5)


@pytest.mark.slow
def test_gradients_are_the_interpolation_weights(ad: Any) -> None:
    """The features are linear in the table: each gradient entry against a difference."""
    p = np.random.default_rng(1).uniform(-1, 1, (6, 3)).astype(np.float32)
    slope = np.random.default_rng(2).normal(size=(CONFIG.size, 6)).astype(np.float32)
    tensor = ad.TensorXf(table(CONFIG))
    dr.enable_grad(tensor)
    found = HashGrid(CONFIG, ad.Float).features(vectors(ad, p), tensor)
    dr.backward(sum(dr.sum(f * ad.Float(s)) for f, s in zip(found, slope, strict=True)))
    gradient = np.array(dr.grad(tensor))
    assert (gradient != 0).sum() > 20
    for entry in np.argwhere(gradient != 0)[::5]:
        change = np.zeros((CONFIG.entries(), CONFIG.features))
        change[tuple(entry)] = 1
        expected = (slow_features(CONFIG, change, p) * slope).sum()
        assert gradient[tuple(entry)] == pytest.approx(expected, rel=1e-3, abs=1e-5)


def test_two_threads_ask_two_tables(ad: Any) -> None:
    """One grid, and each thread sees the table that it asks."""
    grid = HashGrid(CONFIG, ad.Float)
    p = vectors(ad, np.random.default_rng(1).uniform(-1, 1, (50, 3)).astype(np.float32))
    wrong = []

    def ask(level: float) -> None:
        numbers = dr.full(ad.TensorXf, level, (CONFIG.entries(), CONFIG.features))
        for _ in range(40):
            try:
                found = np.stack([np.array(f) for f in grid.features(p, numbers)])
            except Exception as error:
                wrong.append(error)
                continue
            if np.abs(found - level).max() > 1e-3:
                wrong.append(found)

    threads = [Thread(target=ask, args=(level,)) for level in (1.0, 2.0)]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(interval)
    assert wrong == []


def test_nothing_stays_behind_a_failure(ad: Any) -> None:
    """A table that was asked in vain is not kept by the grid."""
    grid = HashGrid(CONFIG, ad.Float)
    with pytest.raises(TypeError):
        grid.features(object(), ad.TensorXf(table(CONFIG)))
    assert grid._encoding.data is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"levels": 0}, "levels=0, expected 1 to 32"),
        ({"features": 3}, "features=3, expected 1 or an even number"),
        ({"log2_entries": 30}, "log2_entries=30, expected 4 to 24"),
        ({"coarsest": 1}, "coarsest=1, expected 2 to"),
        ({"finest": 8}, "finest=8, expected coarsest=16"),
    ],
)
def test_bad_values(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        HashGridConfig(**change)


# ---- Fields ------------------------------------------------------------------


def test_a_field_sees_its_grid(ad: Any) -> None:
    weights = initial_weights(FIELD.shapes(), 0)
    assert weights[GRID].shape == (CONFIG.entries(), CONFIG.features)
    assert 0 < np.abs(weights[GRID]).max() <= 1e-4
    p = np.random.default_rng(0).uniform(-1, 1, (10, 3)) * [1, 2, 1.5] + [0, 0, 1.5]
    d = np.array([[0.0, 0.0, 1.0]] * 10)
    seen = []
    for factor in (1, 1e4):
        field = NeuralField(FIELD, {**weights, GRID: weights[GRID] * factor}, ad.TensorXf)
        seen.append(np.array(field.density_emission(vectors(ad, p), vectors(ad, d))[0]))
    assert np.abs(seen[0] - seen[1]).min() > 0


def test_field_files_keep_the_grid(tmp_path: Path) -> None:
    contents = FieldFile(FIELD, initial_weights(FIELD.shapes(), 3))
    save_field(tmp_path / "field.safetensors", contents)
    loaded = load_field(tmp_path / "field.safetensors")
    assert loaded.config == FIELD
    np.testing.assert_array_equal(loaded.weights[GRID], contents.weights[GRID])


def test_parameters_are_counted() -> None:
    without = replace(FIELD, grid=None)
    more = CONFIG.entries() * CONFIG.features + CONFIG.size * FIELD.network.width
    assert FIELD.parameter_count() == without.parameter_count() + more


def test_weights_of_levels(ad: Any) -> None:
    rng = np.random.default_rng(2)
    table = rng.normal(size=(CONFIG.entries(), CONFIG.features)).astype(np.float32)
    p = rng.uniform(-1, 1, (40, 3)).astype(np.float32)
    weights = [1.0, 0.25, 0.5, 0.0]
    grid = HashGrid(CONFIG, ad.Float)
    found = grid.features(vectors(ad, p), ad.TensorXf(table), ad.Float(weights))
    expected = slow_features(CONFIG, table, p) * np.repeat(weights, CONFIG.features)[:, None]
    assert np.stack([np.array(f) for f in found]) == pytest.approx(expected, abs=2e-5)


def test_entries_that_are_still_to_be_found() -> None:
    with pytest.raises(ValueError, match="log2_entries is not found yet"):
        HashGridConfig(log2_entries=None).entries()
