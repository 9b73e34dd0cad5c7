"""What the user sees while a run goes on: figures and a bar."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from ..base.progress_bar import bars_are_seen, progress_bar
from .config import TrainConfig
from .trainer import StepResult


class Meter:
    """Means over the steps since the last report."""

    def __init__(self) -> None:
        self._losses: list[float] = []
        self._errors: list[float] = []
        self._rays = self._queries = 0
        self._start = time.monotonic()

    def add(self, loss: float, mse: float, result: StepResult) -> None:
        self._losses.append(loss)
        self._errors.append(mse)
        self._rays += int(result.rays[0])
        self._queries += result.queries

    def pause(self, seconds: float) -> None:
        """Leaves out time that has passed without training."""
        self._start += seconds

    def summary(self) -> dict[str, Any]:
        elapsed = max(time.monotonic() - self._start, 1e-9)
        mse = float(np.mean(self._errors)) if self._errors else math.nan
        return {
            "loss": float(np.mean(self._losses)) if self._losses else None,
            "psnr": -10 * math.log10(mse) if mse > 0 else None,
            "samples_per_ray": self._queries / max(self._rays, 1),
            "rays": self._rays,
            "samples_per_second": self._queries / elapsed,
        }


class ProgressBar:
    """A bar on a terminal, a quiet line now and then elsewhere."""

    def __init__(self, config: TrainConfig, initial: float, show: bool) -> None:
        by_time = config.max_seconds is not None
        self._scale = float(config.max_seconds or config.steps or 1)
        self._bar = progress_bar(
            "train",
            "s" if by_time else "step",
            round(self._scale, 1),
            show=show,
            initial=round(initial * self._scale, 1),
            bar_format="{desc} {percentage:3.0f}%|{bar}| {n:.0f}/{total:.0f} {unit}{postfix}",
        )
        self._lines = show and not bars_are_seen()
        self._last_line = -math.inf

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def update(self, progress: float, line: dict[str, Any], final: bool) -> None:
        loss, psnr = line["loss"], line["psnr"]
        text = (
            f"loss {loss:.5f}, psnr {psnr:.2f} dB, " if loss is not None and psnr else ""
        ) + f"{line['samples_per_second'] / 1e3:.0f}k samples/s"
        self._bar.set_postfix_str(text, refresh=False)
        self._bar.n = progress * self._scale
        self._bar.refresh()
        if self._lines and (line["seconds"] - self._last_line >= 10 or progress >= 1 or final):
            print(f"step {line['step']}, {line['seconds']:.0f} s: {text}", flush=True)
            self._last_line = line["seconds"]
