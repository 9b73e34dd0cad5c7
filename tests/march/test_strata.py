"""Ray intervals against exact rational arithmetic, and strata against their definition."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerf.march.intervals import box_interval, clip_interval
from mi_nerf.march.strata import points_along, stratified
from tests.support.arrays import vectors
from tests.support.boxes import awkward_rays, slow_interval

LOWER, UPPER = (-1.0, -0.5, -2.0), (1.0, 1.5, 0.25)


def fast_interval(
    ad: Any, o: np.ndarray, d: np.ndarray, lower: Any = LOWER, upper: Any = UPPER
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    near, far, hit = box_interval(vectors(ad, o), vectors(ad, d), lower, upper)
    near, far, hit = np.array(near), np.array(far), np.array(hit)
    assert np.isfinite(near).all() and np.isfinite(far).all()
    assert (near >= 0).all() and (far[hit] > near[hit]).all()
    assert not near[~hit].any() and not far[~hit].any()
    return near, far, hit


# ---- Rays against the box ---------------------------------------------------


def test_rays_that_meet_faces_edges_and_corners(ad: Any) -> None:
    """Coordinates and slopes for which float32 makes no error: every bit must be right."""
    o, d = awkward_rays(LOWER, UPPER, 6000)
    near, far, hit = fast_interval(ad, o, d)
    slow = [slow_interval(*ray, LOWER, UPPER) for ray in zip(o, d, strict=True)]
    assert np.array_equal(hit, [interval is not None for interval in slow])
    assert 1000 < hit.sum() < 5000
    bounds = np.array([(0, 0) if interval is None else interval for interval in slow], float)
    assert np.array_equal(np.stack([near, far], 1), bounds)


@pytest.mark.parametrize(
    ("o", "d", "expected"),
    [
        pytest.param((-3, 0, 0), (1, 0, -0.0), (2, 4), id="axis-parallel"),
        pytest.param((-3, 1.5, 0), (1, -0.0, 0), (2, 4), id="within a face"),
        pytest.param((-3, 1.5, 0.25), (1, 0, 0), (2, 4), id="along an edge"),
        pytest.param((-3, 1.75, 0), (1, 0, 0), None, id="parallel beside the box"),
        pytest.param((0, 0, 0), (0, 2, 0), (0, 0.75), id="from inside"),
        pytest.param((1, 0, 0), (-1, 0, 0), (0, 2), id="from a face, inwards"),
        pytest.param((1, 0, 0), (1, 0, 0), None, id="from a face, outwards"),
        pytest.param((3, 0, 0), (1, 0, 0), None, id="box behind"),
        pytest.param((0, 2.5, 0), (1, -1, 0), None, id="touches an edge"),
        pytest.param((-2, -1.5, -3), (1, 1, 1), (1, 3), id="through a corner"),
        pytest.param((0, 2.5, -0.75), (1, -1, 1), None, id="touches a corner"),
        pytest.param((0, 0, 0), (0, 0, 0), None, id="no direction"),
        pytest.param((-1, 0, 0), (1e-40, 1, 0), (0, 1.5), id="from a face, subnormal slope"),
        pytest.param((-1, 0, 0), (-1e-40, 1, 0), (0, 1.5), id="nearly parallel in a face"),
    ],
)
def test_named_rays(ad: Any, o: Any, d: Any, expected: Any) -> None:
    near, far, hit = fast_interval(ad, np.array([o], np.float32), np.array([d], np.float32))
    assert hit.tolist() == [expected is not None]
    assert (near[0], far[0]) == (expected or (0, 0))


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-3, 1, 1e4])
def test_random_rays(ad: Any, scale: float) -> None:
    lower, upper = (np.array(corner, np.float32) * np.float32(scale) for corner in (LOWER, UPPER))
    rng = np.random.default_rng(1)
    o = (rng.uniform(-3, 3, (2000, 3)) * scale).astype(np.float32)
    d = (rng.normal(size=(2000, 3)) * 10 ** rng.uniform(-6, 0, (2000, 3))).astype(np.float32)
    near, far, hit = fast_interval(ad, o, d, lower.tolist(), upper.tolist())

    # Rounding moves each face by so much at most.
    slack = 4e-7 * np.maximum(np.maximum(np.abs(lower), np.abs(upper)), np.abs(o)).astype(float)
    tight, loose = 0, 0
    for i in range(len(o)):
        inner = slow_interval(o[i], d[i], lower + slack[i], upper - slack[i])
        outer = slow_interval(o[i], d[i], lower - slack[i], upper + slack[i])
        if hit[i]:
            assert outer is not None
            assert outer[0] <= near[i] and far[i] <= outer[1]
            loose += 1
        if inner is not None:
            assert hit[i]
            assert near[i] <= inner[0] and inner[1] <= far[i]
            tight += 1
    assert 100 < tight <= loose < 1900


# ---- Bounds -----------------------------------------------------------------

number = st.floats(0, 8, width=32)
rays = st.lists(st.tuples(number, number, st.booleans()), min_size=5, max_size=5)


@given(rays=rays, near=st.none() | number, far=st.none() | number)
def test_clip_interval(ad: Any, rays: Any, near: float | None, far: float | None) -> None:
    start, stop, hit = (np.array(column) for column in zip(*rays, strict=True))
    result = clip_interval(ad.Float(start), ad.Float(stop), ad.Bool(hit), near, far)
    low = [s if near is None else max(s, near) for s in start]
    high = [s if far is None else min(s, far) for s in stop]
    valid = [h and a < b for h, a, b in zip(hit, low, high, strict=True)]
    assert np.array(result[2]).tolist() == valid
    assert np.array(result[0]).tolist() == [a if v else 0 for a, v in zip(low, valid, strict=True)]
    assert np.array(result[1]).tolist() == [b if v else 0 for b, v in zip(high, valid, strict=True)]


def test_clip_interval_ray_by_ray(ad: Any) -> None:
    near, far, hit = clip_interval(
        ad.Float([0, 1, 2]), ad.Float(5), ad.Bool(True), ad.Float([1, 0, 6]), ad.Float([9, 4, 9])
    )
    assert (list(near), list(far), list(hit)) == ([1, 1, 0], [5, 4, 0], [True, True, False])


def test_other_bounds_reuse_the_kernel(ad: Any) -> None:
    def kernels(near: float, far: float) -> list[str]:
        start, stop = dr.zeros(ad.Float, 64), dr.full(ad.Float, 9, 64)
        hit = dr.full(ad.Bool, True, 64)
        dr.make_opaque(start, stop, hit)
        dr.kernel_history_clear()
        dr.eval(clip_interval(start, stop, hit, near, far))
        return [str(entry["hash"]) for entry in dr.kernel_history([dr.KernelType.JIT])]

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        assert kernels(1.0, 2.0) == kernels(0.5, 3.0) != []


# ---- Strata -----------------------------------------------------------------


def bounds(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    near = rng.uniform(0, 3, count).astype(np.float32)
    return near, (near + rng.uniform(0.1, 5, count)).astype(np.float32)


@pytest.mark.parametrize("samples", [1, 2, 7, 64])
@pytest.mark.parametrize("count", [1, 5])
@pytest.mark.parametrize("form", ["middle", "per ray", "per sample"])
def test_stratified(ad: Any, count: int, samples: int, form: str) -> None:
    rng = np.random.default_rng(2)
    near, far = bounds(rng, count)
    if form == "middle":
        jitter, offset = None, np.full((count, samples), 0.5)
    else:
        offset = rng.random((count, 1 if form == "per ray" else samples), np.float32)
        jitter = ad.Float(offset.ravel())
    t, delta = stratified(ad.Float(near), ad.Float(far), samples, jitter)
    t, delta = np.array(t).reshape(count, samples), np.array(delta).reshape(count, samples)

    edges = np.linspace(near.astype(float), far.astype(float), samples + 1, axis=1)
    assert delta == pytest.approx(np.diff(edges), rel=1e-5)
    assert delta.sum(axis=1, dtype=float) == pytest.approx(far.astype(float) - near, rel=1e-6)
    slack = 1e-6 * far[:, None]
    assert (edges[:, :-1] - slack <= t).all() and (t <= edges[:, 1:] + slack).all()
    place = edges[:, :-1] + np.diff(edges) * offset
    assert t == pytest.approx(place, abs=2e-6)
    assert (np.diff(t) > 0).all() or form == "per sample"


def test_rays_that_miss_have_samples_of_no_width(ad: Any) -> None:
    t, delta = stratified(ad.Float([0, 1]), ad.Float([0, 2]), 2)
    assert (list(t), list(delta)) == ([0, 0, 1.25, 1.75], [0, 0, 0.5, 0.5])


def test_one_jitter_for_all_rays(ad: Any) -> None:
    t, _ = stratified(ad.Float([0, 2]), ad.Float([2, 4]), 2, ad.Float(0.25))
    assert list(t) == [0.25, 1.25, 2.25, 3.25]


@pytest.mark.parametrize(("precision", "tolerance"), [("32", 1e-5), ("64", 1e-13)])
def test_points_along(ad: Any, precision: str, tolerance: float) -> None:
    rng = np.random.default_rng(3)
    o, d = rng.normal(size=(2, 4, 3)).astype(np.float32)
    t = rng.uniform(0, 9, 12).astype(np.float32)
    ray = np.repeat(np.arange(4), 3)
    Float = getattr(ad, "Float" + precision)
    origins, directions = vectors(ad, o, precision), vectors(ad, d, precision)
    p = points_along(origins, directions, Float(t), ad.UInt32(ray))
    expected = o[ray].astype(float) + t[:, None].astype(float) * d[ray]
    assert np.array(p).T == pytest.approx(expected, abs=tolerance)
    # One origin may serve all rays.
    p = points_along(vectors(ad, o[:1], precision), directions, Float(t), ad.UInt32(ray))
    assert np.array(p).T == pytest.approx(expected - o[ray] + o[0], abs=10 * tolerance)
