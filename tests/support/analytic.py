"""Fields given by formulas, of which everything is known."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import drjit as dr

from mi_nerf.base.box import Corner
from mi_nerf.base.color import ColorSpace
from mi_nerf.cameras.ndc import Ndc
from mi_nerf.fields.protocol import Field


class AnalyticField(Field):
    """Density σ(p) and colour c(p, d) as Dr.Jit functions, of parameters if need be."""

    color_space: ColorSpace = "linear"

    def __init__(
        self,
        density: Callable[[Any], Any],
        emission: Callable[[Any, Any], list[Any]] | None = None,
        lower: Corner = (-1.0, -1.0, -1.0),
        upper: Corner = (1.0, 1.0, 1.0),
        parameters: Mapping[str, Any] | None = None,
        ndc: Ndc | None = None,
    ) -> None:
        """Without ``emission``, the field glows in (1, ½, ¼) everywhere."""
        self.lower, self.upper, self.ndc = lower, upper, ndc
        self._density, self._emission = density, emission
        self._parameters = parameters or {}
        self.asked = 0  # points at which the field was looked at
        self.blocks: list[int] = []  # how many at a time

    def density(self, p: Any) -> Any:
        self.asked += len(p[0])
        return self._density(p)

    def density_emission(self, p: Any, d: Any) -> tuple[Any, list[Any]]:
        self.blocks.append(len(p[0]))
        if self._emission is not None:
            return self._density(p), self._emission(p, d)
        return self._density(p), [dr.full(type(p[0]), c, len(p[0])) for c in (1.0, 0.5, 0.25)]

    def parameters(self) -> Mapping[str, Any]:
        return self._parameters


def uniform(density: float) -> Callable[[Any], Any]:
    """The same density everywhere."""
    return lambda p: dr.full(type(p[0]), density, len(p[0]))


def ball(radius: float, density: float) -> Callable[[Any], Any]:
    """Constant density around the origin, none outside."""
    return lambda p: dr.select(dr.norm(p) < radius, type(p[0])(density), 0)


def gaussian(center: Corner, sigma: float, density: float) -> Callable[[Any], Any]:
    """density · exp(−|p − center|² / 2σ²)."""
    return lambda p: density * dr.exp(-0.5 / sigma**2 * dr.squared_norm(p - type(p)(center)))
