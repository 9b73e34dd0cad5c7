"""Normalised device coordinates against projection by the 4x4 matrix, in double precision."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerf.cameras.ndc import Ndc, NdcRays
from tests.support.arrays import unit, vectors

TOLERANCE = {"32": 2e-5, "64": 1e-13}


def rays(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Origins around the origin, some beyond the near plane, and unit directions ahead."""
    rng = np.random.default_rng(seed)
    d = rng.uniform(-1, 1, (count, 3))
    d[:, 2] = rng.uniform(-1.5, -0.3, count)
    o = rng.uniform(-1.5, 1.5, (count, 3))
    return o.astype(np.float32), unit(d).astype(np.float32)


def slow_projection(ndc: Ndc, p: np.ndarray) -> np.ndarray:
    """Points, (..., 3), through the matrix and the division that follows it."""
    clip = np.concatenate([p, np.ones_like(p[..., :1])], axis=-1) @ ndc.matrix().T
    return clip[..., :3] / clip[..., 3:]


def mapped(ad: Any, ndc: Ndc, o: Any, d: Any, precision: str = "64") -> NdcRays:
    return ndc.rays(vectors(ad, o, precision), vectors(ad, d, precision))


def floats(ad: Any, values: Any, precision: str = "64") -> Any:
    return (ad.Float32 if precision == "32" else ad.Float64)(np.array(values))


ndcs = st.builds(Ndc, st.floats(0.3, 5), st.floats(0.3, 5), st.floats(0.1, 3))


# ---- The matrix --------------------------------------------------------------


@pytest.mark.slow
@given(ndcs)
def test_the_matrix_carries_the_frustum_into_the_cube(ndc: Ndc) -> None:
    """Corners of the near plane, and points far away along the edges of the frustum."""
    for depth, z in ((ndc.near, -1.0), (1e9, 1.0)):
        for x, y in ((1, 1), (-1, 1), (1, -1)):
            corner = depth * np.array([x / ndc.scale_x, y / ndc.scale_y, -1])
            assert np.allclose(slow_projection(ndc, corner), (x, y, z), atol=1e-7)


def test_opengl_matrix_in_the_limit() -> None:
    """Appendix C writes −(f + n)/(f − n) and −2fn/(f − n); here f → ∞."""
    n, far = 0.7, 1e12
    assert np.isclose(Ndc(1, 1, n).matrix()[2, 2], -(far + n) / (far - n))
    assert np.isclose(Ndc(1, 1, n).matrix()[2, 3], -2 * far * n / (far - n))


# ---- Rays --------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["32", "64"])
@given(ndc=ndcs, seed=st.integers(0, 1 << 16))
def test_projected_points_lie_on_the_projected_ray(
    ad: Any, precision: str, ndc: Ndc, seed: int
) -> None:
    """π(o + t·d) = o' + t'·d', with t' from its own formula, at many t beyond the near plane."""
    o, d = rays(32, seed)
    result = mapped(ad, ndc, o, d, precision)
    o64, d64 = o.astype(float), d.astype(float)
    crossing = -(ndc.near + o64[:, 2]) / d64[:, 2]
    for ahead in (1e-3, 0.1, 1.0, 10.0, 1e4):
        t = crossing + ahead
        expected = slow_projection(ndc, o64 + t[:, None] * d64)
        s = result.from_distance(floats(ad, t, precision))
        found = np.array(result.o + s * result.d).T
        # A shallow ray meets the near plane far away: errors are relative to that.
        size = 1 + np.abs(expected).max(axis=1) + np.abs(np.array(result.o)).max(axis=0)
        assert (np.abs(found - expected).max(axis=1) < TOLERANCE[precision] * size * 10).all()


@pytest.mark.slow
@given(ndc=ndcs, seed=st.integers(0, 1 << 16))
def test_origin_direction_and_parameter_by_the_paper(ad: Any, ndc: Ndc, seed: int) -> None:
    """The formulas of appendix C written out, with the origin on the near plane."""
    o, d = (v.astype(float) for v in rays(32, seed))
    o_n = o - (ndc.near + o[:, 2:]) / d[:, 2:] * d
    ox, oy, oz = o_n.T
    dx, dy, dz = d.T
    sx, sy, n = ndc.scale_x, ndc.scale_y, ndc.near
    expected_o = np.stack([-sx * ox / oz, -sy * oy / oz, 1 + 2 * n / oz], axis=1)
    expected_d = np.stack(
        [-sx * (dx / dz - ox / oz), -sy * (dy / dz - oy / oz), -2 * n / oz], axis=1
    )
    result = mapped(ad, ndc, o, d)
    length = np.array(result.length)
    assert np.allclose(np.array(result.o).T, expected_o, rtol=1e-11)
    assert np.allclose(np.array(result.d).T * length[:, None], expected_d, rtol=1e-11)
    for t in (0.01, 0.5, 3.0, 100.0):
        parameter = 1 - oz / (oz + t * dz)
        s = np.array(result.from_distance(floats(ad, t - (n + o[:, 2]) / dz)))
        assert np.allclose(s / length, parameter, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
@given(ndc=ndcs, seed=st.integers(0, 1 << 16))
def test_end_points(ad: Any, ndc: Ndc, seed: int) -> None:
    """t' = 0 and z' = −1 at the near plane; t' = 1 and z' = 1 at infinity."""
    o, d = rays(32, seed)
    result = mapped(ad, ndc, o, d)
    crossing = -(ndc.near + o[:, 2].astype(float)) / d[:, 2].astype(float)
    assert np.allclose(np.array(result.from_distance(floats(ad, crossing))), 0, atol=1e-6)
    assert np.allclose(np.array(result.o)[2], -1, atol=1e-14)
    infinity = np.array(result.from_distance(floats(ad, [np.inf])))
    assert np.array_equal(infinity, np.array(result.length))
    end = np.array(result.o + result.length * result.d)
    assert np.allclose(end[2], 1, atol=1e-12)
    vanishing = slow_projection(ndc, 1e12 * d.astype(float))
    assert np.allclose(end.T, vanishing, atol=1e-8)


@given(seed=st.integers(0, 1 << 16))
def test_distance_and_back(ad: Any, seed: int) -> None:
    ndc = Ndc(1.5, 2.0, 0.8)
    o, d = rays(32, seed)
    result = mapped(ad, ndc, o, d)
    crossing = -(ndc.near + o[:, 2].astype(float)) / d[:, 2].astype(float)
    for ahead in (1e-3, 0.1, 1.0, 10.0, 1e3):
        t = floats(ad, crossing + ahead)
        assert np.allclose(np.array(result.to_distance(result.from_distance(t))), np.array(t))
    assert np.isfinite(np.array(result.to_distance(result.length * 1.01))).all()


def test_bounds(ad: Any) -> None:
    """Nothing behind the camera, nor before the near plane, in the units of either side."""
    ndc = Ndc(1.0, 1.0)
    o = np.array([(0, 0, 0), (0, 0, -3), (0, 0, 2)], float)
    result = mapped(ad, ndc, o, np.tile((0.0, 0, -1), (3, 1)))
    near, far = result.bounds()
    # On the axis t' = 1 − 1/depth, and |d'| = 2.
    assert np.allclose(np.array(near), [0, 2 * (1 - 1 / 3), 0]) and far is None
    near, far = result.bounds(2, floats(ad, [4.0, 4.0, 4.0]))
    assert np.allclose(np.array(near), 2 * np.array([1 - 1 / 2, 1 - 1 / 5, 0]))
    assert np.allclose(np.array(far), 2 * np.array([1 - 1 / 4, 1 - 1 / 7, 1 - 1 / 2]))


def test_rays_that_do_not_face_forward(ad: Any) -> None:
    """They are marked, and nothing about them is NaN."""
    d = unit([(0, 0, 1), (1, 0, 0), (1, 0, -1e-8), (0, 0.2, -1)])
    result = mapped(ad, Ndc(1, 1), np.zeros((4, 3)), d, "32")
    assert np.array_equal(np.array(result.facing), [False, False, False, True])
    for values in (result.o, result.d, result.length, *result.bounds(0, 5)):
        assert np.isfinite(np.array(values)).all()


def test_one_kernel_for_all_projections(ad: Any) -> None:
    """Another projection is other data, not another program."""
    o, d = rays(16, 0)
    hashes = []
    for ndc in (Ndc(1.0, 1.5), Ndc(2.0, 0.5, 0.25)):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            mapped(ad, ndc, o, d, "32")
            kernels = [k for k in dr.kernel_history() if "hash" in k]
        hashes.append([k["hash"] for k in kernels if k["operation_count"] > 30])
    assert hashes[0] == hashes[1] and hashes[0]


@pytest.mark.parametrize("name", ["scale_x", "scale_y", "near"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("inf"), float("nan")])
def test_numbers_that_make_no_projection(name: str, value: float) -> None:
    numbers = {"scale_x": 1.0, "scale_y": 1.0, "near": 1.0, name: value}
    with pytest.raises(ValueError, match=f"{name}="):
        Ndc(**numbers)
