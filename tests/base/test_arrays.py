"""Arrays of NumPy on their way to Dr.Jit."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest

from mi_nerf.base.arrays import joined, upload, vector3_type

NUMBERS = [0.0, -0.0, 1.5, -2e-38, 3e38, np.inf, -np.inf]


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("Float", np.array(NUMBERS, np.float32)),
        ("Float64", np.array([*NUMBERS, -3e-308, 1e308])),
        ("TensorXf", np.array(NUMBERS[:6], np.float32).reshape(2, 3)),
        ("UInt", np.array([0, 1, 2**32 - 1], np.uint32)),
        ("Int", np.array([0, -1, -(2**31)], np.int32)),
        ("Float", np.zeros(0, np.float32)),
    ],
)
def test_every_bit_arrives(ad: Any, name: str, values: np.ndarray) -> None:
    """Also the sign of zero, and the largest and smallest normal numbers."""
    found = np.array(upload(getattr(ad, name), values))
    assert found.shape == values.shape and found.dtype == values.dtype
    assert found.tobytes() == values.tobytes()


def test_it_is_a_copy(ad: Any) -> None:
    values = np.array(NUMBERS, np.float32)
    array = upload(ad.Float, values)
    values[:] = 7
    assert np.array(array)[2] == 1.5


@pytest.mark.parametrize("lengths", [[], [3], [0, 2, 0, 5], [4, 1]])
def test_arrays_and_vectors_one_after_the_other(ad: Any, lengths: list[int]) -> None:
    rng = np.random.default_rng(0)
    parts = [rng.random((3, n)).astype(np.float32) for n in lengths]
    whole = np.concatenate(parts, axis=1) if parts else np.empty((3, 0))
    numbers = joined(ad.Float, [ad.Float(part[0]) for part in parts])
    assert np.array_equal(np.array(numbers), whole[0])
    vector = vector3_type(ad.Float)
    vectors = joined(vector, [vector(*(ad.Float(x) for x in part)) for part in parts])
    assert [np.array(x).tolist() for x in vectors] == whole.tolist()
    index = joined(ad.UInt32, [dr.arange(ad.UInt32, n) for n in lengths])
    assert np.array(index).tolist() == [i for n in lengths for i in range(n)]
