"""The network without derivatives, in one kernel: cooperative vectors instead of tensors.

Activations stay in registers, so that narrow networks are no longer bound by memory. On
two CPU cores this evaluates a 64-wide network about twice as fast as tensor mode; wider
ones, and gradients, are faster as matrix products.

In half precision and with derivatives it is what tensor cores of a GPU are made for.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
from drjit import nn

from ..base.arrays import Floats
from .network import GRID, Layer, NetworkConfig, evaluate

WIDEST = 64  # neurons of a layer up to which this wins


def worth_fusing(config: NetworkConfig, float_type: Any) -> bool:
    """Whether a network is narrow enough, and the backend one on which this was measured."""
    widest = max(layer.outputs for layer in config.layers())
    single = dr.type_v(float_type) == dr.VarType.Float32
    return widest <= WIDEST and single and dr.backend_v(float_type) == dr.JitBackend.LLVM


class FusedNetwork:
    """A copy of a network's weights, packed for products with cooperative vectors."""

    def __init__(self, config: NetworkConfig, weights: Mapping[str, Any]) -> None:
        self._config = config
        self._views = self._pack({n: w for n, w in weights.items() if n != GRID})

    def _pack(self, weights: dict[str, Any]) -> dict[str, Any]:
        with dr.suspend_grad():
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
        return nn.matvec(self._views[layer.second_weight], nn.CoopVec(*direction))

    def answer(self, position: list[Floats], seen: Any) -> tuple[Floats, list[Floats]]:
        """As a call, for directions of which :meth:`seen` is known, or ``None``."""
        h = self._trunk(position)
        density = self._apply(self._config.density(), h, None)
        color = evaluate(self._config.color(), self._apply, h, direction=seen)
        return next(iter(density)), list(color)

    def density(self, position: list[Floats]) -> Floats:
        """Raw density of N queries alone."""
        return next(iter(self._apply(self._config.density(), self._trunk(position), None)))

    def _trunk(self, position: list[Floats]) -> Any:
        x = nn.CoopVec(*position)
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
        half = dr.float16_array_t(type(position[0]))
        single = dr.float32_array_t(half)
        position = [half(x) for x in dr.custom(_ScaleGradient, position, 1 / self._scale)]
        direction = None if direction is None else [half(x) for x in direction]
        density, color = super().__call__(position, direction)
        raw = dr.custom(_ScaleGradient, [single(x) for x in (density, *color)], self._scale)
        raw = [dr.select(dr.isfinite(x), x, dr.nan) for x in raw]  # activations have limits
        return raw[0], raw[1:]

    def _rectified(self, y: Any) -> Any:
        # The maximum would take NaN, and what negative infinity may stand for, for 0.
        return y * dr.step(y, 0)

    def _pack(self, weights: dict[str, Any]) -> dict[str, Any]:
        weights = dr.custom(_ScaleGradient, weights, 1 / self._scale)
        halves = {n: dr.float16_array_t(type(w))(w) for n, w in weights.items()}
        views: dict[str, Any] = nn.pack(halves, layout="training")
        return views
