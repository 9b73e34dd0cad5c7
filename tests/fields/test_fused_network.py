"""The network as one kernel gives the answers of the network as matrix products."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import drjit as dr
import drjit.llvm.ad as ad
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mi_nerf.base.variants import multiplies_in_half
from mi_nerf.fields import fused_network as fusing
from mi_nerf.fields.fourier import FourierEncoding
from mi_nerf.fields.fused_network import FusedNetwork, activation_bounds, fused_network
from mi_nerf.fields.hash_grid import HashGridConfig
from mi_nerf.fields.network import GRID as TABLE
from mi_nerf.fields.network import NetworkConfig
from mi_nerf.fields.neural import NeuralField, NeuralFieldConfig
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.occupancy import OccupancyGrid
from mi_nerf.march.placing import place_samples
from mi_nerf.march.query import Evaluation
from mi_nerf.march.render import render_rays
from mi_nerf.march.settings import MarchSettings
from tests.support.arrays import unit, vectors

PLAIN = NetworkConfig(depth=2, width=24, skip=1, view_width=12)
BASE = NeuralFieldConfig(
    position=FourierEncoding(frequencies=3),
    direction=FourierEncoding(frequencies=2),
    network=PLAIN,
    density_scale=3.0,
)
GRID = HashGridConfig(levels=3, features=2, log2_entries=8, coarsest=4, finest=16)


@pytest.mark.slow
@pytest.mark.parametrize(
    "config",
    [
        BASE,
        replace(BASE, network=replace(PLAIN, view_dependent=False)),
        replace(BASE, network=replace(PLAIN, view_depth=0)),
        replace(BASE, network=replace(PLAIN, view_depth=2, feature_relu=True)),
        replace(BASE, network=replace(PLAIN, feature_layer=False, skip=-1, width=64)),
        replace(BASE, grid=GRID, position=FourierEncoding(frequencies=0)),
        replace(BASE, density_activation="relu", color_activation="exp"),
    ],
)
def test_both_ways_agree(config: NeuralFieldConfig) -> None:
    field = NeuralField.create(config, 3, ad.TensorXf)
    # Biases start at 0, and a hash grid close to it: neither would be seen to be used.
    rng = np.random.default_rng(4)
    weights = {n: w + rng.normal(0, 0.3, w.shape) for n, w in field.weights().items()}
    field = NeuralField(config, {n: w.astype(np.float32) for n, w in weights.items()}, ad.TensorXf)
    p, d = vectors(ad, rng.uniform(-1, 1, (500, 3))), vectors(ad, unit(rng.normal(size=(500, 3))))
    fused = field.fused()
    assert fused is not None
    (density, color), (one_density, one_color) = field.density_emission(p, d), fused(p, d)
    assert np.std(np.array(density)) > 0
    alone = field.fused(emission=False)
    assert alone is not None
    np.testing.assert_allclose(np.array(alone(p)), np.array(one_density), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(np.array(one_density), np.array(density), rtol=2e-5, atol=2e-5)
    for expected, found in zip(color, one_color, strict=True):
        np.testing.assert_allclose(np.array(found), np.array(expected), rtol=2e-5, atol=2e-5)


def test_wide_networks_stay_tensors() -> None:
    wide = replace(BASE, network=replace(PLAIN, width=65))
    assert NeuralField.create(wide, 0, ad.TensorXf).fused() is None


def test_new_weights_are_seen() -> None:
    """A rendering always asks the weights of its own time."""
    field = NeuralField.create(BASE, 0, ad.TensorXf)
    o, d = vectors(ad, [(0.1, -3, 0.2)]), vectors(ad, [(0, 1, 0)])
    before = np.array(render_rays(MarchedField(field, MarchSettings()), o, d).opacity)
    for name, tensor in field.parameters().items():
        field.parameters()[name] = type(tensor)(np.array(tensor) * 2)
    after = np.array(render_rays(MarchedField(field, MarchSettings()), o, d).opacity)
    assert abs(before[0] - after[0]) > 1e-3


def test_gradients_do_not_take_the_short_way() -> None:
    field: Any = NeuralField.create(BASE, 0, ad.TensorXf)
    grid = OccupancyGrid(field.lower, field.upper, np.ones((4, 4, 4), bool), ad.Float)
    o, d = vectors(ad, [(0.1, -3, 0.2)]), vectors(ad, [(0, 1, 0)])
    samples = place_samples(MarchedField(field, MarchSettings(samples=16), grid), o, d)
    kept, short = (Evaluation(field, samples, 16, keep=keep) for keep in (True, False))
    assert kept._fused is None and short._fused is not None
    np.testing.assert_allclose(np.array(kept.density), np.array(short.density), rtol=1e-4)


# ---- In half precision ------------------------------------------------------


def uneven(config: NeuralFieldConfig, seed: int, tensors: Any = ad.TensorXf) -> NeuralField:
    """A field whose biases and hash grid are not close to 0, as after training."""
    rng = np.random.default_rng(seed)
    weights = NeuralField.create(config, seed, tensors).weights()
    weights = {n: (w + rng.normal(0, 0.2, w.shape)).astype(np.float32) for n, w in weights.items()}
    return NeuralField(config, weights, tensors)


CONFIGS = [
    replace(BASE, grid=GRID),
    replace(BASE, network=replace(PLAIN, view_dependent=False)),
    replace(BASE, network=replace(PLAIN, view_depth=0)),
    replace(BASE, network=replace(PLAIN, view_depth=2, feature_layer=False, skip=-1, width=64)),
]


@pytest.mark.slow
@pytest.mark.parametrize("config", CONFIGS)
def test_half_precision_answers_alike(config: NeuralFieldConfig, ad: Any) -> None:
    from drjit.llvm import ad as cpu  # a GPU has cooperative vectors in half precision alone

    if not multiplies_in_half(ad.Float16):
        pytest.skip("no cooperative vectors on this device")
    field, rng = uneven(config, 3, ad.TensorXf), np.random.default_rng(5)
    p, d = vectors(ad, rng.uniform(-1, 1, (500, 3))), vectors(ad, unit(rng.normal(size=(500, 3))))
    features = field._features(p)
    seen = config.direction.features(d) if config.network.view_dependent else None
    answers = []
    for kind, half in ((cpu, False), (ad, True)):
        weights = {n: kind.TensorXf(np.array(w)) for n, w in field.parameters().items()}
        network = FusedNetwork(config.network, weights, half=half)
        rows = [kind.Float(np.array(x)) for x in features]
        directions = None if seen is None else [kind.Float(np.array(x)) for x in seen]
        density, color = network(rows, directions)
        assert type(density) is kind.Float
        np.testing.assert_array_equal(np.array(network.density(rows)), np.array(density))
        answers.append(np.array([np.array(x) for x in (density, *color)], np.float64))
    scale = np.abs(answers[0]).max(axis=1, keepdims=True)
    error = np.abs(answers[1] - answers[0]) / scale
    assert 1e-6 < error.max() < 6e-3, "as many digits as half precision has, and no more"


@given(st.integers(0, 2**32 - 1), st.sampled_from(CONFIGS), st.floats(0.1, 30.0))
@settings(max_examples=20)
def test_no_activation_exceeds_its_bound(seed: int, config: NeuralFieldConfig, by: float) -> None:
    """Against the network in float64, layer by layer, for inputs at the limits of features."""
    network, rng = config.network, np.random.default_rng(seed)
    weights = {n: by * rng.normal(size=s) for n, s in config.shapes().items()}
    bounds = activation_bounds(network, {n: ad.TensorXf(w) for n, w in weights.items()})
    most = max(1.0, np.abs(weights[TABLE]).max()) if TABLE in weights else 1.0
    values = {
        "position": rng.uniform(-most, most, (config.position_size, 200)),
        "direction": rng.uniform(-1, 1, (config.direction.size, 200)),
    }
    for layer in network.layers():
        y = weights[layer.bias][:, None] + sum(
            weights[name] @ values[source] for name, source in layer.matrices().items()
        )
        assert np.abs(y).max() <= bounds[layer.name] * (1 + 1e-5)
        values[layer.name] = np.maximum(y, 0) if layer.rectify else y


def test_the_bound_of_one_neuron_is_reached() -> None:
    """y = relu(3 x − 4), x in [−1, 1]; σ = −2 y + 1 within what the bounds say."""
    config = NetworkConfig(depth=1, width=1, skip=-1, feature_layer=False, view_depth=0)
    values = {"trunk_0.weight": [[3.0]], "trunk_0.bias": [-4.0]}
    values |= {"density.weight": [[-2.0]], "density.bias": [1.0]}
    values |= {"color.weight": [[1.0]] * 3, "color.bias": [0.0] * 3}
    values["color.direction_weight"] = [[0.5]] * 3
    weights = {n: ad.TensorXf(np.array(v, np.float32)) for n, v in values.items()}
    found = activation_bounds(config, weights)
    assert found == {"position": 1, "direction": 1, "trunk_0": 7, "density": 15, "color": 7.5}


@pytest.fixture
def as_on_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """The choice is made as on CUDA; the arithmetic is the CPU's."""
    changed = {"backend_v": lambda _: dr.JitBackend.CUDA}
    names = {name: getattr(dr, name) for name in dir(dr)}
    monkeypatch.setattr(fusing, "dr", SimpleNamespace(**names | changed))


def test_a_gpu_takes_half_precision_where_it_can(
    as_on_a_gpu: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    field = uneven(BASE, 0)
    chosen = fused_network(PLAIN, field.parameters())
    assert chosen is not None and chosen._half
    with dr.scoped_set_flag(dr.JitFlag.FreezingScope, True):
        assert fused_network(PLAIN, field.parameters()) is None
    large = {n: 100 * w for n, w in field.parameters().items()}
    assert fused_network(PLAIN, large) is None, "activations could overflow"
    monkeypatch.setattr(fusing, "multiplies_in_half", lambda _: False)
    assert fused_network(PLAIN, field.parameters()) is None


@pytest.mark.slow
def test_a_picture_in_half_precision(as_on_a_gpu: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same walk, the same picture within what an 8-bit image can show."""
    field = uneven(replace(BASE, grid=GRID), 1)
    rng = np.random.default_rng(0)
    d = unit(rng.normal(size=(2000, 3)))
    o = -3 * d + rng.uniform(-0.7, 0.7, d.shape)
    marched = MarchedField(field, MarchSettings(samples=64))
    half = render_rays(marched, vectors(ad, o), vectors(ad, d))
    monkeypatch.undo()
    single = render_rays(marched, vectors(ad, o), vectors(ad, d))
    assert half.queries > 2000
    pairs = zip((*half.color, half.opacity), (*single.color, single.opacity), strict=True)
    errors = np.array([np.array(a) - np.array(b) for a, b in pairs])
    assert 1e-5 < np.abs(errors).max() < 2 / 255
    assert np.sqrt(np.mean(errors**2)) < 0.2 / 255
