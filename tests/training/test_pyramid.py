"""Training steps on coarse images, and levels of the grid that join on the way."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
from drjit.llvm import ad

from mi_nerf.base.errors import InputError
from mi_nerf.data import Dataset, load_dataset
from mi_nerf.fields.network import GRID
from mi_nerf.training.config import TrainConfig, with_settings
from mi_nerf.training.presets import preset
from mi_nerf.training.run import Run
from mi_nerf.training.trainer import Trainer
from tests.support.datasets import write_blob_dataset

SMALL = ["network.width=16", "network.view_width=16", "sampling.batch=1024", "sampling.samples=16"]
SMALL += ["occupancy.resolution=16", "occupancy.start=4", "occupancy.every=4"]
SMALL += ["grid.levels=4", "grid.log2_entries=10", "grid.coarsest=4", "grid.finest=32"]
PYRAMID = ["pyramid.levels=2", "pyramid.until=0.5", "pyramid.features=true", "sampling.rays=64"]


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = write_blob_dataset(tmp_path_factory.mktemp("blob"), train=4, test=1, size=24)
    return load_dataset(folder, "train")


def config(*settings: str, **changes: Any) -> TrainConfig:
    return replace(with_settings(preset("fast"), SMALL + list(settings)), **changes)


def test_a_coarse_step_learns_from_coarse_pixels(views: Dataset) -> None:
    """At level 2 throughout, it is a step of the dataset of 4×4 block means."""
    pyramid = ["pyramid.levels=2", "pyramid.until=1"]
    trainer = Trainer(config(*pyramid, "sampling.rays=64"), views, ad)
    drawn = trainer._draw(2.0).batch
    blocks = views.premultiplied().reshape(4, 6, 4, 6, 4, 4).mean(axis=(2, 4)).reshape(-1, 4)
    found = np.stack([np.array(c) for c in (*drawn.color, drawn.alpha)], axis=-1)
    nearest = np.abs(found[:, None] - blocks[None]).max(axis=-1).min(axis=1)
    assert nearest.max() < 1e-6


def test_changing_levels_compiles_nothing(views: Dataset) -> None:
    trainer = Trainer(config(*PYRAMID), views, ad)
    for _ in range(12):  # refreshes of the occupancy among them
        trainer.step(1e-3, 0.0)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for progress in (0.0, 0.1, 0.25, 0.4, 0.5, 0.9):
            trainer.step(1e-3, progress)
        dr.sync_thread()
        history = dr.kernel_history([dr.KernelType.JIT])
    assert history and all(entry["cache_hit"] for entry in history)


def test_levels_that_have_not_joined_do_not_learn(views: Dataset) -> None:
    trainer = Trainer(config(*PYRAMID), views, ad)
    before = np.array(trainer.field.parameters()[GRID])
    for _ in range(3):
        trainer.step(1e-2, 0.0)
    moved = np.any(np.array(trainer.field.parameters()[GRID]) != before, axis=1)
    grid = trainer.field_config.grid
    assert grid is not None
    ends = np.cumsum(grid.level_entries())
    assert moved[: ends[1]].any() and not moved[ends[1] :].any()
    trainer.step(1e-2, 1.0)
    moved = np.any(np.array(trainer.field.parameters()[GRID]) != before, axis=1)
    assert moved[ends[2] :].any()


def test_the_weights_of_a_field_contain_those_of_its_levels(views: Dataset) -> None:
    trainer = Trainer(config(*PYRAMID), views, ad)
    trainer.step(1e-2, 0.2)  # the third level counts 0.8, by octaves 3 − 1.2 of 3
    raw, folded = np.array(trainer.field.parameters()[GRID]), trainer.field.weights()[GRID]
    first, second, third, _ = trainer.field_config.grid.level_entries()
    assert np.array_equal(folded[: first + second], raw[: first + second])
    both = slice(first + second, first + second + third)
    assert folded[both] == pytest.approx(0.8 * raw[both])
    assert (folded[first + second + third :] == 0).all()


def test_a_run_sharpens_with_its_progress(
    views: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[float] = []
    run = Run(tmp_path, config(*PYRAMID, steps=8), views, "llvm_ad_rgb")
    draw = run.trainer._source.draw

    def watched(*args: Any) -> Any:
        seen.append(args[3])
        return draw(*args)

    monkeypatch.setattr(run.trainer._source, "draw", watched)
    run.train(show_bar=False)
    assert seen == pytest.approx([2, 1.5, 1, 0.5, 0, 0, 0, 0])


def test_more_levels_than_the_images_have_pixels_for(views: Dataset) -> None:
    with pytest.raises(InputError, match=r"pyramid.levels=5.*: expected 4 at most, .* 24x24"):
        Trainer(config("pyramid.levels=5"), views, ad)


def test_a_run_without_an_end_has_sharp_images(
    views: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Run(tmp_path, config(*PYRAMID), views, "llvm_ad_rgb")
    seen: list[float] = []
    monkeypatch.setattr(run.trainer, "step", lambda rate, progress: seen.append(progress))
    run._advance()
    assert seen == [1.0]
