"""Random rays from all images, gathered from camera matrices on the fly."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from ..base.arrays import gather_vector3, taken
from ..base.kernel_stages import stage
from ..cameras.pinhole import Intrinsics, pack_poses, pixel_rays
from ..data import Dataset, evenly_spread_indices
from ..images.metrics import tone_mapped
from ..images.read import average_blocks
from ..images.stored import premultiplied
from .config import PyramidConfig
from .pixels import Pixels

_COARSE_VIEWS = 16  # that stand for all views


@dataclass
class RayBatch:
    """R rays and the premultiplied pixels they ought to see."""

    o: Any
    d: Any  # unit
    color: list[Any]  # three arrays of R values, premultiplied
    alpha: Any
    background: list[Any]  # what to place behind both, one value or R values a channel

    @property
    def rays(self) -> int:
        """R."""
        return len(self.alpha)

    def part(self, start: int, rays: int) -> RayBatch:
        """``rays`` of the rays, from number ``start`` on."""
        if rays == self.rays:
            return self
        index = dr.arange(dr.uint32_array_t(type(self.alpha)), rays)
        return self.at(index + dr.opaque(type(index), start))

    def at(self, index: Any) -> RayBatch:
        """The rays of these numbers."""
        part = RayBatch(
            gather_vector3(self.o, index),
            gather_vector3(self.d, index),
            [taken(c, index) for c in self.color],
            taken(self.alpha, index),
            [taken(c, index) for c in self.background],
        )
        with stage("rays"):
            dr.eval(part.o, part.d, part.color, part.alpha, part.background)
        return part


@dataclass
class _Pixel:
    """A pixel a ray: its view, the point of the film that the ray goes through, its RGBA."""

    camera: Any
    x: Any
    y: Any
    rgba: list[Any]


class RaySource:
    """Keeps a dataset's pixels and poses on the device and draws random rays.

    Rays go through pixels of the images, or of coarser ones whose pixels are means over
    blocks: level l averages 2^l×2^l pixels.
    """

    def __init__(
        self,
        dataset: Dataset,
        background: str,
        float_type: Any,
        pyramid: PyramidConfig | None = None,
    ) -> None:
        """
        Args:
            background: 'white', 'black' or 'random' (a new colour for every ray).
            pyramid: coarser levels to draw from, too; none: the images alone.

        Raises:
            InputError: for more values of pixels than 32 bits can number.
        """
        self._float, self._uint = float_type, dr.uint32_array_t(float_type)
        self._intrinsics = dataset.intrinsics
        self._pixels = Pixels(dataset, float_type)
        self._poses = float_type(pack_poses(dataset.cam_to_world))
        self._background = background
        self._views = len(dataset)
        self._chosen: Any = None  # numbers of the views to draw from; none: all
        self._pyramid = pyramid or PyramidConfig()

    @property
    def nbytes(self) -> int:
        """Memory that the pixels take."""
        return self._pixels.nbytes

    def of_views(self, views: Sequence[int]) -> RaySource:
        """A source of some of the views; it shares the pixels."""
        some = copy.copy(self)
        some._views, some._chosen = len(views), self._uint(list(views))
        return some

    def draw(self, rays: int, rng: Any, crop: float = 1.0, level: float = 0.0) -> RayBatch:
        """``rays`` pixels chosen uniformly over all images, through their centres.

        Args:
            crop: leaves only the middle of the images, that share of their width and height.
            level: of the images; 1.25 means level 2 for a quarter of the rays, 1 for others.
        """
        if self._pyramid.levels:
            pixel = self._coarse_pixel(rays, rng, crop, level)
        else:
            pixel = self._pixel(rays, rng, crop)
        o, d = pixel_rays(self._poses, self._intrinsics, pixel.camera, pixel.x, pixel.y)
        rgba = pixel.rgba
        batch = RayBatch(o, d, rgba[:3], rgba[3], self._draw_background(rays, rng))
        dr.eval(batch.o, batch.d, batch.color, batch.alpha, batch.background)
        return batch

    def _pixel(self, rays: int, rng: Any, crop: float) -> _Pixel:
        full, uint = self._intrinsics, self._uint
        columns, rows, left, top = _window(full, crop)
        width, area = dr.opaque(uint, columns), dr.opaque(uint, columns * rows)
        chosen = rng.integers(uint, rays, high=dr.opaque(uint, self._views * columns * rows))
        number = chosen // area
        within, camera = chosen - number * area, self._camera(number)
        row = within // width
        column = within - row * width + dr.opaque(uint, left)
        row = row + dr.opaque(uint, top)
        x, y = self._float(column) + 0.5, self._float(row) + 0.5
        pixel = (camera * dr.opaque(uint, full.height) + row) * dr.opaque(uint, full.width) + column
        return _Pixel(camera, x, y, self._pixels.at(pixel))

    def _coarse_pixel(self, rays: int, rng: Any, crop: float, level: float) -> _Pixel:
        """One of the pixels of the level that each ray draws; a remainder is cropped."""
        full, uint = self._intrinsics, self._uint
        columns, rows, left, top = _window(full, crop)
        octave = self._draw_levels(rays, rng, level)
        side = uint(1) << octave
        width, height = (dr.opaque(uint, n) >> octave for n in (columns, rows))
        area = width * height
        dr.eval(area, octave)
        chosen = rng.integers(uint, rays, high=area * dr.opaque(uint, self._views))
        number = chosen // area
        within, camera = chosen - number * area, self._camera(number)
        row = within // width
        column = (within - row * width) * side + dr.opaque(uint, left)
        row = row * side + dr.opaque(uint, top)
        first = (camera * dr.opaque(uint, full.height) + row) * dr.opaque(uint, full.width) + column
        extent = self._float(side)
        x, y = (self._float(n) + 0.5 * extent for n in (column, row))
        if self._pyramid.jitter:
            reach = dr.select(octave > 0, extent, 0)
            x, y = (n + (rng.random(self._float, rays) - 0.5) * reach for n in (x, y))
        return _Pixel(camera, x, y, self._pixels.mean(first, side))

    def _camera(self, number: Any) -> Any:
        """The view that is so many among those to draw from."""
        return number if self._chosen is None else dr.gather(self._uint, self._chosen, number)

    def _draw_levels(self, rays: int, rng: Any, level: float) -> Any:
        """The level of each ray: one of the two beside ``level``, or any for a mixed share."""
        levels, mixed = self._pyramid.levels or 0, self._pyramid.mixed
        here = dr.floor(dr.opaque(self._float, level) + rng.random(self._float, rays))
        if mixed > 0:
            chance = rng.random(self._float, rays) / mixed
            here = dr.select(chance < 1, dr.floor(chance * (levels + 1)), here)
        return self._uint(dr.clip(here, 0, levels))

    def _draw_background(self, rays: int, rng: Any) -> list[Any]:
        if self._background == "random":
            return [rng.random(self._float, rays) for _ in range(3)]
        value = 1.0 if self._background == "white" else 0.0
        return [dr.opaque(self._float, value) for _ in range(3)]


def _window(film: Intrinsics, crop: float) -> tuple[int, int, int, int]:
    """Columns and rows of the middle of the film, and its first of each."""
    columns, rows = (max(1, round(crop * n)) for n in (film.width, film.height))
    return columns, rows, (film.width - columns) // 2, (film.height - rows) // 2


def blank_loss(dataset: Dataset, background: str, level: int = 0, loss: str = "mse") -> float:
    """Mean squared error of a field that has collapsed: empty space, or one even colour.

    Whichever is smaller; a field that has learnt anything stays below a good part of it.

    Args:
        level: the coarsest of a pyramid, whose pixels differ least.
        loss: ``relative`` for the error after tone mapping, which goes with that loss.
    """
    pixels = _some_pixels(dataset, level).astype(np.float64)
    color, alpha = pixels[:, :3], pixels[:, 3:]
    if loss == "relative":
        return _blank_tone_mapped(color, alpha, background)
    if background == "random":  # the mean over all backgrounds, uniform in [0, 1]
        empty = np.mean(np.square(color - alpha / 2)) + np.mean(np.square(alpha)) / 12
        return float(empty)
    behind = 1.0 if background == "white" else 0.0
    empty = np.mean(np.square(color - alpha * behind))
    even = np.mean(np.var(color + (1 - alpha) * behind, axis=0))
    return float(min(empty, even) if empty > 0 else even)


def _blank_tone_mapped(
    color: np.ndarray[Any, Any], alpha: np.ndarray[Any, Any], background: str
) -> float:
    """Before random backgrounds, it is the premultiplied radiance that is compared."""
    behind = 1.0 if background == "white" else 0.0
    seen = tone_mapped(color + (1 - alpha) * behind)
    empty = float(np.mean(np.square(seen - tone_mapped(behind))))
    even = float(np.mean(np.var(seen, axis=0)))
    return empty if background == "random" else min(empty, even) if empty > 0 else even


def _some_pixels(dataset: Dataset, level: int) -> np.ndarray[Any, Any]:
    """About a million pixels at most from all views, or those of some views of a coarse level."""
    if level == 0:
        stride = max(1, dataset.images.size // 4_000_000)
        return premultiplied(dataset.images.reshape(-1, 4)[::stride])
    some = evenly_spread_indices(len(dataset), _COARSE_VIEWS)
    means = [average_blocks(dataset.image(i), 1 << level) for i in some]
    return np.concatenate([m.reshape(-1, 4) for m in means])


def step_rng(float_type: Any, seed: int, step: int) -> Any:
    """The generator of one training step: all its randomness follows from seed and step."""
    return dr.rng(seed=dr.opaque(dr.uint64_array_t(float_type), (seed << 32) + step))
