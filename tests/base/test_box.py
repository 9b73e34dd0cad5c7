"""Boxes: their corners."""

from __future__ import annotations

import numpy as np

from mi_nerf.base.box import corners


def test_corners() -> None:
    found = corners((-1, 0, 2), (1, 3, 5))
    expected = [(x, y, z) for x in (-1, 1) for y in (0, 3) for z in (2, 5)]
    assert found.tolist() == np.array(expected, float).tolist()
