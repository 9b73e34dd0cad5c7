"""A network without derivatives for any number of queries, as products of NumPy's BLAS.

Features are evaluated as rows in memory of their own, in one kernel that does not depend on the
number of queries, and every thread takes the columns of one block at a time through all layers,
so that activations stay in its cache. On two CPU cores a network of 256 neurons takes a bit more
than half the time of tensor mode.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import numpy as np

from ..base.arrays import Floats
from ..base.kernel_stages import host_work
from .blas_network import BlasNetwork
from .network import GRID, NetworkConfig


def on_host(float_type: Any) -> bool:
    """Whether NumPy can work on arrays of this type where they lie."""
    return bool(dr.backend_v(float_type) == dr.JitBackend.LLVM)


class HostNetwork:
    """A network with its weights as they are."""

    def __init__(
        self, config: NetworkConfig, weights: Mapping[str, Any], *, emission: bool = True
    ) -> None:
        """Arguments as for :class:`mi_nerf.fields.blas_network.BlasNetwork`, as tensors."""
        arrays = {n: w.array.numpy().reshape(w.shape) for n, w in weights.items() if n != GRID}
        self._network = BlasNetwork(config, arrays, emission=emission)
        self._outputs = 4 if emission else 1

    def __call__(self, features: Mapping[str, list[Floats]], count: int) -> list[Floats]:
        """Raw density, and with ``emission`` the three raw colours, before their activations.

        Args:
            features: of "position", and "direction" where it is seen: arrays of ``count``
                values, or of one.
        """
        dr.eval(features)  # in one kernel
        float_type = type(features["position"][0])
        uint = dr.uint32_array_t(float_type)
        flat = dr.zeros(float_type, self._outputs * count)
        dr.make_opaque(flat)
        with host_work(count):
            given: Any = {name: _Rows(rows, count) for name, rows in features.items()}
            self._network(given, flat.numpy().reshape(self._outputs, count))
        column, size = dr.arange(uint, count), dr.opaque(uint, count)
        return [dr.gather(float_type, flat, column + size * i) for i in range(self._outputs)]


class _Rows:
    """Rows of a matrix that lie apart; looks like it where columns are taken."""

    def __init__(self, rows: list[Floats], count: int) -> None:
        self._rows = [np.broadcast_to(row.numpy(), (count,)) for row in rows]

    def __getitem__(self, where: tuple[slice, slice]) -> np.ndarray[Any, Any]:
        _, columns = where
        return np.stack([row[columns] for row in self._rows])
