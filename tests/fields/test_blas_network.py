"""The network as NumPy's matrix products, against tensor mode and finite differences."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerf.fields import network
from mi_nerf.fields.blas_network import BlasNetwork, network_product, worth_blas
from mi_nerf.fields.network import NetworkConfig, initial_weights

POSITION, DIRECTION = 11, 5


@pytest.fixture
def llvm() -> Any:
    """The array types of the CPU's backend."""
    return import_module("drjit.llvm.ad")


CONFIGS = st.builds(
    lambda depth, width, skip, feature, rectify, view_depth, view_width, seen: NetworkConfig(
        depth=depth,
        width=width,
        skip=min(skip, depth - 1) or -1,
        feature_layer=feature,
        feature_relu=feature and rectify,
        view_depth=view_depth,
        view_width=view_width,
        view_dependent=seen,
    ),
    st.integers(1, 4),
    st.integers(1, 20),
    st.integers(-1, 3),
    st.booleans(),
    st.booleans(),
    st.integers(0, 2),
    st.integers(1, 20),
    st.booleans(),
)


def reference(config: NetworkConfig, weights: dict[str, Any], x: Any, d: Any) -> np.ndarray:
    """Raw density and colours by the definition, layer by layer."""
    known = {"position": x, "direction": d}
    for layer in config.layers():
        y = sum(weights[w] @ known[source] for w, source in layer.matrices().items())
        y = y + weights[layer.bias][:, None]
        known[layer.name] = np.maximum(y, 0) if layer.rectify else y
    return np.concatenate([known[network.DENSITY], known[network.COLOR]])


def inputs(config: NetworkConfig, count: int, seed: int) -> tuple[Any, Any, Any]:
    rng = np.random.default_rng(seed)
    shapes = config.shapes(POSITION, DIRECTION)
    weights = {n: rng.normal(0, 0.5, s) for n, s in shapes.items()}
    return weights, rng.normal(size=(POSITION, count)), rng.normal(size=(DIRECTION, count))


@given(config=CONFIGS, count=st.integers(1, 30), seed=st.integers(0, 1 << 30))
def test_is_the_network_of_the_definition(config: NetworkConfig, count: int, seed: int) -> None:
    weights, x, d = inputs(config, count, seed)
    expected = reference(config, weights, x, d)
    for emission in (True, False):
        out = np.full((4 if emission else 1, count), np.nan)
        BlasNetwork(config, weights, emission=emission)({"position": x, "direction": d}, out)
        np.testing.assert_allclose(out, expected[: len(out)], rtol=1e-9, atol=1e-9)


def kept(config: NetworkConfig, weights: Any, x: Any, d: Any, emission: bool) -> Any:
    out = np.empty((4 if emission else 1, x.shape[1]))
    made = BlasNetwork(config, weights, emission=emission)
    made({"position": x, "direction": d}, out, np.empty)
    return made, out


@given(config=CONFIGS, seed=st.integers(0, 1 << 30), emission=st.booleans())
def test_tangents_are_slopes(config: NetworkConfig, seed: int, emission: bool) -> None:
    weights, x, d = inputs(config, 7, seed)
    moved, dx, dd = inputs(config, 7, seed + 1)
    made, out = kept(config, weights, x, d, emission)
    found = np.empty_like(out)
    made.forward(moved, {"position": dx, "direction": dd}, found)
    h = 1e-7  # in double precision; a ReLU may change sides in between
    ends = [
        kept(
            config,
            {n: w + sign * h * moved[n] for n, w in weights.items()},
            x + sign * h * dx,
            d + sign * h * dd,
            emission,
        )[1]
        for sign in (1, -1)
    ]
    slope = (ends[0] - ends[1]) / (2 * h)
    close = np.isclose(found, slope, rtol=1e-4, atol=1e-4 * (1 + np.abs(slope).max()))
    assert close.mean() > 0.9


@given(
    config=CONFIGS, count=st.integers(1, 9), seed=st.integers(0, 1 << 30), emission=st.booleans()
)
def test_adjoint_is_the_transpose_of_the_tangents(
    config: NetworkConfig, count: int, seed: int, emission: bool
) -> None:
    weights, x, d = inputs(config, count, seed)
    moved, dx, dd = inputs(config, count, seed + 1)
    made, out = kept(config, weights, x, d, emission)
    tangent, adjoint = np.empty_like(out), np.random.default_rng(seed + 2).normal(size=out.shape)
    made.forward(moved, {"position": dx, "direction": dd}, tangent)
    used = {n for product in made._products for n, _, _ in product.blocks()}
    gradients = {n: np.full_like(weights[n], np.nan) for n in used}
    seen = config.view_dependent and emission
    features = {"position": np.full_like(x, np.nan)}
    features |= {"direction": np.full_like(d, np.nan)} if seen else {}
    made.backward(adjoint, gradients, features)
    right = sum((gradients[n] * moved[n]).sum() for n in used)
    right += (features["position"] * dx).sum()
    right += (features["direction"] * dd).sum() if seen else 0
    np.testing.assert_allclose((tangent * adjoint).sum(), right, rtol=1e-8, atol=1e-8)


def test_many_columns_are_as_few() -> None:
    """More than one thread's share, and the sums over all of them."""
    config = NetworkConfig(depth=2, width=16, skip=1, view_width=8)
    weights, x, d = inputs(config, 5000, 3)
    made, out = kept(config, weights, x, d, True)
    np.testing.assert_allclose(out, reference(config, weights, x, d), rtol=1e-9)
    adjoint = np.random.default_rng(4).normal(size=out.shape)
    whole = {n: np.empty_like(w) for n, w in weights.items()}
    made.backward(adjoint, whole, {})
    total = {n: np.zeros_like(w) for n, w in weights.items()}
    for start in range(0, 5000, 1000):
        part = slice(start, start + 1000)
        some, _ = kept(config, weights, x[:, part], d[:, part], True)
        found = {n: np.empty_like(w) for n, w in weights.items()}
        some.backward(adjoint[:, part], found, {})
        for n, values in found.items():
            total[n] += values
    for n, values in whole.items():
        np.testing.assert_allclose(values, total[n], rtol=1e-8, atol=1e-8)


def test_not_a_number_goes_through() -> None:
    config = NetworkConfig(depth=1, width=4, skip=-1, view_width=4)
    weights, x, d = inputs(config, 3, 5)
    x[0, 1] = np.nan
    _, out = kept(config, weights, x, d, True)
    assert np.isnan(out[:, 1]).all()
    assert np.isfinite(out[:, [0, 2]]).all()


@pytest.mark.parametrize(
    "moving", [{"position"}, {"direction"}, {"weights"}, {"position", "weights"}]
)
def test_gradients_are_those_of_tensor_mode(llvm: Any, moving: set[str]) -> None:
    config = NetworkConfig(depth=2, width=24, skip=1, view_width=16)
    host = initial_weights(config.shapes(POSITION, DIRECTION), 0)
    _, x, d = inputs(config, 300, 6)
    found = []
    for on_host in (True, False):
        weights = {n: llvm.TensorXf(w) for n, w in host.items()}
        given = {
            n: llvm.TensorXf(v.astype(np.float32)) for n, v in (("position", x), ("direction", d))
        }
        leaves = {n: given[n] for n in moving - {"weights"}}
        leaves |= weights if "weights" in moving else {}
        dr.enable_grad(list(leaves.values()))
        if on_host:
            raw = network.rows(network_product(config, weights, given))
        else:
            h = network.trunk(config, weights, given["position"])
            raw = [network.density_head(config, weights, h)]
            raw += network.color_head(config, weights, h, given["direction"])
        dr.backward(sum(dr.sum(dr.sin(r) * (i + 1)) for i, r in enumerate(raw)))
        found.append({n: np.array(dr.grad(leaf)) for n, leaf in leaves.items()})
    for n, expected in found[1].items():
        assert np.abs(expected).max() > 0
        np.testing.assert_allclose(
            found[0][n], expected, atol=2e-5 * np.abs(expected).max(), err_msg=n
        )


def test_only_narrow_networks_of_a_cpu(llvm: Any) -> None:
    assert worth_blas(NetworkConfig(depth=1, width=64, skip=-1, view_width=64), llvm.TensorXf)
    assert not worth_blas(NetworkConfig(), llvm.TensorXf)
