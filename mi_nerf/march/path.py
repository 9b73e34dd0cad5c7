"""The strata of rays, and the next sample of each that may be dense."""

from __future__ import annotations

import drjit as dr

from ..base.arrays import Floats, Indices, Mask, Vectors, vector3_type
from .intervals import RaySegments
from .occupancy import OccupancyGrid


class Path:
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
