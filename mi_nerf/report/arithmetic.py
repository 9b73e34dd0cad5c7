"""What a query of the network costs, and how fast this machine multiplies matrices."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import drjit as dr
import numpy as np

from ..fields.neural import NeuralFieldConfig

_SHAPE = (256, 256, 16384)  # of the product that sets the limit: a wide layer, a full block
_REPETITIONS = 20


def multiply_adds(config: NeuralFieldConfig) -> int:
    """Multiply-adds of the network's matrices for one query, forward."""
    return sum(size for _, size in _matrices(config))


def training_flop(config: NeuralFieldConfig) -> int:
    """Floating-point operations of the matrix products of one query in training.

    A multiply-add counts as two. Every matrix is used three times, forward and towards its
    own gradient and that of its input, except where the input has none: features of a
    direction never have, those of a position only where a hash grid is among them.
    """
    fixed = ("direction", "position") if config.grid is None else ("direction",)
    products = sum((2 if source in fixed else 3) * size for source, size in _matrices(config))
    return 2 * products


def _matrices(config: NeuralFieldConfig) -> Iterator[tuple[str, int]]:
    """What each matrix of the network is multiplied with, and how many numbers it holds."""
    shapes = config.shapes()
    for layer in config.network.layers():
        for name, source in layer.matrices().items():
            yield source, math.prod(shapes[name])


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
