"""Views held back from training: what preset ``auto`` judges a model by."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import drjit as dr
import numpy as np

from ..base.arrays import vector3_type
from ..data import Dataset, evenly_spread_indices
from ..fields.neural import NeuralField
from ..fields.protocol import Field
from .config import TrainConfig
from .trainer import Trainer

FEWEST_VIEWS = 5  # with fewer there is none to hold back
_MOST_VIEWS, _ONE_OF = 8, 8  # to hold back: one of so many
_PIXELS = 8192  # held-back ones that judge a field, at most
_DIRECTIONS = 8  # from which light is averaged
_EVEN_PIXELS = 2048  # for that, at most
_SEED = 77  # of the choice of pixels, always the same


class HeldBack:
    """Some views of a dataset, and the quality of a field in pixels of theirs."""

    def __init__(self, dataset: Dataset, trainer: Trainer) -> None:
        """
        Args:
            trainer: whose field is judged; it still learns from all views of ``dataset``.
        """
        count = min(_MOST_VIEWS, max(1, len(dataset) // _ONE_OF))
        self.views = [(2 * i + 1) * len(dataset) // (2 * count) for i in range(count)]
        self.others = sorted(set(range(len(dataset))) - set(self.views))
        self._trainer, self.holds = trainer, False
        self._known: tuple[tuple[int, TrainConfig], float] | None = None  # when, and what
        self._cameras = dataset.cam_to_world[self.others, :3, 3]
        size = dataset.intrinsics
        most = count * size.width * size.height
        self._pixels, self._few = (
            trainer.pixels_of(self.views, min(n, most), _SEED) for n in (_PIXELS, _EVEN_PIXELS)
        )

    def hold(self) -> None:
        """Takes the views away from the trainer."""
        self._trainer.learn_from(self.others)
        self.holds = True

    def give_back(self) -> None:
        """Lets the trainer learn from all views again."""
        self._trainer.learn_from()
        self.holds = False

    def quality(self, *, samples: int | None = None) -> float:
        """Of the trainer's field, dB: −10 log10 of the loss.

        Args:
            samples: strata a ray; none: as in training.
        """
        return _decibels(self._trainer.validate(self._pixels, samples=samples))

    def _present(self) -> float:
        """The quality of the field as it is now, asked once a step."""
        now = (self._trainer.step_count, self._trainer.config)
        if self._known is None or self._known[0] != now:
            self._known = (now, self.quality())
        return self._known[1]

    def lost_as(self, config: TrainConfig) -> float:
        """What the trained field would lose at once in the shape of another configuration, dB."""
        field = self._trainer.field_in_shape_of(config)
        return self._present() - _decibels(self._trainer.validate(self._pixels, field))

    def lost_even(self) -> float:
        """What the trained field loses if it sends the same light in all directions, dB."""
        trainer, field = self._trainer, self._trainer.field
        config, network = trainer.config, trainer.config.network
        if not network.view_dependent:
            return 0.0
        if field.ndc is not None:  # where cameras have no place among positions
            blind = dataclasses.replace(network, view_dependent=False)
            return self.lost_as(dataclasses.replace(config, network=blind))
        some = evenly_spread_indices(len(self._cameras), _DIRECTIONS)
        cameras = self._cameras[some]
        even = trainer.validate(self._few, _EvenLight(field, cameras))
        return _decibels(trainer.validate(self._few)) - _decibels(even)


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


def _decibels(loss: float) -> float:
    return -10 * math.log10(max(loss, 1e-12)) if math.isfinite(loss) else math.nan
