"""The network as one kernel gives the answers of the network as matrix products."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit.llvm.ad as ad
import numpy as np
import pytest

from mi_nerf.fields.fourier import FourierEncoding
from mi_nerf.fields.hash_grid import HashGridConfig
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
