"""The table of a hash grid in another layout: which entry of it is which of the old one.

A level stays what it is where both layouts have one of the same resolution. A hashed level
of twice the size holds every entry twice, since the hash is only taken modulo the size; a
level that becomes dense looks its vertices up in the old one. Either leaves the features as
they are. A level that shrinks makes one entry of several, their mean by the squared
gradients that they have met. New levels start as zeros.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..fields.hash_grid import HashGridConfig

Array = np.ndarray[Any, Any]

_PRIMES = (1, 2654435761, 805459861)  # of Dr.Jit's hash (Müller et al. 2022, Eq. 4)
_ALIKE = 1e-6  # relative difference of the resolutions of one and the same level


@dataclass(frozen=True)
class Level:
    """Where a level lies in the table, as Dr.Jit lays it out."""

    scale: float  # distances between vertices along [−1, 1]
    side: int  # vertices along an axis
    first: int  # its first entry
    entries: int

    @property
    def dense(self) -> bool:
        """Whether every vertex has an entry of its own."""
        return self.side**3 <= self.entries

    def entry(self, x: Array, y: Array, z: Array) -> Array:
        """The entries of vertices, counted from the beginning of the level."""
        if self.dense:
            return np.asarray((x + self.side * (y + self.side * z)) % self.entries)
        parts = [
            v.astype(np.uint64) * np.uint64(p) for v, p in zip((x, y, z), _PRIMES, strict=True)
        ]
        mixed = (parts[0] ^ parts[1] ^ parts[2]) & np.uint64(0xFFFFFFFF)
        return np.asarray((mixed % np.uint64(self.entries)).astype(np.int64))


def levels(config: HashGridConfig) -> list[Level]:
    """The levels of a grid, coarse to fine."""
    found, first, octaves = [], 0, math.log2(config.growth())
    for number, entries in enumerate(config.level_entries()):
        scale = 2.0 ** (number * octaves) * config.coarsest - 1
        found.append(Level(scale, math.ceil(scale) + 1, first, entries))
        first += entries
    return found


def kept_levels(old: HashGridConfig, new: HashGridConfig) -> list[int | None]:
    """For each level of ``new`` the one of ``old`` that has its resolution, if any does."""
    if old.features != new.features:
        return [None] * new.levels
    before = levels(old)
    return [
        next((i for i, b in enumerate(before) if abs(b.scale - a.scale) < _ALIKE * a.scale), None)
        for a in levels(new)
    ]


class TableMap:
    """Carries arrays with a row for each entry from one layout into another."""

    def __init__(self, old: HashGridConfig, new: HashGridConfig) -> None:
        sources, targets = [], []
        before, after = levels(old), levels(new)
        for level, number in zip(after, kept_levels(old, new), strict=True):
            if number is not None:
                source, target = _pairs(before[number], level)
                sources.append(source + before[number].first)
                targets.append(target + level.first)
        empty = np.zeros(0, np.int64)
        self._source, self._target = (np.concatenate([empty, *n]) for n in (sources, targets))
        self._entries = new.entries()
        counts = np.bincount(self._target, minlength=1)
        self._merges = bool(counts.max() > 1)

    def carry(self, rows: Array, importance: Array | None = None) -> Array:
        """The rows of the new layout; zeros where the old one has nothing.

        Args:
            rows: (old entries, …).
            importance: as large, not negative: weights of the mean, where several rows
                become one; none: all alike.
        """
        picked = rows[self._source]
        result = np.zeros((self._entries, *rows.shape[1:]), rows.dtype)
        if not self._merges:
            result[self._target] = picked
            return result
        weight = np.ones(picked.shape) if importance is None else importance[self._source]
        weight = weight + 1e-12 * max(float(weight.max(initial=0)), 1e-30)
        total, sums = self._added(weight), self._added(weight * picked)
        mean = np.divide(sums, total, out=sums, where=total > 0)
        return mean.reshape(result.shape).astype(rows.dtype)

    def _added(self, rows: Array) -> Array:
        """(new entries, …) sums, in double precision, of the rows that become one."""
        columns = rows.reshape(len(rows), -1).astype(np.float64)
        sums = [np.bincount(self._target, c, self._entries) for c in columns.T]
        return np.stack(sums, axis=-1)


def _pairs(old: Level, new: Level) -> tuple[Array, Array]:
    """Entries of a level that hold the same vertex, before and after."""
    if not old.dense and not new.dense:  # both sizes are powers of two
        entry = np.arange(max(old.entries, new.entries))
        return entry % old.entries, entry % new.entries
    along = np.arange(min(old.side, new.side))
    z, y, x = (a.ravel() for a in np.meshgrid(along, along, along, indexing="ij"))
    return old.entry(x, y, z), new.entry(x, y, z)
