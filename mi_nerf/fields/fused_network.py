"""The network without derivatives, in one kernel: cooperative vectors instead of tensors.

Activations stay in registers, so that narrow networks are no longer bound by memory. On
two CPU cores this evaluates a 64-wide network about twice as fast as tensor mode; wider
ones, and gradients, are faster as matrix products.

In half precision it is what tensor cores of a GPU are made for, without derivatives and with
them: Dr.Jit has no other cooperative vectors there.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import numpy as np
from drjit import nn

from ..base.arrays import Floats
from ..base.variants import multiplies_in_half
from .network import GRID, Layer, NetworkConfig, evaluate

WIDEST = 64  # neurons of a layer up to which this wins
_LARGEST = 65504.0  # of half precision
_MARGIN = 0.9  # of it, that sums with rounding errors stay below


def worth_fusing(config: NetworkConfig, float_type: Any) -> bool:
    """Whether a network is narrow enough, and the device one with such products."""
    widest = max(layer.outputs for layer in config.layers())
    if widest > WIDEST or dr.type_v(float_type) != dr.VarType.Float32:
        return False
    if dr.backend_v(float_type) == dr.JitBackend.LLVM:
        return True
    return multiplies_in_half(dr.float16_array_t(float_type))


def fused_network(config: NetworkConfig, weights: Mapping[str, Any]) -> FusedNetwork | None:
    """The network as one kernel, or ``None`` where that would be slower or wrong.

    On a GPU it is in half precision, if no activation can overflow. While ``dr.freeze`` records,
    weights cannot be looked at to know that.
    """
    float_type = type(next(iter(weights.values())).array)
    half = dr.backend_v(float_type) != dr.JitBackend.LLVM
    if half and dr.flag(dr.JitFlag.FreezingScope) or not worth_fusing(config, float_type):
        return None
    if half and max(activation_bounds(config, weights).values()) > _MARGIN * _LARGEST:
        return None
    return FusedNetwork(config, weights, half=half)


def activation_bounds(config: NetworkConfig, weights: Mapping[str, Any]) -> dict[str, float]:
    """What outputs of the layers, before their ReLU, and features cannot exceed in the box.

    Features of a hash grid are means of entries of its table; all others are coordinates in
    [−1, 1], sines and cosines. A layer is bounded by the sums of the magnitudes in its rows.
    """
    bounds = {"position": 1.0, "direction": 1.0}
    if GRID in weights:
        bounds["position"] = max(1.0, float(dr.max(dr.abs(weights[GRID].array))[0]))
    for layer in config.layers():
        total = np.abs(np.array(weights[layer.bias], np.float64))
        for name, source in layer.matrices().items():
            rows = np.abs(np.array(weights[name], np.float64)).sum(axis=1)
            total = total + rows * bounds[source]
        bounds[layer.name] = float(total.max())
    return bounds


class FusedNetwork:
    """A copy of a network's weights, packed for products with cooperative vectors."""

    def __init__(
        self, config: NetworkConfig, weights: Mapping[str, Any], *, half: bool = False
    ) -> None:
        """With ``half``, products are in half precision; what comes in and out is in single."""
        self._config, self._half = config, half
        self._views = self._pack({n: w for n, w in weights.items() if n != GRID})

    def _pack(self, weights: dict[str, Any]) -> dict[str, Any]:
        with dr.suspend_grad():
            weights = {n: _in_half(dr.detach(w)) if self._half else w for n, w in weights.items()}
            views: dict[str, Any] = nn.pack(dr.detach(weights), layout="inference")
        return views

    def __call__(
        self, position: list[Floats], direction: list[Floats] | None
    ) -> tuple[Floats, list[Floats]]:
        """Raw density and the three raw colours of N queries, before their activations.

        Args:
            position, direction: features, one array of N values each.
        """
        return self.answer(position, None if direction is None else self.seen(direction))

    def seen(self, direction: list[Floats]) -> Any:
        """What the features of a direction add in the layer that sees them, for :meth:`answer`."""
        layer = next(layer for layer in self._config.color() if layer.sees)
        return nn.matvec(self._views[layer.second_weight], self._vector(direction))

    def answer(self, position: list[Floats], seen: Any) -> tuple[Floats, list[Floats]]:
        """As a call, for directions of which :meth:`seen` is known, or ``None``."""
        h = self._trunk(position)
        density = self._apply(self._config.density(), h, None)
        color = evaluate(self._config.color(), self._apply, h, direction=seen)
        return self._numbers(density)[0], self._numbers(color)

    def density(self, position: list[Floats]) -> Floats:
        """Raw density of N queries alone."""
        return self._numbers(self._apply(self._config.density(), self._trunk(position), None))[0]

    def _vector(self, values: list[Floats]) -> Any:
        return nn.CoopVec(*map(_in_half, values) if self._half else values)

    def _numbers(self, vector: Any) -> list[Floats]:
        values = list(vector)
        return [dr.float32_array_t(type(x))(x) for x in values] if self._half else values

    def _trunk(self, position: list[Floats]) -> Any:
        x = self._vector(position)
        return evaluate(self._config.trunk(), self._apply, x, position=x)

    def _apply(self, layer: Layer, x: Any, seen: Any) -> Any:
        views = self._views
        y = nn.matvec(views[layer.weight], x, views[layer.bias])
        if layer.sees == "direction":
            y = y + seen
        elif layer.sees:
            y = y + nn.matvec(views[layer.second_weight], seen)
        return self._rectified(y) if layer.rectify else y

    def _rectified(self, y: Any) -> Any:
        return dr.maximum(y, 0)


def _in_half(values: Any) -> Any:
    return dr.float16_array_t(type(values))(values)


class _ScaleGradient(dr.CustomOp):
    """Values as they are; their adjoints times a factor."""

    def eval(self, values: Any, factor: Any) -> Any:
        """A dictionary of tensors or a list of arrays, unchanged."""
        self._factor = factor
        return values

    def forward(self) -> None:
        """Tangents are not scaled."""
        self.set_grad_out(self.grad_in("values"))

    def backward(self) -> None:
        """The adjoints, scaled."""
        gradients = self.grad_out()
        if isinstance(gradients, dict):
            scaled = {n: type(g)(g.array * self._factor, g.shape) for n, g in gradients.items()}
            self.set_grad_in("values", scaled)
        else:
            self.set_grad_in("values", [g * self._factor for g in gradients])

    def name(self) -> str:
        """Shown in Dr.Jit's graphs."""
        return "ScaleGradient"


class HalfNetwork(FusedNetwork):
    """The network in half precision, with derivatives (Micikevicius et al. 2018).

    Weights, features and results are in single precision outside. Adjoints inside are
    ``loss_scale`` times what they are outside, so that small ones are not lost; where that
    makes them overflow, gradients are not finite. Where activations overflow, on which the
    scale has no influence, answers are NaN, and so is every loss made of them.
    """

    def __init__(self, config: NetworkConfig, weights: Mapping[str, Any], loss_scale: Any) -> None:
        """``loss_scale`` is an array of one value."""
        self._scale = loss_scale
        super().__init__(config, weights)

    def __call__(
        self, position: list[Floats], direction: list[Floats] | None
    ) -> tuple[Floats, list[Floats]]:
        """See :class:`FusedNetwork`."""
        single = dr.float32_array_t(type(position[0]))
        position = [_in_half(x) for x in dr.custom(_ScaleGradient, position, 1 / self._scale)]
        direction = None if direction is None else [_in_half(x) for x in direction]
        density, color = super().__call__(position, direction)
        raw = dr.custom(_ScaleGradient, [single(x) for x in (density, *color)], self._scale)
        raw = [dr.select(dr.isfinite(x), x, dr.nan) for x in raw]  # activations have limits
        return raw[0], raw[1:]

    def _rectified(self, y: Any) -> Any:
        # The maximum would take NaN, and what negative infinity may stand for, for 0.
        return y * dr.step(y, 0)

    def _pack(self, weights: dict[str, Any]) -> dict[str, Any]:
        weights = dr.custom(_ScaleGradient, weights, 1 / self._scale)
        halves = {n: _in_half(w) for n, w in weights.items()}
        views: dict[str, Any] = nn.pack(halves, layout="training")
        return views
