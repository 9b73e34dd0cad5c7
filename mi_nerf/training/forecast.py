"""How long the published schedule takes on the machine at hand, measured before it begins.

The preset ``paper`` brings a schedule of its own, which takes a day or two on one GPU (NeRF
Sec. 5.3) and weeks on a CPU. Before such a run begins, some steps with a share of its rays are
timed on a model that is thrown away, and what follows from them is said.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr

from ..base.errors import InputError, Option
from ..data import Dataset
from .config import TrainConfig
from .model import field_config
from .trainer import Trainer

PUBLISHED_STEPS = {"paper": 200_000}  # of presets with a schedule of their own
LONGEST = 24 * 3600.0  # seconds of a schedule that is begun without having been asked for

_EXAMPLE = 10 * 3600.0  # seconds of the budgets that the error proposes
_FEWEST_RAYS = 256  # of a first trial: enough to fill the blocks that the network evaluates
_MORE_RAYS = 8  # times as many in the next one
_LONG_ENOUGH = 0.5  # seconds of a trial that tells how long a step takes
_VIEWS = 4  # whose rays are traced in trials

_UNITS = (("days", 86400.0), ("hours", 3600.0), ("minutes", 60.0))


@dataclass(frozen=True)
class Forecast:
    """What a run is going to take, as far as the first steps tell."""

    preset: str
    step_seconds: float  # of one step, measured
    steps: int | None  # the run's budget,
    max_seconds: float | None  # as configured

    @property
    def published_seconds(self) -> float:
        """Of the preset's own schedule."""
        return self.step_seconds * PUBLISHED_STEPS[self.preset]

    def sentence(self) -> str:
        """One sentence about the run, and about the published schedule if that is another."""
        published = PUBLISHED_STEPS[self.preset]
        step = f"on this machine ({_rounded(self.step_seconds)} s a step)"
        steps = self.steps or published
        text = f"{_steps(steps)} take about {duration(steps * self.step_seconds)} {step}"
        if self.max_seconds is not None:
            affordable = int(self.max_seconds / self.step_seconds)
            if self.steps is None or affordable < self.steps:
                text = f"about {_steps(affordable)} in {duration(self.max_seconds)} {step}"
            if not affordable:
                text = f"more than {duration(self.max_seconds)} for a single step {step}"
        elif steps == published:
            return f"{text}, as published"
        whole = duration(self.published_seconds)
        return f"{text}; the published {_steps(published)} would take about {whole}"


def forecast(
    config: TrainConfig, dataset: Dataset, backend: Any, timed: Callable[..., float] | None = None
) -> Forecast:
    """Measures a step of a run whose preset has a schedule of its own.

    Args:
        config: with its budget, or without one to ask for the published schedule.
        timed: seconds of a step of ``(config, dataset, backend)``; :func:`step_seconds` if
            not given.

    Raises:
        InputError: if there is no budget, and the published schedule would take longer than
            :data:`LONGEST`.
    """
    seconds = (timed or step_seconds)(config, dataset, backend)
    found = Forecast(config.preset, seconds, config.steps, config.max_seconds)
    unlimited = config.steps is None and config.max_seconds is None
    if unlimited and found.published_seconds > LONGEST:
        raise InputError(
            f"{{}}: its {_steps(PUBLISHED_STEPS[config.preset])} would take about "
            f"{duration(found.published_seconds)} on this machine ({_rounded(seconds)} s a step), "
            "expected {} or {}, for example {} or {}",
            Option("preset", config.preset),
            Option("max_seconds"),
            Option("steps"),
            Option("max_seconds", int(_EXAMPLE)),
            Option("steps", int(float(f"{max(1.0, _EXAMPLE / seconds):.1g}"))),
        )
    return found


def step_seconds(config: TrainConfig, dataset: Dataset, backend: Any) -> float:
    """Seconds of a training step with a fixed number of rays, waited for, without compilation.

    Steps with more and more of the rays are timed until one takes long enough, and the rest is
    taken to be in proportion. The kernels are those of the whole step.

    Args:
        config: with ``sampling.rays``.
    """
    field = field_config(config, dataset)  # in the box of all the views
    views = dataset.evenly_spread(_VIEWS)
    whole = config.sampling.rays
    if whole is None:
        raise ValueError("sampling.rays=None, expected the number of rays of a step")
    rays = min(_FEWEST_RAYS, whole)
    while True:
        sampling = replace(config.sampling, rays=rays)
        part = replace(config, sampling=sampling, box=(*field.lower, *field.upper))
        trainer = Trainer(part, views, backend)
        # The first one compiles, and one may have had to wait for other work on the machine.
        seconds = min(_timed_step(trainer) for _ in range(3))
        if seconds >= _LONG_ENOUGH or rays == whole:
            return seconds * whole / rays
        rays = min(_MORE_RAYS * rays, whole)


def _timed_step(trainer: Trainer) -> float:
    dr.sync_thread()
    start = time.perf_counter()
    trainer.step(trainer.config.optimizer.lr)
    dr.sync_thread()
    return time.perf_counter() - start


def duration(seconds: float) -> str:
    """A span of time in the largest unit that gives two or more, as people say it.

    >>> duration(4.8e6)
    '56 days'
    >>> duration(100)
    '100 s'
    """
    for name, size in _UNITS:
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {name}"
    return f"{_rounded(seconds)} s"


def _steps(count: int) -> str:
    return f"{count:,} step{'' if count == 1 else 's'}"


def _rounded(seconds: float) -> str:
    """To two digits, never as a power of ten."""
    return f"{seconds:.0f}" if seconds >= 10 else f"{float(f'{seconds:.2g}'):g}"
