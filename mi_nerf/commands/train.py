"""``mi-nerf train``: a run on a dataset, new or resumed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from ..backend import choose_variant
from ..errors import InputError
from ..training import run as training
from ..training.config import with_settings
from ..training.presets import preset
from .shared import Variant, positive, valid_seed


@dataclass(frozen=True)
class Train:
    """Trains a radiance field on a dataset of posed images.

    Examples:

    mi-nerf train lego/ --out runs/lego

    mi-nerf train lego/ --out runs/quick --downscale 2 --max-seconds 120

    mi-nerf train lego/ --out runs/wide --set network.width=128 optimizer.lr=5e-3

    mi-nerf train lego/ --out runs/chosen --preset auto --max-seconds 300

    mi-nerf train lego/ --out runs/lego --resume
    """

    data: Positional[Annotated[Path, arg(metavar="DATA")]]
    """Folder of a dataset (images and transforms_train.json, or poses_bounds.npy)."""
    out: Path
    """Folder of the run; created."""
    preset: str = "nerf"
    """Starting point of all settings: nerf, fast, paper, or auto to choose the model itself."""
    max_seconds: float | None = None
    """Stop after so many seconds of wall-clock time (default 600 if --steps is not given)."""
    steps: int | None = None
    """Stop after so many steps."""
    downscale: int = 1
    """Average images over blocks of K×K pixels."""
    seed: int = 0
    """Seed of initial weights, rays and samples."""
    resume: bool = False
    """Go on with the run in --out, with its own settings."""
    set: UseAppendAction[tuple[str, ...]] = ()
    """Change any setting: key=value, e.g. network.width=128; repeatable."""
    variant: Variant = None

    def run(self, started: float) -> None:
        """Trains."""
        config = preset(self.preset)
        config = replace(
            config, seed=valid_seed(self.seed), downscale=positive("downscale", self.downscale)
        )
        config = with_settings(config, list(self.set))
        limits = {"steps": self.steps, "max_seconds": self.max_seconds}
        for name, value in limits.items():
            if value is not None:
                config = replace(config, **{name: positive(name.replace("_", "-"), value)})
        if not self.resume and config.steps is None and config.max_seconds is None:
            config = replace(config, max_seconds=600.0)
        if self.resume and (self.out / training.CONFIG).exists():
            self._require_same_settings()
        run = training.start(
            self.data,
            self.out,
            config,
            choose_variant(self.variant),
            resume=self.resume,
            started=started,
            given={assignment.partition("=")[0] for assignment in self.set},
        )
        for decision in run.decisions:
            print(f"auto: {decision}")
        run.train()
        trainer = run.trainer
        hint = "" if run.progress >= 1 else "; stopped early, go on with --resume"
        print(f"{self.out}: {trainer.step_count} steps in {run.seconds:.0f} s{hint}")

    def _require_same_settings(self) -> None:
        """Refuses options that a resumed run, which keeps its settings, would ignore."""
        recorded, _ = training.read_config(self.out)
        wanted = with_settings(recorded, list(self.set))
        for name, default in (("preset", "nerf"), ("seed", 0), ("downscale", 1)):
            if getattr(self, name) != default:
                wanted = replace(wanted, **{name: getattr(self, name)})
        wanted = replace(wanted, steps=recorded.steps, max_seconds=recorded.max_seconds)
        if wanted != recorded:
            raise InputError(
                f"{self.out}: a resumed run keeps its settings, expected no other --preset, "
                "--seed, --downscale or --set than it was started with"
            )
