"""Random rays from all images, gathered from camera matrices on the fly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from ..base.arrays import gather_vector3
from ..base.errors import InputError, Option
from ..base.kernel_stages import stage
from ..cameras.pinhole import pack_poses, pixel_rays
from ..data import Dataset

MOST_VALUES = 1 << 32  # which an index of 32 bits cannot tell apart any more


@dataclass
class RayBatch:
    """R rays and the premultiplied pixels they ought to see."""

    o: Any
    d: Any  # unit
    color: list[Any]  # three arrays of R values, premultiplied
    alpha: Any
    background: list[Any]  # what to place behind both, one value or R values a channel

    def part(self, start: int, rays: int) -> RayBatch:
        """``rays`` of the rays, from number ``start`` on."""
        if rays == len(self.alpha):
            return self
        index = dr.arange(dr.uint32_array_t(type(self.alpha)), rays)
        index += dr.opaque(type(index), start)

        def take(values: Any) -> Any:
            one = len(values) == 1
            return values if one else dr.gather(type(values), values, index)

        part = RayBatch(
            gather_vector3(self.o, index),
            gather_vector3(self.d, index),
            [take(c) for c in self.color],
            take(self.alpha),
            [take(c) for c in self.background],
        )
        with stage("rays"):
            dr.eval(part.o, part.d, part.color, part.alpha, part.background)
        return part


class RaySource:
    """Keeps a dataset's pixels and poses on the device and draws random rays."""

    def __init__(self, dataset: Dataset, background: str, float_type: Any) -> None:
        """``background`` is 'white', 'black' or 'random' (a new colour for every ray).

        Raises:
            InputError: for more values of pixels than 32 bits can number.
        """
        _require_indices(dataset)
        self._float, self._uint = float_type, dr.uint32_array_t(float_type)
        self._intrinsics = dataset.intrinsics
        self._pixels = float_type(dataset.images.reshape(-1))
        self._poses = float_type(pack_poses(dataset.cam_to_world))
        self._background = background
        self._views = len(dataset)

    def draw(self, rays: int, rng: Any, crop: float = 1.0) -> RayBatch:
        """``rays`` pixels chosen uniformly over all images, through their centres.

        ``crop`` leaves only the middle of the images, that share of their width and height.
        """
        full, uint = self._intrinsics, self._uint
        columns, rows = (max(1, round(crop * n)) for n in (full.width, full.height))
        width, area = dr.opaque(uint, columns), dr.opaque(uint, columns * rows)
        chosen = rng.integers(uint, rays, high=dr.opaque(uint, self._views * columns * rows))
        camera = chosen // area
        within = chosen - camera * area
        row = within // width
        column = within - row * width + dr.opaque(uint, (full.width - columns) // 2)
        row = row + dr.opaque(uint, (full.height - rows) // 2)
        x, y = self._float(column) + 0.5, self._float(row) + 0.5
        pixel = (camera * dr.opaque(uint, full.height) + row) * dr.opaque(uint, full.width) + column
        o, d = pixel_rays(self._poses, self._intrinsics, camera, x, y)
        rgba = [dr.gather(self._float, self._pixels, pixel * 4 + i) for i in range(4)]
        batch = RayBatch(o, d, rgba[:3], rgba[3], self._draw_background(rays, rng))
        dr.eval(batch.o, batch.d, batch.color, batch.alpha, batch.background)
        return batch

    def _draw_background(self, rays: int, rng: Any) -> list[Any]:
        if self._background == "random":
            return [rng.random(self._float, rays) for _ in range(3)]
        value = 1.0 if self._background == "white" else 0.0
        return [dr.opaque(self._float, value) for _ in range(3)]


def _require_indices(dataset: Dataset) -> None:
    """Refuses more values than there are indices, before Dr.Jit does it without advice."""
    size, count = dataset.intrinsics, dataset.images.size
    if count >= MOST_VALUES:
        raise InputError(
            "{}: {} views of {}x{} hold {} values, expected less than {} by a larger {}",
            dataset.path,
            len(dataset),
            size.width,
            size.height,
            count,
            MOST_VALUES,
            Option("downscale"),
        )


def blank_loss(dataset: Dataset, background: str) -> float:
    """Mean squared error of a field that has collapsed: empty space, or one even colour.

    Whichever is smaller; a field that has learnt anything stays below a good part of it.
    """
    stride = max(1, dataset.images.size // 4_000_000)
    pixels = dataset.images.reshape(-1, 4)[::stride].astype(np.float64)
    color, alpha = pixels[:, :3], pixels[:, 3:]
    if background == "random":  # the mean over all backgrounds, uniform in [0, 1]
        empty = np.mean(np.square(color - alpha / 2)) + np.mean(np.square(alpha)) / 12
        return float(empty)
    behind = 1.0 if background == "white" else 0.0
    empty = np.mean(np.square(color - alpha * behind))
    even = np.mean(np.var(color + (1 - alpha) * behind, axis=0))
    return float(min(empty, even) if empty > 0 else even)


def step_rng(float_type: Any, seed: int, step: int) -> Any:
    """The generator of one training step: all its randomness follows from seed and step."""
    return dr.rng(seed=dr.opaque(dr.uint64_array_t(float_type), (seed << 32) + step))
