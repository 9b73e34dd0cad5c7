"""Rays drawn from the pixels of a dataset."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.cameras.pinhole import Intrinsics
from mi_nerf.commands.shared import flag
from mi_nerf.data import Dataset
from mi_nerf.training import batches
from mi_nerf.training.batches import RaySource, step_rng


def views(width: int, height: int) -> Dataset:
    """One black view that takes no memory, whatever its size."""
    images = np.broadcast_to(np.float32(0), (1, height, width, 4))
    camera = Intrinsics.from_angle_x(width, height, 0.7)
    return Dataset(Path("huge"), "train", ("r_0",), images, "srgb", True, np.eye(4)[None], camera)


def test_more_values_than_an_index_can_tell_apart(ad: Any) -> None:
    with pytest.raises(InputError) as refused:
        RaySource(views(1 << 15, 1 << 15), "white", ad.Float)
    assert str(refused.value) == (
        "huge: 1 views of 32768x32768 hold 4294967296 values, expected less than 4294967296 "
        "by a larger downscale"
    )
    assert refused.value.told(flag).endswith("a larger --downscale")


def test_one_value_less_is_drawn_from(ad: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batches, "MOST_VALUES", 101)
    drawn = RaySource(views(5, 5), "white", ad.Float).draw(7, step_rng(ad.Float, 0, 0))
    assert len(drawn.alpha) == 7
    monkeypatch.setattr(batches, "MOST_VALUES", 100)
    with pytest.raises(InputError, match="hold 100 values, expected less than 100"):
        RaySource(views(5, 5), "white", ad.Float)
