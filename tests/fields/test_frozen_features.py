"""Features that are replayed are those that are traced, and so are their gradients."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest

from mi_nerf.base.arrays import upload, vector3_type
from mi_nerf.fields.fourier import FourierEncoding, stack_rows
from mi_nerf.fields.frozen_features import FrozenFeatures
from mi_nerf.fields.hash_grid import HashGrid, HashGridConfig

CONFIG = HashGridConfig(levels=3, features=2, log2_entries=8, coarsest=3, finest=20)


def positions(ad: Any, count: int, seed: int) -> Any:
    values = np.random.default_rng(seed).uniform(-1, 1, (3, count)).astype(np.float32)
    return vector3_type(ad.Float)(*(upload(ad.Float, row) for row in values))


def table(ad: Any, seed: int) -> Any:
    shape = (CONFIG.entries(), CONFIG.features)
    values = np.random.default_rng(seed).normal(size=shape).astype(np.float32)
    tensor = upload(ad.TensorXf, values)
    dr.enable_grad(tensor)
    return tensor


@pytest.mark.parametrize("weighted", [False, True])
def test_values_and_gradients_are_those_of_autodiff(ad: Any, weighted: bool) -> None:
    grid, encoding = HashGrid(CONFIG, ad.Float), FourierEncoding(frequencies=1)

    def features(unit: Any, values: Any, weights: Any) -> list[Any]:
        return encoding.features(unit) + grid.features(unit, values, weights)

    frozen = FrozenFeatures(features)
    weights = ad.Float([1.0, 0.5, 0.0]) if weighted else None
    # Sizes come and go, tables change from call to call: what is recorded must not stay.
    for turn, count in enumerate((100, 37, 100, 64, 37, 100)):
        unit, found = positions(ad, count, turn), []
        for ask in (
            lambda u, t: frozen(u, t, weights),
            lambda u, t: stack_rows(features(u, t, weights)),
        ):
            values = table(ad, turn)
            rows = ask(unit, values)
            assert rows.shape == (encoding.size + CONFIG.size, count)
            dr.backward(dr.sum(dr.sin(rows.array)))
            found.append((np.array(rows), np.array(dr.grad(values))))
        assert np.abs(found[1][1]).max() > 0
        np.testing.assert_allclose(found[0][0], found[1][0], atol=1e-6)
        np.testing.assert_allclose(found[0][1], found[1][1], rtol=1e-5, atol=1e-5)


def test_replays_compile_nothing(ad: Any) -> None:
    grid = HashGrid(CONFIG, ad.Float)
    frozen = FrozenFeatures(grid.features)

    def ask(turn: int) -> None:
        values = table(ad, turn)
        dr.backward(dr.sum(frozen(positions(ad, 50, turn), values).array))
        dr.eval(dr.grad(values))

    for turn in range(2):
        ask(turn)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        ask(2)
        assert all(k.get("cache_hit", True) for k in dr.kernel_history())
