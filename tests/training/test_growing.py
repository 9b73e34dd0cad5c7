"""How a model of preset auto grows: what is asked, when, and what follows from the answers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import pytest

from mi_nerf.fields.fourier import FourierEncoding
from mi_nerf.training import growing
from mi_nerf.training.auto import SMALL, Decision
from mi_nerf.training.config import TrainConfig, with_settings
from mi_nerf.training.growing import FIRST, GROWN, LAST, TRIAL, Growing
from mi_nerf.training.presets import preset

BEGUN = {
    "network.view_dependent": False,
    "network.view_depth": 0,
    "grid.log2_entries": 14,
    "network.depth": 1,
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

    def snapshot(self) -> TrainConfig:
        return self.config

    def go_on_from(self, config: TrainConfig) -> None:
        self.config = config
        self.history.append((self.step_count, config))

    become = go_on_from


@dataclass
class Script:
    """What views held back say of a model."""

    quality: Callable[[TrainConfig, int], float] = lambda config, step: 30.0
    even: float = 1.0  # lost without directions
    lost: Callable[[TrainConfig], float] = lambda config: 1.0  # in the shape of
    strata: dict[int, float] = field(default_factory=dict)
    holds: list[bool] = field(default_factory=list)


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Script:
    said = Script()

    class Scripted:
        def __init__(self, dataset: Any, trainer: FakeTrainer) -> None:
            self._trainer, self.holds = trainer, False

        def hold(self) -> None:
            self.holds = True
            said.holds.append(True)

        def give_back(self) -> None:
            self.holds = False
            said.holds.append(False)

        def quality(self, *, samples: int | None = None) -> float:
            if samples is not None:
                return said.strata.get(samples, 30.0)
            return said.quality(self._trainer.config, self._trainer.step_count)

        def lost_as(self, config: TrainConfig) -> float:
            return said.lost(config)

        def lost_even(self) -> float:
            return said.even

    monkeypatch.setattr(growing, "HeldBack", Scripted)
    return said


def begun(**changes: Any) -> tuple[TrainConfig, list[Decision]]:
    values = {**BEGUN, **changes}
    config = with_settings(preset("auto"), [f"{n}={v}" for n, v in values.items()])
    return config, [Decision(n, v, f"{SMALL}, so") for n, v in values.items()]


def grown(
    config: TrainConfig, decisions: list[Decision], *, steps: int = 10000, until: float = 1.0
) -> FakeTrainer:
    """Takes steps of a hundredth of a second each."""
    trainer = FakeTrainer(config)
    policy = Growing(
        trainer,
        None,
        decisions,
        lambda: trainer.step_count / steps,
        lambda: 0.01 * trainer.step_count,
    )
    while trainer.step_count < until * steps:
        trainer.step_count += 1
        policy.after_step()
    return trainer


def reason(decisions: list[Decision], setting: str) -> str:
    return next(d.reason for d in decisions if d.setting == setting)


def test_everything_is_added_that_is_needed(script: Script) -> None:
    """One after the other, each tried for its share of the budget."""
    config, decisions = begun()
    trainer = grown(config, decisions)
    steps = [round(step / 10000, 2) for step, _ in trainer.history]
    assert steps == [0.0, FIRST, FIRST + TRIAL, FIRST + 2 * TRIAL, *steps[4:]]
    network, grid = trainer.config.network, trainer.config.grid
    assert network.view_dependent and network.view_depth == 1
    assert grid is not None and grid.log2_entries == 16  # the preset's, and no more
    values = {d.setting: d.value for d in decisions}
    assert values["grid.log2_entries"] == 16 and values["network.view_dependent"] is True
    assert all(not d.reason.startswith(SMALL) for d in decisions if d.setting != "network.view_x")
    assert script.holds == [True, False]


def test_nothing_is_added_to_what_needs_nothing(script: Script) -> None:
    script.even, script.lost = 0.1, lambda config: 0.01
    config, decisions = begun()
    trainer = grown(config, decisions)
    assert (
        with_settings(trainer.config, ["sampling.render_samples=128", "network.view_depth=0"])
        == config
    )
    assert "taken out again" in reason(decisions, "network.view_dependent")
    assert "0.10" in reason(decisions, "network.view_dependent")
    assert "2^15 halved again would lose 0.01 dB" in reason(decisions, "grid.log2_entries")


@pytest.mark.parametrize(("even", "needed"), [(0.19, False), (0.21, True)])
def test_directions_stay_where_their_mean_would_not_do(
    script: Script, even: float, needed: bool
) -> None:
    script.even, script.lost = even, lambda config: 0.01
    config, decisions = begun()
    assert grown(config, decisions).config.network.view_dependent == needed


@pytest.mark.parametrize(("enough", "ends"), [(14, 14), (15, 15), (20, 16)])
def test_tables_double_as_long_as_they_need_to(script: Script, enough: int, ends: int) -> None:
    script.lost = lambda config: 0.0 if config.grid.log2_entries >= enough else 0.5
    config, decisions = begun()
    trainer = grown(config, decisions)
    assert trainer.config.grid.log2_entries == ends
    assert len({c.grid.log2_entries for _, c in trainer.history}) == min(ends + 1, 16) - 13


def test_octaves_of_fourier_features(script: Script) -> None:
    """L where two octaves more bring nothing; without a hash grid alone."""
    script.lost = lambda config: 0.0 if config.position.frequencies >= 8 else 0.3
    config = with_settings(preset("nerf"), ["position.frequencies=4"])
    decisions = [Decision("position.frequencies", 4, f"{SMALL}, few")]
    trainer = grown(config, decisions)
    assert trainer.config.position.frequencies == 8
    assert [c.position.frequencies for _, c in trainer.history] == [4, 6, 8, 10, 8]
    assert "L = 10 without the last 2 would lose 0.00 dB" in decisions[0].reason


@pytest.mark.parametrize(("gain", "depth"), [(0.9, 2), (0.2, 1)])
def test_a_layer_has_to_gain_more_than_time_does(script: Script, gain: float, depth: int) -> None:
    """The smaller network learns 0.3 dB in every trial's time."""
    script.even, script.lost = 0.0, lambda config: 0.0

    def quality(config: TrainConfig, step: int) -> float:
        return 30 + step / (TRIAL * 10000) * 0.3 + (gain - 0.3) * (config.network.depth - 1)

    script.quality = quality
    config, decisions = begun()
    trainer = grown(config, decisions)
    assert trainer.config.network.depth == depth
    assert f"gained {gain:.2f} dB" in reason(decisions, "network.depth")
    assert "0.30 just before" in reason(decisions, "network.depth")


def test_a_layer_is_tried_in_long_runs_only(script: Script) -> None:
    config, decisions = begun()
    trainer = grown(config, decisions, steps=3000)
    assert {c.network.depth for _, c in trainer.history} == {1}
    assert "no time" in reason(decisions, "network.depth")


def test_growth_ends_in_time(script: Script) -> None:
    """In a short run trials take their least number of steps each, as long as that goes."""
    for steps in (400, 700, 1500, 20000):
        script.holds.clear()
        config, decisions = begun()
        trainer = grown(config, decisions, steps=steps, until=0.9)
        assert max(step for step, _ in trainer.history) <= GROWN * steps + 1
        assert script.holds == [True, False]


def test_where_steps_are_slow_it_is_preset_fast_at_once(script: Script) -> None:
    config, decisions = begun()
    trainer = grown(config, decisions, steps=400, until=0.9)
    assert [step for step, _ in trainer.history] == [0, 21]
    assert trainer.config.network == preset("fast").network
    assert trainer.config.grid == preset("fast").grid
    assert "too few steps" in reason(decisions, "grid.log2_entries")
    assert script.holds == [True, False]
    config, decisions = begun()
    kept = [d for d in decisions if d.setting not in ("network.view_dependent", "network.depth")]
    assert not grown(config, kept, steps=400).config.network.view_dependent


def test_what_is_settled_is_not_asked(script: Script) -> None:
    config, _ = begun()
    settled = [Decision(n, v, "as before") for n, v in BEGUN.items()]
    trainer = grown(config, list(settled))
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
    before = grown(config, list(decisions), until=LAST - 0.01)
    assert before.config.sampling.render_samples == 128
    trainer = grown(config, decisions)
    assert trainer.config.sampling.render_samples == chosen
    assert "30.00 dB with 128" in reason(decisions, "sampling.render_samples")


def test_after_a_collapse_it_asks_again(script: Script) -> None:
    config, decisions = begun()
    trainer = FakeTrainer(config)
    policy = Growing(trainer, None, decisions, lambda: trainer.step_count / 10000)
    changed = []
    for _ in range(int(10000 * (FIRST + TRIAL / 2))):
        trainer.step_count += 1
        changed.append(policy.after_step())
    assert trainer.config.network.view_dependent and sum(changed) == 1
    trainer.attempt = 1
    trainer.config = replace(config)
    for _ in range(int(10000 * (FIRST + 1.5 * TRIAL))):
        trainer.step_count += 1
        policy.after_step()
    assert trainer.config.network.view_dependent
    assert reason(decisions, "network.view_dependent").startswith("added")
