"""Derivatives of rendered rays, block by block, and batches cut to a budget."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import drjit as dr
import numpy as np
import pytest

from mi_nerf.fields.fourier import FourierEncoding
from mi_nerf.fields.network import NetworkConfig, initial_weights
from mi_nerf.fields.neural import NeuralField, NeuralFieldConfig
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.occupancy import OccupancyGrid
from mi_nerf.march.placing import place_samples
from mi_nerf.march.quadrature import Composite, integrate
from mi_nerf.march.query import Evaluation
from mi_nerf.march.samples import Samples
from mi_nerf.march.settings import MarchSettings
from tests.support.analytic import AnalyticField
from tests.support.arrays import unit, vectors

CONFIG = NeuralFieldConfig(
    position=FourierEncoding(2),
    direction=FourierEncoding(1),
    network=NetworkConfig(depth=2, width=8, skip=1, view_width=4),
    density_shift=1.0,
)
RAYS, COUNT = 12, 6


def batch(ad: Any, field: NeuralField, precision: str = "64") -> Samples:
    """Jittered samples of rays of which some miss the box."""
    rng = np.random.default_rng(0)
    o = 3 * unit(rng.normal(size=(RAYS, 3)))
    d = unit(rng.uniform(-1.6, 1.6, (RAYS, 3)) - o)
    jitter = getattr(ad, "Float" + precision)(rng.random(RAYS * COUNT))
    return place_samples(
        MarchedField(field, MarchSettings(samples=COUNT)),
        vectors(ad, o, precision),
        vectors(ad, d, precision),
        jitter=jitter,
    )


def make_field(ad: Any, weights: Mapping[str, np.ndarray] | None = None) -> NeuralField:
    return NeuralField(CONFIG, weights or initial_weights(CONFIG.shapes(), 1), ad.TensorXf64)


def rows(seen: Composite) -> list[Any]:
    return [*seen.color, seen.opacity, seen.depth]


def mixed(ad: Any, seen: Composite) -> Any:
    """A loss in which every output of every ray has its own share."""
    mix = np.random.default_rng(2).normal(size=(5, RAYS))
    return sum(dr.sum(row * ad.Float64(m)) for row, m in zip(rows(seen), mix, strict=True))


def gradients(
    ad: Any, run: Callable[[NeuralField, Samples], None]
) -> tuple[dict[str, np.ndarray], NeuralField]:
    """What ``run`` leaves in the gradients of a fresh field's parameters."""
    field = make_field(ad)
    samples = batch(ad, field)
    assert 0 < samples.queries < RAYS * COUNT
    dr.enable_grad(field.parameters())
    run(field, samples)
    return {n: np.array(dr.grad(p)) for n, p in field.parameters().items()}, field


def by_blocks(ad: Any, block: int, keep: bool) -> Callable[[NeuralField, Samples], None]:
    def run(field: NeuralField, samples: Samples) -> None:
        evaluation = Evaluation(field, samples, block, keep=keep)
        evaluation.enable_grad()
        dr.backward(mixed(ad, integrate(evaluation, samples)))
        evaluation.backward()

    return run


# ---- Reverse mode -----------------------------------------------------------


@pytest.mark.slow
def test_backward_against_finite_differences(ad: Any) -> None:
    """For every tensor, along a random direction."""
    found, field = gradients(ad, by_blocks(ad, 16, keep=False))
    weights, rng, step = field.weights(), np.random.default_rng(3), 1e-6

    def loss(values: Mapping[str, np.ndarray]) -> float:
        moved = make_field(ad, values)
        samples = batch(ad, moved)
        return float(mixed(ad, integrate(Evaluation(moved, samples, 100), samples))[0])

    for name, w in weights.items():
        way = rng.normal(size=w.shape)
        high, low = (loss({**weights, name: w + sign * step * way}) for sign in (1, -1))
        numeric = (high - low) / (2 * step)
        assert np.sum(found[name] * way) == pytest.approx(numeric, rel=1e-5, abs=1e-7), name


@pytest.mark.slow
@pytest.mark.parametrize("keep", [True, False])
@pytest.mark.parametrize("block", [1, 16, 1000])
def test_blocks_and_stored_activations_make_no_difference(ad: Any, block: int, keep: bool) -> None:
    expected, _ = gradients(ad, by_blocks(ad, 64, keep=False))
    found, _ = gradients(ad, by_blocks(ad, block, keep=keep))
    assert any(g.any() for g in expected.values())
    for name, gradient in expected.items():
        assert found[name] == pytest.approx(gradient, rel=1e-10, abs=1e-13), name


def test_backward_accumulates(ad: Any) -> None:
    once, _ = gradients(ad, by_blocks(ad, 16, keep=True))

    def twice(field: NeuralField, samples: Samples) -> None:
        for keep in (True, False):
            by_blocks(ad, 16, keep)(field, samples)

    found, _ = gradients(ad, twice)
    for name, gradient in once.items():
        assert found[name] == pytest.approx(2 * gradient, rel=1e-10, abs=1e-13), name


def test_unused_outputs_are_no_obstacle(ad: Any) -> None:
    """A loss of the opacity alone leaves the colour branch without gradient."""

    def run(field: NeuralField, samples: Samples) -> None:
        evaluation = Evaluation(field, samples, 16)
        evaluation.enable_grad()
        dr.backward(dr.sum(integrate(evaluation, samples).opacity))
        evaluation.backward()

    found, _ = gradients(ad, run)
    assert found["density.weight"].any() and not found["color.weight"].any()


# ---- Forward mode -----------------------------------------------------------


def test_forward_against_finite_differences(ad: Any) -> None:
    field, rng, step = make_field(ad), np.random.default_rng(4), 1e-6
    weights = field.weights()
    way = {n: rng.normal(size=w.shape) for n, w in weights.items()}
    for name, tensor in field.parameters().items():
        dr.enable_grad(tensor)
        dr.set_grad(tensor, ad.TensorXf64(way[name]))
    samples = batch(ad, field)
    evaluation = Evaluation(field, samples, 16)
    evaluation.enable_grad()
    evaluation.forward()
    outputs = rows(integrate(evaluation, samples))
    dr.forward_to(outputs, flags=dr.ADFlag.ClearNone)  # the depth depends on the opacity
    found = np.array([np.array(dr.grad(row)) for row in outputs])

    def values(sign: int) -> np.ndarray:
        moved = make_field(ad, {n: w + sign * step * way[n] for n, w in weights.items()})
        where = batch(ad, moved)
        seen = integrate(Evaluation(moved, where, 100), where)
        return np.array([np.array(row) for row in rows(seen)])

    assert found == pytest.approx((values(1) - values(-1)) / (2 * step), rel=1e-5, abs=1e-8)
    assert found.any(axis=1).all()


@pytest.mark.parametrize("mode", ["backward", "forward"])
def test_colour_made_of_density(ad: Any, mode: str) -> None:
    """A field may compute one output from another, and return one twice.

    Here c = (σ, 2σ, σ). Of the three samples, the first lies in a cell that counts as
    empty, and the only block is padded: C = 2σ·(1 − exp(−4σ/3)) in the second channel.
    """
    sigma = ad.TensorXf64([0.75])

    def density(p: Any) -> Any:
        return sigma.array + dr.zeros(ad.Float64, len(p[0]))

    field = AnalyticField(density, parameters={"sigma": sigma})
    field.density_emission = lambda p, d: (s := density(p), [s, 2 * s, s])
    grid = OccupancyGrid(
        field.lower, field.upper, np.array([False, True, True]).reshape(1, 1, 3), ad.Float64
    )
    o, d = vectors(ad, [(0, 0, -3)], "64"), vectors(ad, [(0, 0, 1)], "64")
    samples = place_samples(MarchedField(field, MarchSettings(samples=3), grid), o, d)
    dr.enable_grad(sigma)
    dr.set_grad(sigma, 1 if mode == "forward" else 0)
    evaluation = Evaluation(field, samples, 8)
    assert list(evaluation.density) == [0, 0.75, 0.75]
    evaluation.enable_grad()
    if mode == "forward":
        evaluation.forward()
        assert list(dr.grad(evaluation.density)) == [0, 1, 1]
        slope = dr.forward_to(integrate(evaluation, samples).color[1])
    else:
        dr.backward(integrate(evaluation, samples).color[1])
        evaluation.backward()
        slope = dr.grad(sigma).array
    exact = 2 * (1 - np.exp(-1)) + 2 * 0.75 * 4 / 3 * np.exp(-1)
    assert slope[0] == pytest.approx(exact, rel=1e-9)


# ---- What does not carry gradients ------------------------------------------


def test_sample_positions_carry_no_gradient(ad: Any) -> None:
    """Through them, optimisation of cameras or bounds would turn chaotic."""
    field = make_field(ad)
    o, d = vectors(ad, [(0, 0, -3)], "64"), vectors(ad, [(0, 0, 1)], "64")
    far = ad.Float64(3.5)
    dr.enable_grad(o, d, far)
    samples = place_samples(MarchedField(field, MarchSettings(samples=4)), o, d, bounds=(None, far))
    assert not dr.grad_enabled(samples.t, samples.delta)


def test_nothing_is_recorded_unless_asked(ad: Any) -> None:
    field = make_field(ad)
    dr.enable_grad(field.parameters())
    for keep in (True, False):
        evaluation = Evaluation(field, batch(ad, field), 16, keep=keep)
        assert not dr.grad_enabled(evaluation.density, evaluation.emission)


# ---- Budget -----------------------------------------------------------------


@pytest.mark.slow
def test_truncate(ad: Any) -> None:
    """Rays that are said to be complete look as if nothing had been cut; the next does not."""
    field = NeuralField.create(CONFIG, 1, ad.TensorXf)

    def look(samples: Samples) -> np.ndarray:
        seen = integrate(Evaluation(field, samples, 16), samples)
        return np.array([np.array(row) for row in rows(seen)])

    whole = batch(ad, field, "32")
    expected, numbers = look(whole), set()
    for budget in range(1, whole.queries + 2):
        cut = batch(ad, field, "32")
        complete = int(cut.truncate(budget)[0])
        numbers.add(complete)
        assert cut.rays == RAYS and cut.queries == min(budget, whole.queries)
        seen = look(cut)
        assert np.array_equal(seen[:, :complete], expected[:, :complete])
        if budget < whole.queries:
            assert seen[3, complete] < expected[3, complete]
        else:
            assert complete == RAYS
    assert len(numbers) > 3
