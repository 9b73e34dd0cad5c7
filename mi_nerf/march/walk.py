"""Marches rays through a field in one kernel: a loop from one occupied sample to the next.

Each ray walks over its strata, leaving empty bricks of the occupancy grid at once, asks the
field where it may be dense, and ends at its transmittance. The samples are those that
:mod:`mi_nerf.march.placing` keeps, to the last bit, and so is what a ray sees, but for the
order in which sums are rounded; it ends at the very sample behind which less than ``stop``
passes, not after the round in which that was noticed. Nothing is stored but a few numbers a
ray. There are no derivatives.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from ..base.arrays import Floats, Indices, Mask, Vectors, vector3_type
from .intervals import RaySegments, ray_segments
from .marched import MarchedField
from .occupancy import OccupancyGrid
from .rules import one_minus_exp, opaque_at_most


@dataclass
class Walked:
    """What R rays have seen; without colour and depth if only density was asked for."""

    color: list[Floats]  # three arrays of R values, premultiplied by the opacity
    optical_depth: Floats  # R values
    opacity: Floats  # R values in [0, 1]
    depth: Floats  # R values: mean distance under the weights, scene units; 0 where none
    queries: Indices  # R numbers: how often the field was asked


def can_walk(marched: MarchedField) -> bool:
    """Whether a field may be asked within a kernel, and its samples are found one by one."""
    settings, field = marched.settings, marched.field
    refined = field.coarse is not None and settings.fine > 0
    if settings.rule != "constant" or settings.hidden > 0 or refined:
        return False
    return field.fused(emission=False) is not None


def walk_rays(
    marched: MarchedField,
    o: Vectors,
    d: Vectors,
    *,
    jitter: Floats = None,
    bounds: tuple[Any, Any] = (None, None),
    emission: bool = True,
) -> Walked:
    """Marches the rays ``o + t·d`` of a field for which :func:`can_walk` holds.

    Args:
        jitter, bounds: as for :func:`mi_nerf.march.placing.place_samples`; one number a ray.
        emission: whether colour is wanted.
    """
    field, settings = marched.field, marched.settings
    with dr.suspend_grad():
        within = ray_segments(field, o, d, (settings.near, settings.far), bounds)
        dr.eval(within.o, within.d, within.view, within.near, within.far)
        ask = field.fused_along(within.view) if emission else field.fused(emission=False)
        assert ask is not None
        path = _Path(within, settings.samples, jitter, marched.occupancy)
        tau, queries, *channels = _march(path, ask, settings.stop, emission)
        opacity = one_minus_exp(tau)
        depth = opacity
        if emission:
            depth = channels.pop() / dr.select(opacity > 0, opacity, 1)
            depth = depth if within.ndc is None else within.ndc.to_distance(depth)
            depth = dr.select(opacity > 0, depth, 0)
        dr.eval(channels, tau, opacity, depth, queries)
    return Walked(channels, tau, opacity, depth, queries)


class _Path:
    """The strata of rays, and where along them the next sample is that may be dense."""

    def __init__(
        self, within: RaySegments, samples: int, jitter: Floats, grid: OccupancyGrid | None
    ) -> None:
        self.hit, self.samples, self._grid = within.hit, samples, grid
        self._o, self._d, self._near = within.o, within.d, within.near
        self.width = (within.far - within.near) * (1 / samples)  # as stratified() has it
        float_type = type(within.near)
        self.vector = vector3_type(float_type)
        self._offset = float_type(0.5) if jitter is None else jitter
        if grid is None:
            return
        # Rays in units of cells: only to guess where bricks end.
        rate = [float(1 / size) for size in grid.cell_size]
        self._bits = grid.bits()
        self._start = [(within.o[i] - float(grid.lower[i])) * rate[i] for i in range(3)]
        slope = [within.d[i] * rate[i] for i in range(3)]
        self._ahead = [s > 0 for s in slope]
        # Where a ray runs along a face, another one is left before.
        self._pace = [
            dr.select(dr.abs(s) < 1e-20, dr.inf, 1 / dr.select(dr.abs(s) < 1e-20, 1, s))
            for s in slope
        ]

    def at(self, stratum: Indices) -> tuple[Floats, Vectors]:
        """Parameters and positions of the samples in strata of the rays."""
        float_type = type(self._near)
        t = dr.fma(float_type(stratum) + self._offset, self.width, self._near)
        return t, self.vector(*(dr.fma(t, self._d[i], self._o[i]) for i in range(3)))

    def next(self, stratum: Indices) -> Indices:
        """The next sample, from this one on, in an occupied cell; S behind the last one."""
        if self._grid is None:
            return stratum
        last = dr.uint32_array_t(type(self._near))(self.samples)

        def going(stratum: Indices, searching: Mask) -> Mask:
            return searching & (stratum < last)

        def step(stratum: Indices, searching: Mask) -> tuple[Indices, Mask]:
            stratum, found = self._step(stratum)
            return stratum, ~found

        searching = dr.mask_t(type(self._near))(True)
        stratum, _ = dr.while_loop(
            (stratum, searching), going, step, labels=("stratum", "searching")
        )
        return stratum

    def _step(self, stratum: Indices) -> tuple[Indices, Mask]:
        """Stays at a sample that may be dense, or leaves the empty brick around it."""
        assert self._grid is not None
        cell = self._grid.coordinates(self.at(stratum)[1])
        found, edge = self._bits.look(cell)
        brick = [c >> edge for c in cell]
        leave = type(self._near)(dr.inf)
        for i in range(3):
            face = type(leave)((brick[i] + dr.select(self._ahead[i], 1, 0)) << edge)
            time = (face - self._start[i]) * self._pace[i]
            leave = dr.select(time < leave, time, leave)
        guess = dr.floor((leave - self._near) / self.width - self._offset)
        guess = dr.fmin(dr.fmax(guess, type(leave)(stratum)), self.samples - 1)
        end = type(stratum)(guess)
        # Cells ascend or descend along a ray, rounding included: if this sample is still in
        # the brick, all before it are.
        inside = dr.mask_t(type(leave))(True)
        for c, b in zip(self._grid.coordinates(self.at(end)[1]), brick, strict=True):
            inside &= (c >> edge) == b
        beyond = dr.select(inside, end, stratum) + 1
        return dr.select(found, stratum, beyond), found


def _march(path: _Path, ask: Callable[..., Any], stop: float, emission: bool) -> list[Any]:
    """Optical depth, queries, and with ``emission`` the sums of colour and t under the weights."""
    float_type = type(path.width)
    uint = dr.uint32_array_t(float_type)
    rays, last = len(path.hit), uint(path.samples)
    limit = dr.opaque(float_type, -math.log(stop) if stop > 0 else dr.inf)
    sums = [dr.zeros(float_type, rays), dr.zeros(uint, rays)]
    sums += [dr.zeros(float_type, rays) for _ in range(4 if emission else 0)]

    def going(stratum: Indices, *_: Any) -> Mask:
        return stratum < last

    def step(stratum: Indices, tau: Floats, queries: Indices, *seen: Floats) -> tuple[Any, ...]:
        t, p = path.at(stratum)
        density, color = ask(p) if emission else (ask(p), [])
        own = opaque_at_most(density * path.width)
        weight = dr.exp(-tau) * one_minus_exp(own)
        values = [*color, t] if emission else []
        seen = tuple(dr.fma(weight, v, s) for v, s in zip(values, seen, strict=True))
        tau = tau + own
        stratum = path.next(dr.select(tau < limit, stratum + 1, last))
        return (stratum, tau, queries + 1, *seen)

    start = path.next(dr.select(path.hit, uint(0), last))
    names = ("stratum", "tau", "queries", "red", "green", "blue", "depth")
    state = dr.while_loop((start, *sums), going, step, labels=names[: len(sums) + 1])
    return list(state[1:])
