"""Rows 19 and 20: what is trained on, and for how long."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from mi_nerf.training.config import OptimizerConfig
from mi_nerf.training.losses import relative_error, squared_error
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
    """Row 20: the end of a schedule of 1e5 steps."""
    options = OptimizerConfig(lr=1e-2, lr_final=1e-4, warmup=0)
    progress = (naive.summed_progress(STEPS), STEPS / STEPS)
    errors = [abs(learning_rate(options, p, STEPS) / 1e-4 - 1) for p in progress]
    return [Finding("relative error of the last learning rate", *errors)]
