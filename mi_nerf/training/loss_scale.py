"""By what adjoints in half precision are multiplied (Micikevicius et al. 2018)."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from ..base.arrays import upload

_START = 2.0**13
_LARGEST = 2.0**24
_PATIENCE = 1000  # good steps before a larger one is tried


class LossScale:
    """Halves after a step that overflowed, doubles after many that did not.

    Dr.Jit's own scaler decides within its optimisers; here the optimiser decides, and the
    host need not wait for it.
    """

    def __init__(self, float_type: Any) -> None:
        """``float_type`` is the single-precision ``Float`` of the backend."""
        self.value = dr.opaque(float_type, _START)  # an array of one
        self._good = dr.opaque(float_type, 0)  # steps since it last changed

    def update(self, accepted: Any) -> None:
        """Takes note of a step: whether its gradients were finite, a mask of one element."""
        good = self._good + 1
        grow = good >= _PATIENCE
        larger = dr.minimum(2 * self.value, _LARGEST)
        smaller = dr.maximum(0.5 * self.value, 1)
        self.value = dr.select(accepted, dr.select(grow, larger, self.value), smaller)
        self._good = dr.select(accepted & ~grow, good, 0)
        dr.eval(self.value, self._good)

    def state(self) -> np.ndarray[Any, Any]:
        """All that :meth:`restore` needs, two numbers."""
        return np.concatenate([np.array(self.value), np.array(self._good)])

    def restore(self, state: np.ndarray[Any, Any]) -> None:
        """Takes up the result of :meth:`state`.

        Raises:
            ValueError: if it is of another shape.
        """
        if state.shape != (2,):
            raise ValueError(f"loss scale is {state.shape}, expected (2,)")
        self.value, self._good = (upload(type(self.value), state[i : i + 1]) for i in range(2))
