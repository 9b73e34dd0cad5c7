"""What any number of rays see of all fields, as far as each goes; without derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .crossing import Marched, Rays, View, chunks, optical_depth


@dataclass
class Seen:
    """What R rays see of the fields, before what lies behind them."""

    values: list[Any]  # R, G, B (linear, premultiplied), opacity, depth in world units
    normal: Any  # of the fields, where wanted, else 0
    index: Any  # of the field that contributes most, from 1; 0 for none

    @property
    def color(self) -> Any:
        """Linear radiance."""
        return mi.Color3f(*self.values[:3])

    @property
    def opacity(self) -> Any:
        """In [0, 1]."""
        return self.values[3]


def see(fields: list[Marched], rays: Rays, *, normals: bool = False) -> Seen:
    """Radiance and opacity of the fields along R rays, in chunks of bounded memory."""
    count = len(rays.o[0])
    values = [dr.zeros(mi.Float, count) for _ in range(5)]
    index = dr.zeros(mi.Float, count)
    normal = mi.Normal3f(*(dr.zeros(mi.Float, count) for _ in range(3)))
    dr.make_opaque(values, index, normal)
    for where, part in chunks(fields, rays):
        view = View(fields, part, dr.ADMode.Primal, normals=normals)
        for output, value in zip(values, view.values, strict=True):
            dr.scatter(output, value, where)
        dr.scatter(index, view.index, where)
        if normals:
            dr.scatter(normal, mi.Normal3f(*view.normal), where)
        dr.eval(values, index, normal)
    return Seen(values, normal, index)


def transmittance(fields: list[Marched], rays: Rays) -> Any:
    """The share of light that the fields let pass along R rays, for which colours do not matter."""
    through = dr.full(mi.Float, 1, len(rays.o[0]))
    dr.make_opaque(through)
    for where, part in chunks(fields, rays):
        dr.scatter(through, dr.exp(-optical_depth(fields, part)), where)
        dr.eval(through)
    return through
