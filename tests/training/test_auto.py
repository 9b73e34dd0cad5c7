"""Preset auto: how a run begins, what it records, and that it goes on where it stopped."""

from __future__ import annotations

import json
import os
import signal
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
from mi_nerf.formats.field_file import load_field
from mi_nerf.tasks.ablate import ablate
from mi_nerf.training import auto, shaping
from mi_nerf.training import run as training
from mi_nerf.training.auto import Decision, choose, decisions_in
from mi_nerf.training.batches import step_rng
from mi_nerf.training.checkpoint import read_checkpoint
from mi_nerf.training.config import TrainConfig, to_json, with_settings
from mi_nerf.training.held_back import HeldBack
from mi_nerf.training.presets import preset
from mi_nerf.training.run import Run
from mi_nerf.training.run_folder import CHECKPOINT, CONFIG, FIELD, read_config
from mi_nerf.training.scaling import resolved, resolved_octaves
from mi_nerf.training.trainer import Trainer
from tests.support.datasets import blob_images, orbit_poses, write_blender_dataset

VIEWS, SIZE = 20, 20
SMALL_MODEL = ["occupancy.resolution=16", "grid.levels=3", "grid.finest=32"]
SMALL_MODEL += ["sampling.samples=32", "sampling.batch=4096"]
LONG = 10**6  # steps of a run that has time to ask anything


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


def decided(
    config: TrainConfig, dataset: Dataset, **options: Any
) -> tuple[TrainConfig, list[Decision]]:
    choice = choose(config, dataset, **options)
    return choice.config, choice.decisions


def chosen(decisions: list[Decision]) -> dict[str, Any]:
    return {decision.setting: decision.value for decision in decisions}


def chosen_for(setting: str, decisions: list[Decision]) -> Decision:
    return next(d for d in decisions if d.setting == setting)


# ---- From the data alone -----------------------------------------------------------


@pytest.mark.slow
def test_what_follows_from_the_data(diffuse: Dataset) -> None:
    config, decisions = decided(start(steps=1), diffuse)
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
    config, _ = decided(start(steps=1), linear)
    assert (config.loss, config.color_activation) == ("relative", "exp")
    assert config.background == "white" and config.preset == "auto"


def asked(decisions: list[Decision]) -> set[str]:
    return {d.setting for d in decisions if d.open}


@pytest.mark.slow
@pytest.mark.parametrize("budget", [{"steps": 10}, {"max_seconds": 30.0}, {"steps": LONG}])
def test_it_begins_as_preset_fast(diffuse: Dataset, budget: dict[str, Any]) -> None:
    """With all sizes that follow from the images; only a long run asks about the model."""
    config, decisions = decided(start(**budget), diffuse)
    fast = resolved(preset("fast"), diffuse)
    assert config.network == fast.network and config.occupancy == fast.occupancy
    assert config.sampling == fast.sampling and config.pyramid == fast.pyramid
    assert config.grid is not None and replace(config.grid, finest=None) == fast.grid
    assert all(decision.reason for decision in decisions)
    model = {"network.view_dependent", "grid.log2_entries"}
    long = budget.get("steps") == LONG
    assert asked(decisions) == {"sampling.render_samples"} | (model if long else set())
    why = chosen_for("grid.log2_entries", decisions).reason
    assert ("too few to ask" in why) == (not long)


@pytest.mark.slow
def test_of_few_views_none_is_held_back(diffuse: Dataset) -> None:
    _, decisions = decided(start(steps=LONG), diffuse.subset(range(3)))
    assert asked(decisions) == {"sampling.render_samples"}
    why = chosen_for("network.view_dependent", decisions).reason
    assert "3 views, too few to hold any back" in why


@pytest.mark.slow
def test_fourier_features_begin_with_few_octaves(diffuse: Dataset) -> None:
    box = "box=-1,-1,-1,1,1,1"
    config, decisions = decided(start("grid=none", box, steps=LONG), diffuse)
    assert config.position is not None and config.position.frequencies == 4
    octaves = resolved_octaves(diffuse, (-1, -1, -1), (1, 1, 1))
    assert f"the images resolve {octaves}" in chosen_for("position.frequencies", decisions).reason
    assert {"position.frequencies", "network.view_dependent"} <= asked(decisions)


@pytest.mark.slow
def test_what_the_user_sets_is_neither_asked_nor_changed(diffuse: Dataset) -> None:
    settings = ["network.view_dependent=true", "grid.levels=8", "network.depth=1", "loss=relative"]
    settings += ["sampling.samples=40", "box=-1,-1,-1,1,1,1", "sampling.render_samples=100"]
    given = {s.partition("=")[0] for s in settings}
    config, decisions = decided(start(*settings, steps=LONG), diffuse, given=given)
    assert not given & set(chosen(decisions)) and not asked(decisions)
    assert config.network == preset("fast").network
    assert config.grid is not None and config.grid.log2_entries == 16
    assert config.sampling.samples == 40 and config.sampling.render_samples == 100


@pytest.mark.slow
def test_the_choice_is_that_of_a_trainer_left_alone(diffuse: Dataset) -> None:
    """Values found are those that a run of preset fast would find for itself."""
    config, _ = decided(start(steps=1), diffuse)
    trainers = [Trainer(c, diffuse, llvm) for c in (config, preset("fast"))]
    assert trainers[0].field_config == trainers[1].field_config
    assert float(trainers[0].step(1e-2).loss[0]) == float(trainers[1].step(1e-2).loss[0])


# ---- Views held back ------------------------------------------------------------------


def views_seen(trainer: Trainer, rays: int = 4000) -> set[int]:
    """Numbers of the views whose pixels training draws: rays begin where their camera is."""
    drawn = trainer._source.draw(rays, step_rng(llvm.Float, 3, 0))
    o = np.array(drawn.o).T
    cameras = trainer._images._poses.numpy().reshape(VIEWS, -1)
    centers = np.array([[row[3], row[7], row[11]] for row in cameras])
    return set(np.argmin(np.linalg.norm(o[:, None] - centers[None], axis=2), axis=1).tolist())


@pytest.mark.slow
def test_views_are_held_back_and_given_back(diffuse: Dataset) -> None:
    trainer = Trainer(start(*SMALL_MODEL), diffuse, llvm)
    held = HeldBack(diffuse, trainer)
    everything = set(range(VIEWS))
    assert views_seen(trainer) == everything
    held.hold()
    assert len(held.views) == 2
    assert set(held.views) | set(held.others) == everything
    assert views_seen(trainer) == everything - set(held.views)
    held.give_back()
    assert views_seen(trainer) == everything


@pytest.mark.slow
def test_what_a_model_would_lose(diffuse: Dataset) -> None:
    """Nothing in a larger shape or of directions that it does not look at; all of its colour."""
    trainer = Trainer(start(*SMALL_MODEL), diffuse, llvm)
    held = HeldBack(diffuse, trainer)
    for _ in range(30):
        trainer.step(1e-2)
    before = held.quality()
    assert held.lost_as(with_settings(trainer.config, ["grid.log2_entries=17"])) == pytest.approx(
        0, abs=1e-3
    )
    assert held.lost_as(with_settings(trainer.config, ["grid.log2_entries=4"])) > 1
    assert held.lost_even() != 0
    weight = trainer.parameters["view_0.direction_weight"]
    trainer.optimizer.assign("view_0.direction_weight", weight * 0)
    assert held.lost_even() == pytest.approx(0, abs=1e-3)
    assert held.quality() != before and trainer.step_count == 30


# ---- Runs --------------------------------------------------------------------------------


@pytest.fixture
def brisk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything is asked within a few dozen steps, and light is even where anyone asks."""
    monkeypatch.setattr(auto, "SHORTEST_STEPS", 30)
    monkeypatch.setattr(shaping, "ASKED_STEPS", 5)
    monkeypatch.setattr(shaping, "MOST_LOST", 99.0)
    monkeypatch.setattr(shaping, "APART", 3)
    monkeypatch.setattr(shaping, "MOST_CHANGED", 99.0)
    monkeypatch.setattr(shaping, "AT_ONCE", 0.3)


@pytest.mark.slow
@pytest.mark.usefixtures("brisk")
def test_a_run_takes_shape_and_says_why(
    diffuse: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    options = ["--preset", "auto", "--steps", "60", "--set", *SMALL_MODEL[:1], *SMALL_MODEL[3:]]
    assert main(["train", str(diffuse.path), "--out", str(out), *options]) == 0
    said = capsys.readouterr().out
    config, record = read_config(out)
    assert config.preset == "auto" and config.sampling.samples == 32
    settled = {entry["setting"]: entry for entry in record["auto"]}
    assert "sampling.samples" not in settled
    values = dict(training_leaves(config))
    for name, entry in settled.items():
        assert values[name] == entry["value"], name
        assert "open" not in entry
    assert settled["network.view_dependent"]["value"] is False
    assert settled["grid.log2_entries"]["value"] < 16
    assert main(["info", str(out)]) == 0
    shown = capsys.readouterr().out
    for entry in record["auto"]:
        line = f"auto: {Decision(**entry)}"
        assert line in said and line in shown
    contents = load_field(out / FIELD)
    assert contents.config.network == config.network and contents.config.grid == config.grid
    assert contents.march.samples == config.sampling.render_samples
    assert record["field"]["parameters"] == contents.parameter_count()


def training_leaves(config: TrainConfig) -> dict[str, Any]:
    return dict(auto.leaves(to_json(config)))


@pytest.mark.slow
@pytest.mark.usefixtures("brisk")
def test_an_interrupted_run_goes_on_in_its_shape(diffuse: Dataset, tmp_path: Path) -> None:
    """Also if it was killed after the checkpoint was written and before config.json was."""
    config = start(*SMALL_MODEL[:1], *SMALL_MODEL[3:], steps=60)
    out = tmp_path / "run"
    run = training.start(diffuse.path, out, config, "llvm_ad_rgb")
    begun = (out / CONFIG).read_text()
    stop_once(run, lambda: not run.trainer.config.network.view_dependent)
    step = run.trainer.step_count
    assert step < 60
    _, description = read_checkpoint(out / CHECKPOINT)
    assert description.settings == to_json(run.trainer.config)
    (out / CONFIG).write_text(begun)
    again = training.start(diffuse.path, out, config, "llvm_ad_rgb", resume=True)
    assert again.trainer.config == run.trainer.config and again.trainer.step_count == step
    for name, tensor in run.trainer.parameters.items():
        np.testing.assert_array_equal(np.array(again.trainer.parameters[name]), np.array(tensor))
    found = chosen(again.decisions)
    assert found["network.view_dependent"] is False
    again.train(show_bar=False)
    assert again.progress == 1 and again.trainer.step_count == 60
    final, _ = read_config(out)
    assert final == again.config and not final.network.view_dependent


def stop_once(run: Run, due: Callable[[], bool]) -> None:
    """As Ctrl-C would."""

    def stop(_: Run) -> None:
        if due():
            os.kill(os.getpid(), signal.SIGINT)

    run.train(show_bar=False, after_step=stop)


@pytest.mark.slow
def test_a_finished_run_asks_nothing_more(diffuse: Dataset, tmp_path: Path) -> None:
    config = start(*SMALL_MODEL, steps=3)
    first = training.start(diffuse.path, tmp_path / "run", config, "llvm_ad_rgb")
    first.train(show_bar=False)
    before = json.loads((tmp_path / "run/config.json").read_text())
    longer = replace(config, steps=5)
    again = training.start(diffuse.path, tmp_path / "run", longer, "llvm_ad_rgb", resume=True)
    assert views_seen(again.trainer) == set(range(VIEWS))
    again.train(show_bar=False)
    assert again.trainer.step_count == 5
    assert again.config == replace(first.config, steps=5)
    assert json.loads((tmp_path / "run/config.json").read_text()) == before


def test_reasons_that_no_longer_hold_are_not_repeated() -> None:
    config = start("network.view_dependent=true")
    said = [
        {"setting": "network.view_dependent", "value": False, "reason": "so", "open": True},
        {"setting": "network.depth", "value": 1, "reason": "as it is"},
    ]
    found = decisions_in({"auto": said}, config)
    assert found[1] == Decision(**said[1])
    assert found[0].value is True and "interrupted" in found[0].reason and not found[0].open
    for other in ("none", [{"why": 1}], [3]):
        assert decisions_in({"auto": other}, config) == []


@pytest.mark.slow
def test_an_unknown_record_of_reasons_is_passed_over(
    diffuse: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    training.start(diffuse.path, tmp_path / "run", start(*SMALL_MODEL, steps=1), "llvm_ad_rgb")
    file = tmp_path / "run/config.json"
    record = json.loads(file.read_text())
    for other in ("none", [{"why": 1}], None, 3):
        file.write_text(json.dumps({**record, "auto": other}))
        assert main(["info", str(tmp_path / "run")]) == 0
        assert "auto:" not in capsys.readouterr().out


def test_an_ablation_decides_for_itself(diffuse: Dataset, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="preset 'auto': .* expected nerf, fast or paper"):
        ablate(diffuse.path, tmp_path / "out", start(steps=1), "llvm_ad_rgb")
    assert not (tmp_path / "out").exists()
