"""Rays that have samples to ask for, against plain indexing."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mi_nerf.cameras.ndc import NdcRays
from mi_nerf.march.samples import Samples, rays_with_samples


def _vectors(rng: np.random.Generator, rays: int) -> Any:
    return mi.Vector3f(*(mi.Float(rng.random(rays)) for _ in range(3)))


def _some(rays: int, count: int, index: list[int], seed: int, ndc: bool = False) -> Samples:
    rng = np.random.default_rng(seed)
    near, far = mi.Float(rng.random(rays)), mi.Float(1 + rng.random(rays))
    t, delta = (mi.Float(rng.random(rays * count)) for _ in range(2))
    o, d, view = (_vectors(rng, rays) for _ in range(3))
    projected = None
    if ndc:
        length, start, slope = (mi.Float(rng.random(rays)) for _ in range(3))
        facing = mi.Bool(rng.random(rays) < 0.5)
        projected = NdcRays(o, d, length, facing, mi.Float(1), start, slope)
    asked = mi.UInt32(index)
    return Samples(o, d, view, t, delta, count, near, far, index=asked, ndc=projected)


@given(st.data(), st.integers(1, 40), st.integers(1, 9), st.integers(0, 1 << 16))
@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_rays_and_samples_are_those_that_are_asked(
    variant: str, data: st.DataObject, rays: int, count: int, seed: int
) -> None:
    asked = sorted(data.draw(st.sets(st.integers(0, rays * count - 1), min_size=1)))
    samples = _some(rays, count, asked, seed)
    kept, numbers = rays_with_samples(samples)

    wanted = sorted({i // count for i in asked})
    assert np.array(numbers).tolist() == wanted
    assert kept.rays == len(wanted) and kept.count == count
    for name in ("o", "d", "view"):
        whole, part = (np.array(getattr(s, name)) for s in (samples, kept))
        assert np.array_equal(part, whole[:, wanted])
    for name in ("near", "far"):
        assert np.array_equal(getattr(kept, name), np.array(getattr(samples, name))[wanted])
    for name in ("t", "delta"):
        whole = np.array(getattr(samples, name)).reshape(rays, count)
        assert np.array_equal(np.array(getattr(kept, name)).reshape(-1, count), whole[wanted])
        here = np.array(getattr(kept, name))[np.array(kept.index)]
        assert np.array_equal(here, whole.ravel()[asked])


def test_projected_rays_go_with_them(variant: str) -> None:
    samples = _some(5, 2, [2, 3, 9], 0, ndc=True)
    kept, _ = rays_with_samples(samples)
    assert samples.ndc is not None and kept.ndc is not None
    distance = np.array(samples.ndc.to_distance(mi.Float(0.1)))
    assert np.array(kept.ndc.to_distance(mi.Float(0.1))) == pytest.approx(distance[[1, 4]])
    assert np.array_equal(kept.ndc.facing, np.array(samples.ndc.facing)[[1, 4]])
    assert dr.width(kept.ndc.near) == 1
