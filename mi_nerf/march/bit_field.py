"""Which cells of a grid are occupied, as bits of a tree, and the next such sample of a ray.

A word of 64 bits says for the 4×4×4 cells of a brick which are occupied, a word of the next
level the same of 4×4×4 bricks, and so on: one look tells how large the empty space around
a point is at least, and a ray leaves it at once.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from ..base.arrays import Indices, Mask

_EDGE = 4  # cells along a brick, bricks along what is above them
_SHIFT = 2  # its binary logarithm


class BitField:
    """Levels of words over a grid, the finest first."""

    def __init__(self, mask: Mask, shape: tuple[int, ...]) -> None:
        """``mask`` holds X·Y·Z truth values, z running fastest, ``shape`` these three numbers."""
        self.mask = mask  # of which this is made
        self._levels: list[tuple[Any, tuple[int, ...]]] = []
        occupied = mask
        while not self._levels or max(shape) > 1:
            words, shape = _packed(occupied, shape)
            self._levels.append((words, shape))
            occupied = words != 0

    def look(self, cell: list[Indices]) -> tuple[Mask, Indices]:
        """Whether cells are occupied, and how large the empty brick around each is, if not.

        Args:
            cell: their numbers along each axis.

        Returns:
            The truth values, and binary logarithms of edges, in cells.
        """
        uint = type(cell[0])
        occupied, edge = dr.mask_t(uint)(True), uint(0)
        for level in reversed(range(len(self._levels))):
            words, shape = self._levels[level]
            part = [c >> (_SHIFT * level) for c in cell]
            brick, bit = _place(part, shape)
            word = dr.gather(type(words), words, brick, occupied)
            filled = ((word >> type(words)(bit)) & 1) != 0
            edge = dr.select(occupied & ~filled, _SHIFT * level, edge)
            occupied &= filled
        return occupied, edge


def _packed(occupied: Mask, shape: tuple[int, ...]) -> tuple[Any, tuple[int, ...]]:
    """The words of a level, and how many of them there are along each axis."""
    uint = dr.uint32_array_t(type(occupied))
    number = dr.arange(uint, len(occupied))
    row = number // shape[2]
    cell = [row // shape[1], row % shape[1], number % shape[2]]
    above = tuple(-(-size // _EDGE) for size in shape)
    brick, bit = _place(cell, above)
    word = dr.uint64_array_t(uint)
    words = dr.zeros(word, above[0] * above[1] * above[2])
    dr.scatter_reduce(dr.ReduceOp.Or, words, word(1) << word(bit), brick, occupied)
    dr.eval(words)
    return words, above


def _place(cell: list[Indices], shape: tuple[int, ...]) -> tuple[Indices, Indices]:
    """The word in which cells have their bits, of a level of that shape, and which bits."""
    x, y, z = (c >> _SHIFT for c in cell)
    bit = type(x)(0)
    for c in cell:
        bit = bit * _EDGE + (c & (_EDGE - 1))
    return (x * shape[1] + y) * shape[2] + z, bit
