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

from .network import GRID, NetworkConfig

WIDEST = 64  # neurons of a layer up to which this wins


def worth_fusing(config: NetworkConfig, float_type: Any) -> bool:
    """Whether a network is narrow enough, and the backend one on which this was measured."""
    widths = [config.width] + [config.view_width] * (config.view_depth > 0)
    single = dr.type_v(float_type) == dr.VarType.Float32
    return max(widths) <= WIDEST and single and dr.backend_v(float_type) == dr.JitBackend.LLVM


class FusedNetwork:
    """A copy of a network's weights, packed for products with cooperative vectors."""

    def __init__(self, config: NetworkConfig, weights: Mapping[str, Any]) -> None:
        self._config = config
        self._views = self._pack({n: w for n, w in weights.items() if n != GRID})

    def _pack(self, weights: dict[str, Any]) -> dict[str, Any]:
        with dr.suspend_grad():
            views: dict[str, Any] = nn.pack(dr.detach(weights), layout="inference")
        return views

    def __call__(self, position: list[Any], direction: list[Any] | None) -> tuple[Any, list[Any]]:
        """Raw density and the three raw colours of N queries, before their activations.

        Args:
            position, direction: features, one array of N values each.
        """
        config, h = self._config, self._trunk(position)
        v = None if direction is None else nn.CoopVec(*direction)
        density = self._layer("density", h, {})
        if config.feature_layer:
            h = self._layer("feature", h, {}, rectify=config.feature_relu)
        seen = {} if v is None else {"direction_weight": v}
        for i in range(config.view_depth):
            h = self._layer(f"view_{i}", h, seen if i == 0 else {}, rectify=True)
        color = self._layer("color", h, seen if config.view_depth == 0 else {})
        return next(iter(density)), list(color)

    def density(self, position: list[Any]) -> Any:
        """Raw density of N queries alone."""
        return next(iter(self._layer("density", self._trunk(position), {})))

    def _trunk(self, position: list[Any]) -> Any:
        x = h = nn.CoopVec(*position)
        for i in range(self._config.depth):
            extra = {"position_weight": x} if i == self._config.skip else {}
            h = self._layer(f"trunk_{i}", h, extra, rectify=True)
        return h

    def _layer(self, name: str, x: Any, extra: dict[str, Any], *, rectify: bool = False) -> Any:
        views = self._views
        y = nn.matvec(views[f"{name}.weight"], x, views[f"{name}.bias"])
        for kind, value in extra.items():
            y = y + nn.matvec(views[f"{name}.{kind}"], value)
        return dr.maximum(y, 0) if rectify else y


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
    makes them overflow, gradients are not finite.
    """

    def __init__(self, config: NetworkConfig, weights: Mapping[str, Any], loss_scale: Any) -> None:
        """``loss_scale`` is an array of one value."""
        self._scale = loss_scale
        super().__init__(config, weights)

    def __call__(self, position: list[Any], direction: list[Any] | None) -> tuple[Any, list[Any]]:
        """See :class:`FusedNetwork`."""
        half = dr.float16_array_t(type(position[0]))
        single = dr.float32_array_t(half)
        position = [half(x) for x in dr.custom(_ScaleGradient, position, 1 / self._scale)]
        direction = None if direction is None else [half(x) for x in direction]
        density, color = super().__call__(position, direction)
        raw = dr.custom(_ScaleGradient, [single(x) for x in (density, *color)], self._scale)
        return raw[0], raw[1:]

    def _pack(self, weights: dict[str, Any]) -> dict[str, Any]:
        weights = dr.custom(_ScaleGradient, weights, 1 / self._scale)
        halves = {n: dr.float16_array_t(type(w))(w) for n, w in weights.items()}
        views: dict[str, Any] = nn.pack(halves, layout="training")
        return views
