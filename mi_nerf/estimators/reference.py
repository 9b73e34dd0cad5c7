"""What rays see of any field, as exactly as point values can tell, and how exactly that is.

The quadrature of Max 1995 (NeRF Eq. 3; :mod:`mi_nerf.march.quadrature`) with N, 2N, 4N, … equal
intervals, each sampled in its middle, at positions computed in double precision and summed
in it. Its error on smooth fields is a series in h², h the length of an interval, so that

    X_N = F_N + (F_N − F_{N/2}) / 3

(Richardson 1911) is of fourth order, if the observed one, log₂ of the ratio of the last two
differences, is near 2. Where it is not, F_N itself is the estimate.

Differences of estimates alone can be fooled: the intervals of all N share their ends, and a
jump beside one of these shifts all F_N alike. The stated error is therefore at least what
differences of the samples allow. A jump of σ by Δ adds 2Δ to Σ|δ²σ| and up to hΔ/2 to the
error of the optical depth, a bend by m adds mh and mh²/8, curvature adds h∫|σ''| and
h²/24 ∫|σ''|: h/4 · Σ|δ²σ| covers all three. Likewise h/6 · Σ|δ⁴σ| covers what extrapolation
leaves, h⁴ for smooth fields. The densities at both ends of the ray tell of what happens in
its last half intervals. :func:`_roughness` carries all this on to what is seen.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Floats, Vectors, upload, vector3_type
from ..fields.protocol import Field
from ..march.blocks import ranges
from ..march.intervals import RaySegments, ray_segments
from ..march.occupancy import OccupancyGrid

Array = NDArray[np.float64]
Ask = Callable[[Vectors, Vectors], tuple[Floats, list[Floats]]]

# Observed orders that differ from 2 by more than this do not count as second order.
_ORDER_TOLERANCE = 0.5

# The polynomials through the outermost two and four middles, half an interval further out.
_TO_THE_END = np.array([3, -1]) / 2, np.array([35, -35, 21, -5]) / 16

# Samples of all rays in memory at a time, unless one ray has more.
_SAMPLES = 1 << 18


@dataclass(frozen=True)
class Reference:
    """What R rays see, without background, in the field's colour space."""

    color: Array  # (R, 3), premultiplied by the opacity
    opacity: Array  # (R,)
    depth: Array  # (R,) mean distance along the ray, scene units; 0 where nothing is seen
    error: Array  # (R, 5) of red, green, blue, opacity and depth: what they may be off by
    intervals: NDArray[np.int64]  # (R,) N of each ray's finest march


def reference(
    field: Field,
    o: Vectors,
    d: Vectors,
    *,
    occupancy: OccupancyGrid | None = None,
    bounds: tuple[Any, Any] = (None, None),
    tolerance: float = 1e-5,
    intervals: int = 128,
    max_intervals: int = 1 << 16,
    block: int = 16384,
) -> Reference:
    """Marches R rays through a field ever more finely, until the error is tolerable.

    The field is asked in its own precision, that of ``o``; its rounding counts as error.
    What no sample hits cannot be known: a sheet thinner than the length of a ray over
    4 · ``intervals`` may be missed.

    Args:
        field: any field.
        occupancy: cells that it marks as empty are empty, as in renderings; without it, what
            training never saw there counts as well.
        o, d: R origins and unit directions, in the field's coordinates.
        bounds: lower and upper bound of the distance, in scene units: numbers, arrays of R
            values or ``None``.
        tolerance: of the opacity, of colours (relative to those above 1), and of the depth
            relative to the length of ray within the box. A ray that meets it is done.
        intervals: N of the first march; there are at least two more, of 2N and 4N.
        max_intervals: N beyond which no march goes; the error says how good that was.
        block: queries a network evaluation.

    Raises:
        ValueError: if a setting makes no sense.
    """
    if not tolerance > 0:
        raise ValueError(f"tolerance={tolerance}, expected a number above 0")
    if intervals < 8:
        raise ValueError(f"intervals={intervals}, expected at least 8")
    if max_intervals < 4 * intervals:
        raise ValueError(f"max_intervals={max_intervals}, expected at least {4 * intervals}")
    with dr.suspend_grad():
        march = _March(field, o, d, occupancy, bounds, block)
        estimate = _refined(march, tolerance, intervals, max_intervals)
    return _in_scene(estimate, march.segments)


# ---- Refinement ----------------------------------------------------------------


@dataclass
class _Level:
    """One march of R rays with N intervals each."""

    seen: Array  # (R, 5): red, green, blue, opacity, depth
    rough: Array  # (R, 5): what they may be off by
    rough_extrapolated: Array  # (R, 5): the same of extrapolated values


def _refined(march: _March, tolerance: float, intervals: int, most: int) -> Reference:
    rays = len(march.length)
    value, error = np.zeros((rays, 5)), np.zeros((rays, 5))
    count = np.zeros(rays, np.int64)
    pending = np.arange(rays)
    levels: list[_Level] = []
    while len(pending) and intervals <= most:
        levels = [*levels[-2:], march.at(pending, intervals)]
        if len(levels) == 3:
            value[pending], error[pending] = _judged(*levels)
            count[pending] = intervals
            limit = np.maximum(np.abs(value[pending]), 1) * tolerance
            limit[:, 4] = tolerance * march.length[pending]
            going = (error[pending] > limit).any(axis=1)
            pending = pending[going]
            levels = [
                _Level(v.seen[going], v.rough[going], v.rough_extrapolated[going]) for v in levels
            ]
        intervals *= 2
    rounding = march.rounding * np.abs(value)
    rounding[:, 4] = march.rounding * np.where(value[:, 3] > 0, march.far, 0)
    return Reference(value[:, :3], value[:, 3], value[:, 4], error + rounding, count)


def _judged(first: _Level, second: _Level, third: _Level) -> tuple[Array, Array]:
    """The best values that three marches give, and what they may be off by, (R, 5) each."""
    before, last = second.seen - first.seen, third.seen - second.seen
    extrapolated = third.seen + last / 3
    change = np.abs(extrapolated - (second.seen + before / 3))
    with np.errstate(divide="ignore", invalid="ignore"):
        order = np.log2(np.abs(before / last))
    as_expected = (np.abs(order - 2) < _ORDER_TOLERANCE) | (last == 0)
    value = np.where(as_expected, extrapolated, third.seen)
    tight = np.maximum(change, np.minimum(third.rough, third.rough_extrapolated))
    plain = np.maximum(np.abs(last), third.rough)
    return value, np.where(as_expected, tight, plain)


def _in_scene(estimate: Reference, segments: RaySegments) -> Reference:
    """The same with depths in scene space, where rays were projected."""
    ndc = segments.ndc
    if ndc is None:
        return estimate
    float_type = type(ndc.length)

    def distance(s: Array) -> Array:
        return np.array(ndc.to_distance(upload(float_type, s)))

    error, s = estimate.error.copy(), estimate.depth
    visible = estimate.opacity > 0
    depth = np.where(visible, distance(s), 0)
    ends = [np.abs(distance(s + sign * error[:, 4]) - depth) for sign in (-1, 1)]
    error[:, 4] = np.where(visible, np.maximum(*ends), 0)
    return replace(estimate, depth=depth, error=error)


# ---- One march -----------------------------------------------------------------


class _March:
    """Rays through a field, ready to be marched along at any fineness."""

    def __init__(
        self,
        field: Field,
        o: Vectors,
        d: Vectors,
        occupancy: OccupancyGrid | None,
        bounds: tuple[Any, Any],
        block: int,
    ) -> None:
        self._float = type(o[0])
        self._occupancy = occupancy
        self._block = block
        self._ask: Ask = field.fused() or field.density_emission
        double = dr.float64_array_t(self._float)
        vector3 = vector3_type(double)
        limits = tuple(b if b is None or isinstance(b, int | float) else double(b) for b in bounds)
        self.segments = ray_segments(field, vector3(o), vector3(d), (limits[0], limits[1]))
        rays = max(len(o[0]), len(d[0]))
        s = self.segments
        self._o, self._d, self._view = (
            np.broadcast_to(np.array(v, np.float64).T, (rays, 3)) for v in (s.o, s.d, s.view)
        )
        self._near, self.far = (
            np.broadcast_to(np.array(v, np.float64), (rays,)) for v in (s.near, s.far)
        )
        self.length = self.far - self._near
        self.rounding = 4 * float(dr.epsilon(self._float))  # relative, of what the field says

    def at(self, rays: NDArray[np.int64], intervals: int) -> _Level:
        """Marches along some of the rays, as many at a time as memory allows."""
        size = max(1, _SAMPLES // intervals)
        parts = [
            self._part(rays[start : start + size], intervals) for start in range(0, len(rays), size)
        ]
        return _Level(*(np.concatenate(p) for p in zip(*parts, strict=True)))

    def _part(self, rays: NDArray[np.int64], intervals: int) -> tuple[Array, Array, Array]:
        near, length = self._near[rays], self.length[rays]
        h = length[:, None] / intervals
        # Depths from where the ray enters the box: the middles of intervals, and both ends.
        place = np.concatenate([np.arange(intervals) + 0.5, [0, intervals]])
        t = near[:, None] + place * h
        p = self._o[rays, None] + t[..., None] * self._d[rays, None]
        view = np.broadcast_to(self._view[rays, None], p.shape)
        density, emission, asked = self._query(p.reshape(-1, 3), view.reshape(-1, 3))
        emission = _spread(emission.reshape(*t.shape, 3), asked.reshape(t.shape))
        tau, ends = np.split(density.reshape(t.shape) * h, [intervals], axis=1)
        channels = np.concatenate([emission, (place * h)[..., None]], axis=-1).transpose(0, 2, 1)[
            ..., :intervals
        ]
        total = np.cumsum(tau, axis=1)
        through = np.exp(-np.concatenate([0 * h, total], axis=1))  # at the ends of intervals
        weights = through[:, :-1] * -np.expm1(-tau)
        opacity = -np.expm1(-total[:, -1])
        moments = np.einsum("rn,rcn->rc", weights, channels)
        bounds = _roughness(tau, ends, channels, weights, through)

        # ---- The depth is a quotient; its error follows from that of both ----
        visible = opacity > 0
        share = np.where(visible, opacity, 1)
        mean = moments[:, 3] / share
        for bound in bounds:
            off = np.minimum((bound[:, 4] + mean * bound[:, 3]) / share, length)
            unseen = np.where(bound[:, 3] > 0, near + length, 0)
            bound[:, 4] = np.where(visible, off, unseen)
        depth = np.where(visible, near + mean, 0)
        return np.column_stack([moments[:, :3], opacity, depth]), *bounds

    def _query(self, p: Array, view: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """σ and emitted colour at M points, (M,) and (M, 3), and where the field was asked.

        Elsewhere, in cells marked as empty, both are 0.
        """
        density, emission = np.zeros(len(p)), np.zeros((len(p), 3))
        asked = np.ones(len(p), bool)
        if self._occupancy is not None:
            for part, pad in self._blocks(np.arange(len(p))):
                seen = self._occupancy.occupied(self._occupancy.cell(self._vectors(p[pad])))
                asked[part] = np.array(seen)[: len(part)]
        for part, pad in self._blocks(np.flatnonzero(asked)):
            sigma, color = self._ask(self._vectors(p[pad]), self._vectors(view[pad]))
            dr.eval(sigma, color)
            density[part] = np.array(sigma)[: len(part)]
            for channel, values in zip(emission.T, color, strict=True):
                channel[part] = np.array(values)[: len(part)]
        return density, emission, asked

    def _blocks(self, index: NDArray[np.int64]) -> Iterator[tuple[Any, Any]]:
        """Parts of an index, and the same padded to a constant size."""
        for start, size in ranges(len(index), self._block):
            part = index[start : start + size]
            yield part, np.pad(part, (0, size - len(part)), mode="edge")

    def _vectors(self, v: Array) -> Vectors:
        return vector3_type(self._float)(*(upload(self._float, row) for row in v.T))


def _spread(emission: Array, asked: NDArray[np.bool_]) -> Array:
    """Colours of (R, S) samples, those not asked for as at the last one that was, if any.

    Where nothing is emitted any colour is right, and the least change of it the best.
    """
    if asked.all():
        return emission
    last = np.maximum.accumulate(np.where(asked, np.arange(asked.shape[1]), -1), axis=1)
    last = np.where(last < 0, np.argmax(asked, axis=1)[:, None], last)
    return np.take_along_axis(emission, last[..., None], axis=1)


def _roughness(
    tau: Array, ends: Array, c: Array, weights: Array, through: Array
) -> tuple[Array, Array]:
    """What a march may be off by, itself and extrapolated, by differences of its samples.

    Optical depth up to an interval may be off by E = Σ ¼|δ²τ|, extrapolated Σ ⅙|δ⁴τ|, and
    transmittance T by T(exp(E) − 1). The error of ∫ c dA, with A = 1 − T, is by parts that
    of c·A at the far end less that of ∫ A dc, so that with constant c only the former
    remains. Within an interval, c may differ from that of the middle, and samples weigh
    more at its front: up to half an interval if it is opaque.

    Args:
        tau: (R, N) optical depths of the intervals.
        ends: (R, 2) those that the densities at both ends of the ray would make.
        c: (R, 4, N) red, green, blue and depth at their middles.
        weights: (R, N) of the intervals.
        through: (R, N + 1) transmittances at their ends.

    Returns:
        Bounds of red, green, blue, opacity and the sum of weighted depths, (R, 5) each.
    """
    slope = np.abs(np.diff(c, axis=2))
    around = np.zeros(c.shape)  # mean of the steps to both neighbours
    around[..., 1:] += 0.5 * slope
    around[..., :-1] += 0.5 * slope
    within = weights[:, None] * (
        np.minimum(0.5, tau / 12)[:, None] * around + 0.5 * _difference(c, 2)
    )
    inside = within.sum(axis=2), _difference(weights[:, None] * c, 4).sum(axis=2) / 6
    depths = _difference(tau, 2) / 4, _difference(tau, 4) / 6
    bounds = []
    for off, own, line in zip(depths, inside, _TO_THE_END, strict=True):
        off[:, 0] += 0.5 * np.abs(ends[:, 0] - tau[:, : len(line)] @ line)
        off[:, -1] += 0.5 * np.abs(ends[:, 1] - tau[:, : -len(line) - 1 : -1] @ line)
        growth = np.expm1(np.minimum(np.cumsum(off, axis=1), 50))
        shift = np.minimum(through[:, 1:] * growth, 1)
        behind = np.einsum("rn,rcn->rc", shift[:, :-1], slope)
        color = own + behind + np.abs(c[..., -1]) * shift[:, -1:]
        bounds.append(np.column_stack([color[:, :3], shift[:, -1], color[:, 3]]))
    return bounds[0], bounds[1]


def _difference(x: Array, order: int) -> Array:
    """|δx| of an even order along the last axis, 0 where neighbours are missing."""
    result = np.zeros(x.shape)
    half = order // 2
    result[..., half:-half] = np.abs(np.diff(x, n=order, axis=-1))
    return result
