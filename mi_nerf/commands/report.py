"""``mi-nerf report``: tables and plots about a field, or about trainings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from tqdm import tqdm
from tyro.conf import Positional, UseAppendAction, arg

from ..base.errors import InputError
from ..base.variants import choose_variant
from ..march.rules import Rule
from ..report import Knobs, report, report_training, rows_of
from ..report.curves_text import conclusions
from ..report.profile import summary
from ..report.subject import RAYS
from .shared import (
    ExecutorName,
    Variant,
    Workers,
    budget,
    name_and_value,
    positive,
    progress_bar,
    valid_seed,
)

_KNOBS = Knobs()


@dataclass(frozen=True, kw_only=True)
class Report:
    """Speed against error: of a field with many settings, or of trainings over time.

    Of a field: quadrature error against a reference and model error against held-out images, for
    samples a ray, rules, early termination and occupancy grids; the colour of points over all
    directions; where a training step's time goes. With --train: PSNR against seconds.

    Examples:

    mi-nerf report runs/lego --out report/

    mi-nerf report shell --set density=20 edge=0.01 --out report/

    mi-nerf report lego.safetensors --data lego/ --out report/ --samples 32 64 --stops 0 0.01

    mi-nerf report --train lego/ --out curves/ --presets nerf fast --seeds 3 --max-seconds 60

    mi-nerf report --train lego/ --out widths/ --presets nerf --vary network.width=32,64,128
    """

    target: Positional[Annotated[Path | None, arg(metavar="TARGET")]] = None
    """A run folder, a field file, or a formula: slab, two_color, fog, ramp, step, sheet,
    gaussian or shell."""
    out: Path
    """Folder for report.md, report.json and the plots; of trainings, also for the runs."""
    speed: bool = True
    """Sweep the settings of rendering."""
    profile: bool = True
    """Train on for some steps, in memory only, to measure them; runs only."""
    point: UseAppendAction[tuple[tuple[float, float, float], ...]] = ()
    """A point whose emission is drawn; repeatable. Default: three that the cameras see."""
    data: Path | None = None
    """Dataset to compare with; default: that of the run."""
    split: str | None = None
    """Held-out views; default: test, or what there is beside train."""
    views: int = 10
    """So many of them, evenly spread."""
    downscale: int | None = None
    """Average images over blocks of K×K pixels; default: as the run was trained, 1 to train."""
    rays: int = RAYS
    """Rays that are rendered, drawn from all pixels of these views."""
    repeats: int = 7
    """Timed renderings with each setting."""
    samples: tuple[int, ...] = _KNOBS.samples
    """Strata a ray, with each of the rules."""
    rules: tuple[Rule, ...] = _KNOBS.rules
    """Rules of quadrature; cells is the same as constant without jitter."""
    splits: tuple[float, ...] = _KNOBS.splits
    """Shares of a ray's queries that the coarse network makes; fields with two networks only."""
    stops: tuple[float, ...] = _KNOBS.stops
    """Transmittances at which rays end; 0: never."""
    resolutions: tuple[int, ...] = _KNOBS.resolutions
    """Cells of occupancy grids along the longest side."""
    thresholds: tuple[float, ...] = _KNOBS.thresholds
    """Optical thicknesses below which a cell counts as empty."""
    train: Annotated[Path | None, arg(metavar="DATA")] = None
    """Instead of a target: a dataset to train on."""
    presets: tuple[str, ...] = ("nerf", "fast")
    """What is trained."""
    vary: UseAppendAction[tuple[str, ...]] = ()
    """Train with each of several values of a setting: key=value,value; repeatable."""
    seeds: int = 3
    """Trainings of each model, with seeds from --seed on."""
    looks: int = 8
    """How often a model is measured during a training."""
    max_seconds: float | None = None
    """Time of each training (default 60 if --steps is not given)."""
    steps: int | None = None
    """Steps of each training."""
    set: UseAppendAction[tuple[str, ...]] = ()
    """Parameters of a formula, or settings of all trainings: key=value; repeatable."""
    seed: int = 0
    """Chance: which pixels are drawn; the first seed of trainings."""
    workers: Workers = 0
    executor: ExecutorName = None
    variant: Variant = None

    def run(self, _started: float) -> None:
        """Reports."""
        if (self.target is None) == (self.train is None):
            raise InputError("report: expected either TARGET or --train DATA")
        valid_seed(self.seed)
        for name in ("views", "rays", "repeats", "seeds", "looks"):
            positive(name, getattr(self, name))
        if self.train is not None:
            self._train(self.train, self.out)
        else:
            self._report(self.out)

    def _report(self, out: Path) -> None:
        for name in ("vary", "max_seconds", "steps", "workers", "executor"):
            if getattr(self, name):
                option = name.replace("_", "-")
                raise InputError(f"--{option}: of trainings, expected --train DATA, no TARGET")
        knobs = self._knobs() if self.speed else None
        with (
            progress_bar("reference", "rendering") as renderings,
            progress_bar("profile", "training step") as steps,
        ):
            record = report(
                self.target or "",
                out,
                choose_variant(self.variant),
                self.point,
                knobs=knobs,
                repeats=self.repeats,
                profile=self.profile,
                data=self.data,
                on_step=steps.update,
                on_render=lambda total: _advance(renderings, total),
                values=dict(map(_parameter, self.set)),
                split=self.split,
                views=self.views,
                downscale=self.downscale,
                rays=self.rays,
                seed=self.seed,
            )
        for sentence in record["conclusions"]:
            print(sentence)
        for entry in record["view_dependence"]:
            where = ", ".join(f"{v:.3f}" for v in entry["point"])
            print(f"({where}): deviation over directions {entry['deviation']:.3f}")
        if record["step"] is not None:
            print(summary(record["step"]))
        elif self.profile:
            print(f"no profile of training steps: {record['step_left_out']}")
        print(f"{out / 'report.md'}")

    def _knobs(self) -> Knobs:
        names = ("samples", "rules", "splits", "stops", "resolutions", "thresholds")
        try:
            return Knobs(**{name: getattr(self, name) for name in names})
        except ValueError as error:
            raise InputError(f"--{error}") from None

    def _train(self, data: Path, out: Path) -> None:
        vary = dict(name_and_value(v, "--vary") for v in self.vary)
        rows = rows_of(self.presets, {k: v.split(",") for k, v in vary.items()}, self.set)
        end = budget(self.max_seconds, self.steps, usual=60.0)
        scale = positive("downscale", 1 if self.downscale is None else self.downscale)
        end |= {"seed": self.seed, "downscale": scale}
        rows = {name: replace(config, **end) for name, config in rows.items()}
        record = report_training(
            data,
            out,
            rows,
            choose_variant(self.variant),
            seeds=self.seeds,
            split=self.split,
            views=self.views,
            looks=self.looks,
            given=[*vary, *(assignment.partition("=")[0] for assignment in self.set)],
            on_run=lambda name, seed: print(f"{name}, seed {seed}", flush=True),
            workers=self.workers,
            executor=self.executor,
        )
        for sentence in conclusions(record):
            print(sentence)
        if not record["complete"]:
            print(f"{out}: interrupted, the same command goes on")
            raise KeyboardInterrupt
        print(f"{out / 'report.md'}")


def _advance(bar: tqdm[Any], total: int) -> None:
    bar.total = total
    bar.set_description("report", refresh=False)
    bar.update()


def _parameter(text: str) -> tuple[str, float | tuple[float, ...]]:
    """A parameter of a formula: one number, or three."""
    name, value = name_and_value(text)
    try:
        numbers = tuple(float(part) for part in value.split(","))
    except ValueError:
        raise InputError(f"--set {text}: expected a number, or three with commas") from None
    return name, numbers[0] if len(numbers) == 1 else numbers
