"""An occupancy grid that keeps up with weights that change, as in inverse rendering.

What a grid came with is a verdict on certain weights. It says more than these do: where
training never looked, behind the visual hull, a network may be dense, and yet there is
nothing. So the verdict on a cell stands as long as the density there is about what it was
with those weights, and altogether as long as that holds for most of the box. Where it does
not stand, whatever is seen above the threshold counts.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from ..base.arrays import Vectors, upload
from ..fields.protocol import Field
from .blocks import blocks
from .occupancy import THRESHOLD, OccupancyGrid, greatest_around

# Densities within this factor of each other are about the same, and most of the box is more
# than this share.
_ALIKE, _MOST = 4.0, 0.75
# A cell that is not seen full any more stays so for this many looks at least if it was opaque
# or came with the grid, and remembered densities fade by so much at each.
_LIFE, _DECAY = 32, 0.95
# Optical thickness of a cell beyond which it is not remembered any longer.
_OPAQUE = 10.0
# What stands for densities that are not finite.
_ENDLESS = 1e30
# One look will do if no more than this share of the points compared has changed by much since
# the last time, and it adds no more than this share to the occupied cells. Otherwise there are
# several, until one adds no more.
_FEW, _LEAST_LOOKS, _MOST_LOOKS = 1 / 256, 8, 64
# Looks at the weights that the grid came with, and points at which they are compared with others.
_FIRST_LOOKS, _PROBES = 8, 8192
# Points at a time, of networks that keep activations.
_BLOCK = 16384

Ask = Callable[[Any], Any]


class FollowedGrid(OccupancyGrid):
    """The cells of a grid, brought up to date with the field at every :meth:`follow`."""

    def __init__(self, grid: OccupancyGrid, field: Field, float_type: Any) -> None:
        """
        Args:
            grid: what to begin with.
            field: with the weights that it belongs to.
        """
        kept = grid.mask()
        super().__init__(grid.lower, grid.upper, np.ones(kept.shape, bool), float_type)
        limit = THRESHOLD / float(np.mean(self.cell_size))
        self._start, self._most = limit / _DECAY**_LIFE, limit * _OPAQUE / THRESHOLD
        self._kept = self._mask = self._upload_mask(kept)
        self._rng = dr.rng(seed=dr.opaque(dr.uint64_array_t(float_type), 0))
        count = kept.size
        self._every = dr.arange(self._uint, count)
        probes = np.linspace(0, count - 1, min(_PROBES, count)).astype(np.uint32)
        self._probes = self._points(upload(self._uint, probes), self._rng)
        dr.eval(self._every)
        with dr.suspend_grad():
            ask = self._asker(field)
            self._probed = self._last = ask(self._probes)
            self._before = dr.zeros(float_type, count)
            # A grid without any cell would hide the field for good: it is no verdict.
            self._verdict = bool(kept.any())
            for _ in range(_FIRST_LOOKS):
                self._before = dr.maximum(self._before, ask(self._points(self._every, self._rng)))
                dr.eval(self._before)
        start, most = (dr.opaque(float_type, v) for v in (self._start, self._most))
        start = dr.minimum(dr.maximum(self._before, start), most)
        self._values = dr.select(self._kept, start, 0)
        dr.eval(self._values)

    def follow(self, field: Field) -> None:
        """Looks at every cell until hardly any new one is found full.

        Weights that have changed a little take one look. After others it takes several, and
        the neighbours of what is new count as full as well, since what is thin is easily missed.
        """
        with dr.suspend_grad():
            ask, before = self._asker(field), self._mask
            probed = ask(self._probes)
            stands = self._verdict and self._alike(self._probed, probed) >= _MOST
            least = 1 if self._alike(self._last, probed) >= 1 - _FEW else _LEAST_LOOKS
            self._last, looks, more = probed, 0, True
            while looks < least or (more and looks < _MOST_LOOKS):
                new, looks = self._look_everywhere(ask, stands), looks + 1
                more = new > _FEW * float(dr.count(self._mask)[0])
            if looks > 1:
                self._spread(before)

    def _alike(self, was: Any, now: Any) -> float:
        """At which share of the points compared density is about the same, where it matters."""
        limit = dr.opaque(self._float, self._start)
        matters = (was > limit) | (now > limit)
        same = (now <= _ALIKE * was) & (was <= _ALIKE * now)
        return float(dr.count(matters & same)[0]) / max(1.0, float(dr.count(matters)[0]))

    def _look_everywhere(self, ask: Ask, stands: bool) -> int:
        """A random point of each cell; returns how many more cells are occupied."""
        density, old = ask(self._points(self._every, self._rng)), self._mask
        if stands:
            start = dr.opaque(self._float, self._start)
            full = dr.select(density * _ALIKE >= self._before, dr.maximum(density, start), density)
            none = dr.select(density <= self._before * _ALIKE, 0, density)
            density = dr.select(self._kept, full, none)
        most = dr.opaque(self._float, self._most)
        self._values = dr.maximum(self._values * _DECAY, dr.minimum(density, most))
        self.draw_line(THRESHOLD)
        return int(dr.count(self._mask & ~old)[0])

    def _spread(self, before: Any) -> None:
        """Counts the neighbours of new cells as full, for as long as nothing else is seen there."""
        new = np.array(self._mask & ~before).reshape(self.shape)
        near = self._upload_mask(greatest_around(new))
        start = dr.opaque(self._float, self._start)
        self._values = dr.select(near, dr.maximum(self._values, start), self._values)
        self.draw_line(THRESHOLD)

    def _asker(self, field: Field) -> Ask:
        """Densities of N points, all of them finite: what is not a number counts as dense."""
        density = field.fused(emission=False)

        def ask(p: Vectors) -> Any:
            if density is not None:
                found = density(p)
            else:
                found = dr.zeros(self._float, len(p[0]))
                for slot, valid, _ in blocks(dr.arange(self._uint, len(p[0])), _BLOCK):
                    part = type(p)(*(dr.gather(self._float, x, slot, valid) for x in p))
                    dr.eval(part)
                    dr.scatter(found, field.density(part), slot, valid)
                    dr.eval(found)
            found = dr.select(found < _ENDLESS, found, _ENDLESS)
            dr.eval(found)
            return found

        return ask
