"""The published model, its loss and its optimiser in NumPy, in double precision.

Written from the paper (Mildenhall et al. 2020) and Keras' Adam, not from mi_nerf: forward and
backward by hand. Weights may be complex, so that slopes can be found without any backward
pass, by complex steps: Im f(w + i·h·v)/h is the derivative along v to the last digits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]
Weights = dict[str, Array]  # matrices are (outputs, inputs)

DEPTH, SKIP = 8, 5  # of the trunk; the layer, counted from 0, that sees the position again
OCTAVES, DIRECTION_OCTAVES = 10, 4


def encode(x: Array, octaves: int) -> Array:
    """γ of (N, 3) values (Eq. 4), preceded by the values, (N, 3 + 6·octaves)."""
    parts = [x]
    for k in range(octaves):
        parts += [np.sin(2.0**k * np.pi * x), np.cos(2.0**k * np.pi * x)]
    return np.concatenate(parts, axis=1)


@dataclass
class Rays:
    """Samples of R rays, and the pixels that they ought to see."""

    position: Array  # (R, S, 3), the box's longest side spanning [−1, 1]
    direction: Array  # (R, 3) unit
    delta: Array  # (R, S); 0 where the ray misses the box
    target: Array  # (R, 3) on white
    density_scale: float  # 1/scene unit


class Network:
    """The network of Fig. 7; keeps what :meth:`backward` needs."""

    def __init__(self, weights: Weights) -> None:
        self._weights = weights
        self._inputs: dict[str, list[tuple[str, Array]]] = {}
        self._gradients: Weights = {}

    def __call__(self, position: Array, direction: Array) -> tuple[Array, Array]:
        """Raw densities (N,) and raw colours (N, 3) of encoded (N, ·) inputs."""
        self._hidden = [position]
        for i in range(DEPTH):
            extra = {"position_weight": position} if i == SKIP else {}
            self._hidden.append(_relu(self._layer(f"trunk_{i}", self._hidden[-1], **extra)))
        density = self._layer("density", self._hidden[-1])[:, 0]
        feature = self._layer("feature", self._hidden[-1])
        self._view = _relu(self._layer("view_0", feature, direction_weight=direction))
        return density, self._layer("color", self._view)

    def backward(self, density: Array, color: Array) -> Weights:
        """Gradients of all weights, from those of the raw densities and colours."""
        view = self._back("color", color) * (self._view > 0)
        hidden = self._back("feature", self._back("view_0", view))
        hidden = hidden + self._back("density", density[:, None])
        for i in reversed(range(DEPTH)):
            hidden = self._back(f"trunk_{i}", hidden * (self._hidden[i + 1] > 0))
        return self._gradients

    def _layer(self, name: str, x: Array, **extra: Array) -> Array:
        self._inputs[name] = [("weight", x), *extra.items()]
        y = self._weights[f"{name}.bias"]
        for kind, value in self._inputs[name]:
            y = y + value @ self._weights[f"{name}.{kind}"].T
        return y

    def _back(self, name: str, gradient: Array) -> Array:
        self._gradients[f"{name}.bias"] = gradient.sum(axis=0)
        for kind, value in self._inputs[name]:
            self._gradients[f"{name}.{kind}"] = gradient.T @ value
        return gradient @ self._weights[f"{name}.weight"]


@dataclass
class Seen:
    """One network's image of the rays."""

    loss: Any  # mean over rays and channels of the squared error
    weights: Array  # (R, S) of the samples
    gradient: Weights  # of the loss; empty if it was not asked for


def see(network_weights: Weights, rays: Rays, *, gradient: bool = True) -> Seen:
    """Eq. 3 and 6, and their derivatives."""
    count, samples = rays.delta.shape
    network = Network(network_weights)
    raw_density, raw_color = network(
        encode(rays.position.reshape(-1, 3), OCTAVES),
        np.repeat(encode(rays.direction, DIRECTION_OCTAVES), samples, axis=0),
    )
    density = _relu(raw_density).reshape(count, samples) * rays.density_scale
    color = (1 / (1 + np.exp(-raw_color))).reshape(count, samples, 3)
    tau = density * rays.delta
    passed = np.exp(-np.cumsum(tau, axis=1))  # T behind each sample
    weights = np.concatenate([np.ones((count, 1)), passed[:, :-1]], axis=1) - passed
    image = np.einsum("rs,rsc->rc", weights, color) + passed[:, -1:]
    off = image - rays.target
    loss = np.sum(off**2) / (3 * count)
    if not gradient:
        return Seen(loss, weights, {})
    d_image = 2 * off / (3 * count)
    d_color = weights[..., None] * d_image[:, None] * color * (1 - color)
    # More optical depth at j shows more of the sample there, and less of all behind it.
    light = np.einsum("rc,rsc->rs", d_image, color)
    behind = np.cumsum((weights * light)[:, ::-1], axis=1)[:, ::-1] - weights * light
    d_tau = passed * light - behind - (d_image.sum(axis=1) * passed[:, -1])[:, None]
    d_density = d_tau * rays.delta * rays.density_scale
    flat = d_density.ravel() * (raw_density > 0)
    return Seen(loss, weights, network.backward(flat, d_color.reshape(-1, 3)))


def finer(near: Array, far: Array, weights: Array, u: Array) -> Array:
    """The inverse transform of Sec. 5.2 for each of R rays: (R, F) parameters.

    Args:
        weights: (R, S) of samples in equal bins between ``near`` and ``far``.
        u: (R, F) numbers in [0, 1).
    """
    bins = weights.shape[1]
    share = weights + 1e-5
    share = share / share.sum(axis=1, keepdims=True)
    ends = np.concatenate([np.zeros((len(share), 1)), np.cumsum(share, axis=1)], axis=1)
    places = [np.interp(x, row, np.arange(bins + 1) / bins) for x, row in zip(u, ends, strict=True)]
    return near[:, None] + np.array(places) * (far - near)[:, None]


class KerasAdam:
    """Adam as the code of the paper had it: ε is added before the bias is corrected."""

    def __init__(self, beta1: float = 0.9, beta2: float = 0.999, epsilon: float = 1e-7) -> None:
        self._beta1, self._beta2, self._epsilon = beta1, beta2, epsilon
        self._first: Weights = {}
        self._second: Weights = {}
        self._steps = 0

    def step(self, weights: Weights, gradients: Weights, rate: float) -> Weights:
        """The weights after one step."""
        self._steps += 1
        new = {}
        for name, g in gradients.items():
            m, v = self._first.get(name, 0 * g), self._second.get(name, 0 * g)
            m = self._first[name] = self._beta1 * m + (1 - self._beta1) * g
            v = self._second[name] = self._beta2 * v + (1 - self._beta2) * g**2
            mean = m / (1 - self._beta1**self._steps)
            root = np.sqrt(v / (1 - self._beta2**self._steps))
            epsilon = self._epsilon / np.sqrt(1 - self._beta2**self._steps)
            new[name] = weights[name] - rate * mean / (root + epsilon)
        return new


def _relu(x: Array) -> Array:
    return np.where(x.real > 0, x, 0)
