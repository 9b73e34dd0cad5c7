"""Errors of surfaces against loops over pixels, and against what was put in."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerf.cameras.pinhole import Intrinsics
from mi_nerf.data.surfaces import Surfaces
from mi_nerf.fields.closed_form import closed_form
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.settings import MarchSettings
from mi_nerf.march.surfaces import FieldSurfaces, field_surfaces
from mi_nerf.tasks.geometry import surface_figures
from tests.support.datasets import exact_rays, orbit_poses

CAMERA = Intrinsics.from_angle_x(6, 5, 0.6)


def some_surfaces(seed: int) -> tuple[FieldSurfaces, Surfaces]:
    """A field and a truth that agree more or less, with holes in both."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(1, 5, (5, 6))
    depth[rng.random((5, 6)) < 0.3] = 0
    normal = rng.normal(size=(5, 6, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    found = FieldSurfaces(
        rng.random((5, 6)).astype(np.float32),
        (depth * rng.uniform(0.9, 1.1, (5, 6))).astype(np.float32),
        (normal * 0.7 + 0.3 * rng.normal(size=(5, 6, 3))).astype(np.float32),
    )
    return found, Surfaces(CAMERA, depth.astype(np.float32), normal.astype(np.float32))


@given(st.integers(0, 1000))
def test_figures_by_loops(seed: int) -> None:
    found, true = some_surfaces(seed)
    assert found.normal is not None and true.normal is not None
    errors, angles, either, both = [], [], 0, 0
    for y in range(5):
        for x in range(6):
            opaque, there = found.opacity[y, x] >= 0.5, true.depth[y, x] > 0
            either, both = either + (opaque or there), both + (opaque and there)
            if opaque and there:
                exact = float(true.depth[y, x])
                errors.append(abs(float(found.depth[y, x]) - exact) / exact)
                a, b = (v.astype(np.float64) for v in (found.normal[y, x], true.normal[y, x]))
                cosine = a @ b / (np.linalg.norm(a) * np.linalg.norm(b))
                angles.append(math.degrees(math.acos(np.clip(cosine, -1, 1))))
    figures = surface_figures(found, true)
    assert figures["silhouette_iou"] == pytest.approx(both / either)
    errors.sort()
    place = 0.95 * (len(errors) - 1)
    low = int(place)
    high = min(low + 1, len(errors) - 1)
    assert figures["depth_error"] == pytest.approx(float(np.median(errors)))
    assert figures["depth_error_95"] == pytest.approx(
        errors[low] + (place - low) * (errors[high] - errors[low])
    )
    assert figures["normal_error"] == pytest.approx(np.mean(angles), abs=1e-4)


def test_perfect_surfaces() -> None:
    _, true = some_surfaces(0)
    there = true.depth > 0
    found = FieldSurfaces(there.astype(np.float32), true.depth, true.normal)
    assert surface_figures(found, true) == {
        "depth_error": 0.0,
        "depth_error_95": 0.0,
        "normal_error": 0.0,
        "silhouette_iou": 1.0,
    }


def test_known_errors() -> None:
    """Distances 10 % too large, normals turned by 30 degrees, half of the pixels missing."""
    depth = np.full((4, 6), 2.0, np.float32)
    true = Surfaces(CAMERA, depth, np.tile(np.float32([0, 0, 1]), (4, 6, 1)))
    opacity = np.zeros((4, 6), np.float32)
    opacity[:, :3] = 1
    angle = np.radians(30)
    turned = np.tile(np.float32([0, 5 * np.sin(angle), 5 * np.cos(angle)]), (4, 6, 1))
    figures = surface_figures(FieldSurfaces(opacity, 1.1 * depth, turned), true)
    assert figures["depth_error"] == figures["depth_error_95"] == pytest.approx(0.1, rel=1e-6)
    assert figures["normal_error"] == pytest.approx(30, rel=1e-6)
    assert figures["silhouette_iou"] == 0.5
    covered = opacity > 0  # the silhouette that the images say
    assert surface_figures(FieldSurfaces(opacity, depth, turned), true, covered)[
        "silhouette_iou"
    ] == 1.0  # fmt: skip


def test_without_a_normal_the_angle_is_a_right_one() -> None:
    found, true = some_surfaces(1)
    blind = replace(found, normal=np.zeros((5, 6, 3), np.float32))
    assert surface_figures(blind, true)["normal_error"] == 90
    assert "normal_error" not in surface_figures(replace(found, normal=None), true)
    assert "normal_error" not in surface_figures(found, replace(true, normal=None))


def test_nothing_to_compare() -> None:
    found, true = some_surfaces(2)
    empty = replace(found, opacity=0 * found.opacity)
    figures = surface_figures(empty, true)
    assert math.isnan(figures["depth_error"]) and math.isnan(figures["normal_error"])
    assert figures["silhouette_iou"] == 0
    nothing = replace(true, depth=0 * true.depth)
    assert math.isnan(surface_figures(empty, nothing)["silhouette_iou"])


def test_a_ball_whose_surface_is_known(ad: Any, tmp_path: Path) -> None:
    """A dense shell as the field, a sphere of NumPy's as the truth."""
    shell = {"inner": 0.3, "outer": 0.6, "density": 4000.0, "edge": 2e-3}
    marched = MarchedField(closed_form("shell", shell, ad.TensorXf), MarchSettings(samples=4096))
    camera, pose = Intrinsics.from_angle_x(20, 20, 0.5), orbit_poses(3)[1]
    o, d = exact_rays(camera, pose)
    b = d @ o
    square = 0.6**2 - (o @ o - b * b)
    depth = np.where(square > 0, -b - np.sqrt(np.maximum(square, 0)), 0)
    normal = np.where(square[..., None] > 0, (o + depth[..., None] * d) / 0.6, 0)
    true = Surfaces(camera, depth.astype(np.float32), normal.astype(np.float32))
    figures = surface_figures(field_surfaces(marched, camera, pose, ad), true)
    assert 0 < figures["depth_error"] < 1.5e-3
    assert figures["depth_error_95"] < 5e-3
    assert 0 <= figures["normal_error"] < 1
    assert figures["silhouette_iou"] > 0.96
    # The same surface, seen as a ball of 0.66: 10 % nearer, as far as the middle goes.
    nearer = replace(true, depth=(depth * 0.9).astype(np.float32))
    off = surface_figures(field_surfaces(marched, camera, pose, ad), nearer)
    assert off["depth_error"] == pytest.approx(1 / 9, abs=2e-3)
