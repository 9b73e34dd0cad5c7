"""``mi-nerf ablate``: the rows of the paper's Table 2 on one dataset."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from ..base.variants import choose_variant
from ..tasks.ablate import ROWS, ablate, table
from ..training.config import with_settings
from ..training.presets import preset
from .shared import ExecutorName, Variant, Workers, budget, positive


@dataclass(frozen=True)
class Ablate:
    """Measures what each part of the model is worth (NeRF, Table 2), on one dataset.

    Calling it again goes on where it was interrupted, or adds seeds and rows.

    Examples:

    mi-nerf ablate lego/ --out ablation/ --downscale 2 --max-seconds 300 --seeds 3

    mi-nerf ablate lego/ --out quick/ --rows no-pe no-vd complete --downscale 4 --steps 2000

    mi-nerf ablate lego/ --out octaves/ --rows L=4 L=6 L=8 L=10 L=12 --max-seconds 120
    """

    data: Positional[Annotated[Path, arg(metavar="DATA")]]
    """Folder of a dataset."""
    out: Path
    """Folder of the runs, the table (ablation.md, ablation.json) and the figure."""
    rows: tuple[str, ...] = tuple(ROWS)
    """Which rows of the table; L=N for N octaves of the position."""
    seeds: int = 1
    """Runs of each row, with seeds from 0."""
    preset: str = "nerf"
    """Scale of the model: nerf, or paper for the published one."""
    max_seconds: float | None = None
    """Training time of each run (default 300 if --steps is not given)."""
    steps: int | None = None
    """Training steps of each run."""
    downscale: int = 1
    """Average images over blocks of K×K pixels."""
    split: str = "test"
    """Views to evaluate on."""
    views: int | None = None
    """Only so many of them, evenly spread."""
    set: UseAppendAction[tuple[str, ...]] = ()
    """Change any setting of all rows: key=value; repeatable."""
    workers: Workers = 0
    executor: ExecutorName = None
    variant: Variant = None

    def run(self, _started: float) -> None:
        """Trains and evaluates all rows."""
        config = with_settings(preset(self.preset), list(self.set))
        config = replace(config, downscale=positive("downscale", self.downscale))
        config = replace(config, **budget(self.max_seconds, self.steps, usual=300.0))
        if self.views is not None:
            positive("views", self.views)
        record = ablate(
            self.data,
            self.out,
            config,
            choose_variant(self.variant),
            rows=self.rows,
            seeds=positive("seeds", self.seeds),
            split=self.split,
            views=self.views,
            workers=self.workers,
            executor=self.executor,
        )
        print(table(record))
        if not record["complete"]:
            print(f"{self.out}: interrupted, the same command goes on")
            raise KeyboardInterrupt
