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
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from .activations import relu

GRID = "grid.table"  # the parameter that holds the features of a hash grid
_GRID_START = 1e-4  # its entries start within plus or minus this (Müller et al. 2022)


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

    def shapes(self, position_size: int, direction_size: int) -> dict[str, tuple[int, ...]]:
        """Names and shapes of all parameters; weights are ``(outputs, inputs)``."""
        shapes: dict[str, tuple[int, ...]] = {}

        def layer(name: str, outputs: int, **inputs: int) -> int:
            for kind, size in inputs.items():
                shapes[f"{name}.{kind}"] = (outputs, size)
            shapes[f"{name}.bias"] = (outputs,)
            return outputs

        size = position_size
        for i in range(self.depth):
            extra = {"position_weight": position_size} if i == self.skip else {}
            size = layer(f"trunk_{i}", self.width, weight=size, **extra)
        layer("density", 1, weight=size)
        if self.feature_layer:
            size = layer("feature", self.width, weight=size)
        if self.view_depth == 0 and self.view_dependent:
            layer("color", 3, weight=size, direction_weight=direction_size)
            return shapes
        for i in range(self.view_depth):
            first = i == 0 and self.view_dependent
            extra = {"direction_weight": direction_size} if first else {}
            size = layer(f"view_{i}", self.view_width, weight=size, **extra)
        layer("color", 3, weight=size)
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
        linear = layer in ("density", "feature", "color")
        variance = 2 / (inputs + shape[0]) if linear else 2 / inputs
        result[name] = rng.normal(0, math.sqrt(variance), shape).astype(np.float32)
    return result


class _AddBias(dr.CustomOp):
    """``y + bias`` on the columns of a tensor, optionally followed by the ReLU.

    The adjoint of Dr.Jit's broadcast adds to the bias atomically, in an order that
    depends on the threads; summing rows instead makes training reproducible bit by bit.
    Fused with the ReLU, only its result is kept for the backward pass.
    """

    def eval(self, y: Any, bias: Any, rectify: bool) -> Any:
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

    def _mask(self, gradient: Any) -> Any:
        return gradient if self._active is None else dr.select(self._active > 0, gradient, 0)


def _layer(
    weights: dict[str, Any], name: str, x: Any, extra: dict[str, Any], *, rectify: bool = False
) -> Any:
    y = weights[f"{name}.weight"] @ x
    for kind, value in extra.items():
        y = y + weights[f"{name}.{kind}"] @ value
    return dr.custom(_AddBias, y, weights[f"{name}.bias"], rectify)


def trunk(config: NetworkConfig, weights: dict[str, Any], position: Any) -> Any:
    """The ``(width, N)`` activations that density and colour are read from."""
    h = position
    for i in range(config.depth):
        extra = {"position_weight": position} if i == config.skip else {}
        h = _layer(weights, f"trunk_{i}", h, extra, rectify=True)
    return h


def density_head(weights: dict[str, Any], h: Any) -> Any:
    """Raw density of N queries, before its activation."""
    return _layer(weights, "density", h, {}).array


def color_head(config: NetworkConfig, weights: dict[str, Any], h: Any, direction: Any) -> list[Any]:
    """Raw colour of N queries, one array a channel; ``direction`` is γ(d) as a tensor."""
    if config.feature_layer:
        h = _layer(weights, "feature", h, {}, rectify=config.feature_relu)
    seen = {"direction_weight": direction} if config.view_dependent else {}
    for i in range(config.view_depth):
        h = _layer(weights, f"view_{i}", h, seen if i == 0 else {}, rectify=True)
    raw = _layer(weights, "color", h, seen if config.view_depth == 0 else {})
    flat, count = raw.array, raw.shape[1]
    float_type = type(flat)
    column = dr.arange(dr.uint32_array_t(float_type), count)
    return [dr.gather(float_type, flat, column + i * count) for i in range(3)]
