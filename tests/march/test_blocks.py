"""Blocks of a constant size: all entries once, and no more sizes than need be."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerf.base.arrays import upload
from mi_nerf.march.blocks import blocks, ranges


@given(st.integers(0, 500), st.integers(1, 50), st.one_of(st.none(), st.integers(1, 80)))
def test_ranges(count: int, block: int, tail: int | None) -> None:
    found, end = list(ranges(count, block, tail)), 0
    small = min(tail or block, block)
    for start, size in found:
        assert start == end and size in (block, small)
        end = start + size
    assert count <= end < count + max(small, 1)
    assert [s for _, s in found] == sorted((s for _, s in found), reverse=True)


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 23])
def test_blocks_of_an_index(ad: Any, count: int) -> None:
    index = np.random.default_rng(count).integers(1, 1000, count).astype(np.uint32)
    entries = np.zeros(0, np.uint32)
    for slot, valid, where in blocks(upload(ad.UInt, index), 8):
        assert len(slot) == len(valid) == len(where) == 8
        assert np.array_equal(np.array(slot) < count, np.array(valid))
        assert not np.array(where)[~np.array(valid)].any()
        entries = np.concatenate([entries, np.array(where)[np.array(valid)]])
    assert np.array_equal(entries, index)
