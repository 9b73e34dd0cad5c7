"""What changes over a run: the learning rate, and how sharp the images are."""

from __future__ import annotations

import math

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
