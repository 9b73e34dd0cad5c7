"""A trained field in another shape: more levels, entries, neurons, layers or directions.

What is added changes nothing at first, so that training goes on where it was. New neurons
read at random and nobody reads them yet (their output weights are zero); new layers of
ReLUs are the identity; new levels of a hash grid hold zeros, read by random weights; new
octaves and directions are read with weight zero. What is taken out may have mattered:
directions leave their mean behind, entries that become one their mean (see
:mod:`mi_nerf.training.tables`), everything else nothing.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..base.box import grid_shape
from ..base.tensor_file import prefixed
from ..fields.fourier import FourierEncoding
from ..fields.network import GRID, Layer, initial_weights
from ..fields.neural import NeuralFieldConfig
from .config import TrainConfig
from .tables import TableMap, kept_levels

Array = np.ndarray[Any, Any]
_NEW = -1  # in place of the number of an old unit


@dataclass(frozen=True)
class Snapshot:
    """A model in training: what its further steps depend on, apart from their number."""

    config: TrainConfig
    field: NeuralFieldConfig
    weights: dict[str, Array]  # those of a coarse network begin with "coarse."
    optimizer: dict[str, Array]  # its state
    cells: Array  # (X, Y, Z) booleans: those that are not empty for good
    occupancy: dict[str, Array]  # its state, if there is one
    rays: float  # a step


def reshaped(
    old: Snapshot, config: TrainConfig, seed: int, direction: Array | None = None
) -> Snapshot:
    """The same model in the shape of another configuration.

    Args:
        seed, direction: as for :meth:`Reshaping.weights`.

    Raises:
        ValueError: if layers would have to go, or could not start as the identity.
    """
    field = field_in_shape(old.field, config)
    shape = Reshaping(old.field, field)
    weights: dict[str, Array] = {}
    state = {n: a for n, a in old.optimizer.items() if "." not in n}
    for prefix in {"coarse." if n.startswith("coarse.") else "" for n in old.weights}:
        own = {
            n: a for n, a in prefixed(old.weights, prefix).items() if prefix or "coarse." not in n
        }
        squares = prefixed(old.optimizer, f"second.{prefix}")
        found = shape.weights(own, seed + len(prefix), importance=squares, direction=direction)
        weights |= {f"{prefix}{n}": a for n, a in found.items()}
        for kind in sorted({n.partition(".")[0] for n in old.optimizer if "." in n}):
            moments = shape.moments(prefixed(old.optimizer, f"{kind}.{prefix}"))
            state |= {f"{kind}.{prefix}{n}": a for n, a in moments.items()}
    cells = grid_shape(field.lower, field.upper, config.occupancy.resolution)
    return Snapshot(
        config,
        field,
        weights,
        state,
        resampled(old.cells, cells, np.max),
        {
            name: resampled(values, cells, np.min if name == "floor" else np.max)
            for name, values in old.occupancy.items()
        },
        old.rays,
    )


def resampled(cells: Array, shape: tuple[int, ...], of: Callable[..., Any]) -> Array:
    """Other cells of the same box: ``of`` (such as the largest) those that each overlaps."""
    for axis, count in enumerate(shape):
        ratio = cells.shape[axis] / count
        if ratio == 1:
            continue
        spans = [(math.floor(i * ratio), math.ceil((i + 1) * ratio)) for i in range(count)]
        parts = [of(cells.take(range(*span), axis), axis=axis) for span in spans]
        cells = np.stack(parts, axis)
    return cells


def field_in_shape(field: NeuralFieldConfig, config: TrainConfig) -> NeuralFieldConfig:
    """The field of a run whose configuration has become ``config``.

    Raises:
        ValueError: if the number of levels changes and their finest is not given.
    """
    grid = config.grid
    if grid is not None and grid.finest is None:
        if field.grid is None or grid.levels != field.grid.levels:
            raise ValueError(f"grid.levels={grid.levels}, expected grid.finest with it")
        grid = dataclasses.replace(grid, finest=field.grid.finest)
    return dataclasses.replace(
        field,
        network=config.network,
        grid=grid,
        position=config.position or field.position,
        direction=config.direction,
    )


class Reshaping:
    """Carries the parameters of one field, and their moments, into the shape of another."""

    def __init__(self, old: NeuralFieldConfig, new: NeuralFieldConfig) -> None:
        """
        Raises:
            ValueError: if layers would have to go, or could not start as the identity.
        """
        self._old, self._new = old, new
        self._shapes = new.shapes()
        self._before = {layer.name: layer for layer in old.network.layers()}
        self._table = None
        if old.grid is not None and new.grid is not None:
            self._table = TableMap(old.grid, new.grid)
        # For each unit that a layer reads, the number of the old unit that it is.
        self._units = {
            "position": _position_units(old, new),
            "direction": _octaves(old.direction, new.direction),
        }
        layers = new.network.layers()
        if missing := sorted(set(self._before) - {layer.name for layer in layers}):
            raise ValueError(f"layer '{missing[0]}' would be lost, expected all to stay")
        for layer in layers:
            self._units[layer.name] = self._units_of(layer)

    def weights(
        self,
        old: Mapping[str, Array],
        seed: int,
        *,
        importance: Mapping[str, Array] | None = None,
        direction: Array | None = None,
    ) -> dict[str, Array]:
        """The parameters of the new field.

        Args:
            seed: of the weights with which new neurons read.
            importance: squared gradients of the parameters, by name.
            direction: mean features of the directions seen, with which a layer that does
                not see them any more goes on.
        """
        fresh = initial_weights(self._shapes, seed)
        result = {}
        for layer in self._new.network.layers():
            rows = self._units[layer.name]
            for name, source in layer.matrices().items():
                matrix, columns = fresh[name], self._units[source]
                unread = np.full(len(columns), True)
                if source == "position":
                    unread[self._new_levels()] = False
                matrix[np.ix_(rows != _NEW, unread)] = 0
                if layer.name not in self._before and source == layer.reads:
                    _place(matrix, rows, columns, np.eye(1 + max(rows), dtype=np.float32))
                elif name in old:
                    _place(matrix, rows, columns, old[name])
                result[name] = matrix
            result[layer.bias] = fresh[layer.bias]
            if layer.name in self._before:
                bias = old[layer.bias] + self._left_of_directions(layer, old, direction)
                _place(result[layer.bias], rows, None, bias)
        if self._table is not None:
            squares = None if importance is None else importance[GRID]
            result[GRID] = self._table.carry(old[GRID], squares)
        elif GRID in self._shapes:
            result[GRID] = np.zeros(self._shapes[GRID], np.float32)
        return {name: result[name] for name in self._shapes}

    def moments(self, old: Mapping[str, Array]) -> dict[str, Array]:
        """Numbers that go with parameters, by their names: zero where those are new.

        For a table they may be one number for each entry.
        """
        result = {name: np.zeros(shape, np.float32) for name, shape in self._shapes.items()}
        for name in self._shapes.keys() & old.keys():
            if name == GRID:
                if self._table is not None:
                    result[name] = self._table.carry(old[name])
                continue
            layer, source = self._reader(name)
            columns = None if source is None else self._units[source]
            _place(result[name], self._units[layer.name], columns, old[name])
        return result

    def _reader(self, name: str) -> tuple[Layer, str | None]:
        """The layer that a parameter belongs to, and what it is multiplied with, if a matrix."""
        for layer in self._new.network.layers():
            if name in layer.matrices():
                return layer, layer.matrices()[name]
            if name == layer.bias:
                return layer, None
        raise KeyError(name)

    def _units_of(self, layer: Layer) -> Array:
        """The neurons of a layer; those of a new one continue what it reads."""
        units = np.arange(layer.outputs)
        if layer.name in self._before:
            return np.where(units < self._before[layer.name].outputs, units, _NEW)
        reads = self._units[layer.reads]
        source = next((x for x in self._new.network.layers() if x.name == layer.reads), None)
        if source is None or not (source.rectify and layer.rectify):
            raise ValueError(f"layer '{layer.name}' after '{layer.reads}', expected ReLUs in both")
        if layer.outputs <= max(reads):
            raise ValueError(
                f"layer '{layer.name}' has {layer.outputs} neurons, expected as many as it reads, "
                f"{1 + max(reads)}"
            )
        return np.where(units <= max(reads), units, _NEW)

    def _new_levels(self) -> Array:
        """Whether each feature of a position is of a level that has nothing yet."""
        units = self._units["position"]
        return (units == _NEW) & (np.arange(len(units)) >= self._new.position.size)

    def _left_of_directions(
        self, layer: Layer, old: Mapping[str, Array], direction: Array | None
    ) -> Any:
        """What a layer that does not see directions any more adds in their place."""
        before = self._before[layer.name]
        if before.sees != "direction" or layer.sees == "direction" or direction is None:
            return np.float32(0)
        return (old[before.second_weight] @ direction).astype(np.float32)


def _place(target: Array, rows: Array, columns: Array | None, values: Array) -> None:
    """Copies rows and columns to where the numbers in ``rows`` and ``columns`` say."""
    to = np.flatnonzero((rows != _NEW) & (rows < values.shape[0]))
    if columns is None:
        target[to] = values[rows[to]]
        return
    along = np.flatnonzero((columns != _NEW) & (columns < values.shape[1]))
    target[np.ix_(to, along)] = values[np.ix_(rows[to], columns[along])]


def _octaves(old: FourierEncoding, new: FourierEncoding) -> Array:
    """Numbers of the old features of a point, for all new ones."""
    if old.convention != new.convention:
        return np.full(new.size, _NEW)
    plain = 3 * int(new.include_input)
    if old.include_input != new.include_input:
        shift = 3 * int(old.include_input) - plain
        units = np.arange(new.size) + shift
        units[:plain] = _NEW
    else:
        units = np.arange(new.size)
    return np.where(units < old.size, units, _NEW)


def _position_units(old: NeuralFieldConfig, new: NeuralFieldConfig) -> Array:
    """Numbers of the old features of a position, for all new ones."""
    parts = [_octaves(old.position, new.position)]
    if new.grid is not None:
        count = new.grid.features
        kept = kept_levels(old.grid, new.grid) if old.grid is not None else []
        kept = kept or [None] * new.grid.levels
        for level in kept:
            first = _NEW if level is None else old.position.size + level * count
            parts.append(np.where(level is None, _NEW, first + np.arange(count)))
    return np.concatenate(parts)
