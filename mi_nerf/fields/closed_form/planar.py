"""Fields that vary along one axis at most, cut off by a box.

With s = p · axis/|axis| − position, density depends on s alone. On a ray, ds/dt is the
cosine c between ray and axis, and optical depths follow from those along the axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr

from ...base.arrays import Floats, Vectors
from ...base.box import Corner
from .base import ClosedFormConfig, ClosedFormField, number, rise

# exp(60) ≈ 1e26: fog so dense is opaque, and far from overflow in single precision.
_MAX_EXPONENT = 60.0


@dataclass(frozen=True, kw_only=True)
class _BoxConfig(ClosedFormConfig):
    """A field that ends at the faces of a given box."""

    lower: Corner = number((-1.0, -1.0, -1.0), tensor=False)  # corners of the box, scene units
    upper: Corner = number((1.0, 1.0, 1.0), tensor=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        below = all(a < b for a, b in zip(self.lower, self.upper, strict=True))
        self.require(below, "upper", f"numbers above those of lower={self.lower}")

    def box(self) -> tuple[Corner, Corner]:
        """The corners, as given."""
        return self.lower, self.upper


@dataclass(frozen=True, kw_only=True)
class _AxisConfig(_BoxConfig):
    """A field in which one direction is distinguished."""

    axis: Corner = number((0.0, 0.0, 1.0))  # of any length but 0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require(math.hypot(*self.axis) > 0, "axis", "a vector of a length above 0")


@dataclass(frozen=True, kw_only=True)
class _PlanarConfig(_AxisConfig):
    """A field that varies with the distance s from a plane."""

    position: float = number(0.0)  # of the plane s = 0, from the origin along the axis

    def position_range(self) -> tuple[float, float]:
        """The least and greatest position of a plane that meets the box."""
        length = math.hypot(*self.axis)
        corners = list(zip(self.lower, self.upper, self.axis, strict=True))
        first, last = (
            sum(choose(a * n, b * n) for a, b, n in corners) / length for choose in (min, max)
        )
        return first, last


class _PlanarField(ClosedFormField):
    """A field that varies with the distance from a plane."""

    def distance(self, p: Vectors) -> Floats:
        """s of N points, in scene units; negative before the plane."""
        axis = dr.normalize(self.vector("axis", p))
        return dr.dot(axis, p) - self.scalar("position", p)


# ---- The same density everywhere ----------------------------------------------


@dataclass(frozen=True, kw_only=True)
class SlabConfig(_BoxConfig):
    """σ = density in all of the box: τ = density · L over a length L of ray within."""

    density: float = number(2.0, least=0)  # 1/scene unit


class SlabField(ClosedFormField):
    """:class:`SlabConfig` as a field."""

    def density(self, p: Vectors) -> Floats:
        return self.scalar("density", p) + dr.zeros(type(p[0]), len(p[0]))


@dataclass(frozen=True, kw_only=True)
class TwoColorConfig(_AxisConfig):
    """σ = density in all of the box, in one colour along the axis and another against it.

    A ray whose direction has the cosine c with the axis sees
    radiance · (1 + c)/2 + opposite · (1 − c)/2.
    """

    density: float = number(2.0, least=0)  # 1/scene unit
    radiance: Corner = number((1.0, 0.5, 0.1), least=0)  # seen along the axis, linear RGB
    opposite: Corner = number((0.1, 0.5, 1.0), least=0)  # seen by rays against the axis


class TwoColorField(SlabField):
    """:class:`TwoColorConfig` as a field."""

    def emission(self, d: Vectors) -> Vectors:
        share = 0.5 + 0.5 * dr.dot(dr.normalize(self.vector("axis", d)), d)
        opposite = self.vector("opposite", d)
        return opposite + (self.vector("radiance", d) - opposite) * share


# ---- Density that varies along the axis ---------------------------------------


@dataclass(frozen=True, kw_only=True)
class FogConfig(_PlanarConfig):
    """σ = density · exp(−s/height): fog that thins out along the axis.

    Over a length L of ray that starts where the density is σ₀, the optical depth is
    τ = σ₀ · (1 − exp(−kL))/k with k = c/height.
    """

    density: float = number(1.0, least=0)  # at s = 0, 1/scene unit
    height: float = number(0.5, above=0)  # over which it falls by a factor e, scene units


class FogField(_PlanarField):
    """:class:`FogConfig` as a field; its density ends at density · exp(60)."""

    def density(self, p: Vectors) -> Floats:
        exponent = -self.distance(p) / self.scalar("height", p)
        return self.scalar("density", p) * dr.exp(dr.minimum(exponent, _MAX_EXPONENT))


@dataclass(frozen=True, kw_only=True)
class RampConfig(_PlanarConfig):
    """σ = density + slope · s, and 0 where that is negative.

    Over a length L of ray on one side of the plane where σ reaches 0, τ = L · (σ₀ + σ₁)/2
    with the densities of both ends.
    """

    density: float = number(1.0, least=0)  # at s = 0, 1/scene unit
    slope: float = number(1.0)  # along the axis, 1/scene unit²


class RampField(_PlanarField):
    """:class:`RampConfig` as a field."""

    def density(self, p: Vectors) -> Floats:
        line = self.scalar("density", p) + self.scalar("slope", p) * self.distance(p)
        return dr.maximum(line, 0)


@dataclass(frozen=True, kw_only=True)
class StepConfig(_PlanarConfig):
    """σ = ``before`` the plane and another density ``beyond``, linear in between.

    The transition is ``edge`` wide, and its middle is the plane. Over a length L of ray
    on one side of it, or within it, τ = L · (σ₀ + σ₁)/2 with the densities of both ends.
    An edge of 0 is a jump; derivatives with respect to ``axis`` and ``position`` need
    another one (:func:`mi_nerf.fields.closed_form.base.rise`), and samples closer than that.
    """

    before: float = number(0.5, least=0)  # density where s < −edge/2, 1/scene unit
    beyond: float = number(5.0, least=0)  # density where s > edge/2
    edge: float = number(0.05, least=0)  # width of the transition, scene units


class StepField(_PlanarField):
    """:class:`StepConfig` as a field."""

    def density(self, p: Vectors) -> Floats:
        before, beyond = self.scalar("before", p), self.scalar("beyond", p)
        return before + (beyond - before) * rise(self.distance(p), self.scalar("edge", p))


@dataclass(frozen=True, kw_only=True)
class SheetConfig(_PlanarConfig):
    """A thin layer around the plane: σ = thickness/width, and 0 away from it.

    Both sides are ``edge`` wide ramps of which the middles are ``width`` apart. A ray that
    crosses the layer has τ = thickness/|c|, whatever width and edge; the thinner it is,
    the more samples it takes to see it. For an edge of 0, see :class:`StepConfig`.
    """

    thickness: float = number(1.0, least=0)  # optical depth along the axis
    width: float = number(0.02, above=0)  # scene units
    edge: float = number(0.01, least=0)  # scene units, up to the width

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require(self.edge <= self.width, "edge", f"a number up to width={self.width}")
        reach = (self.width + self.edge) / 2
        first, last = self.position_range()
        self.require(
            first <= self.position - reach and self.position + reach <= last,
            "position",
            f"the sheet to lie within the box, from {first:g} to {last:g}",
        )


class SheetField(_PlanarField):
    """:class:`SheetConfig` as a field."""

    def density(self, p: Vectors) -> Floats:
        width = self.scalar("width", p)
        inside = rise(width / 2 - dr.abs(self.distance(p)), self.scalar("edge", p))
        return self.scalar("thickness", p) / width * inside
