"""Preset auto: what it decides, on what grounds, and at what cost."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit.llvm.ad as llvm
import numpy as np
import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.cli import main
from mi_nerf.data import Dataset, load_dataset
from mi_nerf.tasks.ablate import ablate
from mi_nerf.training import auto, probes
from mi_nerf.training import run as training
from mi_nerf.training.auto import Decision, choose, fitting_batch, strata, worth_growing
from mi_nerf.training.config import TrainConfig, with_settings
from mi_nerf.training.model import resolved_octaves
from mi_nerf.training.presets import preset
from mi_nerf.training.probes import Probe, Probes
from mi_nerf.training.run_folder import read_config
from mi_nerf.training.trainer import Trainer
from tests.support.datasets import blob_images, orbit_poses, write_blender_dataset

VIEWS, SIZE = 20, 20
SMALL = ["occupancy.resolution=16", "grid.levels=3", "grid.log2_entries=10", "grid.finest=32"]
SMALL += ["sampling.samples=32", "network.width=32", "network.view_width=32"]
FOURIER = ["grid=none", "position.frequencies=4", "occupancy.resolution=16", *SMALL[-3:]]


def views_of(folder: Path, **kind: bool) -> Dataset:
    poses = np.concatenate([orbit_poses(VIEWS // 2, height=h) for h in (0.5, 2.0)])
    write_blender_dataset(folder, blob_images(poses, SIZE, 0.6, **kind), poses, 0.6)
    return load_dataset(folder, "train")


@pytest.fixture(scope="module")
def diffuse(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return views_of(tmp_path_factory.mktemp("diffuse"))


@pytest.fixture(scope="module")
def mirror(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return views_of(tmp_path_factory.mktemp("mirror"), mirror=True)


def start(*settings: str, **changes: Any) -> TrainConfig:
    return replace(with_settings(preset("auto"), list(settings)), **changes)


def decided(*args: Any, **options: Any) -> tuple[TrainConfig, list[Decision]]:
    choice = choose(*args, **options)
    return choice.config, choice.decisions


def chosen(decisions: list[Decision]) -> dict[str, Any]:
    return {decision.setting: decision.value for decision in decisions}


def chosen_for(setting: str, decisions: list[Decision]) -> Decision:
    return next(d for d in decisions if d.setting == setting)


# ---- From the data alone -----------------------------------------------------------


@pytest.mark.slow
def test_what_follows_from_the_data(diffuse: Dataset) -> None:
    config, decisions = decided(start(steps=1), diffuse, llvm)
    found = chosen(decisions)
    box = found["box"]
    assert config.box == tuple(box) and all(
        a < -0.7 < 0.7 < b for a, b in zip(box[:3], box[3:], strict=True)
    )
    octaves = resolved_octaves(diffuse, tuple(box[:3]), tuple(box[3:]))
    assert config.grid.finest == found["grid.finest"] == max(16, 2 ** (octaves + 1))
    assert (config.loss, config.color_activation) == ("mse", "sigmoid")
    assert config.background == "random"
    linear = replace(diffuse, color_space="linear", has_alpha=False)
    config, _ = decided(start(steps=1), linear, llvm)
    assert (config.loss, config.color_activation) == ("relative", "exp")
    assert config.background == "white" and config.preset == "auto"


@pytest.mark.slow
def test_without_time_for_probes_it_is_preset_fast(diffuse: Dataset) -> None:
    config, decisions = decided(start(steps=10), diffuse, llvm)
    fast = preset("fast")
    assert config.network == fast.network
    assert replace(config.grid, finest=None, log2_entries=None) == fast.grid
    assert all(decision.reason for decision in decisions)
    _, decisions = decided(start(steps=10**6), diffuse.subset(range(3)), llvm)
    assert "3 views, too few to hold any back" in str(decisions[-1])


@pytest.mark.slow
def test_the_choice_is_that_of_a_trainer_left_alone(diffuse: Dataset) -> None:
    """Values found are those that a run of preset fast would find for itself."""
    config, _ = decided(start(steps=1), diffuse, llvm)
    trainers = [Trainer(c, diffuse, llvm) for c in (config, preset("fast"))]
    assert trainers[0].field_config == trainers[1].field_config
    assert float(trainers[0].step(1e-2).loss[0]) == float(trainers[1].step(1e-2).loss[0])


def test_strata_follow_the_grid_and_the_space() -> None:
    assert strata(32, 0.2) == strata(128, 1.0) == 64
    assert strata(256, 0.2) == 96
    assert strata(1024, 1.0) == 64


def test_the_batch_fits_into_memory() -> None:
    assert fitting_batch(16384, 64, 64 << 30) == 16384
    assert fitting_batch(16384, 64, 256 << 20) == 4096
    assert fitting_batch(16384, 64, 1) == 64


# ---- From probes, by the book --------------------------------------------------------


def probe(quality: float, **changes: float) -> Probe:
    values = {"steps": 300, "seconds": 0.01, "quality": quality, "slope": 1.0}
    return Probe(**{**values, "averaged": quality - 1, **changes})


class Scripted:
    """Stands in for :class:`Probes`: answers from a table, by what a model is."""

    def __init__(self, answers: dict[str, Probe | None]) -> None:
        self.answers = answers
        self.asked: list[str] = []

    def __call__(self, *_: Any) -> Scripted:
        return self

    def __len__(self) -> int:
        return 4

    def first(self, config: TrainConfig) -> Probe | None:
        network = config.network
        name = f"{network.depth}x{network.width}" + " flat" * (not network.view_dependent)
        name = "fourier" if config.grid is None else name
        self.asked.append(name)
        return self.answers.get(name)

    def another(self, config: TrainConfig, like: Probe, cost: float = 1.0) -> Probe | None:
        assert cost >= 1 and self.asked
        return self.first(config)


@pytest.fixture
def script(
    diffuse: Dataset, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[TrainConfig, list[Decision], list[str]]]:
    def run(
        answers: dict[str, Probe | None], *settings: str
    ) -> tuple[TrainConfig, list[Decision], list[str]]:
        scripted = Scripted(answers)
        monkeypatch.setattr(auto, "Probes", scripted)
        given = {s.partition("=")[0] for s in settings}
        coarse = start("occupancy.resolution=16", *settings)
        config, decisions = decided(coarse, diffuse, llvm, given=given)
        return config, decisions, scripted.asked

    return run


@pytest.mark.slow
@pytest.mark.parametrize(
    ("averaged", "flat", "needed"),
    [
        (30.1, 30.3, False),
        (29.85, 29.85, False),
        (29.75, 30.5, True),
        (30.5, 29.75, True),
        (30.5, None, True),
        (29.0, 29.0, True),
    ],
)
def test_directions_go_only_if_both_tests_say_so(
    script: Any, averaged: float, flat: float | None, needed: bool
) -> None:
    answers = {"1x64": probe(30.0, averaged=averaged)}
    answers["1x64 flat"] = None if flat is None else probe(flat)
    config, decisions, asked = script(answers)
    assert config.network.view_dependent == needed
    assert config.network.view_depth == (1 if needed else 0)
    assert ("1x64 flat" in asked) == (averaged >= 29.8)  # else there is nothing to confirm
    reason = chosen_for("network.view_dependent", decisions).reason
    assert "30.00" in reason and f"{averaged:.2f}" in reason


@pytest.mark.slow
def test_the_network_grows_while_it_pays(script: Any) -> None:
    answers = {"1x64": probe(30.0), "2x64": probe(30.1, seconds=0.02)}
    config, decisions, asked = script(answers)
    assert (config.network.depth, config.network.width, config.network.view_width) == (1, 64, 64)
    assert asked == ["1x64", "2x64", "fourier"]
    reason = chosen_for("network.width", decisions).reason
    assert reason.startswith("1x64: 30.00 dB at 10.0 ms a step, 2x64: 30.10 dB")
    config, _, _ = script({**answers, "2x64": probe(33.0), "2x128": None})
    assert (config.network.depth, config.network.width) == (2, 64)
    config, decisions, _ = script({"1x64": probe(30.0)})
    assert config.network.width == 64
    assert "no time for a probe of a larger" in str(chosen_for("network.width", decisions))


def test_twice_the_time_has_to_bring_more_than_twice_the_steps() -> None:
    assert worth_growing(probe(30.0), probe(31.1, seconds=0.02))
    assert not worth_growing(probe(30.0), probe(30.9, seconds=0.02))
    assert worth_growing(probe(30.0), probe(30.1))  # at no cost
    assert not worth_growing(probe(30.0), probe(30.01))


@pytest.mark.slow
def test_fourier_features_where_they_learn_more(script: Any) -> None:
    answers = {"1x64": probe(30.0), "fourier": probe(30.2)}
    config, decisions, _ = script(answers)
    assert config.grid is None and config.position is None
    assert config.network.width == 256 and config.sampling.hidden == 0
    assert config.optimizer.muon  # as in the preset whose network it is
    assert chosen(decisions)["grid"] is None
    config, decisions, _ = script({**answers, "fourier": probe(29.0)})
    assert config.grid is not None and chosen(decisions)["grid.levels"] == 8
    _, decisions, asked = script({"1x64": probe(30.0)})
    assert "fourier" in asked and "no time" in str(decisions[-1])


@pytest.mark.slow
def test_nothing_is_decided_without_a_first_probe(script: Any) -> None:
    for first in (None, probe(math.nan, steps=40)):
        config, decisions, asked = script({"1x64": first})
        assert config.network == preset("fast").network and asked == ["1x64"]
        assert "too short for probes" in str(decisions[-1])


@pytest.mark.slow
def test_what_the_user_sets_is_neither_probed_nor_changed(script: Any) -> None:
    answers = {"1x64": probe(30.0, averaged=31.0), "1x64 flat": probe(31.0)}
    answers |= {"1x48": probe(30.0, averaged=30.0), "fourier": probe(29.0)}
    settings = ["network.view_dependent=true", "network.width=48", "grid.levels=8"]
    config, decisions, asked = script(answers, *settings)
    assert asked == []
    assert config.network.view_dependent and config.network.width == 48
    assert not set(chosen(decisions)) & {s.partition("=")[0] for s in settings}
    _, _, asked = script(answers, "network.width=48")
    assert asked == ["1x48", "1x48 flat", "fourier"]
    config, decisions, _ = script({}, "sampling.samples=40", "box=-1,-1,-1,1,1,1", "loss=relative")
    assert config.sampling.samples == 40 and config.loss == "relative"
    assert config.box == (-1, -1, -1, 1, 1, 1)
    assert not set(chosen(decisions)) & {"sampling.samples", "box", "loss"}


# ---- Probes ---------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["diffuse", "mirror"])
def test_directions_are_seen_where_they_matter(
    kind: str, diffuse: Dataset, mirror: Dataset
) -> None:
    config = start(*SMALL, "sampling.batch=4096", steps=4000)
    data = {"diffuse": diffuse, "mirror": mirror}[kind]
    choice = choose(config, data, llvm)
    assert choice.config.network.view_dependent == (kind == "mirror"), choice.decisions
    assert choice.trainer is not None and choice.trainer.config == choice.config
    assert choice.trainer.step_count == probes.STEPS


def counted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Grows with every training step."""
    steps: list[int] = []
    step = Trainer.step

    def counting(self: Trainer, *arguments: float) -> Any:
        steps.append(1)
        return step(self, *arguments)

    monkeypatch.setattr(Trainer, "step", counting)
    return steps


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probes, "FEWEST", 4)
    monkeypatch.setattr(probes, "STEPS", 8)
    monkeypatch.setattr(probes, "_PACED", 2)


def prober(data: Dataset, config: TrainConfig, clock: Callable[[], float] = lambda: 0.0) -> Probes:
    return Probes(config, data, llvm, np.ones((16, 16, 16), bool), clock)


def test_views_are_held_back(diffuse: Dataset) -> None:
    runs = prober(diffuse, start(steps=10))
    held, others = set(runs._held_back.names), set(runs._others.names)
    assert len(runs) == 4 and not held & others and held | others == set(diffuse.names)


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_probes_keep_to_their_share_of_steps(
    diffuse: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first one's steps are the run's own; others may take so many besides."""
    steps = counted(monkeypatch)
    config = start(*SMALL, "sampling.batch=4096", steps=200)
    runs = prober(diffuse, config)
    first = runs.first(config)
    assert first is not None and first.told and first.steps == 8
    taken = [first.steps]
    while (found := runs.another(config, first)) is not None:
        taken.append(found.steps)
    assert taken == [8, 8, 8, 8] and len(steps) - 8 == 24 == probes.SHARE * 200
    few = prober(diffuse, replace(config, steps=50))
    assert few.first(config).steps == 6
    assert prober(diffuse, replace(config, steps=30)).first(config) is None


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_probes_keep_to_their_share_of_seconds(
    diffuse: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a clock on which a step takes two seconds, and nothing else any time."""
    steps = counted(monkeypatch)
    config = start(*SMALL, max_seconds=120.0)
    runs = prober(diffuse, config, lambda: 2.0 * len(steps))
    first = runs.first(config)
    assert first is not None and first.steps == len(steps) == 6  # 13.2 seconds
    assert first.seconds == 2.0
    assert runs.affords(14.3, 10**9) and not runs.affords(14.5, 1)
    assert runs.another(config, first, cost=2.0) is None
    assert runs.another(config, first) is not None
    assert runs.another(config, first) is None and len(steps) == 12
    hasty = prober(diffuse, replace(config, max_seconds=60.0), lambda: 2.0 * len(steps))
    few = hasty.first(config)
    assert few is not None and not few.told and few.trainer.step_count == 2
    assert prober(diffuse, replace(config, max_seconds=480.0)).first(config).steps == 16


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_probes_depend_on_the_seed_alone(diffuse: Dataset) -> None:
    """Without a hash grid, whose gradients are summed in the order of threads."""
    config = start(*FOURIER, steps=100)
    found = [prober(diffuse, replace(config, seed=s)).first(config) for s in (0, 0)]
    assert found[0].quality == found[1].quality and found[0].averaged == found[1].averaged
    other = prober(diffuse, config).first(replace(config, seed=1))
    assert other.quality != found[0].quality


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_the_run_goes_on_from_the_best_probe(
    diffuse: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With all views, at the step where it stopped; so does a resumed run."""
    steps = counted(monkeypatch)
    config = start(*FOURIER, steps=100)
    run = training.start(diffuse.path, tmp_path / "whole", config, "llvm_ad_rgb")
    probed = len(steps)
    assert run.trainer.step_count == 8 <= probed
    assert run.trainer._source._views == len(diffuse)
    run.config = replace(run.config, steps=12)
    run.train(show_bar=False)
    assert len(steps) == probed + 4
    again = training.start(
        diffuse.path, tmp_path / "whole", replace(config, steps=14), "llvm_ad_rgb", resume=True
    )
    again.train(show_bar=False)
    assert len(steps) == probed + 6 and again._begun == 8


# ---- Runs --------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_run_records_and_shows_its_reasons(
    diffuse: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    options = ["--preset", "auto", "--steps", "3", "--set", *SMALL]
    assert main(["train", str(diffuse.path), "--out", str(out), *options]) == 0
    said = capsys.readouterr().out
    config, record = read_config(out)
    assert config.preset == "auto" and config.grid.finest == 32 and config.network.width == 32
    settings = [entry["setting"] for entry in record["auto"]]
    assert "box" in settings and "network.view_dependent" in settings
    assert "network.width" not in settings and "grid.finest" not in settings
    assert main(["info", str(out)]) == 0
    shown = capsys.readouterr().out
    for entry in record["auto"]:
        line = f"auto: {Decision(**entry)}"
        assert line in said and line in shown


@pytest.mark.slow
def test_an_unknown_record_of_reasons_is_passed_over(
    diffuse: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    training.start(diffuse.path, tmp_path / "run", start(*SMALL, steps=1), "llvm_ad_rgb")
    file = tmp_path / "run/config.json"
    record = json.loads(file.read_text())
    for other in ("none", [{"why": 1}], None, 3):
        file.write_text(json.dumps({**record, "auto": other}))
        assert main(["info", str(tmp_path / "run")]) == 0
        assert "auto:" not in capsys.readouterr().out


@pytest.mark.slow
def test_a_resumed_run_does_not_probe(
    diffuse: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = start(*SMALL, steps=3)
    first = training.start(diffuse.path, tmp_path / "run", config, "llvm_ad_rgb")
    first.train(show_bar=False)
    before = (tmp_path / "run/config.json").read_bytes()
    monkeypatch.setattr(training, "choose", lambda *_, **__: pytest.fail("probes again"))
    longer = replace(config, steps=5)
    again = training.start(diffuse.path, tmp_path / "run", longer, "llvm_ad_rgb", resume=True)
    again.train(show_bar=False)
    assert again.trainer.step_count == 5
    assert again.config == replace(first.config, steps=5)
    assert (tmp_path / "run/config.json").read_bytes() == before


@pytest.mark.slow
def test_an_interrupted_choice_leaves_nothing(
    diffuse: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(self: Probes, *_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Probes, "first", interrupt)
    out = tmp_path / "run"
    assert main(["train", str(diffuse.path), "--out", str(out), "--preset", "auto"]) == 130
    assert not out.exists()


def test_an_ablation_decides_for_itself(diffuse: Dataset, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="preset 'auto': .* expected nerf, fast or paper"):
        ablate(diffuse.path, tmp_path / "out", start(steps=1), "llvm_ad_rgb")
    assert not (tmp_path / "out").exists()
