"""Preset ``auto``: how a run begins, by its data, and why; it grows as it goes on.

It is preset ``fast`` where nothing is known. What follows from the data alone (box,
resolution, samples, batch, activations) is fixed at first. Where there is time to ask, the
model begins small, without directions and with tables of a quarter of the size, and
:mod:`mi_nerf.training.growing` lets it grow while it trains.

The seed fixes all chance. But what a step costs is measured, so that another machine, or a
busier one, may decide otherwise.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from ..base.machine import available_memory
from ..data import Dataset
from .config import TrainConfig, to_json, with_settings
from .held_back import FEWEST_VIEWS
from .model import carved_cells, field_config, resolved_octaves
from .plain import as_text, leaves
from .presets import preset

SHORTEST_SECONDS = 55.0  # of a run that has time to ask questions
SHORTEST_STEPS = 900  # likewise
SMALL = "to begin with"  # how reasons begin of what may still grow
SMALLER_TABLE = 2  # of the logarithm of its entries, to begin with
_FEWEST_OCTAVES = 4  # of Fourier features, to begin with
_MEMORY_SHARE = 0.125  # of the machine's, for what one step keeps
_BYTES_PER_QUERY = 8192  # activations, their gradients, samples: generous for a narrow network


@dataclass(frozen=True)
class Decision:
    """One setting that was chosen, and why."""

    setting: str
    value: Any  # as JSON knows it
    reason: str

    def __str__(self) -> str:
        return f"{self.setting} = {as_text(self.value, '.4g')}: {self.reason}"


def record(decisions: list[Decision], new: Decision) -> None:
    """Puts a decision in the place of an earlier one on the same setting, or at the end."""
    for place, old in enumerate(decisions):
        if old.setting == new.setting:
            decisions[place] = new
            return
    decisions.append(new)


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
    field = field_config(choice.config, dataset)
    cells = carved_cells(choice.config, dataset, field)
    _settle_sampling(choice, float(cells.mean()))
    _settle_beginning(choice, len(dataset))
    return Choice(choice.config, choice.decisions)


def decisions_in(record: dict[str, Any], config: TrainConfig) -> list[Decision]:
    """What ``config.json`` says was decided, as far as it agrees with a configuration.

    A run that was killed may have grown after it last wrote down why.
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


def may_grow(decisions: Collection[Decision], setting: str) -> bool:
    """Whether a setting is still as small as a run began with."""
    return any(d.setting == setting and d.reason.startswith(SMALL) for d in decisions)


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
            record(self.decisions, Decision(setting, value, reason))


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
        f"a step keeps {batch * _BYTES_PER_QUERY / 2**30:.2g} GiB at most "
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


def fitting_batch(wanted: int, samples: int, memory: int) -> int:
    """Queries a step that keep no more than a fair part of ``memory`` bytes; a ray's at least."""
    while wanted > samples and wanted * _BYTES_PER_QUERY > _MEMORY_SHARE * memory:
        wanted //= 2
    return max(wanted, samples)


def _settle_beginning(choice: _Settings, views: int) -> None:
    """A small model where there is time for it to grow, else that of preset ``fast``."""
    config = choice.config
    seconds, steps = config.max_seconds, config.steps
    hurry = None
    if seconds is not None and seconds < SHORTEST_SECONDS:
        hurry = f"{seconds:g} s are too few to ask what else"
    elif steps is not None and steps < SHORTEST_STEPS:
        hurry = f"{steps} steps are too few to ask what else"
    elif views < FEWEST_VIEWS:
        hurry = f"{views} views, too few to hold any back"
    elif config.sampling.fine:
        hurry = "two networks do not grow"
    network, grid = config.network, config.grid
    why = (
        f"as in preset fast: {hurry}" if hurry else f"{SMALL}, light does not depend on directions"
    )
    directions = choice.open("network.view_d") and network.view_width >= network.width
    if directions and network.view_dependent and (hurry or network.view_depth == 1):
        choice.take("network.view_dependent", bool(hurry), why)
        if not hurry:
            choice.take("network.view_depth", 0, "without directions, no layers behind them")
    if grid is not None and choice.open("grid"):
        less = 0 if hurry else SMALLER_TABLE
        why = f"as in preset fast: {hurry}" if hurry else f"{SMALL}, a quarter of preset fast's"
        choice.take("grid.log2_entries", grid.log2_entries - less, why)
    position = config.position
    if grid is None and position is not None and choice.open("position") and not hurry:
        why = f"{SMALL}; the images resolve {position.frequencies}"
        choice.take("position.frequencies", min(position.frequencies, _FEWEST_OCTAVES), why)
    if choice.open("network.depth", "network.skip"):
        why = f"as in preset fast: {hurry}" if hurry else f"{SMALL}, as in preset fast"
        choice.take("network.depth", network.depth, why)
    choice.take(
        "sampling.render_samples",
        config.sampling.render_samples,
        f"{SMALL}, as in preset fast; the trained field says how many it needs",
    )


def _changed(config: TrainConfig) -> set[str]:
    """Names of the settings in which ``config`` differs from its preset."""
    found, usual = (dict(leaves(to_json(c))) for c in (config, preset(config.preset)))
    return {name for name, value in found.items() if name not in usual or value != usual[name]}
