"""What a published schedule is said to take, and what follows where nobody chose a budget."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mi_nerf.base.variants import array_module, choose_variant
from mi_nerf.cli import main
from mi_nerf.data import load_dataset
from mi_nerf.training import forecast as module
from mi_nerf.training import run as training
from mi_nerf.training.config import TrainConfig, with_settings
from mi_nerf.training.forecast import Forecast, duration, forecast, step_seconds
from mi_nerf.training.presets import preset
from mi_nerf.training.trainer import Trainer

VARIANT = choose_variant()
NARROW = ["network.width=16", "network.view_width=8", "sampling.rays=64"]
NARROW += ["sampling.samples=8", "sampling.fine=8", "collapse_check=0"]


def narrow(**changes: Any) -> TrainConfig:
    return replace(with_settings(preset("paper"), NARROW), **changes)


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        (0.0123, "0.012 s"),
        (1.0, "1 s"),
        (119.0, "119 s"),
        (120.0, "2 minutes"),
        (7000.0, "117 minutes"),
        (7300.0, "2 hours"),
        (90_000.0, "25 hours"),
        (4.8e6, "56 days"),
    ],
)
def test_durations(seconds: float, said: str) -> None:
    assert duration(seconds) == said


@pytest.mark.parametrize(
    ("step", "steps", "max_seconds", "said"),
    [
        (0.1, None, None, "200,000 steps take about 6 hours on this machine (0.1 s a step), as pu"),
        (24.0, 3000, None, "3,000 steps take about 20 hours on this machine (24 s a step); the p"),
        (24.0, 3000, None, "; the published 200,000 steps would take about 56 days"),
        (24.0, None, 600.0, "about 25 steps in 10 minutes on this machine (24 s a step); the pub"),
        (24.0, 10, 600.0, "10 steps take about 4 minutes on this machine"),
        (24.0, 100, 600.0, "about 25 steps in 10 minutes"),
        (24.0, 1, None, "1 step take"),
        (24.0, None, 20.0, "more than 20 s for a single step on this machine (24 s a step)"),
    ],
)
def test_sentences(step: float, steps: int | None, max_seconds: float | None, said: str) -> None:
    assert said in Forecast("paper", step, steps, max_seconds).sentence()


def test_trials_grow_until_they_take_long_enough(
    blob: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A step that costs a millisecond a ray, in the box of all views."""
    seen: list[int] = []
    config = narrow(sampling=replace(narrow().sampling, rays=4096))
    dataset = load_dataset(blob, "train")
    expected = Trainer(narrow(), dataset, array_module(VARIANT)).field_config

    def timed(trainer: Trainer) -> float:
        field = trainer.field_config
        np.testing.assert_allclose([field.lower, field.upper], [expected.lower, expected.upper])
        rays = trainer.config.sampling.rays or 0
        seen.append(rays)
        return 1e-3 * rays

    monkeypatch.setattr(module, "_timed_step", timed)
    assert step_seconds(config, dataset, array_module(VARIANT)) == pytest.approx(4.096)
    assert seen == [256] * 3 + [2048] * 3
    seen.clear()
    monkeypatch.setattr(module, "_timed_step", lambda t: 0.0 * timed(t))  # a very fast machine
    assert step_seconds(config, dataset, array_module(VARIANT)) == 0
    assert seen == [256] * 3 + [2048] * 3 + [4096] * 3


def test_the_fastest_of_the_steps_counts(blob: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first one compiles, another one was held up."""
    waits = iter([30.0, 2.0, 9.0])
    monkeypatch.setattr(module, "_timed_step", lambda _: next(waits))
    dataset = load_dataset(blob, "train")
    assert step_seconds(narrow(), dataset, array_module(VARIANT)) == 2.0


def test_the_measured_step_is_one_of_training(blob: Path) -> None:
    """The trial takes real steps: with 64 rays no share is left to guess."""
    dataset = load_dataset(blob, "train")
    taken: list[int] = []
    step = Trainer.step

    def counted(trainer: Trainer, rate: float) -> Any:
        taken.append(trainer.config.sampling.rays or 0)
        return step(trainer, rate)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Trainer, "step", counted)
        assert step_seconds(narrow(), dataset, array_module(VARIANT)) > 0
    assert taken == [64, 64, 64]


def test_rays_must_be_given(blob: Path) -> None:
    config = narrow(sampling=replace(narrow().sampling, rays=None))
    with pytest.raises(ValueError, match="sampling.rays=None, expected the number of rays"):
        step_seconds(config, load_dataset(blob, "train"), array_module(VARIANT))


def test_days_are_not_begun_unasked(
    refused: Callable[..., str], blob: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "step_seconds", lambda *_: 24.0)
    words = ["train", blob, "--out", tmp_path / "run", "--preset", "paper"]
    assert refused(*words) == (
        "mi-nerf: --preset paper: its 200,000 steps would take about 56 days on this machine "
        "(24 s a step), expected --max-seconds or --steps, for example --max-seconds 36000 or "
        "--steps 2000"
    )


@pytest.mark.parametrize("seconds", [0.43, 0.44])  # a day is 86,400 s
def test_a_day_is_begun(seconds: float) -> None:
    config = preset("paper")
    if seconds * 200_000 <= module.LONGEST:
        assert forecast(config, None, None, lambda *_: seconds).steps is None  # type: ignore
        return
    with pytest.raises(module.InputError, match="24 hours on this machine"):
        forecast(config, None, None, lambda *_: seconds)  # type: ignore[arg-type]


def test_the_schedule_follows_the_published_steps(
    blob: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Five of them here: the learning rate falls to its end, and a run cut short goes on."""
    for place in (module, training):
        monkeypatch.setattr(place, "PUBLISHED_STEPS", {"paper": 5})
    monkeypatch.setattr(module, "step_seconds", lambda *_: 0.25)
    run = training.start(blob, tmp_path / "run", narrow(report_every=0.0), VARIANT)
    assert run.config.steps == 5 and run.forecast is not None
    assert run.forecast.sentence().startswith("5 steps take about 1.2 s")
    for line in run.reports():
        if line["step"] == 2:
            break
    resumed = training.start(blob, tmp_path / "run", narrow(), VARIANT, resume=True)
    assert resumed.config.steps == 5 and resumed.trainer.step_count == 2
    assert resumed.forecast is None
    list(resumed.reports())
    log = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    options = run.config.optimizer
    ratio = options.lr_final / options.lr
    assert [line["step"] for line in log] == [1, 2, 3, 4, 5]
    expected = [options.lr * ratio ** (k / 5) for k in range(5)]
    np.testing.assert_allclose([line["learning_rate"] for line in log], expected, rtol=1e-6)


def test_the_command_says_what_was_chosen(
    blob: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    words = ["train", str(blob), "--out", str(out), "--preset", "paper", "--steps", "2"]
    assert main([*words, "--set", *NARROW]) == 0
    first = next(s for s in capsys.readouterr().out.splitlines() if s.startswith("paper: "))
    assert first.startswith("paper: 2 steps take about ") and "the published 200,000" in first
    assert json.loads((out / "config.json").read_text())["settings"]["steps"] == 2


def test_a_run_that_never_began_has_its_usual_budget(
    blob: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``--resume`` in an empty folder begins a run, which must end some day."""
    found: list[TrainConfig] = []

    def start(_data: Path, _out: Path, config: TrainConfig, *_: Any, **__: Any) -> None:
        found.append(config)
        raise module.InputError("stop")

    monkeypatch.setattr(training, "start", start)
    main(["train", str(blob), "--out", str(tmp_path / "new"), "--resume"])
    main(["train", str(blob), "--out", str(tmp_path / "new"), "--preset", "paper"])
    assert [(c.steps, c.max_seconds) for c in found] == [(None, 600), (None, None)]
