"""Bits of an occupancy grid: which cells are occupied, and how large empty bricks are."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest

from mi_nerf.march.bit_field import BitField


def slow_look(mask: np.ndarray, cell: np.ndarray) -> int:
    """Binary logarithm of the edge of the largest empty brick of 4^k cells, −1 if occupied."""
    edge = -1
    for level in range(8):
        lower = (cell >> 2 * level) << 2 * level
        x, y, z = (slice(a, a + (1 << 2 * level)) for a in lower)
        if mask[x, y, z].any() or (level > 0 and (1 << 2 * level) >= 4 * max(mask.shape)):
            break
        edge = 2 * level
    return edge


@pytest.mark.parametrize(
    ("shape", "share"),
    [((1, 1, 1), 1.0), ((1, 1, 1), 0.0), ((4, 4, 4), 0.1), ((5, 3, 17), 0.02), ((33, 7, 18), 3e-3)],
)
def test_every_cell(ad: Any, shape: tuple[int, ...], share: float) -> None:
    rng = np.random.default_rng(1)
    mask = rng.random(shape) < share
    bits = BitField(ad.Float(mask.ravel().astype(np.float32)) != 0, shape)
    cells = np.argwhere(np.ones(shape, bool)).astype(np.uint32)
    occupied, edge = bits.look([ad.UInt32(c) for c in cells.T])
    assert np.array_equal(np.array(occupied), mask.ravel())
    levels = 1
    while 4**levels < max(shape):
        levels += 1
    expected = np.array([min(slow_look(mask, c), 2 * (levels - 1)) for c in cells.astype(int)])
    found = np.where(mask.ravel(), -1, np.array(edge).astype(int) * np.ones(len(cells), int))
    assert np.array_equal(found, expected)
    dr.sync_thread()
