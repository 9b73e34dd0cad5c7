"""What all formulas share: validated numbers, each of them a differentiable tensor."""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any

import drjit as dr
import numpy as np

from ...base.arrays import Floats, Vectors, upload, vector3_type
from ...base.box import Corner
from ...base.color import ColorSpace
from ..protocol import Field


def number(
    default: float | Corner,
    *,
    above: float = -math.inf,
    least: float = -math.inf,
    tensor: bool = True,
) -> Any:
    """One number of a formula, or three of them, with the bounds that are checked.

    Args:
        above, least: lower bounds, of which the first is excluded.
        tensor: whether it is a differentiable parameter of the field.
    """
    bounds = {"above": above, "least": least, "tensor": tensor}
    return dataclasses.field(default=default, metadata=bounds)


@dataclass(frozen=True, kw_only=True)
class ClosedFormConfig(ABC):
    """The numbers of a formula, all finite; three stand for a point, a vector or a colour."""

    radiance: Corner = number((1.0, 1.0, 1.0), least=0)  # emitted in all directions, linear RGB

    def __post_init__(self) -> None:
        for f in dataclasses.fields(self):
            value, bounds = getattr(self, f.name), f.metadata
            several = isinstance(f.default, tuple)
            entries = value if several else (value,)
            expected = "three numbers" if several else "a number"
            if bounds["above"] > -math.inf:
                expected += f" above {bounds['above']}"
            elif bounds["least"] > -math.inf:
                expected += f" of {bounds['least']} or more"
            self.require(
                isinstance(entries, tuple)
                and len(entries) == (3 if several else 1)
                and all(_is_number(entry) for entry in entries)
                and all(entry > bounds["above"] for entry in entries)
                and all(entry >= bounds["least"] for entry in entries),
                f.name,
                expected,
            )

    def require(self, holds: bool, name: str, expected: str) -> None:
        """Refuses the value of a number.

        Raises:
            ValueError: unless ``holds``, with the number and what was expected.
        """
        if not holds:
            raise ValueError(f"{name}={getattr(self, name)!r}, expected {expected}")

    @abstractmethod
    def box(self) -> tuple[Corner, Corner]:
        """The corners of the box at which the field ends."""


def _is_number(value: Any) -> bool:
    return not isinstance(value, bool) and isinstance(value, Real) and math.isfinite(value)


class ClosedFormField(Field):
    """A formula as a field; every number of it is differentiable.

    The box is no parameter: it stays as it was when numbers change.
    """

    color_space: ColorSpace = "linear"

    def __init__(self, config: Any, tensor_type: Any) -> None:
        """Uploads the numbers of ``config`` as ``tensor_type`` (such as ``mi.TensorXf``)."""
        self.config = config
        self.lower, self.upper = config.box()
        self._parameters = {
            f.name: upload(tensor_type, np.atleast_1d(np.array(getattr(config, f.name), float)))
            for f in dataclasses.fields(config)
            if f.metadata["tensor"]
        }

    def parameters(self) -> Mapping[str, Any]:
        """Tensors of one or three entries, named as in the configuration."""
        return self._parameters

    def emission(self, d: Vectors) -> Vectors:
        """The radiance along N directions, as a 3-vector of linear RGB."""
        return self.vector("radiance", d)

    def density_emission(self, p: Vectors, d: Vectors) -> tuple[Floats, list[Floats]]:
        """σ in 1/scene unit and the radiance along ``d``, linear RGB."""
        density = self.density(p)
        everywhere = dr.zeros(type(density), len(density))
        return density, [channel + everywhere for channel in self.emission(d)]

    def vector(self, name: str, p: Vectors) -> Vectors:
        """A parameter of three entries as a 3-vector of the precision of ``p``."""
        float_type = type(p[0])
        return vector3_type(float_type)(*(self._entry(name, i, float_type) for i in range(3)))

    def scalar(self, name: str, p: Vectors) -> Floats:
        """A parameter of one entry, of the precision of ``p``."""
        return self._entry(name, 0, type(p[0]))

    def _entry(self, name: str, i: int, float_type: Any) -> Floats:
        """An array of one element, with its history."""
        return dr.gather(float_type, self._parameters[name].array, dr.uint32_array_t(float_type)(i))


def rise(x: Floats, edge: Floats) -> Floats:
    """From 0 to 1 where ``x`` goes from −edge/2 to edge/2, linearly: clip(x/edge + ½, 0, 1).

    With an ``edge`` of 0 it jumps. The derivative of an integral across a jump with respect
    to its place is concentrated in one point, which no sample hits: quadrature finds 0.
    """
    soft = edge > 0
    slope = dr.clip(x / dr.select(soft, edge, 1) + 0.5, 0, 1)
    return dr.select(soft, slope, dr.select(x > 0, type(x)(1), 0))
