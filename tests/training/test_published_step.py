"""Steps of the published model at reduced width against NumPy in double precision."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest

from mi_nerf.base.variants import array_module, choose_variant
from mi_nerf.data import Dataset, load_dataset
from mi_nerf.march.strata import points_along
from mi_nerf.training import trainer as module
from mi_nerf.training.config import with_settings
from mi_nerf.training.optimizer import Adam
from mi_nerf.training.presets import preset
from mi_nerf.training.schedule import learning_rate
from mi_nerf.training.trainer import Trainer
from tests.support.published import KerasAdam, Rays, finer, see

BACKEND = array_module(choose_variant())
RAYS, SAMPLES, FINE = 24, 12, 20
NARROW = ["network.width=16", "network.view_width=8", f"sampling.rays={RAYS}"]
NARROW += [f"sampling.samples={SAMPLES}", f"sampling.fine={FINE}"]


class Recorded:
    """A trainer whose steps can be looked at: rays, samples, gradients."""

    def __init__(self, dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
        self.trainer = Trainer(with_settings(preset("paper"), NARROW), dataset, BACKEND)
        self.drawn: Any = None
        self.samples: list[Any] = []
        self.gradients: dict[str, np.ndarray] = {}
        draw, integrate, update = self.trainer._draw, module.integrate, Adam.step

        def record_draw(progress: float) -> Any:
            self.drawn = draw(progress)
            return self.drawn

        def record_samples(evaluation: Any, samples: Any) -> Any:
            self.samples.append(samples)
            return integrate(evaluation, samples)

        def record_gradients(optimizer: Adam, *arguments: Any) -> Any:
            parameters = self.trainer.parameters
            self.gradients = {n: np.array(dr.grad(p), float) for n, p in parameters.items()}
            return update(optimizer, *arguments)

        monkeypatch.setattr(self.trainer, "_draw", record_draw)
        monkeypatch.setattr(module, "integrate", record_samples)
        monkeypatch.setattr(Adam, "step", record_gradients)

    def weights(self, prefix: str) -> dict[str, np.ndarray]:
        """Of the network ``coarse.`` or the fine one, in double precision."""
        coarse = {n for n in self.trainer.parameters if n.startswith("coarse.")}
        names = coarse if prefix else set(self.trainer.parameters) - coarse
        return {n.removeprefix(prefix): np.array(self.trainer.parameters[n], float) for n in names}

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the rays are in the box, by slabs; both 0 where they are not."""
        o, d = (np.array(v, float).T for v in (self.drawn.batch.o, self.drawn.batch.d))
        ends = [(np.array(c) - o) / d for c in (self.trainer.field.lower, self.trainer.field.upper)]
        near = np.maximum(np.minimum(*ends).max(axis=1), 0)
        far = np.maximum(*ends).min(axis=1)
        return np.where(far > near, near, 0), np.where(far > near, far, 0)

    def rays(self, number: int, delta: np.ndarray) -> Rays:
        """What the coarse (0) or the fine network (1) was asked: positions are the trainer's.

        In single precision up to the encoding, in which the highest octave tells them apart.
        """
        samples, config = self.samples[number], self.trainer.field_config
        ray = dr.arange(BACKEND.UInt32, len(samples.t)) // samples.count
        p = np.array(points_along(samples.o, samples.d, samples.t, ray)).T
        unit = (p - np.float32(config.input_center)) * np.float32(config.input_scale)
        batch = self.drawn.batch
        alpha = np.array(batch.alpha, float)
        return Rays(
            unit.astype(float).reshape(RAYS, samples.count, 3),
            np.array(batch.d, float).T,
            delta,
            np.array(batch.color, float).T + (1 - alpha)[:, None],
            config.density_scale,
        )


def test_the_published_optimiser() -> None:
    """Sec. 5.3, and what the code of the paper leaves to Keras' defaults."""
    options = preset("paper").optimizer
    assert (options.beta1, options.beta2, options.epsilon) == (0.9, 0.999, 1e-7)
    assert options.warmup == 0 and not options.muon
    rates = [learning_rate(options, progress, 0) for progress in (0, 0.5, 1)]
    assert rates == pytest.approx([5e-4, 5e-4 / 10**0.5, 5e-5], rel=1e-12)


def test_steps(blob: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Samples, loss, gradients and weights of three steps, each from the trainer's weights."""
    recorded = Recorded(load_dataset(blob, "train"), monkeypatch)
    oracles = {"coarse.": KerasAdam(), "": KerasAdam()}
    for _ in range(3):
        recorded.samples.clear()
        before = {prefix: recorded.weights(prefix) for prefix in oracles}
        result = recorded.trainer.step(5e-4)
        near, far = recorded.bounds()
        assert (far > near).mean() > 0.8
        t, t_fine = (np.array(s.t, float).reshape(RAYS, -1) for s in recorded.samples)

        u = np.array(recorded.drawn.jitter, float).reshape(RAYS, SAMPLES)
        width = np.repeat((far - near)[:, None] / SAMPLES, SAMPLES, axis=1)
        assert t == pytest.approx(near[:, None] + (np.arange(SAMPLES) + u) * width, abs=1e-5)
        coarse = see(before["coarse."], recorded.rays(0, width))

        u = np.array(recorded.drawn.fine_jitter, float).reshape(RAYS, FINE)
        placed = finer(near, far, coarse.weights, (np.arange(FINE) + u) / FINE)
        expected = np.sort(np.concatenate([t, placed], axis=1), axis=1)
        assert t_fine == pytest.approx(expected, abs=2e-3)  # bins of weight 1e-5 are steep
        assert np.median(np.abs(t_fine - expected)) < 1e-6
        middle = (t_fine[:, 1:] + t_fine[:, :-1]) / 2
        delta = np.diff(np.concatenate([near[:, None], middle, far[:, None]], axis=1), axis=1)
        fine = see(before[""], recorded.rays(1, delta))

        assert float(result.loss[0]) == pytest.approx(coarse.loss + fine.loss, rel=2e-5)
        assert float(result.mse[0]) == pytest.approx(fine.loss, rel=2e-5)
        for prefix, seen in (("coarse.", coarse), ("", fine)):
            _agree(recorded, prefix, seen.gradient, before[prefix], oracles[prefix])


def _agree(
    recorded: Recorded,
    prefix: str,
    gradients: dict[str, np.ndarray],
    before: dict[str, np.ndarray],
    oracle: KerasAdam,
) -> None:
    """Gradients to single precision; updates of the gradients that were found, a few ulp."""
    found = {name: recorded.gradients[prefix + name] for name in gradients}
    for name, g in gradients.items():
        assert np.abs(g).max() > 0, name
        assert np.abs(found[name] - g).max() < 2e-4 * np.abs(g).max(), name
    # Of a gradient's sign alone a first step depends: of that which the trainer found.
    expected, after = oracle.step(before, found, 5e-4), recorded.weights(prefix)
    for name, value in expected.items():
        assert np.abs(after[name] - value).max() < 1e-7 + 2e-7 * np.abs(value).max(), name
        assert np.abs(after[name] - before[name]).max() > 1e-4, name


def test_the_oracle() -> None:
    """Its gradients by hand against complex steps."""
    rng = np.random.default_rng(0)
    shapes = with_settings(preset("paper"), NARROW).network.shapes(63, 27)
    weights = {n: rng.normal(size=s) / np.sqrt(s[-1] / 2) for n, s in shapes.items()}
    direction = rng.normal(size=(7, 3))
    rays = Rays(
        rng.uniform(-1, 1, (7, 9, 3)),
        direction / np.linalg.norm(direction, axis=1, keepdims=True),
        rng.uniform(0, 0.5, (7, 9)),
        rng.random((7, 3)),
        1.5,
    )
    gradient = see(weights, rays).gradient
    assert set(gradient) == set(shapes)
    for name, shape in shapes.items():
        along = rng.normal(size=shape)
        moved = {**weights, name: weights[name] + 1e-20j * along}
        slope = see(moved, rays, gradient=False).loss.imag / 1e-20
        assert slope == pytest.approx(np.sum(gradient[name] * along), rel=1e-9, abs=1e-15), name
