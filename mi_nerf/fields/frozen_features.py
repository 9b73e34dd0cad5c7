"""Features of positions in training, whose kernels are traced once and replayed.

Dr.Jit's hash grid takes some milliseconds of Python to trace, about as long as its kernels take
to run, and once more for its adjoint. ``dr.freeze`` records them the first time that so many
positions are asked for; a table that moves with every step is an argument of the recording.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr

from ..base.arrays import Floats, Tensor, Vectors
from .fourier import stack_rows

Features = Callable[[Vectors, Tensor, Floats], list[Floats]]


class FrozenFeatures:
    """Rows of features that depend on a table; differentiable in the table alone."""

    def __init__(self, features: Features) -> None:
        """``features`` makes N-arrays of N positions, the table and weights of its levels."""

        # Shapes of results are part of a recording, so the number of positions has to be, too.
        def rows(count: int, unit: Vectors, table: Tensor, weights: Floats) -> Tensor:
            return stack_rows(features(unit, table, weights))

        def table_gradient(
            count: int, unit: Vectors, table: Tensor, weights: Floats, gradient: Tensor
        ) -> Tensor:
            table = dr.detach(table)
            dr.enable_grad(table)
            result = rows(count, unit, table, weights)
            dr.set_grad(result, gradient)
            dr.enqueue(dr.ADMode.Backward, result)
            dr.traverse(dr.ADMode.Backward)
            return dr.grad(table)

        self.rows, self.table_gradient = dr.freeze(rows), dr.freeze(table_gradient)

    def __call__(self, unit: Vectors, table: Tensor, weights: Floats = None) -> Tensor:
        """The ``(F, N)`` features of N positions without gradients."""
        return dr.custom(_Rows, table, unit, weights, self)


class _Rows(dr.CustomOp):
    """See :class:`FrozenFeatures`."""

    def eval(self, table: Tensor, unit: Vectors, weights: Floats, frozen: FrozenFeatures) -> Tensor:
        """The features."""
        self._arguments, self._frozen = (dr.width(unit), unit, table, weights), frozen
        return frozen.rows(*self._arguments)

    def backward(self) -> None:
        """The gradient of the table."""
        gradient = self._frozen.table_gradient(*self._arguments, self.grad_out())
        self.set_grad_in("table", gradient)

    def name(self) -> str:
        """Shown in Dr.Jit's graphs."""
        return "FrozenFeatures"
