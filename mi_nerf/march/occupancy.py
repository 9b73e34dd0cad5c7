"""A grid over the box that says where a field may hold anything at all.

Samples in cells marked empty are not evaluated and count as density 0. A cell is only
marked empty while its optical thickness, as last seen, stays below a threshold: a ray
that crosses n such cells loses an opacity of about n · threshold at most.

During training the grid also knows a density that each cell has everywhere, as far as
training's own samples have seen: samples behind much of that are hidden and need no
evaluation either.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import numpy as np

from ..base.arrays import Floats, upload, vector3_type
from ..base.box import Corner
from ..fields.protocol import Field
from .bit_field import BitField
from .samples import Samples
from .strata import points_along

# Value of a cell that was never looked at: occupied whatever the threshold.
_UNSEEN = np.float32(np.finfo(np.float32).max)

# Optical thickness of a cell below which it counts as empty, where nothing else is said.
THRESHOLD = 0.01

# Share of the threshold below which a cell is empty even if the whole scene is that thin.
FAINTEST = 1e-4

# The least density of a cell follows a smaller one at once. A larger one it follows from the
# threshold on, by this factor a step: rays that pass a surface within a cell by will hardly
# find so many before them that all met the surface, though cells add up along them.
_FLOOR_GROWTH = 1.1


class OccupancyGrid:
    """Cells of an axis-aligned box, each with a decaying maximum and a floor of its density."""

    _bits: BitField | None = None  # of the mask, as last asked for

    def __init__(
        self, lower: Corner, upper: Corner, cells: np.ndarray[Any, Any], float_type: Any
    ) -> None:
        """
        Args:
            lower, upper: corners of the box, in scene units.
            cells: (X, Y, Z) booleans, true where the field may be non-empty. The other
                cells are taken to be empty for good.
            float_type: ``Float`` of the backend, e.g. ``mi.Float``.
        """
        self.lower, self.upper = lower, upper
        self.shape = cells.shape
        self._float, self._uint = float_type, dr.uint32_array_t(float_type)
        self._candidates = upload(self._uint, np.flatnonzero(cells).astype(np.uint32))
        self._values = upload(float_type, np.where(cells.ravel(), _UNSEEN, 0))
        # Bits of numbers: of those that are not negative, in the same order, and every device
        # has extremes of integers.
        self._floor = dr.zeros(self._uint, cells.size)
        self._hull = self._mask = self._upload_mask(cells)

    @classmethod
    def surveyed(
        cls,
        field: Field,
        cells: np.ndarray[Any, Any],
        float_type: Any,
        *,
        looks: int,
        most: int | None = None,
        seed: int = 0,
        block: int = 16384,
    ) -> OccupancyGrid:
        """A grid that remembers the greatest density seen in each of ``cells``.

        All of them are marked as sampled: :meth:`draw_line` tells which are not empty.

        Args:
            cells: (X, Y, Z) booleans over the box of the field; the others are empty.
            looks: at as many random points of each cell, an even number.
            most: looks at all cells together, but for two at each.
            block: points at a time.
        """
        grid = cls(field.lower, field.upper, cells, float_type)
        count, pairs = int(cells.sum()), looks // 2  # a refresh looks at all cells twice
        if most is not None:
            pairs = min(max(most // max(2 * count, 1), 1), pairs)
        rng = dr.rng(seed)
        for turn in range(-(-count // block) * pairs):
            grid.refresh(field, rng, turn, queries=2 * block, threshold=0, decay=1.0)
        return grid

    @property
    def cell_size(self) -> np.ndarray[Any, Any]:
        """Edge lengths of a cell, in scene units."""
        return (np.asarray(self.upper) - np.asarray(self.lower)) / np.asarray(self.shape)

    def mask(self) -> np.ndarray[Any, Any]:
        """(X, Y, Z) booleans: the cells that are sampled."""
        return np.array(self._mask).astype(bool).reshape(self.shape)

    def values(self) -> np.ndarray[Any, Any]:
        """(X, Y, Z) remembered densities, 1/scene unit."""
        return np.array(self._values).reshape(self.shape)

    def floor(self) -> np.ndarray[Any, Any]:
        """(X, Y, Z) densities below which the cells have seldom been seen, 1/scene unit."""
        return np.array(self._floor).view(np.float32).reshape(self.shape)

    def fraction(self) -> float:
        """Share of the cells that are sampled."""
        return float(dr.count(self._mask)[0]) / len(self._mask)

    def cell(self, p: Any) -> Any:
        """Numbers of the cells in which points (in field coordinates) lie."""
        index = self._uint(0)
        for along, size in zip(self.coordinates(p), self.shape, strict=True):
            index = index * size + along
        return index

    def coordinates(self, p: Any) -> list[Any]:
        """Cells of points, counted along each axis; the nearest ones for points outside."""
        result = []
        for i, size in enumerate(self.cell_size):
            along = dr.floor((p[i] - float(self.lower[i])) * float(1 / size))
            result.append(self._uint(dr.fmin(dr.fmax(along, 0), float(self.shape[i] - 1))))
        return result

    def bits(self) -> BitField:
        """The cells that are sampled, for walks along rays."""
        if self._bits is None or self._bits.mask is not self._mask:
            self._bits = BitField(self._mask, self.shape)
        return self._bits

    def occupied(self, cell: Any) -> Any:
        """Whether cells may hold something."""
        return dr.gather(dr.mask_t(self._float), self._mask, cell)

    def least_density(self, cell: Any) -> Any:
        """What light meets everywhere in these cells, as far as seen; 1/scene unit."""
        return dr.reinterpret_array(self._float, dr.gather(self._uint, self._floor, cell))

    def witness(self, samples: Samples, density: Floats) -> None:
        """Takes note of the densities of the samples that training has asked for.

        They are what raises the least density of a cell, as they lie where rays pass: looks at
        random places cannot tell whether a surface runs through the cell. What is seen past it
        would be hidden, training would fill the cell in place of that, and images get worse.

        Args:
            density: R·S numbers, of all samples.
        """
        with dr.suspend_grad():
            index = samples.index
            t, density = (dr.gather(self._float, v, index) for v in (samples.t, density))
            cell = self.cell(points_along(samples.o, samples.d, t, index // samples.count))
            density = dr.select(density >= 0, density, 0)  # what is not a number hides nothing
            first = dr.opaque(self._float, THRESHOLD / float(np.mean(self.cell_size)))
            risen = dr.fmin(dr.fmax(_FLOOR_GROWTH * self.least_density(cell), first), density)
            dr.eval(cell, density, risen)
            self._extreme(dr.ReduceOp.Max, risen, cell)
            self._extreme(dr.ReduceOp.Min, density, cell)

    def refresh(
        self, field: Field, rng: Any, turn: int, *, queries: int, threshold: float, decay: float
    ) -> None:
        """Looks at the field again at one random point in each of ``queries`` cells.

        Half of them take their turn among all cells that are not known to be empty for
        good, half among those sampled now. A value decays by ``decay`` at every look and
        never stays below the density just seen; :meth:`draw_line` says what is empty then.

        Args:
            rng: a Dr.Jit generator, for the place within each cell.
            turn: how often the grid has been refreshed before.
        """
        half = max(1, queries // 2)
        sampled = self._uint(dr.compress(self._mask))
        for pool in (self._candidates, sampled):
            if len(pool):
                self._look(field, pool, turn * half, half, rng, decay)
        self.draw_line(threshold)

    def draw_line(self, threshold: float) -> None:
        """Marks cells as empty whose value times the mean edge length is below ``threshold``.

        Or below half the mean over all cells where that is less, as in a scene that is
        nothing but thin fog. Below :data:`FAINTEST` of the threshold even such fog counts
        as nothing. With 0, all cells are kept that are not empty for good.
        """
        limit = dr.opaque(self._float, threshold / float(np.mean(self.cell_size)))
        seen = self._hull & (self._values < float(_UNSEEN))
        total = dr.sum(dr.select(seen, self._values, 0))
        mean = total / dr.fmax(self._float(dr.count(seen)), 1)
        limit = dr.fmax(dr.fmin(limit, 0.5 * mean), FAINTEST * limit)
        kept = self._values > limit if threshold > 0 else True
        self._mask = self._hull & kept
        dr.eval(self._mask, self._values)

    def state(self) -> dict[str, np.ndarray[Any, Any]]:
        """All that :meth:`restore` needs, by name."""
        return {"values": self.values(), "floor": self.floor(), "mask": self.mask()}

    def restore(self, state: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Takes up the :meth:`state` of a grid of the same shape.

        Raises:
            KeyError: if an array is missing.
            ValueError: if the shape is another.
        """
        values, floor, mask = (state[name] for name in ("values", "floor", "mask"))
        for array in (values, floor, mask):
            if array.shape != self.shape:
                raise ValueError(f"occupancy grid is {array.shape}, expected {self.shape}")
        self._values = upload(self._float, np.asarray(values, np.float32).ravel())
        self._floor = upload(self._uint, np.asarray(floor, np.float32).ravel().view(np.uint32))
        self._mask = self._upload_mask(mask)

    def _upload_mask(self, cells: np.ndarray[Any, Any]) -> Any:
        mask = upload(self._uint, cells.ravel().astype(np.uint32)) != 0
        dr.eval(mask)
        return mask

    def _look(
        self, field: Field, pool: Any, first: int, count: int, rng: Any, decay: float
    ) -> None:
        uint = self._uint
        slot = dr.arange(uint, count)
        new = slot < dr.opaque(uint, len(pool))  # each cell once, in however small a pool
        cell = dr.gather(
            uint, pool, (slot + dr.opaque(uint, first % len(pool))) % dr.opaque(uint, len(pool))
        )
        p = self._points(cell, rng)
        with dr.suspend_grad():
            density = field.density(p)
            old = dr.gather(self._float, self._values, cell)
            old = dr.select(old < float(_UNSEEN), old * decay, 0)
            dr.eval(old, density, cell, new)
            dr.scatter(self._values, dr.fmax(old, density), cell, new)
            dr.eval(self._values)
            self._extreme(dr.ReduceOp.Min, dr.select(density >= 0, density, 0), cell, new)

    def _extreme(self, operation: Any, density: Floats, cell: Any, active: Any = True) -> None:
        """Raises or lowers least densities of cells, several of which may be the same."""
        bits = dr.reinterpret_array(self._uint, density)
        mode = dr.ReduceMode.Direct  # copies of the grid, one a thread, would cost more
        dr.scatter_reduce(operation, self._floor, bits, cell, active, mode=mode)
        dr.eval(self._floor)

    def _points(self, cell: Any, rng: Any) -> Any:
        """A random point in each of these cells."""
        rest, where = cell, list[Any]()
        for size in reversed(self.shape):
            where.insert(0, rest % size)
            rest = rest // size
        p = vector3_type(self._float)(
            *(
                (self._float(w) + rng.random(self._float, len(cell))) * float(s) + float(low)
                for w, s, low in zip(where, self.cell_size, self.lower, strict=True)
            )
        )
        dr.eval(p, cell)
        return p


def greatest_around(values: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """The greatest of each of (X, Y, Z) cells and its 26 neighbours, of booleans whether any."""
    for axis in range(3):
        ends = [(1, 1) if i == axis else (0, 0) for i in range(3)]
        padded = np.pad(values, ends, mode="edge")
        parts = [padded.take(range(k, k + values.shape[axis]), axis) for k in range(3)]
        values = np.maximum.reduce(parts)
    return values
