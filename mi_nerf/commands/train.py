"""``mi-nerf train``: a run on a dataset, new or resumed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from ..api import start
from ..base.variants import choose_variant
from ..data import ImageKind
from .shared import Variant


@dataclass(frozen=True)
class Train:
    """Trains a radiance field on a dataset of posed images.

    Examples:

    mi-nerf train lego/ --out runs/lego

    mi-nerf train lego/ --out runs/quick --downscale 2 --max-seconds 120

    mi-nerf train lego/ --out runs/wide --set network.width=128 optimizer.lr=5e-3

    mi-nerf train lego/ --out runs/chosen --preset auto --max-seconds 300

    mi-nerf train lego/ --out runs/published --preset paper --steps 3000

    mi-nerf train hdr/ --out runs/hdr --images exr

    mi-nerf train lego/ --out runs/lego --resume
    """

    data: Positional[Annotated[Path, arg(metavar="DATA")]]
    """Folder of a dataset (images and transforms_train.json, or poses_bounds.npy)."""
    out: Path
    """Folder of the run; created."""
    preset: str = "nerf"
    """Starting point of all settings: nerf, fast, paper, or auto to choose the model itself."""
    max_seconds: float | None = None
    """Stop after so many seconds of wall-clock time (default 600 if --steps is not given; paper
    has a schedule of its own, 200,000 steps, if they take less than a day)."""
    steps: int | None = None
    """Stop after so many steps."""
    downscale: int = 1
    """Average images over blocks of K×K pixels."""
    images: ImageKind | None = None
    """The files to train on: png, 8-bit pictures, or exr, the linear radiance beside them; default:
    those that the dataset names."""
    seed: int = 0
    """Seed of initial weights, rays and samples."""
    resume: bool = False
    """Go on with the run in --out, with its own settings."""
    set: UseAppendAction[tuple[str, ...]] = ()
    """Change any setting: key=value, e.g. network.width=128; repeatable."""
    variant: Variant = None

    def run(self, started: float) -> None:
        """Trains."""
        run = start(
            self.data,
            self.out,
            preset=self.preset,
            max_seconds=self.max_seconds,
            steps=self.steps,
            downscale=self.downscale,
            images=self.images,
            seed=self.seed,
            settings=self.set,
            resume=self.resume,
            variant=choose_variant(self.variant),
            started=started,
        )
        said = [str(decision) for decision in run.decisions]
        print("".join(f"auto: {line}\n" for line in said), end="")
        print(f"model: {run.sizes}")
        if run.forecast is not None:
            print(f"{self.preset}: {run.forecast.sentence()}", flush=True)
        run.train()
        for line in map(str, run.decisions):  # what has become clear on the way
            if line not in said:
                print(f"auto: {line}")
        trainer = run.trainer
        hint = "" if run.progress >= 1 else "; stopped early, go on with --resume"
        print(f"{self.out}: {trainer.step_count} steps in {run.seconds:.0f} s{hint}")
