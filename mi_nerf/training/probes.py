"""Short trainings on most of the views, judged on the others: what preset ``auto`` rests on."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from ..base.arrays import vector3_type
from ..base.progress_bar import progress_bar
from ..data import Dataset
from ..fields.neural import NeuralField
from ..fields.protocol import Field
from .batches import RaySource, step_rng
from .config import TrainConfig
from .schedule import learning_rate
from .trainer import Trainer

SHARE = 0.12  # of a run's budget, for probes that lead nowhere
FIRST = 0.11  # of a run's budget, for the first probe, with which training usually goes on
STEPS = 400  # of a probe in a run of two minutes or less; more in longer ones
FEWEST = 300  # a shorter probe tells nothing
FEWEST_VIEWS = 5  # with fewer there is none to hold back
_MOST_VIEWS = 8  # to hold back
_PACED = 40  # steps after which it is clear how many there is time for
_PIXELS = 16384  # held-back ones that judge a field, at most
_SEED = 77  # of their choice, the same for all probes
_DIRECTIONS = 8  # from which light is averaged


@dataclass(frozen=True)
class Probe:
    """What the first steps of a training came to."""

    steps: int
    seconds: float  # a step, median
    quality: float  # of the pixels held back, dB: -10 log10 of the loss
    slope: float  # dB that the second half of the steps brought
    averaged: float  # quality with light averaged over directions of view
    trainer: Trainer | None = None  # to go on with

    @property
    def told(self) -> bool:
        """Whether there was time for enough steps to judge anything."""
        return self.steps >= FEWEST


class Probes:
    """Begins to train one configuration after the other, as a run would.

    The run can go on with any of them, so that only those that lead nowhere cost it
    anything: at most :data:`SHARE` of its budget, for which what is left of it by the pace
    of earlier probes has to suffice, and the time in which their kernels are compiled.
    """

    def __init__(
        self,
        config: TrainConfig,
        dataset: Dataset,
        backend: Any,
        cells: np.ndarray[Any, Any],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """
        Args:
            config: the run's, for its budget.
            cells: of the box that may hold something, as for :class:`Trainer`.
        """
        self._backend, self._cells, self._clock = backend, cells, clock
        count = min(_MOST_VIEWS, len(dataset) // FEWEST_VIEWS)
        held = [(2 * i + 1) * len(dataset) // (2 * count) for i in range(count)]
        self._held_back = dataset.subset(held)
        self._others = dataset.subset([i for i in range(len(dataset)) if i not in held])
        limit, goal = config.max_seconds or math.inf, float(STEPS)
        if math.isfinite(limit):
            goal *= math.sqrt(max(limit / 120, 1))
        self._first_seconds = FIRST * limit
        self._seconds_left, self._steps_left = SHARE * limit, math.inf
        if config.steps is not None:
            self._steps_left = SHARE * config.steps
            goal = min(goal, self._steps_left)
        self._goal = int(goal)

    def __len__(self) -> int:
        """The number of views held back."""
        return len(self._held_back)

    def affords(self, seconds: float, steps: int) -> bool:
        """Whether the budget has room for so much that may lead nowhere."""
        return seconds <= self._seconds_left and steps <= self._steps_left

    def first(self, config: TrainConfig) -> Probe | None:
        """Trains and judges as many steps as there is time for.

        Returns:
            What they came to. If there was time for a few only, these, not judged, to go
            on with; ``None`` if there was not even time to begin.
        """
        return None if self._goal < FEWEST else self._train(config, self._goal, paced=True)

    def another(self, config: TrainConfig, like: Probe, cost: float = 1.0) -> Probe | None:
        """Trains and judges another configuration for as many steps, if there is time.

        Args:
            like: the probe to compare with.
            cost: of a step, expected, in steps of that probe.
        """
        if not self.affords(cost * like.steps * like.seconds, like.steps):
            return None
        found = self._train(config, like.steps, paced=False)
        self._seconds_left -= found.seconds * found.steps
        self._steps_left -= found.steps
        return found if math.isfinite(found.quality) else None

    def _train(self, config: TrainConfig, goal: int, paced: bool) -> Probe:
        """The first steps of a training; ``paced`` adapts their number to the time left."""
        trainer = Trainer(config, self._others, self._backend, self._cells)
        pixels = self._pixels(trainer)
        durations: list[float] = []
        halfway, previous = math.nan, None
        with progress_bar(_title(config), "step", goal, leave=False) as bar:
            while trainer.step_count < goal:
                begin = self._clock()
                result = trainer.step(learning_rate(config.optimizer, 0.0, trainer.step_count))
                if previous is not None:
                    float(previous.loss[0])  # waits, for the step before
                previous = result
                durations.append(self._clock() - begin)
                bar.update()
                if trainer.step_count == goal // 2:
                    halfway = _decibels(trainer.validate(pixels))
                if paced and trainer.step_count == _PACED:
                    goal = min(goal, self._fitting(durations[_PACED // 2 :]))
                    bar.total = goal
        seconds = statistics.median(durations)
        if goal < FEWEST:
            return Probe(goal, seconds, math.nan, math.nan, math.nan, trainer)
        found = _decibels(trainer.validate(pixels))
        return Probe(
            steps=goal,
            seconds=seconds,
            quality=found,
            slope=max(0.0, found - halfway),
            averaged=self._averaged(trainer, pixels, found),
            trainer=trainer,
        )

    def _fitting(self, durations: list[float]) -> int:
        """How many steps there is time for, by the pace of the last ones; few if too few."""
        pace = statistics.median(durations)
        goal = int(min(self._first_seconds / max(pace, 1e-9), 1e9))
        return goal if goal >= FEWEST else _PACED

    def _pixels(self, trainer: Trainer) -> Any:
        """Pixels of the views held back, chosen alike for all probes."""
        film = self._held_back.intrinsics
        count = min(_PIXELS, len(self) * film.width * film.height)
        float_type = self._backend.Float
        source = RaySource(self._held_back, trainer.background, float_type)
        return source.draw(count, step_rng(float_type, _SEED, 0))

    def _averaged(self, trainer: Trainer, pixels: Any, otherwise: float) -> float:
        """Quality of the trained field if it sent the same light in all directions."""
        field = trainer.field
        if not field.config.network.view_dependent or field.ndc is not None:
            return otherwise
        cameras = self._others.evenly_spread(_DIRECTIONS).cam_to_world[:, :3, 3]
        return _decibels(trainer.validate(pixels, _EvenLight(field, cameras)))


class _EvenLight(Field):
    """A field whose emission is averaged over directions from which cameras see it."""

    def __init__(self, field: NeuralField, cameras: np.ndarray[Any, Any]) -> None:
        self._field, self._cameras = field, cameras
        self.lower, self.upper = field.lower, field.upper
        self.color_space, self.ndc = field.color_space, field.ndc

    def density(self, p: Any) -> Any:
        return self._field.density(p)

    def parameters(self) -> dict[str, Any]:
        return self._field.parameters()

    def density_emission(self, p: Any, d: Any) -> tuple[Any, list[Any]]:
        """Cameras on the other side of a surface do not know what it looks like: their
        say is the smaller, the more their direction differs from ``d``."""
        vector, total = vector3_type(type(p[0])), 0
        density, colors = None, [0, 0, 0]
        for camera in self._cameras:
            towards = dr.normalize(p - vector(*(float(x) for x in camera)))
            density, color = self._field.density_emission(p, towards)
            weight = dr.fmax(dr.dot(towards, d), 0) + 1e-3
            total = total + weight
            colors = [c + weight * new for c, new in zip(colors, color, strict=True)]
            dr.eval(density, colors, total)
        return density, [c / total for c in colors]


def _title(config: TrainConfig) -> str:
    features = "Fourier features" if config.grid is None else "hash grid"
    seen = "" if config.network.view_dependent else ", no directions"
    return f"probing {features}, {config.network.depth}x{config.network.width}{seen}"


def _decibels(loss: float) -> float:
    return -10 * math.log10(max(loss, 1e-12)) if math.isfinite(loss) else math.nan
