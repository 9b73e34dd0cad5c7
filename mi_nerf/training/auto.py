"""Preset ``auto``: the model a scene needs, from its data and a few short trainings.

It starts from preset ``fast`` and departs from it only where there is a measured reason.
What follows from the data alone (box, resolution, samples, batch, activations) is fixed
first. Then training begins, on most of the views, and is judged on the others; the run
goes on from there. Other models begin in its place as long as their share of the budget
lasts, and the run goes on with whichever did best:

1. Does colour depend on the direction of view? The model is judged again with its light
   averaged over directions. Where that costs little, another begins without directions;
   if it keeps up, step by step, directions go.
2. How wide, how deep? The larger of two networks has to gain more, at the same number of
   steps, than the smaller one would in the time that the larger one costs.
3. A hash grid, or Fourier features alone? At the same number of steps.

The seed fixes all chance in the probes. But how many steps there is time for and what a
step costs are measured, so that another machine, or a busier one, may decide otherwise.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

from ..base.machine import available_memory
from ..data import Dataset
from . import probes
from .config import TrainConfig, to_json, with_settings
from .model import carved_cells, field_config
from .plain import as_text, leaves
from .presets import nerf, preset
from .probes import Probe, Probes
from .scaling import BYTES_PER_QUERY, fitting_batch, resolved, resolved_octaves, usual_batch
from .trainer import Trainer

# Of 400 steps on 200×200 pixels: a diffuse scene lost 0.0 and 0.14 dB, a glossy one 0.35
# and 0.45 dB. Without directions a step takes less time, which makes up for 0.2 dB.
MOST_LOST = 0.2  # dB that either test may lose without directions
MARGIN = 0.05  # dB that a larger model, or another kind, has to gain at any rate
_USUAL = (1, 64)  # depth and width of preset ``fast``; with 32 neurons a step takes as long
_LARGER = ((2, 64), (2, 128))  # as they grow
_FOURIER_COST = 3  # a step of Fourier features in steps of a hash grid of four times the batch


@dataclass(frozen=True)
class Decision:
    """One setting that was chosen, and why."""

    setting: str
    value: Any  # as JSON knows it
    reason: str

    def __str__(self) -> str:
        return f"{self.setting} = {as_text(self.value, '.4g')}: {self.reason}"


@dataclass(frozen=True)
class Choice:
    """The configuration for a dataset, every setting that was chosen, and what is trained."""

    config: TrainConfig
    decisions: list[Decision]
    trainer: Trainer | None = None  # that has begun with this configuration


def choose(
    config: TrainConfig,
    dataset: Dataset,
    backend: Any,
    *,
    given: Collection[str] = (),
    clock: Callable[[], float] = time.monotonic,
) -> Choice:
    """Chooses the configuration for a dataset.

    Args:
        config: of preset ``auto``. What differs from the preset is kept.
        given: names of settings that are kept even where they do not differ.
        clock: seconds, as they count for ``config.max_seconds``.
    """
    choice = _Settings(config, set(given) | _changed(config))
    _settle_data(choice, dataset)
    choice.config = resolved(choice.config, dataset)
    field = field_config(choice.config, dataset)
    cells = carved_cells(choice.config, dataset, field)
    _settle_sampling(choice, float(cells.mean()))
    if len(dataset) < probes.FEWEST_VIEWS:
        choice.leave(f"{len(dataset)} views, too few to hold any back")
        return Choice(choice.config, choice.decisions)
    best = _Questions(choice, Probes(choice.config, dataset, backend, cells, clock)).answer()
    trainer = None if best is None else best.trainer
    if trainer is not None and trainer.config == choice.config:
        trainer.learn_from(dataset)
        return Choice(choice.config, choice.decisions, trainer)
    return Choice(choice.config, choice.decisions)


class _Settings:
    """A configuration that takes shape."""

    def __init__(self, config: TrainConfig, fixed: set[str]) -> None:
        self.config, self._fixed = config, fixed
        self.decisions: list[Decision] = []

    def open(self, *prefixes: str) -> bool:
        """Whether the user has left all settings alone whose names begin so."""
        return not any(name.startswith(prefixes) for name in self._fixed)

    def take(self, setting: str, value: Any, reason: str) -> None:
        """Settles one setting, unless the user has."""
        if self.open(setting):
            self.config = with_settings(self.config, [f"{setting}={as_text(value)}"])
            self.decisions.append(Decision(setting, value, reason))

    def leave(self, reason: str) -> None:
        """Settles what probes were to answer in the way of preset ``fast``."""
        network = self.config.network
        for name in ("view_dependent", "depth", "width", "view_width"):
            self.take(f"network.{name}", getattr(network, name), f"as in preset fast: {reason}")


# ---- From the data alone ---------------------------------------------------------


def _settle_data(choice: _Settings, dataset: Dataset) -> None:
    """Box, resolution, and how colours and errors are expressed."""
    config = choice.config
    field = field_config(config, dataset)
    if config.box is None:
        how = "what the cameras see" if dataset.box is None else "the dataset's own box"
        if dataset.has_alpha and config.occupancy.hull and dataset.ndc is None:
            how += f", tightened to the silhouettes of {len(dataset)} views"
        choice.take("box", [*field.lower, *field.upper], how)
    octaves = resolved_octaves(dataset, field.lower, field.upper)
    why = f"{octaves} octaves: the finest has a period of two pixels in the middle of the box"
    if field.grid is not None:
        choice.take("grid.finest", field.grid.finest, why)
    elif choice.open("position"):
        choice.take("position.frequencies", octaves, why)
    linear = dataset.color_space == "linear"
    targets = "linear images" if linear else "sRGB images"
    if config.color_activation == "auto":
        choice.take("color_activation", field.color_activation, targets)
    if config.loss == "auto":
        choice.take("loss", "relative" if linear else "mse", targets)
    if config.background == "auto":
        alpha = "images with alpha" if dataset.has_alpha else "images without alpha"
        choice.take("background", "random" if dataset.has_alpha else "white", alpha)


def _settle_sampling(choice: _Settings, occupied: float) -> None:
    """Strata a ray and queries a step."""
    grid = choice.config.grid
    if grid is not None and grid.finest is not None:
        samples = min(strata(grid.finest, occupied), choice.config.sampling.batch)
        choice.take(
            "sampling.samples",
            samples,
            f"the grid has {grid.finest} vertices along the box, "
            f"{occupied:.0%} of which may hold something",
        )
    memory = available_memory()
    sampling = choice.config.sampling
    batch = fitting_batch(sampling.batch, sampling.samples, memory)
    choice.take(
        "sampling.batch",
        batch,
        f"a step keeps {batch * BYTES_PER_QUERY / 2**30:.2g} GiB at most "
        f"of the machine's {memory / 2**30:.0f} GiB",
    )


def strata(finest: int, occupied: float) -> int:
    """Strata a ray: one for two vertices of the finest grid, where not too much is evaluated.

    Args:
        finest: vertices along the box.
        occupied: share of the box in which samples are evaluated at first.
    """
    affordable = 48 / max(occupied, 0.5)
    return 64 if finest <= 128 else int(max(64, 16 * round(min(finest / 2, affordable) / 16)))


# ---- From probes ------------------------------------------------------------------


class _Questions:
    """What only training can tell; each answer is the ground for the next question."""

    def __init__(self, choice: _Settings, runs: Probes) -> None:
        self._choice, self._runs = choice, runs
        self._grows = choice.open("network.depth", "network.width", "network.view_width")

    def answer(self) -> Probe | None:
        """Asks them all, as far as the budget goes; returns the probe to go on with."""
        choice = self._choice
        directions = choice.open("network.view_d")
        features = choice.open("grid", "position") and choice.config.grid is not None
        if not (directions or self._grows or features):
            return None
        best = self._runs.first(choice.config)
        if best is None or not best.told:
            choice.leave("the budget is too short for probes")
            return best
        best = self._directions(best) if directions else best
        best = self._size(best) if self._grows else best
        return self._features(best) if features else best

    def _probe(self, like: Probe, *settings: str, cost: float = 1.0) -> Probe | None:
        """A probe of the model so far with some settings changed, if there is time."""
        config = with_settings(self._choice.config, list(settings))
        return self._runs.another(config, like, cost)

    def _directions(self, seeing: Probe) -> Probe:
        """Leaves directions out if that costs little; returns the probe of what remains."""
        choice, setting, even = self._choice, "network.view_dependent", seeing.averaged
        why = (
            f"{len(self._runs)} views held back have {seeing.quality:.2f} dB after "
            f"{seeing.steps} steps, {even:.2f} with light averaged over directions"
        )
        if even < seeing.quality - MOST_LOST:
            choice.take(setting, True, why)
            return seeing
        blind = self._probe(seeing, f"{setting}=false", "network.view_depth=0")
        if blind is None:
            choice.take(setting, True, f"{why}, but no time for a probe without directions")
            return seeing
        needless = blind.quality >= seeing.quality - MOST_LOST
        why += f", {blind.quality:.2f} trained without directions"
        why += f", at {1e3 * blind.seconds:.1f} instead of {1e3 * seeing.seconds:.1f} ms a step"
        choice.take(setting, not needless, why)
        if needless:
            choice.take("network.view_depth", 0, "without directions, no layers behind them")
        return blind if needless else seeing

    def _size(self, usual: Probe) -> Probe:
        """Grows the network as long as it pays; returns the probe of what it came to."""
        best, shape, said = usual, _USUAL, [_report(_USUAL, usual)]
        for larger in _LARGER:
            cost = larger[0] * larger[1] / (shape[0] * shape[1])
            probe = self._probe(best, *_shape(*larger), cost=cost)
            if probe is None:
                break
            said.append(_report(larger, probe))
            if not worth_growing(best, probe):
                break
            best, shape = probe, larger
        if len(said) == 1:
            said.append("as in preset fast: no time for a probe of a larger one")
        self._take_shape(shape, ", ".join(said))
        return best

    def _take_shape(self, shape: tuple[int, int], why: str) -> None:
        depth, width = shape
        self._choice.take("network.width", width, why)
        self._choice.take("network.view_width", width, "as network.width")
        self._choice.take("network.depth", depth, "with network.width")

    def _features(self, hashed: Probe) -> Probe:
        """Fourier features alone, if they have learnt more in as many steps."""
        choice = self._choice
        trial = _Settings(choice.config, set())
        _settle_fourier(trial, "")
        why = "as in preset fast: no time for a probe of Fourier features"
        probe = self._runs.another(trial.config, hashed, _FOURIER_COST)
        if probe is not None:
            why = (
                f"after {hashed.steps} steps {hashed.quality:.2f} dB with a hash grid, "
                f"{probe.quality:.2f} with Fourier features"
            )
            if probe.quality >= hashed.quality + MARGIN:
                _settle_fourier(choice, why)
                return probe
        assert choice.config.grid is not None
        choice.take("grid.levels", choice.config.grid.levels, why)
        return hashed


def worth_growing(smaller: Probe, larger: Probe) -> bool:
    """Whether the larger model gains more than the smaller one would in the same time."""
    rivals = smaller.slope * math.log2(max(1.0, larger.seconds / smaller.seconds))
    return larger.quality - smaller.quality > max(rivals, MARGIN)


def _settle_fourier(choice: _Settings, why: str) -> None:
    """The network of preset ``nerf`` in place of a hash grid."""
    model, network = nerf(), nerf().network
    choice.take("grid", None, why)
    choice.take("position", None, why)
    for name in ("depth", "width", "view_depth", "view_width"):
        choice.take(f"network.{name}", getattr(network, name), why)
    choice.take("sampling.batch", usual_batch(features=False), why)
    choice.take("sampling.hidden", model.sampling.hidden, why)
    choice.take("optimizer.muon", model.optimizer.muon, why)


def _shape(depth: int, width: int) -> list[str]:
    return [f"network.depth={depth}", f"network.width={width}", f"network.view_width={width}"]


def _report(shape: tuple[int, int], probe: Probe) -> str:
    return f"{shape[0]}x{shape[1]}: {probe.quality:.2f} dB at {1e3 * probe.seconds:.1f} ms a step"


def _changed(config: TrainConfig) -> set[str]:
    """Names of the settings in which ``config`` differs from its preset."""
    found, usual = (dict(leaves(to_json(c))) for c in (config, preset(config.preset)))
    return {name for name, value in found.items() if name not in usual or value != usual[name]}
