"""Several fields along the same rays: their samples merged in depth and integrated once.

Each field keeps its own samples, with its density constant between the ends of each. The
ends of all of them, sorted along a ray, bound pieces on which every density is constant:

    σ = Σ_k σ_k,    c = Σ_k σ_k c_k / σ,    w_m = T_m (1 − exp(−σ_m δ_m)),

the quadrature of Max 1995 on the union of the intervals. Field k has the share σ_k/σ of a
piece's weight. Only the ends of samples that were evaluated count, so a piece may span much
empty space, and the work grows with the samples taken.

Nothing is lost by it: of densities that are constant between the ends, it is the exact
integral. The order of the fields decides nothing but the last bits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from ..base.arrays import Floats, Indices
from .importance import count_below
from .query import Evaluation
from .rules import sample_weights
from .samples import Samples
from .strata import rows

# No row, or no sample: where a ray misses a field.
_NONE = 0xFFFFFFFF


@dataclass
class Layer:
    """The samples of one field on the rays that cross its box."""

    ray: Indices  # N numbers of rays, each once
    samples: Samples  # theirs
    evaluation: Evaluation
    scale: Any  # N lengths in the field's own units of a unit length of the scene
    edges: Floats  # N·(S + 1) ends of the samples' intervals, as distances in the scene

    @property
    def stride(self) -> int:
        """S + 1, the number of ends a ray."""
        return self.samples.count + 1


@dataclass
class Pieces:
    """R·W pieces of R rays, ascending, on which all densities are constant."""

    t: Floats  # R·W distances at which they begin
    delta: Floats  # R·W lengths; 0 for those that fill up a row
    width: int  # W
    sample: list[Any]  # for each field, R·W numbers of the samples that they belong to


@dataclass
class MergedView:
    """What R rays see of K fields."""

    color: list[list[Any]]  # of each field, three arrays of R values: weights times emission
    share: list[Any]  # of each field, R opacities: they sum to that of all
    opacity: Floats  # R values
    depth: Floats  # R mean distances under the weights, scene units; 0 where nothing is seen
    weights: list[Any]  # of each field, R·W weights of the pieces


def merge(layers: list[Layer], rays: int) -> Pieces:
    """Sorts the ends of what the fields were asked for along each of R rays.

    Differentiable in the ``edges`` of the layers.
    """
    uint = type(layers[0].ray)
    with dr.suspend_grad():
        tables = [_Ends(layer, rays) for layer in layers]
        total = dr.zeros(uint, rays)
        for table in tables:
            total += dr.select(table.row != _NONE, table.kept_of(table.row), 0)
        dr.eval(total)
        width = _row_size(int(dr.max(total)[0]))

    float_type = type(layers[0].edges)
    t = dr.zeros(float_type, rays * width)
    sample = [dr.full(uint, _NONE, rays * width) for _ in layers]
    dr.make_opaque(t, sample)
    for i, (layer, table) in enumerate(zip(layers, tables, strict=True)):
        if not len(table.list):
            continue
        with dr.suspend_grad():
            end = table.list
            row = end // layer.stride
            ray = dr.gather(uint, layer.ray, row)
            x = dr.gather(float_type, dr.detach(layer.edges), end)
            place = dr.gather(uint, table.rank, end)
            within = [
                (row, end - row * layer.stride + 1)
                if j == i
                else other.locate(ray, x, strict=j > i)
                for j, other in enumerate(tables)
            ]
            for j, other in enumerate(tables):
                if j != i:
                    place += other.kept_below(*within[j])
            target = ray * width + place
            dr.eval(target)
            for array, other, (there, count) in zip(sample, tables, within, strict=True):
                dr.scatter(array, other.sample(there, count), target)
        dr.scatter(t, dr.gather(float_type, layer.edges, end), target)
        dr.eval(t, sample)
    return Pieces(t, _lengths(t, total, width), width, sample)


def integrate_merged(layers: list[Layer], pieces: Pieces) -> MergedView:
    """Quadrature of several fields; differentiable in all that they answered.

    Each field's colour is kept apart, in its own colour space.
    """
    float_type, width = type(pieces.t), pieces.width
    inside = [sample != _NONE for sample in pieces.sample]
    densities = []
    for layer, sample, there in zip(layers, pieces.sample, inside, strict=True):
        row = sample // layer.samples.count
        scale = dr.gather(float_type, layer.scale, row, there)
        densities.append(dr.gather(float_type, layer.evaluation.density, sample, there) * scale)
    total = sum(densities[1:], densities[0])
    all_weights, opacity = sample_weights(total, pieces.delta, width)
    per_density = dr.select(total > 0, all_weights / dr.select(total > 0, total, 1), 0)
    weights = [density * per_density for density in densities]
    dr.eval(weights, all_weights, opacity)

    color = [
        [
            dr.block_sum(w * dr.gather(float_type, channel, sample, there), width)
            for channel in layer.evaluation.emission
        ]
        for layer, w, sample, there in zip(layers, weights, pieces.sample, inside, strict=True)
    ]
    visible = opacity > 0
    middle = pieces.t + 0.5 * pieces.delta
    depth = dr.block_sum(all_weights * middle, width) / dr.select(visible, opacity, 1)
    share = [dr.block_sum(w, width) for w in weights]
    return MergedView(color, share, opacity, dr.select(visible, depth, 0), weights)


class _Ends:
    """The ends of a layer's intervals, and which of them matter."""

    def __init__(self, layer: Layer, rays: int) -> None:
        self._edges, self._stride = dr.detach(layer.edges), layer.stride
        self._uint = uint = type(layer.ray)
        samples = layer.samples
        self.asked = dr.zeros(dr.mask_t(layer.edges), len(samples.t))
        dr.make_opaque(self.asked)
        if len(layer.evaluation.asked):
            dr.scatter(self.asked, dr.mask_t(layer.edges)(True), layer.evaluation.asked)
        row, number = rows(uint, len(self._edges), self._stride)  # of each end
        after = row * samples.count + number
        kept = dr.gather(dr.mask_t(layer.edges), self.asked, after, number < samples.count)
        kept |= dr.gather(dr.mask_t(layer.edges), self.asked, after - 1, number > 0)
        one = dr.select(kept, uint(1), uint(0))
        dr.eval(kept, one)
        self.rank = dr.block_prefix_sum(one, self._stride, exclusive=True)
        self._kept = dr.block_sum(one, self._stride)
        self.list = uint(dr.compress(kept))
        self.row = dr.full(uint, _NONE, rays)
        dr.make_opaque(self.row)
        dr.scatter(self.row, dr.arange(uint, len(layer.ray)), layer.ray)
        dr.eval(self.rank, self._kept, self.list, self.row, self.asked)

    def kept_of(self, row: Indices) -> Any:
        """How many ends in a row matter."""
        return dr.gather(self._uint, self._kept, row, row != _NONE)

    def locate(self, ray: Indices, x: Floats, strict: bool) -> tuple[Any, Any]:
        """The row of a ray, and how many of its ends lie below (or at) x."""
        row = dr.gather(self._uint, self.row, ray)
        there = row != _NONE
        first = dr.select(there, row, 0) * self._stride
        count = count_below(self._edges, x, first, self._stride, strict)
        return row, dr.select(there, count, 0)

    def kept_below(self, row: Indices, count: Indices) -> Any:
        """How many of the first ``count`` ends of a row matter."""
        whole = count == self._stride
        rank = dr.gather(self._uint, self.rank, row * self._stride + count, (row != _NONE) & ~whole)
        return dr.select(whole, self.kept_of(row), rank)

    def sample(self, row: Indices, count: Indices) -> Any:
        """The sample that begins with the last of the first ``count`` ends, if it was asked."""
        inside = (row != _NONE) & (count > 0) & (count < self._stride)
        number = row * (self._stride - 1) + count - 1
        asked = dr.gather(dr.mask_t(self._edges), self.asked, number, inside)
        return dr.select(asked, number, _NONE)


def _lengths(t: Floats, total: Floats, width: int) -> Floats:
    """From each end to the next; 0 after the last of a ray."""
    uint, float_type = type(total), type(t)
    index = dr.arange(uint, len(t))
    ray = index // width
    inner = index - ray * width + 1 < dr.gather(uint, total, ray)
    after = dr.gather(float_type, t, index + 1, inner)
    delta = dr.select(inner, after - t, 0)
    dr.eval(delta)
    return delta


def _row_size(least: int) -> int:
    """The next of 16, 24, 32, 48, 64, …: kernels depend on it and are compiled for few."""
    size = 16
    while size < least:
        size = size * 3 // 2 if size & (size - 1) == 0 else size // 3 * 4
    return size
