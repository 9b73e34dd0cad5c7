"""Pixels as stored, and as numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mi_nerf.images.stored import empty_stack, is_stored, premultiplied, with_alpha


@given(st.sampled_from([np.uint8, np.uint16]).flatmap(lambda t: arrays(t, (3, 2, 4))))
def test_integers_are_straight_over_their_full_range(stored: Any) -> None:
    straight = stored.astype(np.float64) / np.iinfo(stored.dtype).max
    expected = np.concatenate([straight[..., :3] * straight[..., 3:], straight[..., 3:]], axis=-1)
    found = premultiplied(stored)
    assert found.dtype == np.float32
    assert found == pytest.approx(expected, rel=2e-7, abs=0)


def test_floats_are_premultiplied_already() -> None:
    half = np.linspace(0, 70, 24, dtype=np.float16).reshape(2, 3, 4)
    assert np.array_equal(premultiplied(half), half.astype(np.float32))
    single = half.astype(np.float32)
    assert premultiplied(single) is single


def test_three_channels_are_opaque() -> None:
    values = np.arange(18, dtype=np.uint16).reshape(2, 3, 3)
    opaque = with_alpha(values)
    assert np.array_equal(opaque[..., :3], values) and (opaque[..., 3] == 65535).all()
    assert with_alpha(opaque) is opaque


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float16, np.float32])
def test_room_starts_at_a_cache_line(dtype: Any) -> None:
    stack = empty_stack((3, 5, 7, 4), dtype)
    assert stack.shape == (3, 5, 7, 4) and stack.dtype == dtype
    assert stack.ctypes.data % 64 == 0 and stack.flags.c_contiguous
    assert is_stored(stack.dtype)


def test_signed_numbers_are_no_pixels() -> None:
    assert not is_stored(np.dtype(np.int8)) and not is_stored(np.dtype(np.uint32))
