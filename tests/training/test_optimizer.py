"""Updates of Adam and Muon against NumPy in double precision."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mi_nerf.fields.network import GRID
from mi_nerf.training.optimizer import Adam
from mi_nerf.training.orthogonal import is_hidden, orthogonalized, update_size
from tests.support.published import KerasAdam


def polynomial(matrix: np.ndarray, rounds: int = 5) -> np.ndarray:
    """What the iteration does to each singular value of a float64 matrix."""
    u, s, vt = np.linalg.svd(matrix, full_matrices=False)
    s = s / np.linalg.norm(matrix)
    for _ in range(rounds):
        s = 3.4445 * s - 4.7750 * s**3 + 2.0315 * s**5
    return (u * s) @ vt


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**31), scale=st.floats(-8, 4), shape=st.sampled_from([0, 1, 2]))
def test_singular_values_go_to_one(ad: Any, seed: int, scale: float, shape: int) -> None:
    size = [(48, 32), (32, 48), (40, 40)][shape]
    matrix = np.random.default_rng(seed).normal(size=size) * 10**scale
    found = np.array(orthogonalized(ad.TensorXf(matrix.astype(np.float32))), float)
    assert found.shape == size
    assert np.abs(found - polynomial(matrix)).max() < 2e-3
    values = np.linalg.svd(found)[1]
    strong = np.linalg.svd(matrix)[1] > 0.01 * np.linalg.norm(matrix)
    assert values[strong].min() > 0.6 and values.max() < 1.3
    assert np.sqrt(np.mean(found**2)) * update_size(size) == pytest.approx(0.2, rel=0.3)


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    scale=st.floats(-6, 4),
    beta1=st.sampled_from([0.0, 0.9]),
    beta2=st.sampled_from([0.9, 0.99, 0.999]),
    epsilon=st.sampled_from([1e-7, 1e-2]),
    accepted=st.lists(st.booleans(), min_size=1, max_size=8),
)
def test_adam(
    ad: Any,
    seed: int,
    scale: float,
    beta1: float,
    beta2: float,
    epsilon: float,
    accepted: list[bool],
) -> None:
    """Several steps of random gradients; those that are declined leave no trace."""
    rng, rate = np.random.default_rng(seed), 1e-2
    expected = {"a.weight": rng.normal(size=(3, 5)), "a.bias": rng.normal(size=3)}
    parameters = {n: ad.TensorXf(w.astype(np.float32)) for n, w in expected.items()}
    optimizer = Adam(parameters, beta1=beta1, beta2=beta2, epsilon=epsilon)
    oracle = KerasAdam(beta1, beta2, epsilon)
    for accept in accepted:
        gradients = {n: rng.normal(size=w.shape) * 10**scale for n, w in expected.items()}
        optimizer.zero_grad()
        for name, g in gradients.items():
            dr.set_grad(parameters[name], ad.TensorXf(g.astype(np.float32)))
        assert optimizer.step(rate, ad.Bool(accept))[0] == accept
        if accept:
            expected = oracle.step(expected, gradients, rate)
        for name, w in expected.items():  # 1 - beta2 keeps few digits in single precision
            assert np.abs(np.array(parameters[name], float) - w).max() < 2e-6 + 1e-4 * rate


def test_nothing_stays_nothing(ad: Any) -> None:
    zeros = orthogonalized(dr.zeros(ad.TensorXf, (32, 40)))
    assert np.array_equal(np.array(zeros), np.zeros((32, 40)))


def test_thin_matrices_and_vectors_are_left_to_adam() -> None:
    assert is_hidden((256, 39)) and is_hidden((32, 256))
    assert not is_hidden((256,)) and not is_hidden((3, 32)) and not is_hidden((32, 15))


def quadratic(ad: Any, muon: bool, broken: bool = False) -> tuple[Adam, dict[str, Any]]:
    rng = np.random.default_rng(1)
    parameters = {
        "wide.weight": ad.TensorXf(rng.normal(size=(32, 40)).astype(np.float32)),
        "thin.weight": ad.TensorXf(rng.normal(size=(3, 40)).astype(np.float32)),
    }
    optimizer = Adam(parameters, beta1=0.9, muon=muon)
    optimizer.zero_grad()
    loss = sum(dr.sum(dr.square(p), axis=None) for p in parameters.values())
    dr.backward(loss * (dr.nan if broken else 1))
    return optimizer, parameters


def test_one_step(ad: Any) -> None:
    """By hand: the first moment is a tenth of the gradient, looked ahead once."""
    optimizer, parameters = quadratic(ad, muon=True)
    before = {n: np.array(p, float) for n, p in parameters.items()}
    assert optimizer.step(0.01, ad.Bool(True))[0]
    gradient = 2 * before["wide.weight"]
    step = 0.01 * 0.2 * np.sqrt(40) * polynomial(0.1 * gradient + 0.9 * 0.1 * gradient)
    found = np.array(parameters["wide.weight"], float)
    assert np.abs(found - (before["wide.weight"] - step)).max() < 1e-4
    other, plain = quadratic(ad, muon=False)
    other.step(0.01, ad.Bool(True))
    assert np.array_equal(np.array(parameters["thin.weight"]), np.array(plain["thin.weight"]))
    assert not np.allclose(found, np.array(plain["wide.weight"]))


def test_a_step_that_is_not_finite_changes_nothing(ad: Any) -> None:
    optimizer, parameters = quadratic(ad, muon=True, broken=True)
    before = {n: np.array(p) for n, p in parameters.items()}
    assert not optimizer.step(0.01, ad.Bool(True))[0]
    for name, value in before.items():
        assert np.array_equal(np.array(parameters[name]), value)
    assert all(np.isfinite(v).all() for v in optimizer.state().values())


# ---- Tables ------------------------------------------------------------------


def test_only_entries_with_gradients_move(ad: Any) -> None:
    """Adam entry by entry in double precision, with the count of all accepted steps."""
    rng, shape, rate = np.random.default_rng(3), (50, 4), 1e-2
    p = rng.normal(size=shape)
    m, v = np.zeros(shape), np.zeros(shape)
    parameters = {GRID: ad.TensorXf(p.astype(np.float32))}
    optimizer = Adam(parameters, beta1=0.9, beta2=0.99, epsilon=1e-15)
    for count in range(1, 7):
        g = np.where(rng.random(shape) < 0.7, 0, rng.normal(size=shape)).astype(np.float32)
        optimizer.zero_grad()
        dr.set_grad(parameters[GRID], ad.TensorXf(g))
        before = {n: a.copy() for n, a in optimizer.state().items()}
        assert optimizer.step(rate, ad.Bool(True))[0]
        seen = g != 0
        m[seen] = (0.9 * m + 0.1 * g)[seen]
        v[seen] = (0.99 * v + 0.01 * g.astype(float) ** 2)[seen]
        with np.errstate(invalid="ignore"):
            change = rate * (m / (1 - 0.9**count)) / np.sqrt(v / (1 - 0.99**count))
        p[seen] -= change[seen]
        assert np.abs(np.array(parameters[GRID], float) - p).max() < 1e-5
        after = optimizer.state()
        for moment in (f"first.{GRID}", f"second.{GRID}"):
            assert np.array_equal(after[moment][~seen], before[moment][~seen])


@pytest.mark.parametrize("entry", [np.nan, np.inf, -np.inf, 1e20])
def test_one_entry_whose_square_is_not_finite(ad: Any, entry: float) -> None:
    parameters = {GRID: dr.ones(ad.TensorXf, (30, 4)), "a.bias": dr.ones(ad.TensorXf, (3,))}
    optimizer = Adam(parameters)
    gradient = np.ones((30, 4), np.float32)
    gradient[17, 2] = entry
    for value, accepted in ((gradient, False), (np.ones_like(gradient), True)):
        optimizer.zero_grad()
        dr.set_grad(parameters[GRID], ad.TensorXf(value))
        dr.set_grad(parameters["a.bias"], ad.TensorXf(np.ones(3, np.float32)))
        assert optimizer.step(0.1, ad.Bool(True))[0] == accepted
        moved = [np.array(p) != 1 for p in parameters.values()]
        assert all(m.all() if accepted else not m.any() for m in moved)
    assert optimizer.state()["steps"][0] == 1


def test_a_table_is_passed_over_twice(ad: Any) -> None:
    """Once to look for what is not finite, once to update; nothing is compiled anew."""
    parameters = {GRID: dr.ones(ad.TensorXf, (700, 4)), "a.bias": dr.ones(ad.TensorXf, (3,))}
    dr.eval(parameters)
    optimizer = Adam(parameters)
    for step in range(3):
        optimizer.zero_grad()
        for p in parameters.values():
            dr.set_grad(p, dr.opaque(ad.TensorXf, 0.5, shape=p.shape))
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            optimizer.step(0.01 / (step + 1), ad.Bool(True))
            history = dr.kernel_history()
    assert len([entry for entry in history if entry["size"] == 2800]) == 2
    assert not any(entry.get("cache_hit", True) == 0 for entry in history)
