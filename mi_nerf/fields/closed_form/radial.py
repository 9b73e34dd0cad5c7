"""Fields that vary with the distance from a centre alone."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr

from ...base.arrays import Floats, Vectors
from ...base.box import Corner
from .base import ClosedFormConfig, ClosedFormField, number, rise


def _cube(center: Corner, half: float) -> tuple[Corner, Corner]:
    """The corners of a cube of side 2 · ``half``."""
    x, y, z = center
    return (x - half, y - half, z - half), (x + half, y + half, z + half)


@dataclass(frozen=True, kw_only=True)
class GaussianConfig(ClosedFormConfig):
    """σ(p) = peak · exp(−|p − center|² / 2 width²).

    The box ends where the density has fallen to ``peak`` · exp(−extent²/2). Along a ray
    that passes the centre at distance b, the optical depth of all that lies beyond the box
    and within is peak · width · √(2π) · exp(−b²/2 width²).
    """

    center: Corner = number((0.0, 0.0, 0.0))
    width: float = number(0.2, above=0)  # standard deviation, scene units
    peak: float = number(10.0, least=0)  # density at the centre, 1/scene unit
    extent: float = number(4.5, above=0, tensor=False)  # half the side of the box, in widths

    def box(self) -> tuple[Corner, Corner]:
        """A cube of half the side ``extent`` · ``width`` around the centre."""
        return _cube(self.center, self.extent * self.width)


class GaussianField(ClosedFormField):
    """:class:`GaussianConfig` as a field."""

    def density(self, p: Vectors) -> Floats:
        offset = (p - self.vector("center", p)) / self.scalar("width", p)
        return self.scalar("peak", p) * dr.exp(-0.5 * dr.squared_norm(offset))


@dataclass(frozen=True, kw_only=True)
class ShellConfig(ClosedFormConfig):
    """σ = density between two spheres around a centre, and 0 elsewhere.

    Both surfaces are transitions ``edge`` wide, in which density is linear in the distance
    r from the centre; their middles are at ``inner`` and ``outer``. Where σ = α + βr on a
    ray that passes the centre at distance b, with u the distance from the closest point,
    ∫ σ du = αu + β/2 · (u·r + b² · arsinh(u/b)). The box touches the shell.

    An edge of 0 is a jump; derivatives with respect to ``center`` and the radii need another
    one (:func:`mi_nerf.fields.closed_form.base.rise`), and samples closer than that.
    """

    center: Corner = number((0.0, 0.0, 0.0))
    inner: float = number(0.4, least=0)  # radii, scene units
    outer: float = number(0.6, above=0)
    density: float = number(10.0, least=0)  # between them, 1/scene unit
    edge: float = number(0.05, least=0)  # scene units, up to outer − inner and 2 · inner

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require(self.inner < self.outer, "inner", f"a number below outer={self.outer}")
        widest = min(self.outer - self.inner, 2 * self.inner)
        # Differences of decimal numbers are off by a few ulp.
        self.require(self.edge <= widest * (1 + 1e-12), "edge", f"a number up to {widest:g}")

    def box(self) -> tuple[Corner, Corner]:
        """The cube around the outer surface."""
        return _cube(self.center, self.outer + self.edge / 2)


class ShellField(ClosedFormField):
    """:class:`ShellConfig` as a field."""

    def density(self, p: Vectors) -> Floats:
        square = dr.squared_norm(p - self.vector("center", p))
        r = dr.sqrt(dr.maximum(square, dr.smallest(type(square))))  # finite slope in the centre
        edge = self.scalar("edge", p)
        between = rise(r - self.scalar("inner", p), edge) - rise(r - self.scalar("outer", p), edge)
        return self.scalar("density", p) * between
