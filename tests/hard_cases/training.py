"""Rows 19 and 20: what is trained on, and for how long."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import drjit as dr
import numpy as np

from mi_nerf.data import Dataset
from mi_nerf.training.config import OptimizerConfig, TrainConfig
from mi_nerf.training.losses import relative_error, squared_error
from mi_nerf.training.run import Run
from mi_nerf.training.schedule import learning_rate
from tests.hard_cases import Finding
from tests.support import naive

STEPS = 100_000


def hdr_targets(ad: Any) -> list[Finding]:
    """Row 19: radiances from 1e-2 to 1e4, all of them predicted 10 % too bright."""
    target = np.logspace(-2, 4, 7).astype(np.float32)

    def shares(loss: Callable[..., Any]) -> tuple[float, float]:
        exponent = ad.Float(np.log(1.1 * target))
        dr.enable_grad(exponent)
        value = loss([dr.exp(exponent)] * 3, [ad.Float(target)] * 3)
        dr.backward(value)
        found, slopes = np.array(dr.detach(value)), np.abs(np.array(dr.grad(exponent)))
        return float(found.max() / found.min()), float(slopes.max() / slopes.min())

    what = (
        "loss of the brightest pixel over that of the darkest (1 is best)",
        "the same of its slope by log(radiance)",
    )
    pairs = zip(what, shares(squared_error), shares(relative_error), strict=True)
    return [Finding(*pair) for pair in pairs]


def many_steps(ad: Any) -> list[Finding]:
    """Row 20: rates from 1e-2 to 1e-4 over 1e5 steps, by what a run says of its progress."""
    options = OptimizerConfig(lr=1e-2, lr_final=1e-4, warmup=0)
    config = replace(TrainConfig(), steps=STEPS, max_seconds=None, optimizer=options)
    trainer: Any = SimpleNamespace(config=config, step_count=0, blank_loss=0.0)
    run = Run(Path(), config, cast(Dataset, None), "llvm_ad_rgb", trainer=trainer)
    errors = []
    for step in range(STEPS // 100, STEPS + 1, STEPS // 100):
        trainer.step_count = step
        exact = 10.0 ** (-2 - 2 * step / STEPS)
        for progress in (naive.summed_progress(STEPS, step), run.progress):
            errors.append(abs(learning_rate(options, progress, step) / exact - 1))
    largest = max(errors[::2]), max(errors[1::2])
    return [Finding("largest relative error of the learning rate on the way", *largest)]
