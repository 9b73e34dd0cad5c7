"""Runs on linear radiance: lamps and the dark are learnt together."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mi_nerf
from mi_nerf.base.variants import array_module, choose_variant
from mi_nerf.cli import main
from mi_nerf.data import load_dataset
from mi_nerf.march.view import render_view
from mi_nerf.tasks.target import open_target
from mi_nerf.training.config import with_settings
from mi_nerf.training.presets import preset
from mi_nerf.training.trainer import Trainer
from tests.support.datasets import write_radiant_dataset


@pytest.fixture(scope="module")
def lamp(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dark ball with a lamp, as PNG and EXR. Not to be changed."""
    return write_radiant_dataset(tmp_path_factory.mktemp("lamp"))


def trained(data: Path, out: Path, *options: str) -> Path:
    arguments = ["--preset", "fast", "--steps", "250", *options]
    assert main(["train", str(data), "--out", str(out), *arguments]) == 0
    return out


@pytest.mark.slow
def test_radiance_is_learnt_from_radiance(lamp: Path, tmp_path: Path) -> None:
    light = trained(lamp, tmp_path / "exr", "--images", "exr")
    clipped = trained(lamp, tmp_path / "png")
    settings = json.loads((light / "config.json").read_text())
    assert settings["settings"]["images"] == "exr"
    assert settings["data"]["color_space"] == "linear"
    found = mi_nerf.evaluate(light)["mean"]  # of its own accord, against what it was trained on
    other = mi_nerf.evaluate(clipped, truth="exr")["mean"]
    assert found["psnr_log"] > other["psnr_log"] + 3
    assert "psnr_log" not in mi_nerf.evaluate(clipped)["mean"]
    # The field says that its colours are radiance, and holds the lamp's.
    target = open_target(light)
    assert target.images == "exr" and target.contents.config.color_space == "linear"
    test = load_dataset(lamp, "test", images="exr")
    backend = array_module(choose_variant())
    view = render_view(
        target.contents.marched(backend), test.intrinsics, test.cam_to_world[0], backend
    )
    truth = test.image(0)
    assert truth[..., 0].max() == 50
    bright = truth[..., 0] > 40
    assert 20 < np.median(view.color[bright][:, 0]) < 80
    dark = (truth[..., 3] > 0.99) & (truth[..., 0] < 0.05)
    errors = np.abs(np.log10(view.color[dark] / truth[dark][:, :3]))
    assert np.median(errors) < 0.2  # decades


@pytest.mark.slow
def test_a_run_resumes_on_its_own_images(lamp: Path, tmp_path: Path) -> None:
    run = trained(lamp, tmp_path / "run", "--images", "exr", "--steps", "5")
    mi_nerf.start(lamp, run, resume=True, steps=7, variant=choose_variant()).train()
    with pytest.raises(mi_nerf.InputError, match="keeps its settings, .* images"):
        mi_nerf.start(lamp, run, resume=True, images="png", variant=choose_variant())


def test_a_pyramid_of_radiance(ad: Any, lamp: Path) -> None:
    """Coarse pixels are means of premultiplied radiance; the steps are finite."""
    dataset = load_dataset(lamp, "train", images="exr")
    config = with_settings(preset("fast"), ["pyramid.levels=2", "sampling.batch=2048"])
    trainer = Trainer(replace(config, steps=8), dataset, ad)
    results = [trainer.step(1e-2, progress=i / 8) for i in range(8)]
    assert all(r.accepted[0] and np.isfinite(float(r.loss[0])) for r in results)


@pytest.mark.parametrize("half", [False, True])
def test_lamps_in_halves(ad: Any, lamp: Path, half: bool) -> None:
    """EXR of 16 bits; and a network of 16 bits, whose gradients lamps must not overflow."""
    dataset = load_dataset(lamp, "train", images="exr")
    stored = replace(dataset, images=dataset.images.astype(np.float16))
    settings = ["sampling.batch=2048", f"half_precision={str(half).lower()}"]
    trainer = Trainer(with_settings(preset("fast"), settings), stored, ad)
    results = [trainer.step(1e-2) for _ in range(12)]
    assert all(np.isfinite(float(r.loss[0])) for r in results)
    assert sum(bool(r.accepted[0]) for r in results) >= 10  # of halves, a scale is tried first


def test_a_floor_for_the_relative_loss(ad: Any, lamp: Path) -> None:
    dataset = load_dataset(lamp, "train", images="exr")
    losses = []
    for floor in ("1e-3", "10"):
        config = with_settings(preset("fast"), [f"loss_floor={floor}", "sampling.batch=2048"])
        losses.append(float(Trainer(config, dataset, ad).step(1e-2).loss[0]))
    assert losses[1] < losses[0] / 2
    with pytest.raises(mi_nerf.InputError, match="loss_floor=0"):
        with_settings(preset("fast"), ["loss_floor=0"])
