"""Work in parts of a constant size, for which kernels compile once."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import drjit as dr

from ..base.arrays import Indices


def ranges(count: int, block: int, tail: int | None = None) -> Iterator[tuple[int, int]]:
    """Starts and sizes of the blocks that cover ``count`` entries; the last one may reach beyond.

    Args:
        tail: size of the blocks that cover what is left once no full block is needed any
            more, to waste less on filling them up. Default: the same.
    """
    small, start = min(tail or block, block), 0
    while start < count:
        size = block if count - start > block - small else small
        yield start, size
        start += size


def blocks(index: Indices, block: int, tail: int | None = None) -> Iterator[tuple[Any, Any, Any]]:
    """Entries of an index in blocks: ``(slot, valid, where)``.

    ``slot`` counts on through all blocks, ``where`` are the entries there. Beyond the end
    ``valid`` is false, and the entry 0. Nothing is evaluated yet.
    """
    uint = type(index)
    for start, size in ranges(len(index), block, tail):
        slot = dr.arange(uint, size) + dr.opaque(uint, start)
        valid = slot < dr.opaque(uint, len(index))
        yield slot, valid, dr.gather(uint, index, slot, valid)
