"""The neural field: what it promises to quadrature, plugins and training."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import drjit as dr
import numpy as np
import pytest

from mi_nerf.fields.fourier import FourierEncoding
from mi_nerf.fields.network import NetworkConfig, initial_weights
from mi_nerf.fields.neural import NeuralField, NeuralFieldConfig
from mi_nerf.fields.noise import DensityNoise
from mi_nerf.fields.protocol import Field
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.render import render_rays
from mi_nerf.march.settings import MarchSettings
from tests.support.arrays import unit, vectors

SMALL = NeuralFieldConfig(
    position=FourierEncoding(3),
    direction=FourierEncoding(2, include_input=False),
    network=NetworkConfig(depth=3, width=16, skip=1, view_width=8),
)


def queries(count: int = 50) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.uniform(-1, 1, (count, 3)), unit(rng.normal(size=(count, 3)))


def ask(ad: Any, field: NeuralField, p: Any, d: Any) -> tuple[np.ndarray, np.ndarray]:
    """Densities (N,) and colours (3, N), in double precision."""
    density, color = field.density_emission(vectors(ad, p, "64"), vectors(ad, d, "64"))
    return np.array(density), np.array([np.array(c) for c in color])


def slow_field(
    config: NeuralFieldConfig, weights: dict[str, np.ndarray], p: np.ndarray, d: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The field of ``SMALL``'s architecture, line by line."""

    def encode(v: np.ndarray, octaves: int) -> list[np.ndarray]:
        return [f(2**k * np.pi * v.T) for k in range(octaves) for f in (np.sin, np.cos)]

    def linear(name: str, x: np.ndarray, kind: str = "weight") -> np.ndarray:
        return weights[f"{name}.{kind}"].astype(float) @ x

    def bias(name: str) -> np.ndarray:
        return weights[f"{name}.bias"][:, None]

    unit_p = (p - config.input_center) * config.input_scale
    x = np.concatenate([unit_p.T, *encode(unit_p, 3)])
    h = np.maximum(linear("trunk_0", x) + bias("trunk_0"), 0)
    skipped = linear("trunk_1", x, "position_weight")
    h = np.maximum(linear("trunk_1", h) + skipped + bias("trunk_1"), 0)
    h = np.maximum(linear("trunk_2", h) + bias("trunk_2"), 0)
    raw = linear("density", h)[0] + bias("density")[0] + config.density_shift
    feature = linear("feature", h) + bias("feature")
    seen = linear("view_0", np.concatenate(encode(d, 2)), "direction_weight")
    h = np.maximum(linear("view_0", feature) + seen + bias("view_0"), 0)
    color = linear("color", h) + bias("color")
    return config.density_scale * np.logaddexp(0, raw), 1 / (1 + np.exp(-color))


# ---- Values -----------------------------------------------------------------


def test_against_numpy(ad: Any) -> None:
    config = dataclasses.replace(
        SMALL,
        density_shift=0.5,
        density_scale=3.0,
        input_center=(0.1, -0.2, 0.3),
        input_scale=0.7,
    )
    p, d = queries()
    field = NeuralField.create(config, 1, ad.TensorXf64)
    density, color = ask(ad, field, p, d)
    slow_density, slow_color = slow_field(config, field.weights(), p, d)
    assert density == pytest.approx(slow_density, rel=1e-6)
    assert color == pytest.approx(slow_color, rel=1e-10)


def test_single_precision(ad: Any) -> None:
    p, d = queries()
    p, d = p.astype(np.float32), d.astype(np.float32)
    field = NeuralField.create(SMALL, 1, ad.TensorXf)
    density, color = field.density_emission(vectors(ad, p), vectors(ad, d))
    assert type(density) is ad.Float
    slow_density, slow_color = slow_field(SMALL, field.weights(), p.astype(float), d.astype(float))
    assert np.array(density) == pytest.approx(slow_density, rel=1e-4)
    assert np.array([np.array(c) for c in color]) == pytest.approx(slow_color, abs=1e-5)


def test_density_does_not_depend_on_direction(ad: Any) -> None:
    p, d = queries()
    field = NeuralField.create(SMALL, 0, ad.TensorXf64)
    density, color = ask(ad, field, p, d)
    turned_density, turned_color = ask(ad, field, p, -d)
    assert np.array_equal(density, turned_density)
    assert np.abs(color - turned_color).max() > 0.01
    assert np.array(field.density(vectors(ad, p, "64"))) == pytest.approx(density, rel=1e-12)


def test_colour_without_view_dependence(ad: Any) -> None:
    network = dataclasses.replace(SMALL.network, view_dependent=False)
    field = NeuralField.create(dataclasses.replace(SMALL, network=network), 0, ad.TensorXf64)
    p, d = queries()
    assert np.array_equal(ask(ad, field, p, d)[1], ask(ad, field, p, -d)[1])


@pytest.mark.parametrize("density", ["softplus", "relu", "exp"])
@pytest.mark.parametrize("color", ["sigmoid", "softplus", "exp"])
def test_activations_are_applied(ad: Any, density: str, color: str) -> None:
    functions = {
        "softplus": lambda x: np.logaddexp(0, x),
        "relu": lambda x: np.maximum(x, 0),
        "exp": np.exp,
        "sigmoid": lambda x: 1 / (1 + np.exp(-x)),
    }
    config = dataclasses.replace(SMALL, density_activation=density, color_activation=color)
    field = NeuralField.create(config, 2, ad.TensorXf64)
    p, d = queries()
    sigma, colors = ask(ad, field, p, d)
    softplus, sigmoid = slow_field(config, field.weights(), p, d)
    assert sigma == pytest.approx(functions[density](np.log(np.expm1(softplus))), abs=1e-6)
    logit = np.log(sigmoid / (1 - sigmoid))
    assert colors == pytest.approx(functions[color](logit), rel=1e-6)


@pytest.mark.parametrize("scale", [1e-3, 2.0, 1e4])
def test_unit_of_the_scene(ad: Any, scale: float) -> None:
    """In a box s times as large, the same colours, and densities per s times the length."""
    lower, upper = np.array([-1.0, 0.5, -0.5]), np.array([0.0, 1.0, 3.5])
    p, d = queries()
    p = lower + (p + 1) / 2 * (upper - lower)
    config = SMALL.in_box(tuple(lower), tuple(upper))
    weights = initial_weights(config.shapes(), 0)
    density, color = ask(ad, NeuralField(config, weights, ad.TensorXf64), p, d)

    larger = config.in_box(tuple(scale * lower), tuple(scale * upper))
    direct = SMALL.in_box(tuple(scale * lower), tuple(scale * upper))
    assert larger.density_scale == pytest.approx(direct.density_scale)
    scaled = ask(ad, NeuralField(larger, weights, ad.TensorXf64), scale * p, d)
    assert scaled[0] == pytest.approx(density / scale, rel=1e-6)
    assert scaled[1] == pytest.approx(color, rel=1e-9)


def test_longest_side_fills_the_unit_interval() -> None:
    config = SMALL.in_box((-1.0, 0.0, 2.0), (1.0, 1.0, 6.0))
    assert (config.lower, config.upper) == ((-1.0, 0.0, 2.0), (1.0, 1.0, 6.0))
    assert config.input_center == (0.0, 0.5, 4.0)
    assert config.input_scale == 0.5
    assert config.density_scale == 0.5


# ---- Interface --------------------------------------------------------------


def test_protocol(ad: Any) -> None:
    field = NeuralField.create(SMALL, 0, ad.TensorXf)
    assert isinstance(field, Field)
    assert not isinstance(object(), Field)
    assert (field.lower, field.upper, field.color_space) == (SMALL.lower, SMALL.upper, "srgb")


def test_a_field_need_not_say_more(ad: Any) -> None:
    """Without a coarse field, without a projection, and without a faster way."""

    class Fog(Field):
        lower, upper, color_space = (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), "linear"

        def density(self, p: Any) -> Any:
            return dr.full(type(p[0]), 0.5, len(p[0]))

        def density_emission(self, p: Any, d: Any) -> tuple[Any, list[Any]]:
            return self.density(p), [self.density(p)] * 3

        def parameters(self) -> dict[str, Any]:
            return {}

    o, d = vectors(ad, [(0.1, -3, 0.2)]), vectors(ad, [(0, 1, 0)])
    for fine in (0, 8):
        seen = render_rays(MarchedField(Fog(), MarchSettings(samples=8, fine=fine)), o, d)
        assert seen.opacity[0] == pytest.approx(1 - math.exp(-1), abs=1e-6)
    with pytest.raises(TypeError, match="density"):
        type("Half", (Fog,), {"density": Field.density})()


def test_published_parameter_count() -> None:
    assert NeuralFieldConfig().parameter_count() == 595_844


@pytest.mark.slow
def test_parameters_are_live(ad: Any) -> None:
    """An optimiser may write into a tensor or put another in its place."""
    p, d = queries(3)
    field = NeuralField.create(SMALL, 0, ad.TensorXf64)
    parameters = field.parameters()
    assert set(parameters) == set(SMALL.shapes())
    before = ask(ad, field, p, d)[1]
    parameters["color.bias"][:] = ad.TensorXf64([9.0, 9.0, 9.0])
    high = ask(ad, field, p, d)[1]
    assert (high > before).all() and (high > 0.99).all()
    parameters["color.bias"] = ad.TensorXf64([-9.0, -9.0, -9.0])
    assert (ask(ad, field, p, d)[1] < 0.01).all()
    assert list(field.weights()["color.bias"]) == [-9, -9, -9]


def test_weights_are_copies(ad: Any) -> None:
    weights = initial_weights(SMALL.shapes(), 0)
    field = NeuralField(SMALL, weights, ad.TensorXf)
    kept = weights["trunk_0.weight"].copy()
    weights["trunk_0.weight"][:] = np.nan
    field.weights()["trunk_0.weight"][:] = np.nan
    assert np.array_equal(field.weights()["trunk_0.weight"], kept)


def test_gradients_reach_all_parameters(ad: Any) -> None:
    field = NeuralField.create(SMALL, 0, ad.TensorXf)
    dr.enable_grad(field.parameters())
    p, d = queries()
    density, color = field.density_emission(vectors(ad, p), vectors(ad, d))
    dr.backward(dr.sum(density) + sum(dr.sum(c) for c in color))
    for name, tensor in field.parameters().items():
        gradient = np.array(dr.grad(tensor))
        assert np.isfinite(gradient).all() and gradient.any(), name


# ---- Errors -----------------------------------------------------------------


def test_wrong_weights_are_refused(ad: Any) -> None:
    good = initial_weights(SMALL.shapes(), 0)
    bad = {n: w for n, w in good.items() if n != "density.bias"}
    with pytest.raises(ValueError, match=r"'density.bias' is missing, expected shape \(1,\)"):
        NeuralField(SMALL, bad, ad.TensorXf)
    with pytest.raises(ValueError, match="unexpected tensor 'trunk_3.weight'"):
        NeuralField(SMALL, {**good, "trunk_3.weight": np.zeros((16, 16))}, ad.TensorXf)
    with pytest.raises(ValueError, match=r"'trunk_1.weight' is \(16, 15\), expected \(16, 16\)"):
        NeuralField(SMALL, {**good, "trunk_1.weight": np.zeros((16, 15))}, ad.TensorXf)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"lower": (-1.0, 1.0, -1.0)}, "box"),
        ({"upper": (1.0, 1.0, float("nan"))}, "box"),
        ({"density_activation": "sigmoid"}, "density_activation='sigmoid'"),
        ({"color_activation": "relu"}, "color_activation='relu'"),
        ({"color_space": "xyz"}, "color_space='xyz'"),
    ],
)
def test_settings_are_validated(change: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        dataclasses.replace(SMALL, **change)


# --------------------------------------------------------------------------
#   Noise on raw densities
# --------------------------------------------------------------------------


def test_density_noise_is_standard_normal(ad: Any) -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (3, 200_000)).astype(np.float32)
    noise = np.array(DensityNoise(2.0, 7).at(ad.Array3f(points)))
    assert noise.mean() == pytest.approx(0, abs=0.02)
    assert noise.std() == pytest.approx(2, rel=0.01)
    for bound in (-1, 0, 1, 2):  # the normal distribution function
        expected = 0.5 * (1 + math.erf(bound / math.sqrt(2)))
        assert (noise < 2 * bound).mean() == pytest.approx(expected, abs=5e-3)
    # Neighbours, seeds and repeats.
    close = np.array(DensityNoise(2.0, 7).at(ad.Array3f(points + np.float32(1e-6))))
    other = np.array(DensityNoise(2.0, 8).at(ad.Array3f(points)))
    again = np.array(DensityNoise(2.0, 7).at(ad.Array3f(points)))
    assert abs(np.corrcoef(noise, close)[0, 1]) < 0.02
    assert abs(np.corrcoef(noise, other)[0, 1]) < 0.02
    assert (again == noise).all()


@pytest.mark.slow
def test_density_noise_acts_before_the_activation(ad: Any) -> None:
    config = NeuralFieldConfig(network=NetworkConfig(depth=1, width=8, skip=-1, view_width=8))
    field = NeuralField.create(config, 0, ad.TensorXf)
    p = ad.Array3f(np.random.default_rng(0).uniform(-1, 1, (3, 50)).astype(np.float32))
    clean = np.array(field.density(p), np.float64)
    raw = np.log(np.expm1(clean)) + np.array(DensityNoise(1.0, 3).at(p), np.float64)
    noisy = np.array(field.for_training(noise=1.0, seed=3).density(p))
    assert noisy == pytest.approx(np.log1p(np.exp(raw)), rel=1e-4)
    assert (np.array(field.density(p)) == clean).all()


def test_training_looks_at_the_same_weights(ad: Any) -> None:
    """Also at those that come later; the coarse field has noise of its own."""
    field = NeuralField.create(SMALL, 0, ad.TensorXf, NeuralField.create(SMALL, 0, ad.TensorXf))
    view = field.for_training(noise=1.0, seed=5)
    assert view.parameters() is field.parameters() and view.coarse is not None
    p = vectors(ad, queries()[0].astype(np.float32))
    fine, coarse = np.array(view.density(p)), np.array(view.coarse.density(p))
    assert (fine == np.array(field.for_training(noise=1.0, seed=5).density(p))).all()
    assert (coarse == np.array(field.for_training(noise=1.0, seed=6).density(p))).all()
    field.parameters()["density.bias"] = ad.TensorXf([40.0])
    assert (np.array(view.density(p)) > 20).all()
