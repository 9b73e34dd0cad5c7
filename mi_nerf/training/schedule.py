"""What changes over a run: the learning rate, and how sharp the images are."""

from __future__ import annotations

import math

from ..fields.hash_grid import HashGridConfig
from .config import OptimizerConfig, PyramidConfig


def learning_rate(options: OptimizerConfig, progress: float, step: int) -> float:
    """Linear warm-up by steps, then decay from ``lr`` to ``lr_final``.

    Exponentially, linearly, or along half a cosine (Loshchilov & Hutter 2017).

    Args:
        progress: share of the run's budget that is spent, 0 to 1.
        step: steps taken since the weights were initialised.
    """
    warm = min(1.0, (step + 1) / options.warmup) if options.warmup > 0 else 1.0
    first, last = options.lr, options.lr_final
    if options.schedule == "exponential":
        return warm * first * (last / first) ** progress
    left = 1 - progress
    if options.schedule == "cosine":
        left = (1 + math.cos(math.pi * progress)) / 2
    return warm * (last + (first - last) * left)


def image_level(options: PyramidConfig, progress: float) -> float:
    """The level of the pyramid that rays see: ``levels`` at first, 0 from ``until`` on."""
    left = 1 - progress / options.until if options.until > 0 else 0.0
    return (options.levels or 0) * max(0.0, left)


def grid_level_weights(
    options: PyramidConfig, grid: HashGridConfig, progress: float
) -> list[float]:
    """How much each level of a grid counts: one joins as the images come to resolve it.

    The weight rises from 0 to 1, linearly in octaves, while the finest resolution that the
    images call for grows from that of the level before to the level's own (a window as in
    Park et al. 2021, Nerfies). The first level always counts.
    """
    finest = grid.coarsest if grid.finest is None else grid.finest
    octaves = math.log2(finest / grid.coarsest) - image_level(options, progress)
    step = math.log2(grid.growth())
    if step == 0:
        return [1.0] * grid.levels
    reached = 1 + octaves / step
    return [1.0, *(min(1.0, max(0.0, reached - i)) for i in range(1, grid.levels))]
