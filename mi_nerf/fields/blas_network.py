"""A narrow network and its derivatives on a CPU, as matrix products of NumPy's BLAS.

Dr.Jit's own products reach a fifth of a CPU's speed on narrow matrices, and a pass over the
activations of a whole batch for every bias and ReLU costs as much again. Here every thread
takes some of the columns through all layers, and a row of ones below the inputs of a layer
takes the bias into the product.

    A₀ = [γ(x); 1],   A_{k+1} = [relu(M_k A_k); γ(d) or γ(x) where it is seen; 1]

The layer that density is read from and the first one towards colour read the same: they are
one product.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from ..base.arrays import Tensor
from ..base.kernel_stages import host_work
from ..base.workers import parallel
from .network import Layer, NetworkConfig

# Columns that a thread takes at a time through all layers, on any machine: sums depend on it.
_COLUMNS = 2048
_WIDEST = 128  # neurons of a layer up to which this wins
_Matrix = np.ndarray[Any, Any]


def worth_blas(config: NetworkConfig, float_type: Any) -> bool:
    """Whether a network is narrow enough for it, and its arrays where NumPy can work on them.

    Products of 256 rows take as long as Dr.Jit's own, and those need not be waited for.
    """
    widest = max(layer.outputs for layer in config.layers())
    return bool(widest <= _WIDEST and dr.backend_v(float_type) == dr.JitBackend.LLVM)


@dataclass(frozen=True)
class _Product:
    """Y = M·A: one or two layers that read the same rows of A, and what happens to Y."""

    layers: tuple[Layer, ...]  # with the density last, if it is among them
    reads: int  # rows of A that are outputs of the product before, or features of the position
    sees: str  # "position" or "direction": which features come below them; or nothing,
    seen: int  # and their number
    rectified: int  # first rows of Y that a ReLU follows

    @property
    def outputs(self) -> int:
        """Rows of Y."""
        return sum(layer.outputs for layer in self.layers)

    @property
    def inputs(self) -> int:
        """Rows of A."""
        return self.reads + self.seen + 1

    def blocks(self) -> list[tuple[str, slice, Any]]:
        """The names of the parameters in M, and where each of them is: rows, columns."""
        found: list[tuple[str, slice, Any]] = []
        first = 0
        for layer in self.layers:
            rows = slice(first, first + layer.outputs)
            found.append((layer.weight, rows, None))
            if layer.sees:
                found.append((layer.second_weight, rows, slice(self.reads, self.inputs - 1)))
            found.append((layer.bias, rows, self.inputs - 1))
            first += layer.outputs
        return found


def _products(
    config: NetworkConfig, position: int, direction: int, emission: bool
) -> list[_Product]:
    """The layers in order, from the features of a position to density or to colour."""
    sizes = {"position": position, "direction": direction}
    color = config.color()
    groups: list[tuple[Layer, ...]] = [(layer,) for layer in config.trunk()]
    groups += [(color[0], config.density())] if emission else [(config.density(),)]
    groups += [(layer,) for layer in color[1:]] if emission else []
    products: list[_Product] = []
    reads = position
    for group in groups:
        first = group[0]
        seen = sizes[first.sees] if first.sees else 0
        rectified = first.outputs if first.rectify else 0
        products.append(_Product(group, reads, first.sees or "", seen, rectified))
        reads = products[-1].outputs
    return products


class BlasNetwork:
    """A network for some number of queries at a time; keeps what its adjoint needs."""

    def __init__(
        self, config: NetworkConfig, weights: Mapping[str, _Matrix], *, emission: bool = True
    ) -> None:
        """
        Args:
            weights: arrays by name, as :meth:`NetworkConfig.shapes` has them.
            emission: whether colour is wanted, or density alone.
        """
        first, seen = config.layers()[0], config.color()
        position = weights[first.weight].shape[1]
        second = next((layer.second_weight for layer in seen if layer.sees == "direction"), None)
        direction = weights[second].shape[1] if second else 0
        self._products = _products(config, position, direction, emission)
        self._matrices = [self._joined(product, weights) for product in self._products]
        self._kept: list[_Matrix] = []  # A of every product

    def __call__(self, features: Mapping[str, _Matrix], out: _Matrix, memory: Any = None) -> None:
        """Raw density and colours of N queries.

        Args:
            features: ``(F, N)`` of "position", and "direction" if it is seen.
            out: ``(4, N)`` or ``(1, N)``, to be filled.
            memory: makes arrays of a shape, in which inputs of layers are kept for
                :meth:`backward` and :meth:`forward`; none: they are not kept.
        """
        count = out.shape[1]
        if memory is not None:
            self._kept = [memory((product.inputs, count)) for product in self._products]

        def work(columns: slice) -> None:
            if memory is not None:
                inputs = [a[:, columns] for a in self._kept]
            else:
                size = columns.stop - columns.start
                inputs = [np.empty((p.inputs, size), out.dtype) for p in self._products]
            given = {name: values[:, columns] for name, values in features.items()}
            self._forward_columns(inputs, given, out[:, columns])

        parallel(work, _parts(count))

    def _forward_columns(
        self, inputs: list[_Matrix], features: Mapping[str, _Matrix], out: _Matrix
    ) -> None:
        last = len(self._products) - 1
        inputs[0][: self._products[0].reads] = features["position"]
        for k, (product, matrix) in enumerate(zip(self._products, self._matrices, strict=True)):
            a = inputs[k]
            if product.sees:
                a[product.reads : -1] = features[product.sees]
            a[-1] = 1
            if k == last:
                break
            y = inputs[k + 1][: product.outputs]
            np.matmul(matrix, a, out=y)
            if product.rectified:
                rectified = y[: product.rectified]
                np.maximum(rectified, 0, out=rectified)
            if len(product.layers) > 1:
                out[0] = y[-1]
        y = matrix @ a
        if len(self._products[last].layers) > 1:  # colour straight from the trunk
            out[0], out[1:] = y[-1], y[:-1]
        else:
            out[-len(y) :] = y

    def backward(
        self,
        adjoint: _Matrix,
        gradients: Mapping[str, _Matrix],
        features: Mapping[str, _Matrix],
    ) -> None:
        """Carries the adjoint of the results back.

        Args:
            adjoint: ``(4, N)`` or ``(1, N)``.
            gradients: arrays shaped like the weights, to be filled; empty if not wanted.
            features: ``(F, N)`` of those whose adjoint is wanted, to be filled.
        """

        def work(columns: slice) -> list[_Matrix]:
            sums = [np.empty_like(m) for m in self._matrices] if gradients else []
            asked = {name: values[:, columns] for name, values in features.items()}
            self._backward_columns(columns, adjoint[:, columns], sums, asked)
            return sums

        parts = parallel(work, _parts(adjoint.shape[1]))
        for k, product in enumerate(self._products if gradients else []):
            matrix = np.sum([sums[k] for sums in parts], axis=0)
            for name, rows, columns in product.blocks():
                gradients[name][...] = matrix[rows, _own(columns, gradients[name])]

    def _backward_columns(
        self,
        part: slice,
        adjoint: _Matrix,
        sums: list[_Matrix],
        features: Mapping[str, _Matrix],
    ) -> None:
        g = self._last_adjoint(adjoint)
        for k in range(len(self._products) - 1, -1, -1):
            product, matrix, a = self._products[k], self._matrices[k], self._kept[k][:, part]
            if sums:
                np.matmul(g, a.T, out=sums[k])
            if product.sees in features:  # once, but for the position
                seen = slice(product.reads, product.inputs - 1)
                features[product.sees][...] = matrix[:, seen].T @ g
            if k == 0:
                if "position" in features:
                    again = any(p.sees == "position" for p in self._products)
                    own, out = matrix[:, : product.reads].T, features["position"]
                    if again:
                        out += own @ g
                    else:
                        np.matmul(own, g, out=out)
                return
            before = self._products[k - 1]
            g = matrix[:, : product.reads].T @ g
            if before.rectified:
                active = g[: before.rectified]
                active *= a[: before.rectified] > 0
            if len(before.layers) > 1:
                g[-1] = adjoint[0]

    def _last_adjoint(self, adjoint: _Matrix) -> _Matrix:
        """That of what the last product makes."""
        if len(self._products[-1].layers) > 1:
            return np.concatenate([adjoint[1:], adjoint[:1]])
        return np.array(adjoint[-self._products[-1].outputs :])

    def forward(
        self,
        tangents: Mapping[str, _Matrix],
        features: Mapping[str, _Matrix],
        out: _Matrix,
    ) -> None:
        """Carries tangents of weights and features to the results.

        Args:
            tangents: of the weights; all of them.
            features: ``(F, N)`` tangents of those that have one.
            out: ``(4, N)`` or ``(1, N)``, to be filled.
        """
        moves = [self._joined(product, tangents) for product in self._products]
        for part in _parts(out.shape[1]):
            da: _Matrix | None = None
            for k, product in enumerate(self._products):
                a, matrix = self._kept[k][:, part], self._matrices[k]
                moved = np.zeros_like(a)
                if k > 0:
                    moved[: product.reads] = da
                elif "position" in features:
                    moved[: product.reads] = features["position"][:, part]
                if product.sees in features:
                    moved[product.reads : -1] = features[product.sees][:, part]
                da = moves[k] @ a + matrix @ moved
                if product.rectified and k + 1 < len(self._products):
                    da[: product.rectified] *= self._kept[k + 1][: product.rectified, part] > 0
                if len(product.layers) > 1:
                    out[0, part] = da[-1]
            assert da is not None
            last = da[:-1] if len(self._products[-1].layers) > 1 else da
            out[-len(last) :, part] = last

    def _joined(self, product: _Product, weights: Mapping[str, _Matrix]) -> _Matrix:
        """M, from the matrices and biases of the layers; 0 where a layer sees nothing."""
        some = weights[product.layers[0].weight]
        matrix = np.zeros((product.outputs, product.inputs), some.dtype)
        for name, rows, columns in product.blocks():
            matrix[rows, _own(columns, weights[name])] = weights[name]
        return matrix


def _parts(count: int) -> list[slice]:
    """Ranges of columns."""
    return [slice(i, min(i + _COLUMNS, count)) for i in range(0, count, _COLUMNS)]


def _own(columns: Any, values: _Matrix) -> Any:
    """Where a parameter lies in M. A product may read one row, a density, more than its layers."""
    return slice(0, values.shape[1]) if columns is None else columns


class _NetworkProduct(dr.CustomOp):
    """Raw density and colours as a ``(4, N)`` tensor, or density alone as ``(1, N)``."""

    def eval(
        self,
        weights: dict[str, Tensor],
        features: dict[str, Tensor],
        config: NetworkConfig,
        emission: bool,
        moving: Collection[str],
    ) -> Tensor:
        """``moving`` names the features whose adjoints are wanted, and "weights" if theirs are."""
        self._tensor, self._moving = type(features["position"]), moving
        arrays = {name: _view(w) for name, w in weights.items()}
        self._shapes = {name: w.shape for name, w in arrays.items()}
        self._rows = {name: f.shape[0] for name, f in features.items()}
        self._network = BlasNetwork(config, arrays, emission=emission)
        self._out = (4 if emission else 1, features["position"].shape[1])
        self._memory: list[Any] = []
        dr.eval(features)  # in one kernel
        given, (out, result) = _views(features), self._new(self._out)
        with host_work(self._out[1]):
            self._network(given, result, self._keep if moving else None)
        return out

    def forward(self) -> None:
        """Tangents of weights and features."""
        weights, features = _views(self.grad_in("weights")), _views(self.grad_in("features"))
        out, result = self._new(self._out)
        self._network.forward(weights, features, result)
        self.set_grad_out(out)

    def backward(self) -> None:
        """Adjoints of weights and features."""
        adjoint, count, moving = _view(self.grad_out()), self._out[1], self._moving
        weights = {n: self._new(s) for n, s in self._shapes.items() if "weights" in moving}
        features = {n: self._new((rows, count)) for n, rows in self._rows.items() if n in moving}
        with host_work(count):
            self._network.backward(
                adjoint,
                {n: array for n, (_, array) in weights.items()},
                {n: array for n, (_, array) in features.items()},
            )
        if weights:
            self.set_grad_in("weights", {n: tensor for n, (tensor, _) in weights.items()})
        if features:  # all of them, in their order: Dr.Jit takes none else
            adjoints = {n: dr.zeros(self._tensor, (rows, count)) for n, rows in self._rows.items()}
            self.set_grad_in("features", adjoints | {n: f for n, (f, _) in features.items()})

    def name(self) -> str:
        """Shown in Dr.Jit's graphs."""
        return "NetworkProduct"

    def _keep(self, shape: tuple[int, ...]) -> _Matrix:
        """Memory that only NumPy reads: Dr.Jit's, which does not go back to the system."""
        self._memory.append(dr.empty(dr.array_t(self._tensor), math.prod(shape)))
        array: _Matrix = self._memory[-1].numpy().reshape(shape)
        return array

    def _new(self, shape: tuple[int, ...]) -> tuple[Tensor, _Matrix]:
        """A tensor of Dr.Jit, and its memory."""
        flat = dr.zeros(dr.array_t(self._tensor), math.prod(shape))
        dr.make_opaque(flat)  # what is gathered from an empty array is not a number
        return self._tensor(flat, shape=shape), flat.numpy().reshape(shape)


def network_product(
    config: NetworkConfig,
    weights: Mapping[str, Tensor],
    features: Mapping[str, Tensor],
    *,
    emission: bool = True,
) -> Tensor:
    """Raw density of N queries and their raw colours, ``(4, N)``, or density alone, ``(1, N)``.

    Args:
        weights: of the layers alone, by name.
        features: ``(F, N)`` of "position", and of "direction" where it is seen.
    """
    moving = [name for name, values in features.items() if dr.grad_enabled(values)]
    moving += ["weights"] if dr.grad_enabled(list(weights.values())) else []
    return dr.custom(_NetworkProduct, dict(weights), dict(features), config, emission, moving)


def _view(tensor: Tensor) -> _Matrix:
    """The memory of a tensor, evaluated."""
    values: _Matrix = tensor.array.numpy().reshape(tensor.shape)
    return values


def _views(tensors: Mapping[str, Tensor]) -> dict[str, _Matrix]:
    return {name: _view(tensor) for name, tensor in tensors.items()}
