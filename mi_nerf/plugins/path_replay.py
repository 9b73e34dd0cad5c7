"""Derivatives of light paths by path replay (Vicini et al. 2021).

The radiance that a camera ray gathers along its path is a sum over vertices and segments,

    L = Σ_k β_k (E_k + e_k),    β_{k+1} = β_k T_k f_k,

with what emitters, those that were chosen included, send to vertex k, what the fields on
segment k emit, T_k, which they let pass, and f_k, by which the surface weighs what follows. A
path is followed twice with the same random numbers. The first time says L. The second time,
what has been gathered is taken away again: at any place on the path, the rest R is all that
is still to come, and by the product rule

    dL = Σ_k β_k (dE_k + de_k) + R_k (dT_k / T_k + df_k / f_k),

so that every vertex and every segment is differentiated on its own and forgotten. Memory does
not grow with the number of bounces. How paths are sampled is not differentiated, nor where
surfaces are.

The second time, fields need not be asked again what they show: the first numbers of that, four
a segment, are kept, so many a camera ray and no more, however long the paths are.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from .colors import Spectrum
from .path_derivatives import Derivatives
from .path_state import Image, Vertex, gather
from .sampled import Rays
from .vertex import Surroundings

# Behind fields that let less pass, the rest is left out: divided by so little, it would be
# nothing but rounding. What is lost is as small, relative to the light behind.
_LEAST_PASSING = 1e-4

# Segments and connections, for each camera ray on average, of which is kept what fields show.
_KEPT_A_RAY = 32


class Colors:
    """The parameters of surfaces and lights that have gradients, and what depends on them."""

    def __init__(self, around: Surroundings) -> None:
        self._around = around
        with dr.resume_grad():
            values = [value for _, value in mi.traverse(around.scene)]
            self.wanted = [value for value in values if dr.grad_enabled(value)]

    def gathered(self, vertex: Vertex, rest: Any) -> Any:
        """What N paths gather at a vertex and behind it, with the derivatives of colours.

        Args:
            rest: N colours: what comes with the next segments.
        """
        around, paths, chance = self._around, vertex.paths, vertex.chance
        si, bsdf = around.at(vertex.ends)
        value = around.emitted(si, paths, vertex.depth, attached=True)
        if vertex.following is None:
            return value
        assert vertex.chosen is not None
        emitters = around.to_emitters(
            si, bsdf, paths, vertex.chosen, vertex.through > 0, attached=True, every=True
        )
        turned = around.turned(si, bsdf, vertex.following, chance, vertex.going)
        with dr.resume_grad():
            value += emitters.light * vertex.through
            value += turned * rest
            if vertex.shone is None:
                return value
        shining = dr.max(vertex.shone) > 0
        fields = around.to_fields(si, bsdf, paths, chance, shining, attached=True, every=True)
        assert fields is not None
        with dr.resume_grad():
            return value + fields.light * vertex.shone


class Recording(Image):
    """What camera rays gather, and what fields show to their paths meanwhile."""

    def __init__(self, rays: int, paths: int, colors: Colors) -> None:
        """
        Args:
            paths: of each ray, every one of which has a recording of its own.
        """
        super().__init__(rays)
        self.every_connection = bool(colors.wanted)  # as in the replay
        self.kept: list[Any] = []  # in order; ``None`` for what was not kept
        self._room = _KEPT_A_RAY * rays // paths

    def shown(self, find: Callable[[], Any]) -> Any:
        found = find()
        dr.eval(found)
        self._room -= dr.width(found)
        self.kept.append(found if self._room >= 0 else None)
        return found


class Replay(Image):
    """What is left of the radiance of camera rays, while their paths are followed again."""

    def __init__(
        self, radiance: Any, shown: list[Any], colors: Colors, derivatives: Derivatives
    ) -> None:
        """
        Args:
            radiance: what the paths have brought in all.
            shown: what a :class:`Recording` has kept.
            derivatives: where derivatives go.
        """
        self.radiance, self._shown = Spectrum(radiance), iter(shown)
        self._colors, self._derivatives = colors, derivatives
        # A lamp of no power brings no light, but has a derivative.
        self.every_connection = bool(colors.wanted)

    def shown(self, find: Callable[[], Any]) -> Any:
        """What was kept of it, or else the same once more."""
        kept = next(self._shown)
        return find() if kept is None else kept

    def add(self, slot: Any, radiance: Any) -> None:
        """Takes away, of some of the rays, what was added to them."""
        dr.scatter_add(self.radiance, -radiance, slot)

    def cover(self, slot: Any, alpha: Any) -> None:
        """Nothing: opacity has no derivatives here."""

    def evaluate(self) -> None:
        dr.eval(self.radiance)

    def passed(self, slot: Any, rays: Rays, weight: Any, through: Any) -> None:
        known = through > _LEAST_PASSING
        behind = dr.select(known, gather(self.radiance, slot) / dr.select(known, through, 1), 0)
        dr.eval(behind)
        self._derivatives.see(slot, rays, weight, behind)

    def lit(self, slot: Any, rays: Rays, light: Any, through: Any) -> None:
        self._derivatives.pass_through(slot, rays, light * through)

    def shone_upon(self, slot: Any, rays: Rays, weight: Any) -> None:
        self._derivatives.see(slot, rays, weight, Spectrum(0))

    def left(self, vertex: Vertex) -> None:
        if self._colors.wanted:
            slot = vertex.paths.slot
            value = self._colors.gathered(vertex, gather(self.radiance, slot))
            self._derivatives.carry(slot, value, self._colors.wanted)
