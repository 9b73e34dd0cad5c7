"""Rows 6, 9, 10 and 17: initial weights, features, activations and optimiser."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np
from drjit.opt import Adam as DrJitAdam

from mi_nerf.fields.activations import relu, sigmoid
from mi_nerf.fields.fourier import FourierEncoding, sincos_octave
from mi_nerf.fields.network import NetworkConfig, initial_weights
from mi_nerf.fields.neural import NeuralField, NeuralFieldConfig
from mi_nerf.march.quadrature import over_background
from mi_nerf.training.losses import squared_error
from mi_nerf.training.optimizer import Adam
from tests.hard_cases import Finding, not_finite
from tests.support import naive
from tests.support.arrays import vectors

SEEDS = 20
PUBLISHED = NeuralFieldConfig(
    position=FourierEncoding(10),
    network=NetworkConfig(),
    density_activation="relu",
    density_shift=0.0,
)


def dead_density(ad: Any) -> list[Finding]:
    """Row 6: the published 8×256 network over 20 seeds, at 256 points."""
    softplus = replace(PUBLISHED, density_activation="softplus", density_shift=-1.0)
    negative = replace(PUBLISHED, density_shift=-1.0)
    ours = densities(ad, softplus, initial_weights)
    usual = densities(ad, PUBLISHED, naive.initial_weights)
    below = densities(ad, negative, naive.initial_weights)
    return [
        Finding("seeds of 20 whose density is 0 everywhere", usual[0], ours[0]),
        Finding("whose gradient is 0 for every weight", usual[1], ours[1]),
        Finding("the same, 1 subtracted before the activation", below[1], ours[1]),
    ]


def densities(
    ad: Any, config: NeuralFieldConfig, weights: Callable[..., Any]
) -> tuple[float, float]:
    """How many seeds give no density anywhere, and how many no gradient."""
    p = vectors(ad, np.random.default_rng(0).uniform(-1, 1, (256, 3)))
    largest, slopes = [], []
    for seed in range(SEEDS):
        field = NeuralField(config, weights(config.shapes(), seed), ad.TensorXf)
        dr.enable_grad(field.parameters())
        density = field.density(p)
        largest.append(np.array(dr.detach(density)).max())
        dr.backward(dr.sum(density))
        tensors = field.parameters().values()
        slopes.append(max(np.abs(np.array(dr.grad(tensor))).max() for tensor in tensors))
    return float(np.sum(np.equal(largest, 0))), float(np.sum(np.equal(slopes, 0)))


def high_octaves(ad: Any) -> list[Finding]:
    """Row 9: features of points within ±8, and of coordinates in half precision."""
    x = np.random.default_rng(0).uniform(-8, 8, 2000).astype(np.float32)

    def errors(sincos: Callable[[Any, int], Any], k: int) -> tuple[float, float]:
        phase = np.pi * np.fmod(x.astype(float) * 2.0**k, 2)
        argument = ad.Float(x)
        dr.enable_grad(argument)
        sine, _ = sincos(argument, k)
        value = np.abs(np.array(dr.detach(sine)) - np.sin(phase)).max()
        dr.backward(sine)
        slopes = np.array(dr.grad(argument)) / (np.pi * 2.0**k)
        return float(value), float(np.abs(slopes - np.cos(phase)).max())

    def ours(x: Any, k: int) -> Any:
        return sincos_octave(x, k, "pi")

    def half(x: Any, k: int) -> Any:
        return ours(ad.Float(ad.Float16(x)), k)

    doubled, plain = errors(naive.doubled_sincos, 15), errors(naive.plain_sincos, 15)
    exact, ninth = errors(ours, 15), errors(ours, 9)
    return [
        Finding("error of sin(π·2^15·x), by doubled angles", doubled[0], exact[0]),
        Finding("of its slope, per π·2^15", doubled[1], exact[1]),
        Finding("error of the sine of the product as it stands", plain[0], exact[0]),
        Finding(
            "error of sin(π·2^9·x), coordinates in half precision", errors(half, 9)[0], ninth[0]
        ),
    ]


def not_a_number(ad: Any) -> list[Finding]:
    """Row 10: a NaN in a network, and one in a gradient."""
    spoilt = ad.Float([np.nan, 1, -1])
    hidden, seen = (not_finite(f(spoilt)) for f in (naive.relu, relu))

    def destroyed(step: Callable[[dict[str, Any]], None]) -> float:
        parameters = {"w": ad.TensorXf(np.ones(100, np.float32))}
        step(parameters)
        return float(not_finite(parameters["w"].array))

    def usual(parameters: dict[str, Any]) -> None:
        optimizer = DrJitAdam(lr=0.1, params=parameters)
        for gradient in gradients(ad):
            dr.set_grad(optimizer["w"], gradient)
            optimizer.step()
        parameters["w"] = dr.detach(optimizer["w"])

    def ours(parameters: dict[str, Any]) -> None:
        optimizer = Adam(parameters)
        for gradient in gradients(ad):
            dr.set_grad(parameters["w"], gradient)
            optimizer.step(0.1, ad.Bool(True))

    return [
        Finding("NaN of a hidden layer that pass its ReLU (1 of 1)", hidden, seen),
        Finding("weights of 100 lost to one NaN gradient", destroyed(usual), destroyed(ours)),
    ]


def gradients(ad: Any) -> list[Any]:
    """A gradient of ones that are NaN for once, then as they should be."""
    spoilt = np.where(np.arange(100) < 50, np.nan, 1).astype(np.float32)
    return [ad.TensorXf(spoilt), ad.TensorXf(np.ones(100, np.float32))]


def saturation(ad: Any) -> list[Finding]:
    """Row 17: colour heads far out, and a white object before white."""

    def pull(background: np.ndarray) -> float:
        """Mean of −∂loss/∂opacity of a white object seen with opacity 0.3 instead of 1."""
        opacity = dr.full(ad.Float, 0.3, len(background))
        dr.make_opaque(opacity)
        dr.enable_grad(opacity)
        behind = [ad.Float(b) for b in background.T]
        predicted = over_background([opacity] * 3, opacity, behind)
        one = dr.full(ad.Float, 1, len(background))
        dr.backward(dr.mean(squared_error(predicted, over_background([one] * 3, one, behind))))
        return float(-np.array(dr.grad(opacity)).sum())

    def least(f: Callable[[Any], Any]) -> float:
        return float(dr.log(f(ad.Float(-100)))[0])

    random = np.random.default_rng(0).random((4096, 3))
    return [
        Finding("logarithm of the sigmoid of −100 (finite)", least(naive.sigmoid), least(sigmoid)),
        Finding(
            "pull on the opacity of a white object (above 0)",
            pull(np.ones((4096, 3))),
            pull(random),
        ),
    ]
