"""Radiance fields given by formulas, of which the integral along any ray is known.

They are ground truth: for tests, for measuring quadrature, and as scenes that show what
a reconstruction should find.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from .arrays import upload, vector3_type
from .field import ColorSpace, Corner
from .ndc import Ndc


@dataclass(frozen=True)
class GaussianConfig:
    """σ(p) = peak · exp(−|p − center|² / 2 width²), glowing evenly in one colour.

    The box ends where the density has fallen to ``peak`` · exp(−extent²/2). Along a ray
    that passes the centre at distance b, the optical depth of all that lies beyond the box
    and within is peak · width · √(2π) · exp(−b²/2 width²), and the radiance of a ray of
    optical depth τ is radiance · (1 − exp(−τ)).
    """

    center: Corner = (0.0, 0.0, 0.0)
    width: float = 0.2  # standard deviation, scene units
    peak: float = 10.0  # density at the centre, 1/scene unit
    radiance: Corner = (1.0, 1.0, 1.0)  # emitted in all directions, linear RGB
    extent: float = 4.5  # half the side of the box, in widths

    def __post_init__(self) -> None:
        for name in ("width", "extent"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name}={getattr(self, name)}, expected a number above 0")
        for value in (self.peak, *self.radiance):
            if not 0 <= value < math.inf:
                raise ValueError("peak and radiance: expected numbers of 0 or more")


class GaussianField:
    """:class:`GaussianConfig` behind the Field protocol; every number is differentiable."""

    color_space: ColorSpace = "linear"
    ndc: Ndc | None = None

    def __init__(self, config: GaussianConfig, tensor_type: Any) -> None:
        half = config.extent * config.width
        x, y, z = config.center
        self.config = config
        self.lower: Corner = (x - half, y - half, z - half)
        self.upper: Corner = (x + half, y + half, z + half)
        numbers = {name: getattr(config, name) for name in ("center", "width", "peak", "radiance")}
        self._parameters = {
            name: upload(tensor_type, np.atleast_1d(np.array(value, np.float32)))
            for name, value in numbers.items()
        }

    def parameters(self) -> Mapping[str, Any]:
        """Tensors ``center`` (3), ``width`` (1), ``peak`` (1) and ``radiance`` (3)."""
        return self._parameters

    def density(self, p: Any) -> Any:
        """σ at N points, in 1/scene unit."""
        float_type = type(p[0])
        x, y, z = self._numbers("center", float_type)
        (width,), (peak,) = self._numbers("width", float_type), self._numbers("peak", float_type)
        offset = (p - vector3_type(float_type)(x, y, z)) / width
        return peak * dr.exp(-0.5 * dr.squared_norm(offset))

    def density_emission(self, p: Any, d: Any) -> tuple[Any, list[Any]]:
        """σ in 1/scene unit, and the radiance, the same along all ``d``."""
        density = self.density(p)
        float_type = type(density)
        everywhere = dr.zeros(float_type, len(density))
        return density, [c + everywhere for c in self._numbers("radiance", float_type)]

    def _numbers(self, name: str, float_type: Any) -> list[Any]:
        """The entries of a parameter as arrays of one element, with their history."""
        values = self._parameters[name].array
        index = dr.uint32_array_t(float_type)
        return [dr.gather(float_type, values, index(i)) for i in range(len(values))]


CLOSED_FORMS: dict[str, tuple[type[GaussianConfig], type[GaussianField]]] = {
    "gaussian": (GaussianConfig, GaussianField)
}


def closed_form(kind: str, values: Mapping[str, Any], tensor_type: Any) -> GaussianField:
    """The field of a kind with the given parameters, the others by default.

    Raises:
        ValueError: for an unknown kind or parameter, or a value that makes no sense.
    """
    if kind not in CLOSED_FORMS:
        raise ValueError(f"field='{kind}', expected {', '.join(CLOSED_FORMS)}")
    config_type, field_type = CLOSED_FORMS[kind]
    known = {f.name for f in dataclasses.fields(config_type)}
    if unknown := sorted(set(values) - known):
        raise ValueError(f"'{unknown[0]}' is no parameter of '{kind}', expected {sorted(known)}")
    return field_type(config_type(**values), tensor_type)
