"""Pixels on the device against those on the host, of every type that files hold."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest

from mi_nerf.cameras.pinhole import Intrinsics
from mi_nerf.data import Dataset
from mi_nerf.images.read import average_blocks
from mi_nerf.training.pixels import Pixels

BYTES = {np.uint8: 4, np.uint16: 8, np.float16: 8, np.float32: 16}  # a pixel
TYPES = pytest.mark.parametrize("dtype", list(BYTES))


def views(dtype: Any, shape: tuple[int, int, int] = (3, 11, 13)) -> Dataset:
    """Random views, with opaque and with fully transparent pixels among them."""
    rng, whole = np.random.default_rng(5), np.dtype(dtype).kind == "u"
    high = int(np.iinfo(dtype).max) + 1 if whole else 40
    images = rng.integers(0, high, (*shape, 4)).astype(dtype)
    images[0, 0, 0], images[0, 1, 1] = 0, high - 1
    count, height, width = shape
    camera = Intrinsics.from_angle_x(width, height, 0.7)
    poses = np.tile(np.eye(4), (count, 1, 1))
    names = tuple(f"r_{i}" for i in range(count))
    return Dataset(Path("views"), "train", names, images, "srgb", True, poses, camera)


@TYPES
def test_every_pixel_is_as_on_the_host(ad: Any, dtype: Any) -> None:
    dataset = views(dtype)
    found = Pixels(dataset, ad.Float).at(dr.arange(ad.UInt32, 3 * 11 * 13))
    expected = dataset.premultiplied().reshape(-1, 4)
    assert np.stack([np.array(c) for c in found], axis=-1) == pytest.approx(expected, rel=3e-7)


@TYPES
def test_they_take_as_much_memory_as_in_their_files(ad: Any, dtype: Any) -> None:
    dataset = views(dtype)
    assert Pixels(dataset, ad.Float).nbytes == BYTES[dtype] * 3 * 11 * 13 == dataset.images.nbytes


@TYPES
@pytest.mark.parametrize("k", [1, 2, 4, 8])
def test_means_over_blocks(ad: Any, dtype: Any, k: int) -> None:
    dataset = views(dtype)
    expected = np.stack([average_blocks(dataset.image(i), k) for i in range(3)])
    view, row, column = np.unravel_index(np.arange(expected[..., 0].size), expected.shape[:3])
    first = ((view * 11 + row * k) * 13 + column * k).astype(np.uint32)
    found = Pixels(dataset, ad.Float).mean(ad.UInt32(first), dr.full(ad.UInt32, k, len(first)))
    found = np.stack([np.array(c) for c in found], axis=-1)
    assert found == pytest.approx(expected.reshape(-1, 4), rel=2e-6)


def test_blocks_of_different_sizes_side_by_side(ad: Any) -> None:
    dataset = views(np.uint8)
    first, side = [0, 15, 150, 300], [4, 1, 3, 2]
    found = Pixels(dataset, ad.Float).mean(ad.UInt32(first), ad.UInt32(side))
    for i, (start, k) in enumerate(zip(first, side, strict=True)):
        view, row, column = (int(n) for n in np.unravel_index(start, (3, 11, 13)))
        block = dataset.image(view)[row : row + k, column : column + k]
        expected = block.astype(np.float64).reshape(-1, 4).mean(axis=0)
        assert [c[i] for c in found] == pytest.approx(expected, rel=2e-6)
