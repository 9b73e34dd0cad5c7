"""Fourier features of a point or a direction (NeRF Eq. 4), exact at any frequency.

Sines of 2^k·π·x lose all their digits when the argument grows, or when they are
built by the double-angle recurrence. Multiplying a float by 2^k is exact, and so
is taking the remainder modulo the period, so the argument is reduced first and
the sine is only ever taken inside one period.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import drjit as dr

from ..base.arrays import Floats, Tensor, Vectors, array_type

Convention = Literal["pi", "one", "two_pi"]

# 2π as a sum of three floats of decreasing size, for Cody-Waite reduction.
_TWO_PI_PARTS = (6.28125, 0.0019350051879882812, 3.0199159819567353e-07)


@dataclass(frozen=True)
class FourierEncoding:
    """γ(p): sines and cosines of p at ``frequencies`` octaves.

    The features of a 3-vector p are ordered as in the released NeRF code: p itself
    (where ``include_input``), then for k = 0 … L−1 the three sines and the three
    cosines of s·2^k·p, with s given by ``convention``.
    """

    frequencies: int = 10  # L
    convention: Convention = "pi"  # s = π (the paper), 1 (its released code), 2π (nerfstudio)
    include_input: bool = True  # prepend p itself, as the released code does

    def __post_init__(self) -> None:
        if not 0 <= self.frequencies <= 24:
            raise ValueError(f"encoding: frequencies={self.frequencies}, expected 0 to 24")
        if self.convention not in ("pi", "one", "two_pi"):
            raise ValueError(
                f"encoding: convention={self.convention!r}, expected 'pi', 'one' or 'two_pi'"
            )
        if self.size == 0:
            raise ValueError("encoding: no frequencies and no identity term leave no features")

    @property
    def size(self) -> int:
        """Number of features of a 3-vector."""
        return 3 * (2 * self.frequencies + int(self.include_input))

    def features(self, p: Vectors) -> list[Floats]:
        """The ``size`` features of the 3-vectors ``p``, as a list of per-query arrays."""
        result = [p[i] for i in range(3)] if self.include_input else []
        for k in range(self.frequencies):
            pairs = [sincos_octave(p[i], k, self.convention) for i in range(3)]
            result += [s for s, _ in pairs] + [c for _, c in pairs]
        return result

    def __call__(self, p: Vectors) -> Any:
        """Encodes N 3-vectors into a ``(size, N)`` tensor."""
        return stack_rows(self.features(p))


def sincos_octave(x: Floats, k: int, convention: Convention) -> tuple[Floats, Floats]:
    """``(sin, cos)`` of s·2^k·x to about 5e-7 for every k, with s = π, 1 or 2π."""
    scaled = x * float(2**k)  # exact
    if convention == "one":
        turns = dr.round(dr.detach(scaled) * (0.5 / math.pi))
        for part in _TWO_PI_PARTS:
            scaled = dr.fma(turns, -part, scaled)
        return dr.sincos(scaled)
    half_turns = scaled if convention == "pi" else 2 * scaled
    # Remove an even number of half turns: exact, and what is left lies in [−1, 1].
    reduced = half_turns - 2 * dr.round(dr.detach(half_turns) * 0.5)
    return dr.sincos(reduced * math.pi)


class _StackRows(dr.CustomOp):
    """Arrays as the rows of a tensor.

    The adjoint of a scatter also clears what it overwrites, row by row in kernels of their
    own; here every row is written once, and a gather is all that is needed.
    """

    def eval(self, rows: list[Floats]) -> Any:
        """F arrays of N values, or of one, as an ``(F, N)`` tensor."""
        float_type = type(rows[0])
        self._sizes = [len(row) for row in rows]
        count = max(self._sizes)
        uint = dr.uint32_array_t(float_type)
        self._column, self._stride = dr.arange(uint, count), dr.opaque(uint, count)
        flat = dr.ravel(array_type(float_type)(rows), order="C")
        return dr.tensor_t(float_type)(flat, shape=(len(rows), count))

    def forward(self) -> None:
        """The tangents, stacked likewise."""
        self.set_grad_out(_StackRows().eval(self.grad_in("rows")))

    def backward(self) -> None:
        """The rows of the gradient."""
        gradient = self.grad_out().array
        rows = [
            dr.gather(type(gradient), gradient, self._column + self._stride * i)
            for i in range(len(self._sizes))
        ]
        single = [n == 1 and len(row) > 1 for n, row in zip(self._sizes, rows, strict=True)]
        rows = [dr.sum(row) if one else row for one, row in zip(single, rows, strict=True)]
        self.set_grad_in("rows", rows)

    def name(self) -> str:
        """Shown in Dr.Jit's graphs."""
        return "StackRows"


def stack_rows(rows: list[Floats]) -> Tensor:
    """Writes F arrays of N values into one ``(F, N)`` tensor, in a single kernel."""
    return dr.custom(_StackRows, rows)
