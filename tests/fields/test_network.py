"""The network against one written in NumPy as the paper draws it, with concatenations."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np
import pytest

from mi_nerf.fields import network
from mi_nerf.fields.fourier import FourierEncoding
from mi_nerf.fields.network import NetworkConfig, initial_weights

PUBLISHED = NetworkConfig()
SMALL = NetworkConfig(depth=4, width=16, skip=2, view_width=8)
CONFIGS = {
    "small": SMALL,
    "skip in the last layer": NetworkConfig(depth=3, width=16, skip=2, view_width=8),
    "no skip": NetworkConfig(depth=4, width=16, skip=-1, view_width=8),
    "no feature layer": NetworkConfig(depth=4, width=16, skip=1, feature_layer=False, view_width=8),
    "rectified feature": NetworkConfig(depth=2, width=16, skip=-1, feature_relu=True, view_width=8),
    "one layer": NetworkConfig(depth=1, width=16, skip=-1, view_width=8),
    "deep view branch": NetworkConfig(depth=2, width=16, skip=1, view_depth=3, view_width=8),
    "no view branch": NetworkConfig(depth=2, width=16, skip=1, view_depth=0),
    "colour from the trunk": NetworkConfig(
        depth=2, width=16, skip=1, view_depth=0, feature_layer=False, view_dependent=False
    ),
    "view independent": NetworkConfig(depth=3, width=16, skip=1, view_dependent=False),
    "view independent, no view branch": NetworkConfig(
        depth=3, width=16, skip=1, view_depth=0, view_dependent=False
    ),
}
POSITION, DIRECTION = 9, 6  # sizes of γ(x) and γ(d) of the small networks


def slow_forward(
    config: NetworkConfig, weights: dict[str, np.ndarray], x: np.ndarray, d: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Raw density (N,), raw colour (3, N) and the trunk's activations."""

    def layer(name: str, *inputs: np.ndarray) -> np.ndarray:
        """One matrix on concatenated inputs: the previous layer's, then the extra one."""
        kinds = ["weight", "position_weight", "direction_weight"]
        parts = [weights[f"{name}.{k}"] for k in kinds if f"{name}.{k}" in weights]
        matrix = np.concatenate(parts, axis=1).astype(float)
        return matrix @ np.concatenate(inputs) + weights[f"{name}.bias"][:, None]

    h, trunk = x, []
    for i in range(config.depth):
        h = np.maximum(layer(f"trunk_{i}", *([h, x] if i == config.skip else [h])), 0)
        trunk.append(h)
    density = layer("density", h)[0]
    if config.feature_layer:
        h = layer("feature", h)
        h = np.maximum(h, 0) if config.feature_relu else h
    if config.view_dependent:
        h = np.concatenate([h, d])
    for i in range(config.view_depth):
        h = np.maximum(layer(f"view_{i}", h), 0)
    return density, layer("color", h), trunk


def random_weights(config: NetworkConfig, seed: int = 0) -> dict[str, np.ndarray]:
    """Initial weights, but with biases that matter."""
    rng = np.random.default_rng(seed)
    weights = initial_weights(config.shapes(POSITION, DIRECTION), seed)
    return {n: w if w.ndim == 2 else rng.normal(size=w.shape) for n, w in weights.items()}


def inputs(count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    return rng.uniform(-1, 1, (POSITION, count)), rng.uniform(-1, 1, (DIRECTION, count))


def fast_forward(config: NetworkConfig, weights: dict[str, Any], x: Any, d: Any) -> tuple[Any, Any]:
    h = network.trunk(config, weights, x)
    return network.density_head(config, weights, h), network.color_head(config, weights, h, d)


# ---- Shape ------------------------------------------------------------------


def count(config: NetworkConfig, position: FourierEncoding, direction: FourierEncoding) -> int:
    return sum(math.prod(s) for s in config.shapes(position.size, direction.size).values())


def test_published_parameter_count() -> None:
    assert count(PUBLISHED, FourierEncoding(10), FourierEncoding(4)) == 595_844


def test_published_shapes() -> None:
    shapes = PUBLISHED.shapes(63, 27)
    assert shapes["trunk_0.weight"] == (256, 63)
    assert shapes["trunk_5.weight"] == (256, 256)
    assert shapes["trunk_5.position_weight"] == (256, 63)
    assert shapes["density.weight"] == (1, 256)
    assert shapes["feature.weight"] == (256, 256)
    assert shapes["view_0.weight"] == (128, 256)
    assert shapes["view_0.direction_weight"] == (128, 27)
    assert shapes["color.weight"] == (3, 128)
    assert [n for n in shapes if "position" in n] == ["trunk_5.position_weight"]
    assert all(shapes[n.split(".")[0] + ".bias"] == shapes[n][:1] for n in shapes)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"depth": 0}, "depth=0"),
        ({"feature_relu": True, "feature_layer": False}, "expected feature_layer=True"),
        ({"width": 0}, "width=0"),
        ({"view_depth": -1}, "view_depth=-1"),
        ({"view_width": 0}, "view_width=0"),
        ({"skip": 0}, "skip=0"),
        ({"skip": 8}, "skip=8"),
        ({"skip": -2}, "skip=-2"),
    ],
)
def test_settings_are_validated(change: dict[str, int], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        NetworkConfig(**change)


# ---- Forward ----------------------------------------------------------------


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
@pytest.mark.parametrize(("precision", "tolerance"), [("f", 2e-5), ("f64", 1e-13)])
def test_forward(ad: Any, config: NetworkConfig, precision: str, tolerance: float) -> None:
    weights, (x, d) = random_weights(config), inputs(11)
    Tensor = getattr(ad, "TensorX" + precision)
    tensors = {name: Tensor(w) for name, w in weights.items()}
    direction = Tensor(d) if config.view_dependent else None
    density, color = fast_forward(config, tensors, Tensor(x), direction)
    slow_density, slow_color, _ = slow_forward(config, weights, x, d)
    assert np.array(density) == pytest.approx(slow_density, abs=tolerance)
    assert np.array([np.array(c) for c in color]) == pytest.approx(slow_color, abs=tolerance)


def test_one_query(ad: Any) -> None:
    weights, (x, d) = random_weights(SMALL), inputs(1)
    tensors = {name: ad.TensorXf64(w) for name, w in weights.items()}
    density, color = fast_forward(SMALL, tensors, ad.TensorXf64(x), ad.TensorXf64(d))
    slow_density, slow_color, _ = slow_forward(SMALL, weights, x, d)
    assert list(density) == pytest.approx(list(slow_density))
    assert [c[0] for c in color] == pytest.approx(list(slow_color[:, 0]))


# ---- Initial weights --------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_initial_activations_neither_die_nor_grow(seed: int) -> None:
    """Through 8 × 256 ReLU layers, as seen from points of the whole box."""
    rng = np.random.default_rng(100 + seed)
    phase = rng.uniform(-1, 1, (3, 500)) * np.pi
    x = np.concatenate([f(2**k * phase) for k in range(10) for f in (np.sin, np.cos)])
    d = np.zeros((24, 500))
    density, color, trunk = slow_forward(
        PUBLISHED, initial_weights(PUBLISHED.shapes(60, 24), seed), x, d
    )
    for h in trunk:
        assert 0.3 < np.sqrt(np.mean(h**2)) < 3
        assert 0.2 < np.mean(h > 0) < 0.8
    assert 0.05 < density.std() < 3 and np.abs(density).max() < 10
    assert np.abs(color).max() < 10


def test_initial_weights_follow_he_and_glorot() -> None:
    """He: 2/inputs, all inputs of the layer counted. Glorot: 2/(inputs + outputs)."""
    weights = initial_weights(PUBLISHED.shapes(63, 27), 0)
    variance = {
        "trunk_0.weight": 2 / 63,
        "trunk_4.weight": 2 / 256,
        "trunk_5.weight": 2 / (256 + 63),
        "trunk_5.position_weight": 2 / (256 + 63),
        "view_0.direction_weight": 2 / (256 + 27),
        "feature.weight": 2 / (256 + 256),
        "density.weight": 2 / (256 + 1),
        "color.weight": 2 / (128 + 3),
    }
    for name, expected in variance.items():
        # Four standard deviations of an estimate from so many numbers.
        tolerance = 4 * math.sqrt(2 / weights[name].size)
        assert weights[name].var() == pytest.approx(expected, rel=tolerance), name
    assert not any(w.any() for name, w in weights.items() if name.endswith("bias"))
    assert all(w.dtype == np.float32 for w in weights.values())


def test_initial_weights_depend_on_the_seed_alone() -> None:
    shapes = SMALL.shapes(POSITION, DIRECTION)
    first, again, other = (initial_weights(shapes, seed) for seed in (3, 3, 4))
    assert {n: w.shape for n, w in first.items()} == shapes
    assert all(np.array_equal(first[n], again[n]) for n in shapes)
    assert not np.array_equal(first["trunk_0.weight"], other["trunk_0.weight"])


# ---- Derivatives ------------------------------------------------------------


@pytest.mark.parametrize("name", ["small", "no feature layer", "no view branch"])
def test_gradients_against_finite_differences(ad: Any, name: str) -> None:
    """For every tensor, along a random direction and in one of its entries."""
    config = CONFIGS[name]
    weights, (x, d) = random_weights(config), inputs(7)
    rng = np.random.default_rng(6)
    mix = rng.normal(size=(4, 7))

    def loss(values: dict[str, np.ndarray]) -> float:
        density, color, _ = slow_forward(config, values, x, d)
        return float(np.sum(mix * np.concatenate([density[None], color])))

    tensors = {n: ad.TensorXf64(w) for n, w in weights.items()}
    dr.enable_grad(tensors)
    density, color = fast_forward(config, tensors, ad.TensorXf64(x), ad.TensorXf64(d))
    rows = [density, *color]
    dr.backward(sum(dr.sum(row * ad.Float64(m)) for row, m in zip(rows, mix, strict=True)))

    step = 1e-6
    for n, w in weights.items():
        gradient = np.array(dr.grad(tensors[n]))
        assert gradient.shape == w.shape
        entry = np.zeros(w.shape)
        entry.flat[rng.integers(w.size)] = 1
        for way in (rng.normal(size=w.shape), entry):
            high, low = (loss({**weights, n: w + sign * step * way}) for sign in (1, -1))
            numeric = (high - low) / (2 * step)
            assert np.sum(gradient * way) == pytest.approx(numeric, rel=1e-5, abs=1e-8), n
