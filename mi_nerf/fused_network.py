"""The network without derivatives, in one kernel: cooperative vectors instead of tensors.

Activations stay in registers, so that narrow networks are no longer bound by memory. On
two CPU cores this evaluates a 64-wide network about twice as fast as tensor mode; wider
ones, and gradients, are faster as matrix products.
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
        names = [name for name in weights if name != GRID]
        with dr.suspend_grad():
            views = nn.pack(*(dr.detach(weights[name]) for name in names), layout="inference")
        self._views = dict(zip(names, views, strict=True))

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
