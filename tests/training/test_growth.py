"""A field in another shape: the same function where it grows, a stated one where it shrinks."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import drjit.llvm.ad as llvm
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mi_nerf.base.box import grid_shape
from mi_nerf.data import load_dataset
from mi_nerf.fields.fourier import FourierEncoding
from mi_nerf.fields.hash_grid import HashGrid, HashGridConfig
from mi_nerf.fields.network import GRID, NetworkConfig, initial_weights
from mi_nerf.fields.neural import NeuralField, NeuralFieldConfig
from mi_nerf.training.config import with_settings
from mi_nerf.training.growth import Reshaping, resampled
from mi_nerf.training.presets import preset
from mi_nerf.training.tables import TableMap, levels
from mi_nerf.training.trainer import Trainer
from tests.fields.test_hash_grid import slow_features
from tests.support.arrays import vectors

GRIDS = HashGridConfig(levels=3, features=2, log2_entries=8, coarsest=4, finest=16)
SMALL = NeuralFieldConfig(
    position=FourierEncoding(frequencies=1),
    grid=GRIDS,
    direction=FourierEncoding(frequencies=1),
    network=NetworkConfig(
        depth=1, width=6, skip=-1, feature_layer=False, view_width=6, view_depth=1
    ),
)
BLIND = replace(SMALL, network=replace(SMALL.network, view_dependent=False, view_depth=0))


def drawn(config: NeuralFieldConfig, seed: int = 0) -> dict[str, np.ndarray]:
    """Weights of a field that has learnt something: no zeros anywhere."""
    rng = np.random.default_rng(seed)
    weights = initial_weights(config.shapes(), seed)
    return {n: (w + rng.normal(0, 0.3, w.shape)).astype(np.float32) for n, w in weights.items()}


def octaves(encoding: FourierEncoding, p: np.ndarray) -> list[np.ndarray]:
    rows = [p]
    for k in range(encoding.frequencies):
        rows += [np.sin(np.pi * 2**k * p), np.cos(np.pi * 2**k * p)]
    return rows


def slow_raw(
    config: NeuralFieldConfig, weights: dict[str, np.ndarray], p: np.ndarray, d: np.ndarray
) -> np.ndarray:
    """(4, N) raw density and colour, in double precision, layer by layer."""
    w = {n: a.astype(np.float64) for n, a in weights.items()}
    position = octaves(config.position, p)
    if config.grid is not None:
        position.append(slow_features(config.grid, weights[GRID], p).T)
    values = {"position": np.hstack(position).T}
    values["direction"] = np.hstack(octaves(config.direction, d)).T
    for layer in config.network.layers():
        y = w[layer.bias][:, None] + sum(w[n] @ values[s] for n, s in layer.matrices().items())
        values[layer.name] = np.maximum(y, 0) if layer.rectify else y
    return np.vstack([values["density"], values["color"]])


def rays(count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Points not within half a vertex spacing of the far faces, where a table wraps around."""
    rng = np.random.default_rng(5)
    d = rng.normal(size=(count, 3))
    return rng.uniform(-0.95, 0.7, (count, 3)), d / np.linalg.norm(d, axis=1, keepdims=True)


def network(**changes: Any) -> Any:
    return lambda c: replace(c, network=replace(c.network, **changes))


def grid(**changes: Any) -> Any:
    return lambda c: replace(c, grid=replace(c.grid, **changes))


GROWN = {
    "directions": (BLIND, network(view_dependent=True, view_depth=1)),
    "wider": (SMALL, network(width=9, view_width=11)),
    "deeper": (SMALL, network(depth=3)),
    "deeper and wider": (SMALL, network(depth=2, width=8, view_width=8)),
    "a layer for colour": (BLIND, network(view_depth=2)),
    "entries": (SMALL, grid(log2_entries=10)),
    "all dense": (SMALL, grid(log2_entries=14)),
    "finer": (SMALL, grid(levels=5, finest=64)),
    "finer, larger": (SMALL, grid(levels=5, finest=64, log2_entries=9)),
    "a first grid": (replace(SMALL, grid=None), lambda c: replace(c, grid=GRIDS)),
    "octaves": (SMALL, lambda c: replace(c, position=FourierEncoding(frequencies=4))),
    "octaves of d": (SMALL, lambda c: replace(c, direction=FourierEncoding(frequencies=3))),
}


@pytest.mark.parametrize("name", GROWN)
def test_what_is_added_changes_nothing(name: str) -> None:
    old, change = GROWN[name]
    new = change(old)
    before, (p, d) = drawn(old), rays()
    after = Reshaping(old, new).weights(before, seed=3)
    assert {n: a.shape for n, a in after.items()} == new.shapes()
    expected = slow_raw(old, before, p, d)
    np.testing.assert_allclose(slow_raw(new, after, p, d), expected, rtol=0, atol=1e-6)
    assert np.abs(expected).max() > 0.1


@pytest.mark.parametrize("name", GROWN)
def test_what_is_added_can_learn(name: str) -> None:
    """The slope of the outputs is not zero in every new number: finite differences."""
    old, change = GROWN[name]
    new = change(old)
    after = Reshaping(old, new).weights(drawn(old), seed=3)
    known = Reshaping(old, new).moments({n: np.ones(s) for n, s in old.shapes().items()})
    p, d = rays()
    at = slow_raw(new, after, p, d)
    slopes = {}
    for tensor, values in after.items():
        fresh = np.argwhere(known[tensor] == 0)
        for place in fresh[:: max(1, len(fresh) // 10)]:
            moved = values.copy()
            moved[tuple(place)] += 0.1
            found = slow_raw(new, {**after, tensor: moved}, p, d) - at
            slopes[tensor] = max(slopes.get(tensor, 0), np.abs(found).max())
    if name not in ("entries", "all dense"):  # whose entries all come from old ones
        assert max(slopes.values()) > 1e-3


def test_the_field_itself_stays(ad: Any) -> None:
    """In single precision, as it is trained."""
    for old, change in GROWN.values():
        before, (p, d) = drawn(old), rays()
        after = Reshaping(old, change(old)).weights(before, seed=3)
        outputs = []
        for config, weights in ((old, before), (change(old), after)):
            field = NeuralField(config, weights, ad.TensorXf)
            density, color = field.density_emission(vectors(ad, p), vectors(ad, d))
            outputs.append(np.array([density, *color]))
        np.testing.assert_allclose(outputs[1], outputs[0], rtol=2e-6, atol=1e-6)


def test_moments_go_where_their_parameters_go() -> None:
    old = SMALL
    new = replace(
        SMALL,
        network=replace(SMALL.network, width=8, view_width=9, depth=2),
        grid=replace(GRIDS, log2_entries=9, levels=5, finest=64),
    )
    shape, weights = Reshaping(old, new), drawn(old)
    moved, carried = shape.moments(weights), shape.weights(weights, seed=1)
    assert {n: a.shape for n, a in moved.items()} == new.shapes()
    for name, values in moved.items():
        known = values != 0  # wherever there is a moment, it is that of the number itself
        np.testing.assert_array_equal(values[known], carried[name][known])
        if name in weights and name != GRID:
            assert known.sum() == weights[name].size
    assert not moved["trunk_1.weight"].any() and not moved["trunk_1.bias"].any()
    counters = {GRID: np.arange(GRIDS.entries(), dtype=np.float32)}  # one for each entry
    assert shape.moments(counters)[GRID].shape == (new.grid.entries(),)


# ---- Tables ---------------------------------------------------------------------------


@settings(max_examples=20)
@given(st.integers(1, 5), st.integers(5, 13), st.integers(2, 9), st.integers(0, 40))
def test_levels_are_laid_out_as_in_the_grid(n: int, log2: int, coarsest: int, more: int) -> None:
    config = HashGridConfig(n, 2, log2, coarsest, coarsest + more)
    HashGrid(config, llvm.Float)  # refuses another layout than that of entries()
    found = levels(config)
    assert found[0].first == 0 and found[-1].first + found[-1].entries == config.entries()
    for one, next_one in zip(found, found[1:], strict=False):
        assert one.first + one.entries == next_one.first


def test_a_smaller_table_holds_means_by_importance() -> None:
    """Both of a pair of entries, weighted by the squares of their gradients."""
    new = replace(GRIDS, log2_entries=7)
    before, after = levels(GRIDS)[-1], levels(new)[-1]
    assert (before.entries, after.entries) == (256, 128)
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(GRIDS.entries(), 2)).astype(np.float32)
    squares = rng.uniform(0.1, 1, rows.shape).astype(np.float32)
    found = TableMap(GRIDS, new).carry(rows, squares)[after.first :]
    a, b = (slice(before.first + k, before.first + k + 128) for k in (0, 128))
    expected = (rows[a] * squares[a] + rows[b] * squares[b]) / (squares[a] + squares[b])
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_unused_entries_do_not_count() -> None:
    """A table of which no two used entries meet halves without loss."""
    new = replace(GRIDS, log2_entries=7)
    before, after = levels(GRIDS)[-1], levels(new)[-1]
    rows = np.ones((GRIDS.entries(), 2), np.float32)
    squares = np.zeros_like(rows)
    squares[before.first : before.first + 128] = 1
    rows[before.first + 128 :] = 100
    found = TableMap(GRIDS, new).carry(rows, squares)[after.first :]
    np.testing.assert_allclose(found, 1, atol=1e-6)


def test_doubling_and_halving_a_table_is_nothing() -> None:
    larger = replace(GRIDS, log2_entries=9)
    rows = np.random.default_rng(0).normal(size=(GRIDS.entries(), 2)).astype(np.float32)
    there = TableMap(GRIDS, larger).carry(rows)
    hashed = levels(GRIDS)[-1].first
    assert larger.entries() > GRIDS.entries()
    np.testing.assert_allclose(
        TableMap(larger, GRIDS).carry(there)[hashed:], rows[hashed:], rtol=1e-6
    )


# ---- What is taken out -------------------------------------------------------------------


def test_directions_leave_their_mean_behind() -> None:
    """With one direction seen, nothing is lost in it."""
    p, d = rays()
    d = np.repeat(d[:1], len(p), axis=0)
    blind = network(view_dependent=False)(SMALL)
    mean = np.hstack(octaves(SMALL.direction, d))[0].astype(np.float32)
    before = drawn(SMALL)
    after = Reshaping(SMALL, blind).weights(before, seed=0, direction=mean)
    found, expected = slow_raw(blind, after, p, d), slow_raw(SMALL, before, p, d)
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_octaves_that_go_are_read_no_more() -> None:
    old = replace(SMALL, position=FourierEncoding(frequencies=3))
    before = drawn(old)
    kept = {**before, "trunk_0.weight": before["trunk_0.weight"].copy()}
    kept["trunk_0.weight"][:, 9:21] = 0  # p itself and an octave come before, the grid behind
    p, d = rays()
    after = Reshaping(old, SMALL).weights(before, seed=0)
    np.testing.assert_allclose(slow_raw(SMALL, after, p, d), slow_raw(old, kept, p, d), atol=1e-6)


@pytest.mark.parametrize(
    ("old", "change", "message"),
    [
        (SMALL, network(view_depth=0), "layer 'view_0' would be lost"),
        (replace(BLIND, network=replace(BLIND.network, feature_layer=True)), network(view_depth=1),
         "layer 'view_0' after 'feature', expected ReLUs in both"),
        (SMALL, network(depth=2, view_width=5), None),
        (BLIND, network(view_depth=1, view_width=5), "has 5 neurons, expected .* it reads, 6"),
    ],
)  # fmt: skip
def test_what_cannot_be_carried_over_is_refused(old: Any, change: Any, message: str | None) -> None:
    if message is None:
        Reshaping(old, change(old))
        return
    with pytest.raises(ValueError, match=message):
        Reshaping(old, change(old))


@pytest.mark.parametrize("count", [2, 3, 5, 8, 13, 16])
def test_cells_are_never_lost(count: int) -> None:
    """A cell is kept if any old one that it overlaps is; point by point."""
    cells = np.random.default_rng(1).random((8, 8, 6)) < 0.1
    shape = grid_shape((0, 0, 0), (4, 4, 3), count)
    found = resampled(cells, shape, np.max)
    assert found.shape == shape
    for where in np.random.default_rng(2).random((500, 3)):
        old = cells[tuple((where * cells.shape).astype(int))]
        assert found[tuple((where * shape).astype(int))] >= old


# ---- A trainer that becomes another --------------------------------------------------------


@pytest.mark.slow
def test_a_trainer_goes_on_with_another_model(blob: Any) -> None:
    """Same pixels before and after, moments and occupancy kept; and back again."""
    few = ["network.width=8", "network.view_width=8", "network.view_dependent=false"]
    few += ["network.view_depth=0", "grid.levels=3", "grid.log2_entries=8", "grid.finest=32"]
    few += ["occupancy.resolution=16", "occupancy.start=2", "occupancy.every=2"]
    few += ["sampling.batch=1024", "sampling.samples=16"]
    trainer = Trainer(with_settings(preset("fast"), few), load_dataset(blob, "train"), llvm)
    for _ in range(4):
        trainer.step(1e-2)
    batch = trainer._source.draw(500, dr.rng(0))
    before, loss = trainer.snapshot(), trainer.validate(batch)
    more = ["network.view_dependent=true", "network.view_depth=1", "network.depth=2"]
    more += ["grid.log2_entries=10", "network.width=12", "network.view_width=16"]
    trainer.become(with_settings(trainer.config, more))
    assert trainer.validate(batch) == pytest.approx(loss, rel=1e-5)
    assert trainer.field_config.network.depth == 2 and trainer.step_count == 4
    state = trainer.optimizer.state()
    assert state["steps"] == before.optimizer["steps"]
    kept = state["second.trunk_0.weight"][:8]
    np.testing.assert_array_equal(kept, before.optimizer["second.trunk_0.weight"])
    assert (trainer.occupancy.values() == before.occupancy["values"]).all()
    trainer.become(with_settings(trainer.config, ["occupancy.resolution=32"]))
    assert trainer.validate(batch) == pytest.approx(loss, rel=1e-5)
    assert bool(trainer.step(1e-2).accepted[0])
    trainer.go_on_from(before)
    assert trainer.validate(batch) == loss
    assert trainer.step_count == 5 and trainer.config == before.config
    assert bool(trainer.step(1e-2).accepted[0])
