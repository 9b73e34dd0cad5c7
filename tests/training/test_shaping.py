"""How a model of preset auto takes shape: what is asked, when, and what follows from it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import pytest

from mi_nerf.fields.fourier import FourierEncoding
from mi_nerf.training import shaping
from mi_nerf.training.auto import Decision
from mi_nerf.training.config import TrainConfig, with_settings
from mi_nerf.training.presets import preset
from mi_nerf.training.shaping import (
    ASKED,
    ASKED_STEPS,
    AT_ONCE,
    LAST,
    MOST_CHANGED,
    MOST_LOST,
    SETTLED,
    TRIAL,
    Shaping,
)

ASKED_ABOUT = {
    "network.view_dependent": True,
    "grid.log2_entries": 16,
    "sampling.render_samples": 128,
}


class FakeTrainer:
    """Counts steps and remembers what it was."""

    def __init__(self, config: TrainConfig) -> None:
        self.config, self.step_count, self.attempt = config, 0, 0
        self.history: list[tuple[int, TrainConfig]] = [(0, config)]

    @property
    def field_config(self) -> Any:
        position = self.config.position or FourierEncoding(frequencies=7)
        return SimpleNamespace(position=position)

    def become(self, config: TrainConfig) -> None:
        self.config = config
        self.history.append((self.step_count, config))


@dataclass
class Script:
    """What views held back say of a model."""

    even: float = 1.0  # lost with light averaged over directions
    # in the shape of a configuration, at a step, from the present one
    lost: Callable[[TrainConfig, int, TrainConfig], float] = lambda config, step, now: 2.0
    strata: dict[int, float] = field(default_factory=lambda: {64: 29.0, 96: 29.5})
    holds: list[tuple[int, bool]] = field(default_factory=list)


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Script:
    said = Script()

    class Scripted:
        def __init__(self, dataset: Any, trainer: FakeTrainer) -> None:
            self._trainer, self.holds = trainer, False

        def hold(self) -> None:
            self.holds = True
            said.holds.append((self._trainer.step_count, True))

        def give_back(self) -> None:
            self.holds = False
            said.holds.append((self._trainer.step_count, False))

        def quality(self, *, samples: int) -> float:
            return said.strata.get(samples, 30.0)

        def lost_as(self, config: TrainConfig) -> float:
            return said.lost(config, self._trainer.step_count, self._trainer.config)

        def lost_even(self) -> float:
            return said.even

    monkeypatch.setattr(shaping, "HeldBack", Scripted)
    return said


def begun(**changes: Any) -> tuple[TrainConfig, list[Decision]]:
    values = {**ASKED_ABOUT, **changes}
    config = with_settings(preset("auto"), [f"{n}={v}" for n, v in values.items()])
    return config, [Decision(n, v, "so far", open=True) for n, v in values.items()]


def shaped(
    config: TrainConfig, decisions: list[Decision], *, steps: int = 10000, until: float = 1.0
) -> FakeTrainer:
    trainer = FakeTrainer(config)
    policy = Shaping(trainer, None, decisions, lambda: trainer.step_count / steps)
    while trainer.step_count < until * steps:
        trainer.step_count += 1
        policy.after_step()
    return trainer


def reason(decisions: list[Decision], setting: str) -> str:
    return next(d.reason for d in decisions if d.setting == setting)


def entries(config: TrainConfig) -> int:
    assert config.grid is not None and config.grid.log2_entries is not None
    return config.grid.log2_entries


def test_it_stays_preset_fast_where_everything_is_needed(script: Script) -> None:
    config, decisions = begun()
    trainer = shaped(config, decisions)
    assert trainer.history == [(0, config)]
    assert not any(d.open for d in decisions)
    assert script.holds == [(0, True), (ASKED[-1] * 10000, False)]
    assert "would lose 2.00 dB, at once" in reason(decisions, "network.view_dependent")
    why = reason(decisions, "grid.log2_entries")
    assert why.endswith("at once, after 2000 steps 2.00 dB with 2^15")  # and not asked again


def test_what_is_nearly_needed_is_asked_about_again(script: Script) -> None:
    script.lost = lambda config, step, now: 1.5 * AT_ONCE
    config, decisions = begun()
    trainer = shaped(config, decisions)
    assert entries(trainer.config) == 16
    assert reason(decisions, "grid.log2_entries").count("0.90 dB with 2^15") == len(ASKED)


def test_what_is_not_missed_goes_at_once_and_together(script: Script) -> None:
    """0.2 dB for each halving at 2000 steps, more later; directions when colours are known."""
    script.even = 0.1
    script.lost = lambda config, step, now: 0.99e-4 * step * (entries(now) - entries(config))
    config, decisions = begun()
    trainer = shaped(config, decisions)
    assert [step for step, _ in trainer.history] == [0, *(share * 10000 for share in ASKED)]
    shapes = [c for _, c in trainer.history[1:]]
    assert [entries(c) for c in shapes] == [13, 11, 10, 10]  # 0.6, 0.6, 0.4 dB at once
    assert [c.network.view_dependent for c in shapes] == [True, True, True, False]
    assert shapes[-1].network.view_depth == 1
    why = reason(decisions, "network.view_dependent")
    assert why.startswith("taken out: after 5000 steps") and "0.10 with light averaged" in why


@pytest.mark.parametrize(("until", "first"), [(0.25, 0.3), (0.4, 0.5), (0.5, None)])
def test_nothing_is_asked_while_images_are_coarse(
    script: Script, until: float, first: float | None
) -> None:
    script.lost = lambda config, step, now: 0.0
    config, decisions = begun(**{"pyramid.levels": 3, "pyramid.until": until})
    kept = [d for d in decisions if not d.setting.startswith("pyramid")]
    trainer = shaped(config, kept)
    changed = [step / 10000 for step, _ in trainer.history[1:]]
    assert changed[:1] == ([] if first is None else [first])


@pytest.mark.parametrize(("less", "needed"), [(-0.01, False), (0.01, True)])
def test_directions_go_where_light_is_even(script: Script, less: float, needed: bool) -> None:
    script.even, script.lost = MOST_LOST + less, lambda config, step, now: 0.0
    config, decisions = begun()
    assert shaped(config, decisions).config.network.view_dependent == needed


@pytest.mark.parametrize("mean", [0.9, 1.1])
def test_a_large_change_is_not_made_even_if_light_is_even(script: Script, mean: float) -> None:
    """What the mean of directions costs at once does not count against smaller tables."""

    def lost(config: TrainConfig, step: int, now: TrainConfig) -> float:
        early = 0.8 if step < ASKED[-1] * 10000 else 0.0
        fewer = entries(now) - entries(config)
        return mean * (not config.network.view_dependent) + early + 0.25 * fewer

    script.even, script.lost = 0.0, lost
    config, decisions = begun()
    trainer = shaped(config, decisions)
    assert trainer.config.network.view_dependent == (mean > MOST_CHANGED)
    assert entries(trainer.config) == 14  # 0.5 dB at once


@pytest.mark.parametrize("enough", [10, 12, 15, 16])
def test_tables_are_halved_as_far_as_that_loses_little(script: Script, enough: int) -> None:
    script.lost = lambda config, step, now: 0.9 * AT_ONCE if entries(config) >= enough else 3.0
    config, decisions = begun()
    trainer = shaped(config, decisions)
    assert entries(trainer.config) == enough
    assert trainer.config.network.view_dependent  # which would lose as much


def test_octaves_of_fourier_features(script: Script) -> None:
    """L where two octaves more bring nothing; without a hash grid alone."""

    def lost(config: TrainConfig, step: int, now: TrainConfig) -> float:
        assert config.position is not None
        return 0.0 if config.position.frequencies >= 8 else 0.3

    script.lost = lost
    config = with_settings(preset("nerf"), ["position.frequencies=4"])
    decisions = [Decision("position.frequencies", 4, "to begin with", open=True)]
    trainer = shaped(config, decisions)
    assert trainer.config.position is not None and trainer.config.position.frequencies == 8
    octaves = [(n, c.position.frequencies) for n, c in trainer.history if c.position is not None]
    trial = round(TRIAL * 10000)
    assert [count for _, count in octaves] == [4, 6, 8, 10, 8]
    steps = [step for step, _ in octaves]
    apart = {b - a for a, b in pairwise(steps[1:])}
    assert steps[0] == 0 and apart <= {trial, trial + 1}
    assert "L = 10 without the last 2 would lose 0.00 dB" in decisions[0].reason


@pytest.mark.parametrize("steps", [300, 350, 700, 20000])
def test_all_views_are_learnt_from_in_time(script: Script, steps: int) -> None:
    script.lost = lambda config, step, now: 0.0
    config, decisions = begun()
    trainer = shaped(config, decisions, steps=steps, until=0.9)
    assert script.holds[-1][0] <= SETTLED * steps + 1 and not script.holds[-1][1]
    changed = [step for step, _ in trainer.history[1:]]
    assert all(ASKED_STEPS <= step <= SETTLED * steps for step in changed)
    assert not any(d.open for d in decisions if d.setting != "sampling.render_samples")
    if steps == 300:
        assert not changed
        assert "too few steps to ask" in reason(decisions, "grid.log2_entries")


def test_what_is_settled_is_not_asked(script: Script) -> None:
    config, _ = begun()
    settled = [Decision(n, v, "as before") for n, v in ASKED_ABOUT.items()]
    trainer = shaped(config, list(settled))
    assert trainer.history == [(0, config)] and script.holds == []


@pytest.mark.parametrize(
    ("strata", "chosen"),
    [
        ({64: 29.99, 96: 30.0, 192: 30.05}, 64),
        ({64: 29.9, 96: 29.99, 192: 30.05}, 96),
        ({64: 29.0, 96: 29.9, 192: 30.05}, 128),
        ({64: 29.0, 96: 29.5, 192: 30.2}, 192),
    ],
)
def test_as_few_strata_as_the_field_needs(
    script: Script, strata: dict[int, float], chosen: int
) -> None:
    script.strata = strata
    config, decisions = begun()
    before = shaped(config, list(decisions), until=LAST - 0.01)
    assert before.config.sampling.render_samples == 128
    trainer = shaped(config, decisions)
    assert trainer.config.sampling.render_samples == chosen
    assert "30.00 dB with 128" in reason(decisions, "sampling.render_samples")


def test_after_a_collapse_it_asks_when_there_is_something_to_ask(script: Script) -> None:
    """The first questions again, if they were not answered before."""
    script.lost = lambda config, step, now: 0.0
    config, decisions = begun()
    trainer = FakeTrainer(config)
    policy = Shaping(trainer, None, decisions, lambda: trainer.step_count / 10000)
    changed = []
    for step in range(1, 6001):
        trainer.step_count = step
        if step == 2000:
            trainer.attempt = 1
        changed += [step] if policy.after_step() else []
    assert changed[0] == ASKED[0] * 10000
    assert [step for step, _ in trainer.history[1:]] == changed[:1]
