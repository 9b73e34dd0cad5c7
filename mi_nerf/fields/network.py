"""The multilayer perceptron of a radiance field (NeRF, Fig. 7), in tensor mode.

    γ(x) ─ trunk ─┬─ density head ─ σ
                  └─ feature layer ─┐
    γ(d) ───────────────────────────┴─ view branch ─ colour head ─ c

Density never sees the direction. A layer that receives two inputs (the skip layer,
the first view layer) keeps one matrix for each, which spares the concatenation.
Queries are the columns of ``(features, N)`` tensors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import numpy as np

from ..base.arrays import Floats, Tensor
from .activations import relu

GRID = "grid.table"  # the parameter that holds the features of a hash grid
_GRID_START = 1e-4  # its entries start within plus or minus this (Müller et al. 2022)
DENSITY, FEATURE, COLOR = "density", "feature", "color"  # layers that start as linear ones


@dataclass(frozen=True)
class Layer:
    """y = W·x + b, perhaps with a second matrix for features that it sees besides x."""

    name: str
    reads: str  # where x comes from: the name of another layer, or "position"
    outputs: int
    sees: str | None = None  # "position" or "direction"
    rectify: bool = False  # a ReLU follows

    @property
    def weight(self) -> str:
        """The name of W."""
        return f"{self.name}.weight"

    @property
    def second_weight(self) -> str:
        """The name of the second matrix, if there is one."""
        return f"{self.name}.{self.sees}_weight"

    @property
    def bias(self) -> str:
        """The name of b."""
        return f"{self.name}.bias"

    def matrices(self) -> dict[str, str]:
        """The names of the matrices, and of what each is multiplied with."""
        return {self.weight: self.reads} | ({self.second_weight: self.sees} if self.sees else {})


@dataclass(frozen=True)
class NetworkConfig:
    """Shape of the network; the defaults are the published one."""

    depth: int = 8  # layers of the trunk
    width: int = 256  # neurons a trunk layer
    skip: int = 5  # trunk layer (counted from 0) that sees γ(x) again; −1: none
    feature_layer: bool = True  # a linear layer between trunk and view branch
    feature_relu: bool = False  # a ReLU after it, as some ports of the original have
    view_depth: int = 1  # layers of the view branch; 0: colour straight from the feature
    view_width: int = 128  # neurons a view-branch layer
    view_dependent: bool = True  # False: the view branch does not see the direction

    def __post_init__(self) -> None:
        for name, lowest in (("depth", 1), ("width", 1), ("view_depth", 0), ("view_width", 1)):
            value = getattr(self, name)
            if value < lowest:
                raise ValueError(f"network: {name}={value}, expected at least {lowest}")
        if not -1 <= self.skip < self.depth or self.skip == 0:
            raise ValueError(
                f"network: skip={self.skip}, expected -1 (none) or a layer from 1 to depth-1"
            )
        if self.feature_relu and not self.feature_layer:
            raise ValueError("network: feature_relu=True, expected feature_layer=True with it")

    def trunk(self) -> list[Layer]:
        """The layers whose last outputs density and colour are read from."""
        names = ["position", *(f"trunk_{i}" for i in range(self.depth))]
        return [
            Layer(names[i + 1], names[i], self.width, "position" if i == self.skip else None, True)
            for i in range(self.depth)
        ]

    def density(self) -> Layer:
        """The head that density is read from."""
        return Layer(DENSITY, f"trunk_{self.depth - 1}", 1)

    def color(self) -> list[Layer]:
        """The layers from the trunk to the three channels."""
        layers, last = [], f"trunk_{self.depth - 1}"
        if self.feature_layer:
            layers.append(Layer(FEATURE, last, self.width, rectify=self.feature_relu))
            last = FEATURE
        seen = "direction" if self.view_dependent else None  # by the first of the following
        for i in range(self.view_depth):
            layers.append(Layer(f"view_{i}", last, self.view_width, seen, True))
            last, seen = f"view_{i}", None
        return [*layers, Layer(COLOR, last, 3, seen)]

    def layers(self) -> list[Layer]:
        """All of them; none comes before what it reads."""
        return [*self.trunk(), self.density(), *self.color()]

    def shapes(self, position_size: int, direction_size: int) -> dict[str, tuple[int, ...]]:
        """Names and shapes of all parameters; weights are ``(outputs, inputs)``."""
        shapes: dict[str, tuple[int, ...]] = {}
        sizes = {"position": position_size, "direction": direction_size}
        for layer in self.layers():
            for name, source in layer.matrices().items():
                shapes[name] = (layer.outputs, sizes[source])
            shapes[layer.bias] = (layer.outputs,)
            sizes[layer.name] = layer.outputs
        return shapes


def initial_weights(
    shapes: dict[str, tuple[int, ...]], seed: int
) -> dict[str, np.ndarray[Any, Any]]:
    """He-normal weights for ReLU layers, Glorot-normal for linear ones, zero biases.

    Entries of a hash grid start near 0.
    """
    rng = np.random.default_rng(seed)
    result = {}
    for name, shape in shapes.items():
        layer, kind = name.split(".")
        if name == GRID:
            result[name] = rng.uniform(-_GRID_START, _GRID_START, shape).astype(np.float32)
            continue
        if kind == "bias":
            result[name] = np.zeros(shape, np.float32)
            continue
        inputs = sum(s[1] for n, s in shapes.items() if n.startswith(layer + ".") and len(s) == 2)
        linear = layer in (DENSITY, FEATURE, COLOR)
        variance = 2 / (inputs + shape[0]) if linear else 2 / inputs
        result[name] = rng.normal(0, math.sqrt(variance), shape).astype(np.float32)
    return result


class _AddBias(dr.CustomOp):
    """``y + bias`` on the columns of a tensor, optionally followed by the ReLU.

    The adjoint of Dr.Jit's broadcast adds to the bias atomically, in an order that
    depends on the threads; summing rows instead makes training reproducible bit by bit.
    Fused with the ReLU, only its result is kept for the backward pass.
    """

    def eval(self, y: Tensor, bias: Tensor, rectify: bool) -> Any:
        """The ``(features, N)`` sum."""
        z = y + dr.reshape(bias, (bias.shape[0], 1))
        z = relu(z) if rectify else z
        self._active = z if rectify else None
        return z

    def forward(self) -> None:
        """Tangents of both inputs, added."""
        bias = self.grad_in("bias")
        self.set_grad_out(self._mask(self.grad_in("y") + dr.reshape(bias, (bias.shape[0], 1))))

    def backward(self) -> None:
        """The gradient itself, and the sum of its rows."""
        gradient = self._mask(self.grad_out())
        self.set_grad_in("y", gradient)
        self.set_grad_in("bias", dr.sum(gradient, axis=1))

    def name(self) -> str:
        """Shown in Dr.Jit's graphs."""
        return "AddBias"

    def _mask(self, gradient: Tensor) -> Tensor:
        return gradient if self._active is None else dr.select(self._active > 0, gradient, 0)


def evaluate(
    layers: Iterable[Layer], apply: Callable[[Layer, Any, Any], Any], x: Tensor, **features: Any
) -> Any:
    """What the last of the layers gives if the first one reads ``x``.

    Args:
        apply: one layer's outputs, of what it reads and of the features that it sees.
        features: by what the layers call them.
    """
    for layer in layers:
        x = apply(layer, x, features[layer.sees] if layer.sees else None)
    return x


def trunk(config: NetworkConfig, weights: Mapping[str, Any], position: Tensor) -> Tensor:
    """The ``(width, N)`` activations that density and colour are read from."""
    return evaluate(config.trunk(), partial(_apply, weights), position, position=position)


def density_head(config: NetworkConfig, weights: Mapping[str, Any], h: Tensor) -> Floats:
    """Raw density of N queries, before its activation."""
    return _apply(weights, config.density(), h, None).array


def color_head(
    config: NetworkConfig, weights: Mapping[str, Any], h: Tensor, direction: Tensor
) -> list[Floats]:
    """Raw colour of N queries, one array a channel; ``direction`` is γ(d) as a tensor."""
    return rows(evaluate(config.color(), partial(_apply, weights), h, direction=direction))


def rows(tensor: Tensor) -> list[Floats]:
    """The rows of an ``(F, N)`` tensor as arrays."""
    flat, count = tensor.array, tensor.shape[1]
    float_type = type(flat)
    column = dr.arange(dr.uint32_array_t(float_type), count)
    return [dr.gather(float_type, flat, column + i * count) for i in range(tensor.shape[0])]


def _apply(weights: Mapping[str, Any], layer: Layer, x: Tensor, seen: Tensor) -> Tensor:
    y = weights[layer.weight] @ x
    if layer.sees:
        y = y + weights[layer.second_weight] @ seen
    return dr.custom(_AddBias, y, weights[layer.bias], layer.rectify)
