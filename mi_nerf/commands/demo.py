"""``mi-nerf demo``: the whole job on a small scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..base.variants import choose_variant
from ..tasks.demo import run_demo
from .shared import Variant, positive, valid_seed


@dataclass(frozen=True)
class Demo:
    """The whole job on a small scene: path-traces images, trains, evaluates, compares.

    Examples:

    mi-nerf demo

    mi-nerf demo --out /tmp/demo
    """

    out: Path | None = None
    """Folder for everything it makes; default: mi-nerf-demo, or the next free such name."""
    seconds: float = 45.0
    """Training time."""
    seed: int = 0
    """Seed of images and training."""
    variant: Variant = None

    def run(self, started: float) -> None:
        """Runs the demo."""
        run_demo(
            self.out,
            choose_variant(self.variant),
            seconds=positive("seconds", self.seconds),
            seed=valid_seed(self.seed),
        )
