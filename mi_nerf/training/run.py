"""A training run: a folder, a clock, a log, and the loop around the trainer's steps."""

from __future__ import annotations

import json
import platform
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike

from .._version import __version__
from ..base.arrays import Image
from ..base.errors import InputError, Option
from ..base.files import check_folder, make_folder, write_json
from ..base.interrupts import interruptible
from ..base.variants import array_module
from ..cameras.pinhole import Intrinsics
from ..data import Dataset, load_dataset
from ..formats.field_file import FieldFile, save_field
from ..march.marched import MarchedField
from ..march.view import View, display_image, render_view
from .auto import Choice, Decision, choose, decisions_in
from .checkpoint import Progress, load_checkpoint, read_checkpoint, save_checkpoint
from .config import TrainConfig, from_json, to_json
from .device import for_device
from .forecast import PUBLISHED_STEPS, Forecast, forecast
from .fresh import field_file, render_settings
from .progress import Meter, ProgressBar
from .run_folder import (
    CHECKPOINT,
    CONFIG,
    FIELD,
    FORMAT,
    LOG,
    cut_log,
    read_config,
)
from .scaling import summary
from .schedule import learning_rate
from .shaping import Shaping
from .trainer import StepResult, Trainer


class TrainingError(RuntimeError):
    """Training cannot go on; the message says why and what to try."""


class Run:
    """A run folder and the training that goes on in it."""

    def __init__(
        self,
        folder: Path,
        config: TrainConfig,
        dataset: Dataset,
        variant: str,
        *,
        started: float | None = None,
        trainer: Trainer | None = None,
    ) -> None:
        """
        Args:
            started: the value of ``time.monotonic()`` from which seconds count; none: they
                count while :meth:`reports` is at work.
            trainer: of this configuration and dataset, in place of a new one.
        """
        self.folder, self.variant = folder, variant
        self.decisions: list[Decision] = []  # why the configuration is what it is
        self.forecast: Forecast | None = None  # of a new run with a published schedule
        self.interrupted = False  # by Ctrl-C, when last trained
        self._started = started  # None: the clock stands still,
        self._paused = time.monotonic()  # since then
        self.trainer = trainer or Trainer(config, dataset, array_module(variant))
        self.config = self.trainer.config  # with what follows from the data
        self._shaping: Shaping | None = None
        self._record: dict[str, Any] = {}  # what config.json holds
        self._blank = self.trainer.blank_loss
        self._before = 0.0  # seconds of training before the clock was last started
        self._skipped = 0
        self._skipped_in_row = self._without_rays = 0
        self._attempt_start = 0
        self._begun = 0  # steps before the log began
        self._since = Meter()
        # Squared errors of the last steps, as many as tell a collapse from bad luck.
        self._recent: deque[float] = deque(maxlen=max(1, min(100, config.collapse_check // 2)))
        self._pending: StepResult | None = None

    @property
    def seconds(self) -> float:
        """Wall-clock seconds of training so far, earlier processes included."""
        now = time.monotonic()
        return self._before + now - (now if self._started is None else self._started)

    @property
    def progress(self) -> float:
        """How much of the budget is spent, 0 to 1: the larger share of steps and seconds."""
        shares = [0.0]
        if self.config.steps:
            shares.append(self.trainer.step_count / self.config.steps)
        if self.config.max_seconds:
            shares.append(self.seconds / self.config.max_seconds)
        return min(1.0, max(shares))

    @property
    def sizes(self) -> str:
        """What is trained, in a line: features, cells, strata, and how much memory they take."""
        trainer = self.trainer
        return summary(self.config, trainer.field_config, trainer.image_bytes)

    def shape(self, dataset: Dataset, decisions: list[Decision]) -> None:
        """Lets the model take shape while it trains; ``decisions`` say why it is what it is."""
        self.decisions = decisions
        self._shaping = Shaping(self.trainer, dataset, decisions, lambda: self.progress)

    def keep_record(self, record: dict[str, Any]) -> None:
        """Writes ``config.json``, now and whenever the run is saved in another shape."""
        self._record = record
        write_json(self.folder / CONFIG, record)

    def resume(self) -> None:
        """Goes back to the checkpoint of the folder, and cuts the log to match."""
        progress = load_checkpoint(self.folder / CHECKPOINT, self.trainer)
        self._before, self._skipped = progress.seconds, progress.skipped
        self._attempt_start, self._begun = progress.attempt_start, progress.begun
        cut_log(self.folder / LOG, self.trainer.step_count)

    def train(
        self, show_bar: bool = True, after_step: Callable[[Run], object] | None = None
    ) -> None:
        """Trains until the budget is spent or the user interrupts; always saves.

        Args:
            after_step: called after every step; :meth:`clock_stopped` is for it.

        Raises:
            TrainingError: after too many non-finite steps in a row, or collapses.
        """
        with ProgressBar(self.config, self.progress, show_bar) as bar:
            for line in self._reports(after_step, hold=True):
                bar.update(self.progress, line, self.interrupted)

    def reports(
        self, after_step: Callable[[Run], object] | None = None
    ) -> Iterator[dict[str, Any]]:
        """Trains as :meth:`train` does, and hands over every report on the way.

        A report is a line of the log: ``step``, ``seconds`` (of training), ``loss``, ``psnr``
        (dB, of the training rays), ``samples_per_ray``, ``samples_per_second``,
        ``learning_rate``, ``occupied`` (share of the box), ``skipped`` steps: means since the
        last one, ``report_every`` seconds ago. What the caller does between two reports takes
        no training time. Ctrl-C, or *interrupt* in a notebook, ends training after the present
        step; what the caller does with a report, it interrupts as usual. Leaving the loop ends
        training, too. In any case the run is saved, and a further call goes on.

        Raises:
            TrainingError: after too many non-finite steps in a row, or collapses.
        """
        return self._reports(after_step, hold=False)

    def _reports(
        self, after_step: Callable[[Run], object] | None, hold: bool
    ) -> Iterator[dict[str, Any]]:
        """:meth:`reports`; with ``hold``, signals are requests between reports, too."""
        log_file = (self.folder / LOG).open("a")
        with self._clock_running(), log_file as log, interruptible() as stop:
            last_report = last_save = self.seconds
            self._log, self.interrupted = log, False
            # At least one step, so that there is always a field to look at.
            while (self.progress < 1 or self.trainer.step_count == 0) and not stop:
                self._advance()
                if self._collapsed():
                    self._restart()
                if self._shaping is not None and self._shaping.after_step():
                    self._note_shape()
                now = self.seconds
                self.interrupted = bool(stop)
                finished = self.progress >= 1 or self.interrupted
                if now - last_report >= self.config.report_every or finished:
                    self._settle()
                    line, last_report = self._report(), now
                    try:
                        with self.clock_stopped(), nullcontext() if hold else stop.released():
                            yield line
                    except GeneratorExit:  # the caller left the loop
                        break
                if now - last_save >= self.config.checkpoint_every:
                    self.save()
                    last_save = self.seconds
                if after_step is not None:
                    after_step(self)
            self.interrupted = bool(stop)
            self._settle()
            self.save()

    def view(self, intrinsics: Intrinsics, cam_to_world: ArrayLike, spp: int = 1) -> View:
        """What a camera sees of the field as it is now; see :func:`mi_nerf.march.view.render_view`.

        Args:
            cam_to_world: (4, 4), OpenGL axes.
            spp: rays a pixel, rounded down to a square number.
        """
        trainer = self.trainer
        with dr.suspend_grad():
            return render_view(
                MarchedField(trainer.field, render_settings(self.config), trainer.occupancy),
                intrinsics,
                cam_to_world,
                array_module(self.variant),
                spp=spp,
            )

    def picture(self, dataset: Dataset, index: int) -> Image:
        """(H, W, 3) sRGB: the field as it is now, on white, from a view of a dataset."""
        view = self.view(dataset.intrinsics, dataset.cam_to_world[index])
        return display_image(view, self.trainer.field.color_space)

    def save(self) -> None:
        """Writes the checkpoint and the field file."""
        progress = Progress(self.seconds, self._skipped, self._attempt_start, self._begun)
        save_checkpoint(self.folder / CHECKPOINT, self.trainer, progress)
        save_field(self.folder / FIELD, self.field_file())
        if self._shaping is not None and self._record:
            # Last: a checkpoint in another shape counts, see _resumed_config.
            self.keep_record(self._present_record())

    def field_file(self) -> FieldFile:
        """The field as it is now, as XML scenes will load it."""
        return field_file(self.trainer, {"seconds": round(self.seconds, 3)})

    # ---------------------------------- The clock ----------------------------------

    @contextmanager
    def clock_stopped(self) -> Iterator[None]:
        """What happens inside is not training time; steps under way are waited for before."""
        dr.sync_thread()
        self.pause()
        try:
            yield
        finally:
            self._start_clock()

    @contextmanager
    def _clock_running(self) -> Iterator[None]:
        self._start_clock()
        try:
            yield
        finally:
            self.pause()

    def pause(self) -> None:
        """Stops the clock until training goes on."""
        if self._started is not None:
            self._before, self._started, self._paused = self.seconds, None, time.monotonic()

    def _start_clock(self) -> None:
        if self._started is None:
            self._started = time.monotonic()
            self._since.pause(self._started - self._paused)

    # ---------------------------------- One step ----------------------------------

    def _advance(self) -> None:
        """Launches a step, then reads the results of the one before."""
        progress, age = self.progress, self.trainer.step_count - self._attempt_start
        rate = learning_rate(self.config.optimizer, progress, age)
        ends = self.config.steps or self.config.max_seconds  # else images are sharp at once
        result = self.trainer.step(rate, progress if ends else 1.0)
        self._settle()
        self._pending = result
        self._rate = rate

    def _settle(self) -> None:
        """Reads the results of the last step; waits for it."""
        result, self._pending = self._pending, None
        if result is None:
            return
        if result.accepted[0]:
            self._skipped_in_row = 0
            mse = float(result.mse[0])
            self._since.add(float(result.loss[0]), mse, result)
            self._recent.append(mse)
            self._count_without_rays(int(result.rays[0]))
            return
        self._skipped += 1
        self._skipped_in_row += 1
        if self._skipped_in_row >= self.config.max_skipped:
            raise TrainingError(
                f"loss or gradient not finite in {self._skipped_in_row} steps in a row at step "
                f"{self.trainer.step_count}; try a smaller optimizer.lr"
            )

    def _count_without_rays(self, rays: int) -> None:
        """Steps of which nothing can be learnt are not taken for ever."""
        self._without_rays = 0 if rays else self._without_rays + 1
        if self._without_rays >= self.config.max_skipped:
            raise TrainingError(
                f"no ray kept all of its samples in {self._without_rays} steps in a row at step "
                f"{self.trainer.step_count}; try a larger sampling.batch or fewer sampling.rays"
            )

    # ----------------------------------- Shape -----------------------------------

    def _note_shape(self) -> None:
        """Goes on with the configuration that the trainer has by now."""
        config, budget = self.trainer.config, self.config
        self.config = replace(config, steps=budget.steps, max_seconds=budget.max_seconds)
        self._blank = self.trainer.blank_loss

    def _present_record(self) -> dict[str, Any]:
        """What ``config.json`` holds by now; its budget stays what the run began with."""
        budget = {n: self._record["settings"].get(n) for n in ("steps", "max_seconds")}
        field = {
            **self._record["field"],
            "parameters": self.trainer.field_config.parameter_count(),
        }
        return {
            **self._record,
            "settings": {**to_json(self.config), **budget},
            "field": field,
            "auto": [decision.as_json() for decision in self.decisions],
        }

    # ---------------------------------- Collapse ----------------------------------

    def _collapsed(self) -> bool:
        """Whether the field is still no better than empty space when it should be."""
        age = self.trainer.step_count - self._attempt_start
        first = self._begun if self._attempt_start == 0 else 0
        due = max(self.config.collapse_check, first + (self._recent.maxlen or 0))
        if age != due or not self._recent or self.config.collapse_check == 0:
            return False
        return float(np.mean(self._recent)) > 0.9 * self._blank

    def _restart(self) -> None:
        self._settle()
        if self.trainer.attempt >= self.config.max_restarts:
            raise TrainingError(
                f"collapsed {self.trainer.attempt + 1} times: the field stays as good as empty; "
                "try another seed, a smaller optimizer.lr or another density.activation"
            )
        self.trainer.attempt += 1
        self._attempt_start = self.trainer.step_count
        self._write({"event": "restart", "attempt": self.trainer.attempt, "reason": "collapse"})
        self.trainer.reset()
        self._since = Meter()
        self._recent.clear()

    # ---------------------------------- Reports ----------------------------------

    def _report(self) -> dict[str, Any]:
        """Adds a line to the log and returns it."""
        line = self._since.summary()
        occupancy = self.trainer.occupancy
        line |= {
            "learning_rate": self._rate,
            "occupied": 1.0 if occupancy is None else occupancy.fraction(),
            "skipped": self._skipped,
        }
        self._since = Meter()
        return self._write(line)

    def _write(self, line: dict[str, Any]) -> dict[str, Any]:
        line = {"step": self.trainer.step_count, "seconds": round(self.seconds, 3), **line}
        self._log.write(json.dumps(line) + "\n")
        self._log.flush()
        return line


def start(
    data: str | Path,
    out: str | Path,
    config: TrainConfig,
    variant: str,
    *,
    resume: bool = False,
    started: float | None = None,
    given: Collection[str] = (),
) -> Run:
    """Opens a run: a new one in an empty folder, or the one that is there with ``resume``.

    With ``resume`` the folder's own configuration holds; only ``steps`` and
    ``max_seconds`` of ``config`` take its place, where given. Seconds count from ``started``,
    or else while this function and :meth:`Run.reports` are at work. A run with preset
    ``auto`` chooses its model, in part while it trains; settings named in ``given`` or unlike
    the preset's are kept. A new one with a preset that has a published schedule first measures
    how long that takes, and follows it if it has no budget.

    Raises:
        InputError: if the folder already holds a run, the data cannot be read, or a published
            schedule that nobody asked for would take days.
    """
    folder = Path(out)
    clock = time.monotonic() if started is None else started
    recorded = resume and (folder / CONFIG).exists()
    record: dict[str, Any] = {}
    if recorded:
        config, record = _resumed_config(folder, config, data)
    elif resume and (folder / CHECKPOINT).exists():
        raise InputError(f"{folder}: no {CONFIG} beside the {CHECKPOINT}, expected both")
    elif (folder / CONFIG).exists() or (folder / CHECKPOINT).exists():
        resuming = Option("resume", True)
        raise InputError("{}: already holds a run, expected {} or another folder", folder, resuming)
    if not recorded:
        config = for_device(config, variant, given)
    check_folder(folder)
    dataset = load_dataset(
        data, "train", downscale=config.downscale, limit=config.views, images=config.images
    )
    expected = None
    if config.preset in PUBLISHED_STEPS and not recorded:
        expected = forecast(config, dataset, array_module(variant))
        if config.steps is None and config.max_seconds is None:
            config = replace(config, steps=PUBLISHED_STEPS[config.preset])
    choice = Choice(config, [])
    if config.preset == "auto":
        choice = (
            Choice(config, decisions_in(record, config))
            if recorded
            else choose(config, dataset, given=given)
        )
    run = Run(folder, choice.config, dataset, variant, started=clock)
    run.forecast = expected
    make_folder(folder)
    if resume and (folder / CHECKPOINT).exists():
        run.resume()
    else:
        (folder / LOG).unlink(missing_ok=True)
    if choice.decisions:
        run.shape(dataset, choice.decisions)
    run.keep_record(record or _record(run, dataset))
    if started is None:
        run.pause()
    return run


def _resumed_config(
    folder: Path, given: TrainConfig, data: str | Path
) -> tuple[TrainConfig, dict[str, Any]]:
    """The configuration to go on with, and what ``config.json`` records."""
    config, record = read_config(folder)
    recorded = record["data"]["path"]
    if Path(recorded) != Path(data).resolve():
        raise InputError(f"{data}: expected {recorded}, on which the run in {folder} was trained")
    if config.preset == "auto" and (folder / CHECKPOINT).exists():
        # It may have another shape than when config.json was last written.
        _, description = read_checkpoint(folder / CHECKPOINT)
        if description.settings is not None:
            shaped = from_json(description.settings, str(folder / CHECKPOINT))
            config = replace(shaped, steps=config.steps, max_seconds=config.max_seconds)
    if given.steps is not None or given.max_seconds is not None:
        config = replace(config, steps=given.steps, max_seconds=given.max_seconds)
    return config, record


def _record(run: Run, dataset: Dataset) -> dict[str, Any]:
    """What ``config.json`` holds."""
    import mitsuba as mi

    field, size = run.trainer.field_config, dataset.intrinsics
    return {
        "format": FORMAT,
        "settings": to_json(run.config),
        "seed": run.config.seed,
        "data": {
            "path": str(dataset.path.resolve()),
            "views": len(dataset),
            "size": [size.width, size.height],
            "color_space": dataset.color_space,
            "has_alpha": dataset.has_alpha,
        },
        "field": {
            "lower": field.lower,
            "upper": field.upper,
            "parameters": field.parameter_count(),
        },
        **({"auto": [d.as_json() for d in run.decisions]} if run.decisions else {}),
        "variant": run.variant,
        "versions": {
            "mi_nerf": __version__,
            "mitsuba": mi.__version__,
            "drjit": dr.__version__,
            "python": platform.python_version(),
        },
    }
