"""The network on the host for any number of queries, against its definition."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerf.base.arrays import upload
from mi_nerf.fields.host_network import HostNetwork, on_host
from mi_nerf.fields.network import NetworkConfig
from tests.fields.test_blas_network import CONFIGS, inputs, reference


@given(config=CONFIGS, count=st.integers(1, 30), seed=st.integers(0, 1 << 30))
def test_is_the_network_of_the_definition(config: NetworkConfig, count: int, seed: int) -> None:
    ad = import_module("drjit.llvm.ad")
    weights, x, d = inputs(config, count, seed)
    x[2], d[1] = 0.25, -0.5  # features that are alike for all queries may be single numbers
    expected = reference(config, weights, x, d)
    tensors = {name: upload(ad.TensorXf64, w) for name, w in weights.items()}
    rows = {"position": x, "direction": d}
    features = {
        name: [upload(ad.Float64, row[:1] if np.ptp(row) == 0 else row) for row in values]
        for name, values in rows.items()
    }
    for emission in (True, False):
        found = HostNetwork(config, tensors, emission=emission)(features, count)
        assert [len(row) for row in found] == [count] * (4 if emission else 1)
        np.testing.assert_allclose(np.array(found), expected[: len(found)], rtol=1e-9, atol=1e-9)


def test_many_queries_in_single_precision() -> None:
    """More than one thread takes at a time, and not a multiple of that."""
    ad, config = import_module("drjit.llvm.ad"), NetworkConfig(depth=2, width=96, skip=1)
    weights, x, d = inputs(config, 5001, 3)
    expected = reference(config, weights, x, d)
    tensors = {name: upload(ad.TensorXf, w.astype(np.float32)) for name, w in weights.items()}
    rows = {"position": x, "direction": d}
    features: dict[str, list[Any]] = {
        name: [upload(ad.Float, row.astype(np.float32)) for row in values]
        for name, values in rows.items()
    }
    found = np.array(HostNetwork(config, tensors)(features, 5001))
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize(("backend", "expected"), [("llvm", True), ("cuda", False)])
def test_memory_of_a_card_is_not_the_hosts(backend: str, expected: bool) -> None:
    ad = import_module(f"drjit.{backend}.ad")
    assert dr.is_float_v(ad.Float) and on_host(ad.Float) is expected
