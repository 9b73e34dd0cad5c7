"""Noise added to densities in training, as a function of the position."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr

from ..base.arrays import Floats, Indices, Vectors


@dataclass(frozen=True)
class DensityNoise:
    """Gaussian noise that follows from position and seed, so that it can be computed again."""

    level: float  # standard deviation
    seed: int

    def at(self, p: Vectors) -> Floats:
        """One value for each of N positions in single precision (Box & Muller 1958)."""
        float_type = type(p[0])
        uint = dr.uint32_array_t(float_type)
        key = dr.opaque(uint, self.seed & 0xFFFFFFFF)
        for i in range(3):
            key = _scramble(key ^ dr.reinterpret_array(uint, p[i]))
        # From the upper 24 bits, never 0.
        first, second = (
            (float_type(k >> 8) + 0.5) * 2.0**-24 for k in (key, _scramble(key + 0x9E3779B9))
        )
        radius = dr.sqrt(-2 * dr.log(first))
        return dr.opaque(float_type, self.level) * radius * dr.cos(2 * dr.pi * second)


def _scramble(x: Indices) -> Indices:
    """A hash of 32 bits (the output function of PCG, O'Neill 2014)."""
    x = x * 747796405 + 2891336453
    x = ((x >> ((x >> 28) + 4)) ^ x) * 277803737
    return (x >> 22) ^ x
