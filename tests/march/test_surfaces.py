"""Opacity, distance and normal of a field's surfaces against formulas in float64."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest

from mi_nerf.cameras.ndc import Ndc
from mi_nerf.cameras.pinhole import Intrinsics
from mi_nerf.fields.closed_form import closed_form
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.settings import MarchSettings
from mi_nerf.march.surfaces import field_surfaces, surfaces_along
from mi_nerf.march.view import render_view
from tests.support.datasets import exact_rays, orbit_poses

CAMERA = Intrinsics.from_angle_x(14, 10, 0.5)
POSE = orbit_poses(5, height=1.3)[2]


def test_an_opaque_ball(ad: Any) -> None:
    """A shell so dense that light ends within 0.002 of its surface, where it is met."""
    shell = {"inner": 0.3, "outer": 0.6, "density": 4000.0, "edge": 2e-3, "center": (0.1, 0, 0.05)}
    marched = MarchedField(closed_form("shell", shell, ad.TensorXf), MarchSettings(samples=4096))
    found = field_surfaces(marched, CAMERA, POSE, ad)
    o, d = exact_rays(CAMERA, POSE)
    offset = o - shell["center"]
    b = d @ offset
    square = 0.6**2 - (offset @ offset - b * b)
    inside = square > 0.02  # not the rim, where the edge is crossed at a slant
    distance = -b - np.sqrt(np.maximum(square, 0))
    normal = (offset + distance[..., None] * d) / 0.6
    assert inside.sum() > 20 and (square < -0.05).sum() > 20
    assert found.opacity[inside] == pytest.approx(1, abs=1e-5)
    assert np.all(found.opacity[square < -0.05] == 0)
    assert found.depth[inside] == pytest.approx(distance[inside], abs=4e-3)
    assert found.normal is not None
    # Shorter where part of the light ends within, where density is even.
    length = np.linalg.norm(found.normal, axis=-1)[inside]
    assert np.all((length > 0.5) & (length < 1 + 1e-5))
    cosine = np.sum(found.normal * normal, axis=-1)[inside] / length
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 1.5
    assert np.all(found.normal[square < -0.05] == 0) and np.all(found.depth[square < -0.05] == 0)


@pytest.mark.parametrize("density", [2.0, 40.0])
def test_a_gaussian_by_dense_sums(density: float, ad: Any) -> None:
    """Mean distance and mean unit normal under T·σ, by 20,000 samples in float64."""
    numbers = {"center": (0.1, -0.1, 0.0), "width": 0.25, "peak": density}
    field = closed_form("gaussian", numbers, ad.TensorXf)
    marched = MarchedField(field, MarchSettings(samples=1024, chunk=1 << 14))
    found = field_surfaces(marched, CAMERA, POSE, ad)
    o, d = exact_rays(CAMERA, POSE)
    t, step = np.linspace(2, 6.5, 20_000, retstep=True)
    for row, column in ((2, 4), (4, 7), (5, 6), (7, 9)):
        p = o + t[:, None] * d[row, column] - numbers["center"]
        inside = np.all(np.abs(p) <= 4.5 * 0.25, axis=1)
        sigma = np.where(inside, density * np.exp(-np.sum(p * p, axis=1) / (2 * 0.25**2)), 0)
        tau = sigma * step
        weights = np.exp(-(np.cumsum(tau) - tau)) * -np.expm1(-tau)
        opacity = weights.sum()
        unit = p / np.linalg.norm(p, axis=1, keepdims=True)
        assert found.opacity[row, column] == pytest.approx(opacity, abs=2e-3)
        assert found.depth[row, column] == pytest.approx(weights @ t / opacity, abs=5e-3)
        assert found.normal is not None
        assert found.normal[row, column] == pytest.approx(weights @ unit / opacity, abs=5e-3)


def test_distances_are_those_of_pictures(ad: Any) -> None:
    field = closed_form("gaussian", {"peak": 30.0}, ad.TensorXf)
    marched = MarchedField(field, MarchSettings(samples=64, stop=1e-3))
    found = field_surfaces(marched, CAMERA, POSE, ad, normals=False)
    view = render_view(marched, CAMERA, POSE, ad)
    assert found.normal is None
    assert found.opacity == pytest.approx(view.opacity, abs=1e-5)
    assert found.depth == pytest.approx(view.depth, abs=1e-4)


def test_no_normals_in_normalised_device_coordinates(ad: Any) -> None:
    field = closed_form("slab", {"density": 3.0}, ad.TensorXf)
    field.ndc = Ndc(2.0, 2.0)
    found = field_surfaces(MarchedField(field, MarchSettings(samples=8)), CAMERA, np.eye(4), ad)
    assert found.normal is None and found.depth.max() > 1


def test_another_view_compiles_nothing(ad: Any) -> None:
    field = closed_form("gaussian", {"peak": 30.0}, ad.TensorXf)
    marched = MarchedField(field, MarchSettings(samples=64))
    poses = orbit_poses(4, height=0.4)
    for pose in poses[:2]:
        field_surfaces(marched, CAMERA, pose, ad)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        field_surfaces(marched, CAMERA, poses[3], ad)
        history = dr.kernel_history([dr.KernelType.JIT])
    assert history and all(entry["cache_hit"] for entry in history)


def test_rays_that_miss_the_box(ad: Any) -> None:
    field = closed_form("gaussian", {}, ad.TensorXf)
    o, d = ad.Array3f([0, 0], [0, 0], [9, 9]), ad.Array3f([0, 0], [0, 1], [1, 0])
    found = surfaces_along(MarchedField(field, MarchSettings(samples=8)), o, d)
    assert len(found) == 5 and all(np.all(np.array(v) == 0) for v in found)
