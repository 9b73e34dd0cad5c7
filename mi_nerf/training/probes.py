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

from ..arrays import vector3_type
from ..data import Dataset
from ..field import NeuralField
from .batches import RaySource, step_rng
from .config import TrainConfig, with_settings
from .schedule import learning_rate
from .trainer import Trainer

SHARE = 0.12  # of a run's budget, for all probes together
BATCH = 4096  # field queries a step of a probe, at most
STEPS = 350  # of a probe in a run of two minutes or less; up to four times as many in longer ones
FEWEST = 250  # a shorter probe tells nothing
FEWEST_VIEWS = 5  # with fewer there is none to hold back
_MOST_VIEWS = 8  # to hold back
_FIRST = 0.65  # of the seconds left, for a first probe: it may have to compile
_PACED = 40  # steps after which it is clear how many there is time for
_PIXELS = 16384  # held-back ones that judge a field, at most
_SEED = 77  # of their choice, the same for all probes
_DIRECTIONS = 8  # from which light is averaged


@dataclass(frozen=True)
class Probe:
    """What a short training came to."""

    steps: int
    seconds: float  # a step, median
    quality: float  # of the pixels held back, dB: -10 log10 of the loss
    slope: float  # dB that the second half of the steps brought
    averaged: float  # quality with light averaged over directions of view


class Probes:
    """Trains one configuration after the other within a share of a run's budget.

    Of a limit in seconds they take at most :data:`SHARE`, but for the step that is under
    way when it ends; of a limit in steps, as many as make that share of its queries.
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
        self._deadline, self._steps_left, goal = math.inf, math.inf, float(STEPS)
        if config.max_seconds is not None:
            self._deadline = clock() + SHARE * config.max_seconds
            goal *= min(max(config.max_seconds / 120, 1), 4)
        if config.steps is not None:
            batch = config.sampling.batch
            self._steps_left = SHARE * config.steps * batch / min(BATCH, batch)
            goal = min(goal, self._steps_left / 2)  # two at least, to compare
        self._goal = int(goal)

    def __len__(self) -> int:
        """The number of views held back."""
        return len(self._held_back)

    def affords(self, seconds: float, steps: int) -> bool:
        """Whether the budget has room for so much more."""
        return self._clock() + seconds <= self._deadline and steps <= self._steps_left

    def train(self, config: TrainConfig, like: Probe | None = None) -> Probe | None:
        """Trains and judges; ``None`` if the budget ends before it tells anything.

        Args:
            like: the probe to compare with, whose number of steps is taken. Without it,
                some of the budget stays for such a comparison.
        """
        now = self._clock()
        share = _FIRST if like is None else 1.0
        limit = now + share * (self._deadline - now) if math.isfinite(self._deadline) else math.inf
        goal = self._goal if like is None else like.steps
        if goal < FEWEST or not self.affords(0, goal):
            return None
        trainer = Trainer(_short(config, goal), self._others, self._backend, self._cells)
        pixels = self._pixels(trainer)
        durations: list[float] = []
        halfway, previous = math.nan, None
        while trainer.step_count < goal and self._clock() < limit:
            begin = self._clock()
            result = _step(trainer, goal)
            if previous is not None:
                float(previous.loss[0])  # waits, for the step before
            previous = result
            durations.append(self._clock() - begin)
            self._steps_left -= 1
            if trainer.step_count == _PACED and like is None:
                goal = min(goal, self._fitting(durations[_PACED // 2 :], limit))
                if goal < FEWEST:
                    return None
            if trainer.step_count == goal // 2:
                halfway = _decibels(trainer.validate(pixels))
        found = _decibels(trainer.validate(pixels))
        if trainer.step_count < goal or not math.isfinite(found + halfway):
            return None
        return Probe(
            steps=goal,
            seconds=statistics.median(durations),
            quality=found,
            slope=max(0.0, found - halfway),
            averaged=self._averaged(trainer, pixels, found),
        )

    def _fitting(self, durations: list[float], limit: float) -> int:
        """How many steps there is time for, by the pace of the last ones."""
        pace = statistics.median(durations)
        left = 0.9 * (limit - self._clock())
        return _PACED + int(min(left / max(pace, 1e-9), 1e9))

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


class _EvenLight:
    """A field whose emission is averaged over directions from which cameras see it."""

    coarse = None

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


def _short(config: TrainConfig, steps: int) -> TrainConfig:
    """The settings of a probe: smaller steps, and all that waits for later ones earlier."""
    options = config.optimizer
    return with_settings(
        config,
        [
            f"sampling.batch={max(config.sampling.samples, min(BATCH, config.sampling.batch))}",
            f"occupancy.start={min(config.occupancy.start, steps // 3)}",
            f"optimizer.warmup={min(options.warmup, 20)}",
            "crop_steps=0",
        ],
    )


def _step(trainer: Trainer, goal: int) -> Any:
    """A step whose learning rate has come half the way of a run's at the end of the probe."""
    done = trainer.step_count
    return trainer.step(learning_rate(trainer.config.optimizer, 0.5 * done / goal, done))


def _decibels(loss: float) -> float:
    return -10 * math.log10(max(loss, 1e-12)) if math.isfinite(loss) else math.nan
