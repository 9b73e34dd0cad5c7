"""Training in half precision: the same derivatives to its precision, small ones included."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mi_nerf.base.errors import InputError
from mi_nerf.data import Dataset, load_dataset
from mi_nerf.fields.fourier import FourierEncoding
from mi_nerf.fields.hash_grid import HashGridConfig
from mi_nerf.fields.network import NetworkConfig
from mi_nerf.fields.neural import NeuralField, NeuralFieldConfig
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.render import render_rays
from mi_nerf.training import loss_scale
from mi_nerf.training.checkpoint import Progress, load_checkpoint, save_checkpoint
from mi_nerf.training.config import TrainConfig, with_settings
from mi_nerf.training.loss_scale import LossScale
from mi_nerf.training.presets import preset
from mi_nerf.training.trainer import Trainer
from tests.support.arrays import unit, vectors
from tests.support.datasets import write_blob_dataset

PLAIN = NetworkConfig(depth=2, width=16, skip=1, view_width=8)
BASE = NeuralFieldConfig(
    position=FourierEncoding(frequencies=2),
    direction=FourierEncoding(frequencies=1),
    network=PLAIN,
)
GRID = HashGridConfig(levels=2, features=2, log2_entries=8, coarsest=4, finest=8)
CONFIGS = (
    BASE,
    replace(BASE, network=replace(PLAIN, view_dependent=False, view_depth=0)),
    replace(BASE, grid=GRID, position=FourierEncoding(frequencies=0)),
)
HALF = 2.0**-11  # relative error of a rounded number


def gradients(
    ad: Any, config: NeuralFieldConfig, scale: float | None, size: float = 1.0, seed: int = 1
) -> dict[str, np.ndarray]:
    """Of a sum of the answers of 200 queries, times ``size``, and the answers."""
    rng = np.random.default_rng(seed)
    field = NeuralField.create(config, 3, ad.TensorXf)
    weights = {n: w + rng.normal(0, 0.2, w.shape) for n, w in field.weights().items()}
    field = NeuralField(config, {n: w.astype(np.float32) for n, w in weights.items()}, ad.TensorXf)
    if scale is not None:
        field = field.for_training(loss_scale=dr.opaque(ad.Float, scale))
    p, d = (vectors(ad, v) for v in (rng.uniform(-1, 1, (200, 3)), unit(rng.normal(size=(200, 3)))))
    dr.enable_grad(field.parameters())
    dr.enable_grad(p)
    density, color = field.density_emission(p, d)
    answers = [density, *color]
    dr.backward(sum(dr.sum((i + 1) * a) for i, a in enumerate(answers)) * dr.opaque(ad.Float, size))
    found = {n: np.array(dr.grad(w), float) for n, w in field.parameters().items()}
    found["position"] = np.array(dr.grad(p), float)
    return found | {f"answer {i}": np.array(dr.detach(a), float) for i, a in enumerate(answers)}


def relative_error(found: np.ndarray, expected: np.ndarray) -> float:
    """By the root mean square."""
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


@pytest.mark.slow
@settings(max_examples=6, deadline=None)
@given(seed=st.integers(0, 1000), config=st.sampled_from(CONFIGS))
def test_derivatives_are_those_of_single_precision(
    ad: Any, seed: int, config: NeuralFieldConfig
) -> None:
    expected = gradients(ad, config, None, seed=seed)
    found = gradients(ad, config, 64.0, seed=seed)
    errors = {n: relative_error(found[n], v) for n, v in expected.items()}
    # A rectifier may switch by a rounding error, which gradients feel in full.
    assert max(errors.values()) < 0.1
    assert max(e for n, e in errors.items() if n.startswith("answer")) < 20 * HALF
    assert max(errors.values()) > 0.1 * HALF  # it is half precision


@pytest.mark.slow
def test_small_gradients_need_the_scale(ad: Any) -> None:
    """Adjoints of 1e-8 are less than half precision can hold."""
    expected = gradients(ad, BASE, None, size=1e-9)
    lost, kept = (gradients(ad, BASE, scale, size=1e-9) for scale in (1.0, 2.0**20))
    for name in BASE.shapes():
        assert relative_error(kept[name], expected[name]) < 0.1
    assert np.abs(lost["trunk_0.weight"]).max() == 0


def test_too_large_a_scale_shows(ad: Any) -> None:
    found = gradients(ad, BASE, 2.0**24)
    assert not np.isfinite(found["trunk_0.weight"]).all()


@pytest.mark.parametrize("config", CONFIGS)
def test_overflowing_activations_show(ad: Any, config: NeuralFieldConfig) -> None:
    """An answer is right to its precision or not finite, never something in between."""
    rng, size = np.random.default_rng(2), 2.0**15
    weights = {n: rng.normal(0, 0.4, shape) for n, shape in config.shapes().items()}
    # In exact numbers, the rectifier makes up for it; a half ends at 65504.
    factors = {"trunk_0.weight": size, "trunk_0.bias": size, "trunk_1.weight": 1 / size}
    weights |= {name: weights[name] * factor for name, factor in factors.items()}
    field = NeuralField(config, {n: w.astype(np.float32) for n, w in weights.items()}, ad.TensorXf)
    p, d = (vectors(ad, v) for v in (rng.uniform(-1, 1, (500, 3)), unit(rng.normal(size=(500, 3)))))
    answers = []
    for network in (field, field.for_training(loss_scale=dr.opaque(ad.Float, 64.0))):
        density, color = network.density_emission(p, d)
        answers.append(np.array([np.array(a, float) for a in (density, *color)]))
    expected, found = answers
    finite = np.isfinite(found)
    assert np.isfinite(expected).all() and 50 < finite.all(axis=0).sum() < 500
    np.testing.assert_allclose(found[finite], expected[finite], rtol=0.1, atol=0.05)


def test_the_scale_follows_what_happens(ad: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loss_scale, "_PATIENCE", 3)
    scale, yes, no = LossScale(ad.Float), ad.Bool(True), ad.Bool(False)
    seen = []
    for accepted in (no, no, yes, yes, yes, yes, no, yes, yes, yes):
        scale.update(accepted)
        seen.append(float(scale.value[0]) / 2**13)
    assert seen == [0.5, 0.25, 0.25, 0.25, 0.5, 0.5, 0.25, 0.25, 0.25, 0.5]
    for _ in range(100):
        scale.update(yes)
    assert float(scale.value[0]) == 2**24
    for _ in range(100):
        scale.update(no)
    assert float(scale.value[0]) == 1


# ---- Training ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = write_blob_dataset(tmp_path_factory.mktemp("blob"), train=6, test=1, size=20)
    return load_dataset(folder, "train")


def small(*changes: str) -> TrainConfig:
    return with_settings(
        preset("fast"),
        [
            "half_precision=true",
            "network.width=16",
            "network.view_width=8",
            "grid.levels=2",
            "grid.log2_entries=8",
            "sampling.batch=1024",
            "sampling.samples=24",
            "occupancy.resolution=16",
            *changes,
        ],
    )


@pytest.mark.slow
def test_it_learns_as_in_single_precision(ad: Any, views: Dataset) -> None:
    errors = []
    for half in ("true", "false"):
        trainer = Trainer(small(f"half_precision={half}"), views, ad)
        last = [trainer.step(1e-2).mse for _ in range(150)][-20:]
        errors.append(float(np.mean([m[0] for m in last])))
    assert errors[0] == pytest.approx(errors[1], rel=0.3)
    assert errors[0] < 0.02


@pytest.mark.slow
def test_an_overflow_is_declined_and_answered(ad: Any, views: Dataset) -> None:
    trainer = Trainer(small(), views, ad)
    assert trainer.loss_scale is not None
    trainer.loss_scale.restore(np.array([2.0**40, 0], np.float32))
    before = trainer.field.weights()
    assert not trainer.step(1e-2).accepted[0]
    assert float(trainer.loss_scale.value[0]) == 2.0**39
    for name, weight in trainer.field.weights().items():
        np.testing.assert_array_equal(weight, before[name])


def test_overflowing_activations_are_declined(ad: Any, views: Dataset) -> None:
    """And single precision, in which everything else looks at the field, is not concerned."""
    trainer = Trainer(small("occupancy.enabled=false"), views, ad)
    assert trainer.loss_scale is not None
    trainer.optimizer.assign("trunk_0.weight", trainer.field.parameters()["trunk_0.weight"] * 1e8)
    trainer.optimizer.assign("density.weight", trainer.field.parameters()["density.weight"] * 1e-8)
    before, scale = trainer.field.weights(), float(trainer.loss_scale.value[0])
    assert not trainer.step(1e-2).accepted[0]
    assert float(trainer.loss_scale.value[0]) == scale / 2
    for name, weight in trainer.field.weights().items():
        np.testing.assert_array_equal(weight, before[name])
    o, d = vectors(ad, [(0.1, -3, 0.2)]), vectors(ad, [(0, 1, 0)])
    seen = render_rays(MarchedField(trainer.field, trainer.march_settings()), o, d)
    assert np.isfinite([c[0] for c in (*seen.color, seen.opacity)]).all()


@pytest.mark.slow
def test_it_goes_on_from_a_checkpoint(ad: Any, views: Dataset, tmp_path: Path) -> None:
    trainer = Trainer(small(), views, ad)
    assert trainer.loss_scale is not None
    trainer.loss_scale.restore(np.array([2.0**9, 7], np.float32))
    save_checkpoint(tmp_path / "c", trainer, Progress(0.0))
    other = Trainer(small(), views, ad)
    load_checkpoint(tmp_path / "c", other)
    assert other.loss_scale is not None
    np.testing.assert_array_equal(other.loss_scale.state(), [2.0**9, 7])


@pytest.mark.slow
def test_a_checkpoint_of_full_precision_is_refused(ad: Any, views: Dataset, tmp_path: Path) -> None:
    save_checkpoint(
        tmp_path / "c", Trainer(small("half_precision=false"), views, ad), Progress(0.0)
    )
    with pytest.raises(InputError, match="half_precision=false, expected true"):
        load_checkpoint(tmp_path / "c", Trainer(small(), views, ad))


def test_wide_networks_are_refused() -> None:
    with pytest.raises(InputError, match="half_precision=true with 256 neurons.*64 at most"):
        with_settings(preset("nerf"), ["half_precision=true"])
