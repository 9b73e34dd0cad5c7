"""The learning rate over a run."""

from __future__ import annotations

from .config import OptimizerConfig


def learning_rate(options: OptimizerConfig, progress: float, step: int) -> float:
    """Linear warm-up by steps, then exponential decay from ``lr`` to ``lr_final``.

    Args:
        progress: share of the run's budget that is spent, 0 to 1.
        step: steps taken since the weights were initialised.
    """
    warm = min(1.0, (step + 1) / options.warmup) if options.warmup > 0 else 1.0
    return warm * options.lr * (options.lr_final / options.lr) ** progress
