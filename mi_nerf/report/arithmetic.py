"""What a query of the network costs, and how fast this machine multiplies matrices."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from ..fields.network import GRID
from ..fields.neural import NeuralFieldConfig

_SHAPE = (256, 256, 16384)  # of the product that sets the limit: a wide layer, a full block
_REPETITIONS = 20


def multiply_adds(config: NeuralFieldConfig) -> int:
    """Multiply-adds of the network's matrices for one query, forward."""
    return sum(outputs * inputs for outputs, inputs in _matrices(config).values())


def training_flop(config: NeuralFieldConfig) -> int:
    """Floating-point operations of the matrix products of one query in training.

    A multiply-add counts as two. Every matrix is used three times, forward and towards its
    own gradient and that of its input, except where the input has none: features of a
    direction never have, those of a position only where a hash grid is among them.
    """
    products = 0
    for name, (outputs, inputs) in _matrices(config).items():
        position = name == "trunk_0.weight" or name.endswith(".position_weight")
        fixed = name.endswith(".direction_weight") or (position and config.grid is None)
        products += (2 if fixed else 3) * outputs * inputs
    return 2 * products


def _matrices(config: NeuralFieldConfig) -> dict[str, tuple[int, int]]:
    shapes = config.shapes().items()
    return {n: (s[0], s[1]) for n, s in shapes if n != GRID and len(s) == 2}


def drjit_product_rate(backend: Any) -> float:
    """GFLOP/s of a product of 256x256 and 256x16384 numbers in Dr.Jit, the best of some."""
    a, b = (backend.TensorXf(m) for m in _factors())

    def product() -> None:
        dr.eval(a @ b)
        dr.sync_thread()

    return _best_rate(product)


def numpy_product_rate() -> float:
    """GFLOP/s of the same product on the CPU, by the library that NumPy calls."""
    a, b = _factors()
    result = np.empty((len(a), b.shape[1]), np.float32)
    return _best_rate(lambda: np.matmul(a, b, out=result))


def _factors() -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    rows, inner, columns = _SHAPE
    rng = np.random.default_rng(0)
    return rng.random((rows, inner), np.float32), rng.random((inner, columns), np.float32)


def _best_rate(product: Callable[[], object]) -> float:
    seconds = []
    for _ in range(_REPETITIONS):
        start = time.perf_counter()
        product()
        seconds.append(time.perf_counter() - start)
    rows, inner, columns = _SHAPE
    return 2 * rows * inner * columns / min(seconds) / 1e9
