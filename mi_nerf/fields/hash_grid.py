"""Features of a multiresolution hash grid (Müller et al. 2022), by Dr.Jit's own encoding.

Each level is a grid of vertices over [−1, 1]³ that holds a few trainable numbers a vertex;
a point receives the trilinear interpolation of the eight around it. Levels with more
vertices than the table has entries share them by hashing.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
from drjit.nn import HashGridEncoding

from ..base.arrays import Floats, Tensor, Vectors, vector3_type


@dataclass(frozen=True)
class HashGridConfig:
    """Resolutions and sizes of the levels."""

    levels: int = 8  # resolutions
    features: int = 4  # a vertex of every level; four are gathered at once
    log2_entries: int | None = 16  # a level stores at most 2 to this power; none: by the images
    coarsest: int = 16  # vertices along [−1, 1] at the first level
    finest: int | None = None  # vertices at the last level; none: as many as the images resolve

    def __post_init__(self) -> None:
        for name, lowest, highest in (
            ("levels", 1, 32),
            ("features", 1, 8),
            ("log2_entries", 4, 24),
            ("coarsest", 2, 1 << 16),
        ):
            value = getattr(self, name)
            if value is not None and not lowest <= value <= highest:
                raise ValueError(f"grid: {name}={value}, expected {lowest} to {highest}")
        if self.features > 1 and self.features % 2:
            raise ValueError(f"grid: features={self.features}, expected 1 or an even number")
        if self.finest is not None and not self.coarsest <= self.finest <= 1 << 16:
            raise ValueError(
                f"grid: finest={self.finest}, expected coarsest={self.coarsest} to {1 << 16}"
            )

    @property
    def size(self) -> int:
        """Number of features of a point."""
        return self.levels * self.features

    def growth(self) -> float:
        """Ratio of the resolutions of one level and the one before."""
        finest = self.coarsest if self.finest is None else self.finest
        return float((finest / self.coarsest) ** (1 / max(self.levels - 1, 1)))

    def entries(self) -> int:
        """Vertices in memory, of all levels together."""
        return sum(self.level_entries())

    def level_entries(self) -> list[int]:
        """Vertices in memory of each level, which follow each other in the table."""
        found = []
        for level in range(self.levels):
            scale = 2.0 ** (level * math.log2(self.growth())) * self.coarsest - 1
            vertices = (math.ceil(scale) + 1) ** 3
            vertices = -(-vertices // self.features) * self.features
            found.append(min(vertices, self.most_entries))
        return found

    @property
    def most_entries(self) -> int:
        """Vertices that a level has memory for at most, once that is found."""
        if self.log2_entries is None:
            raise ValueError("grid: log2_entries is not found yet, expected a number")
        return 1 << self.log2_entries


class HashGrid:
    """Evaluates the features of a table of ``(entries, features)`` numbers."""

    def __init__(self, config: HashGridConfig, float_type: Any) -> None:
        """``float_type`` is the single-precision ``Float`` of the backend."""
        self._config = config
        self._encoding = HashGridEncoding(
            float_type,
            3,
            n_levels=config.levels,
            n_features_per_level=config.features,
            hashmap_size=config.most_entries,
            base_resolution=config.coarsest,
            per_level_scale=config.growth(),
        )
        if self._encoding.n_params != config.entries() * config.features:
            raise RuntimeError("Dr.Jit lays out hash grids in another way than expected")
        self._encoding.data = None

    def features(self, p: Vectors, table: Tensor, level_weights: Floats = None) -> list[Floats]:
        """The ``size`` features of the 3-vectors ``p`` in [−1, 1]³, one array each.

        Args:
            level_weights: one number a level, by which its features are multiplied.
        """
        encoding = copy.copy(self._encoding)  # the table is this call's alone
        encoding.data = table.array
        found = encoding(vector3_type(type(p[0]))(*(0.5 * p[i] + 0.5 for i in range(3))))
        features = [found[i] for i in range(self._config.size)]
        if level_weights is None:
            return features
        kind, index = type(level_weights), dr.uint32_array_t(type(level_weights))
        weights = [dr.gather(kind, level_weights, index(i)) for i in range(self._config.levels)]
        return [f * weights[i // self._config.features] for i, f in enumerate(features)]
