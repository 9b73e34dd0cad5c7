"""The volume-rendering integral without quadrature: an unbiased estimate, ray by ray.

A ray collides at random with a medium of another density σ̄, the majorant. At a collision
where the field has density σ and emission c, with r = σ/σ̄,

    C ← C + T · r · c,    T ← T · (1 − r),

and what is left of T at the end is an estimate of the transmittance: ratio tracking
(Novák et al. 2014), with the emission of what would have been absorbed. Each step leaves
the expected value of C + T · (radiance from here on) as it was, whatever σ̄ > 0 is: where
the field is denser than its majorant, T changes its sign, the mean stays right. So may
majorants grow while rays are under way, as those of cells do where more is met.

The second moment of the transmittance is exp(∫ σ(r − 2) dt), at most 1 while r ≤ 2 and
finite as long as σ̄ > 0 where σ > 0. A weak T ends by Russian roulette.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr

from ..base.arrays import Floats, Indices, gather_vector3
from ..fields.protocol import Field
from ..march.blocks import ranges
from ..march.intervals import RaySegments
from ..march.strata import points_along
from .majorant import Majorants

# Rays under way at a time; others start as these end.
_SLOTS = 1 << 16
# Weights below this survive with a probability of weight/_WEAK.
_WEAK = 0.1
# A round of fewer queries than a block takes this many at a time.
_SMALL_BLOCK = 1024


@dataclass
class Tracked:
    """An estimate of what each of R rays sees, without background; R values each."""

    color: list[Floats]  # three channels, in the field's colour space
    opacity: Floats  # one minus the transmittance: right on average, not within [0, 1]
    queries: int  # collisions of all rays


@dataclass
class _Live:
    """Rays under way."""

    ray: Indices  # its number
    t: Floats  # how far it has come
    through: Floats  # T
    random: Any  # generators, one a ray

    def keep(self, where: Indices) -> _Live:
        """Those in the slots ``where``."""
        kept = dr.gather(_Live, self, where)
        dr.eval(kept)
        return kept


def track(
    field: Field,
    segments: RaySegments,
    majorants: Majorants,
    random: Any,
    *,
    grow: bool = False,
    block: int = 16384,
) -> Tracked:
    """Estimates what R rays see, each by one random walk; without derivatives.

    Args:
        segments: the rays, and where the field is.
        majorants: densities ≥ 0 over the field's box. Where they are 0, the field counts
            as empty.
        random: R independent generators (``PCG32``).
        grow: whether to raise the majorants of cells in which more is met.
        block: queries a network evaluation.
    """
    float_type = type(segments.near)
    with dr.suspend_grad():
        rays = max(len(segments.o[0]), len(segments.d[0]), len(random.state))
        color = [dr.zeros(float_type, rays) for _ in range(3)]
        remaining = dr.ones(float_type, rays)
        dr.make_opaque(color, remaining)
        ask, queries = _asker(field, block), 0
        for live, majorant, cell in _collisions(segments, majorants, random, rays):
            density, emission = ask(segments, live)
            queries += len(live.ray)
            ratio = density / majorant
            for channel, value in zip(color, emission, strict=True):
                dr.scatter_add(channel, live.through * ratio * value, live.ray)
            live.through = live.through * (1 - ratio)
            _roulette(live)
            dr.scatter(remaining, live.through, live.ray)
            if grow:
                majorants.raise_to(cell, density)
            dr.eval(color, remaining, live.through, live.random)
        return Tracked(color, 1 - remaining, queries)


def _collisions(
    segments: RaySegments, majorants: Majorants, random: Any, rays: int
) -> Iterator[tuple[_Live, Any, Any]]:
    """Rounds of one collision of each ray under way, with majorants and their cells.

    The caller updates T; rays without any are not heard of again.
    """
    float_type = type(segments.near)
    uint = dr.uint32_array_t(float_type)
    hit = dr.full(dr.mask_t(float_type), True, rays) & (segments.far > segments.near)
    waiting = uint(dr.compress(hit))
    started = 0
    live = _Live(uint(), float_type(), float_type(), None)
    while len(live.ray) or started < len(waiting):
        live, started = _refill(live, waiting, started, segments, random)
        depth = -dr.log(1 - live.random.next_float32())
        place, value, cell = majorants.collide(
            gather_vector3(segments.o, live.ray),
            gather_vector3(segments.d, live.ray),
            live.t,
            dr.gather(float_type, segments.far, live.ray),
            depth,
        )
        live.t = place
        dr.eval(live.t, live.random, value, cell)
        going = uint(dr.compress(value > 0))
        live = live.keep(going)
        if len(going):
            yield live, dr.gather(float_type, value, going), dr.gather(uint, cell, going)
            live = live.keep(uint(dr.compress(live.through != 0)))


def _refill(
    live: _Live, waiting: Any, started: int, segments: RaySegments, random: Any
) -> tuple[_Live, int]:
    """Starts waiting rays in free slots."""
    count = min(_SLOTS - len(live.ray), len(waiting) - started)
    if count <= 0:
        return live, started
    uint, float_type = type(waiting), type(live.t)
    slot = dr.arange(uint, count) + dr.opaque(uint, started)
    ray = dr.gather(uint, waiting, slot)
    new = _Live(
        ray,
        dr.gather(float_type, segments.near, ray),
        dr.ones(float_type, count),
        dr.gather(type(random), random, ray),
    )
    dr.eval(new.ray, new.t, new.through, new.random)
    if not len(live.ray):
        return new, started + count
    generators = type(random)()
    generators.state = dr.concat([live.random.state, new.random.state])
    generators.inc = dr.concat([live.random.inc, new.random.inc])
    ray, t, through = (
        dr.concat([getattr(live, name), getattr(new, name)]) for name in ("ray", "t", "through")
    )
    return _Live(ray, t, through, generators), started + count


def _roulette(live: _Live) -> None:
    """Ends rays of little weight at random, and gives their weight to the others."""
    weight = dr.abs(live.through)
    weak = weight < _WEAK
    survives = live.random.next_float32() * _WEAK < weight
    strengthened = dr.select(survives, dr.copysign(type(weight)(_WEAK), live.through), 0)
    live.through = dr.select(weak, strengthened, live.through)


def _asker(field: Field, block: int) -> Callable[[RaySegments, _Live], tuple[Floats, list[Floats]]]:
    """Density and emission where rays collide, in blocks that compile once."""
    fused = field.fused()
    ask = fused or field.density_emission

    def query(segments: RaySegments, live: _Live) -> tuple[Floats, list[Floats]]:
        p = points_along(segments.o, segments.d, live.t, live.ray)
        density, emission = ask(p, gather_vector3(segments.view, live.ray))
        dr.eval(density, emission)
        return density, emission

    def in_blocks(segments: RaySegments, live: _Live) -> tuple[Floats, list[Floats]]:
        count, float_type, uint = len(live.ray), type(live.t), type(live.ray)
        outputs = [dr.zeros(float_type, count) for _ in range(4)]
        for start, size in ranges(count, block, _SMALL_BLOCK):
            slot = dr.arange(uint, size) + dr.opaque(uint, start)
            valid = slot < dr.opaque(uint, count)
            density, emission = query(segments, live.keep(dr.select(valid, slot, 0)))
            for output, value in zip(outputs, (density, *emission), strict=True):
                dr.scatter(output, value, slot, valid)
            dr.eval(outputs)
        return outputs[0], outputs[1:]

    return in_blocks if fused is None else query
