"""Preset ``auto``: how a run begins, by its data, and why; it takes shape as it goes on.

It is preset ``fast`` until something is known: the same model from the same seed. What follows
from the data alone (box, resolution, samples, activations) is written down with its reason.
Where there is time to ask, views are held back, and :mod:`mi_nerf.training.shaping` takes out,
while the run goes on, what these views do not miss, or adds what they call for.

The seed fixes all chance. But what a step costs is measured, so that another machine, or a
busier one, may decide otherwise.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict, dataclass
from typing import Any

from ..data import Dataset
from .config import TrainConfig, to_json, with_settings
from .held_back import FEWEST_VIEWS
from .model import field_config
from .plain import as_text, leaves
from .presets import preset
from .scaling import pixels_across, resolved, resolved_octaves

SHORTEST_SECONDS = 55.0  # of a run that has time to ask questions
SHORTEST_STEPS = 600  # likewise
SO_FAR = "as in preset fast so far"  # the reason for what training may still change
FEWEST_OCTAVES = 4  # of Fourier features, to begin with


@dataclass(frozen=True)
class Decision:
    """One setting that was chosen, and why."""

    setting: str
    value: Any  # as JSON knows it
    reason: str
    open: bool = False  # whether training may still change it

    def __str__(self) -> str:
        return f"{self.setting} = {as_text(self.value, '.4g')}: {self.reason}"

    def as_json(self) -> dict[str, Any]:
        """What ``config.json`` holds of it."""
        found = asdict(self)
        return found if self.open else {n: v for n, v in found.items() if n != "open"}


def record(decisions: list[Decision], new: Decision) -> None:
    """Puts a decision in the place of an earlier one on the same setting, or at the end."""
    for place, old in enumerate(decisions):
        if old.setting == new.setting:
            decisions[place] = new
            return
    decisions.append(new)


def is_open(decisions: Collection[Decision], setting: str) -> bool:
    """Whether training may still change a setting."""
    return any(d.setting == setting and d.open for d in decisions)


@dataclass(frozen=True)
class Choice:
    """The configuration with which a run begins, and every setting that was chosen."""

    config: TrainConfig
    decisions: list[Decision]


def choose(config: TrainConfig, dataset: Dataset, *, given: Collection[str] = ()) -> Choice:
    """Chooses the configuration with which a run on a dataset begins.

    Args:
        config: of preset ``auto``. What differs from the preset is kept.
        given: names of settings that are kept even where they do not differ.
    """
    choice = _Settings(config, set(given) | _changed(config))
    _settle_data(choice, dataset)
    _settle_sizes(choice, dataset)
    _settle_questions(choice, len(dataset))
    return Choice(choice.config, choice.decisions)


def decisions_in(record: dict[str, Any], config: TrainConfig) -> list[Decision]:
    """What ``config.json`` says was decided, as far as it agrees with a configuration.

    A run that was killed may have changed its shape after it last wrote down why.
    """
    values = dict(leaves(to_json(config)))
    try:
        found = [Decision(**decision) for decision in record.get("auto", ())]
    except TypeError:  # written by another version
        return []
    return [
        d
        if values.get(d.setting, d.value) == d.value
        else Decision(d.setting, values[d.setting], "as it was when the run was interrupted")
        for d in found
    ]


class _Settings:
    """A configuration that is being settled."""

    def __init__(self, config: TrainConfig, fixed: set[str]) -> None:
        self.config, self._fixed = config, fixed
        self.decisions: list[Decision] = []

    def open(self, *prefixes: str) -> bool:
        """Whether the user has left all settings alone whose names begin so."""
        return not any(name.startswith(prefixes) for name in self._fixed)

    def take(self, setting: str, value: Any, reason: str, *, open_still: bool = False) -> None:
        """Settles one setting, unless the user has."""
        if self.open(setting):
            self.config = with_settings(self.config, [f"{setting}={as_text(value)}"])
            record(self.decisions, Decision(setting, value, reason, open_still))


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


def _settle_sizes(choice: _Settings, dataset: Dataset) -> None:
    """What grows with the images, as for every preset."""
    before = dict(leaves(to_json(choice.config)))
    choice.config = config = resolved(choice.config, dataset)
    assert config.box is not None  # any more
    across = pixels_across(dataset, config.box[:3], config.box[3:])
    for name, value in leaves(to_json(config)):
        if before.get(name) is None and value is not None:
            choice.take(name, value, f"{across:.0f} pixels across the box")


# ---- What training will tell ------------------------------------------------------


def _settle_questions(choice: _Settings, views: int) -> None:
    """What may still change, where there is time to ask."""
    config = choice.config
    network, grid = config.network, config.grid
    hurry = _hurry(config, views)
    why = SO_FAR if hurry is None else f"as in preset fast: {hurry}"
    asks = hurry is None
    if network.view_dependent and choice.open("network.view_d"):
        choice.take("network.view_dependent", True, why, open_still=asks)
    if grid is not None and choice.open("grid"):
        choice.take("grid.log2_entries", grid.log2_entries, why, open_still=asks)
    position = config.position
    if grid is None and position is not None and choice.open("position") and asks:
        few = min(position.frequencies, FEWEST_OCTAVES)
        why_few = f"to begin with; the images resolve {position.frequencies}"
        choice.take("position.frequencies", few, why_few, open_still=True)
    strata = config.sampling.render_samples
    choice.take("sampling.render_samples", strata, SO_FAR, open_still=True)


def _hurry(config: TrainConfig, views: int) -> str | None:
    """Why nothing can be asked, if so."""
    seconds, steps = config.max_seconds, config.steps
    if seconds is not None and seconds < SHORTEST_SECONDS:
        return f"{seconds:g} s are too few to ask what else"
    if steps is not None and steps < SHORTEST_STEPS:
        return f"{steps} steps are too few to ask what else"
    if views < FEWEST_VIEWS:
        return f"{views} views, too few to hold any back"
    return "two networks keep their shape" if config.sampling.fine else None


def _changed(config: TrainConfig) -> set[str]:
    """Names of the settings in which ``config`` differs from its preset."""
    found, usual = (dict(leaves(to_json(c))) for c in (config, preset(config.preset)))
    return {name for name, value in found.items() if name not in usual or value != usual[name]}
