"""Rows 7, 8, 11, 12 and 18: where rays are sampled."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np

from mi_nerf.cameras.ndc import Ndc
from mi_nerf.fields.closed_form import closed_form
from mi_nerf.march.importance import inverse_transform
from mi_nerf.march.intervals import box_interval
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.placing import place_samples
from mi_nerf.march.quadrature import integrate
from mi_nerf.march.query import Evaluation
from mi_nerf.march.rules import sample_weights
from mi_nerf.march.settings import MarchSettings
from mi_nerf.march.strata import points_along, stratified
from tests.hard_cases import Finding, not_finite, relative
from tests.support import naive
from tests.support.arrays import unit, vectors
from tests.support.boxes import awkward_rays, slow_interval


def empty_bins(ad: Any) -> list[Finding]:
    """Row 7: 62 bins of which one holds everything."""
    weights = np.zeros(62, np.float32)
    weights[30] = 1
    share = (weights + 1e-5).astype(float) / np.sum(weights + 1e-5, dtype=float)
    u = np.cumsum(share) - share / 2  # leads to the middle of each bin
    edges = np.arange(63, dtype=np.float32)
    rays, zero = np.tile(weights, 62), dr.zeros(ad.Float, 62)
    ours = inverse_transform(zero, zero + 62, ad.Float(rays), 62, 1, ad.Float(u))

    def collapsed(t: np.ndarray) -> float:
        place = np.delete(t - np.arange(62), 30)
        return float(np.sum(np.abs(place) < 0.02))

    return [
        Finding(
            "samples, of 61 for the middles of empty bins, that land on a left edge",
            collapsed(naive.inverse_transform(edges, weights, u.astype(np.float32))),
            collapsed(np.array(ours)),
        )
    ]


def sample_positions(ad: Any) -> list[Finding]:
    """Row 8: the far bound of rays through a thin sheet; nothing is where they end."""
    field = closed_form("sheet", {"width": 0.02, "edge": 0.01}, ad.TensorXf)
    rays = 64
    o, d = (vectors(ad, np.tile(v, (rays, 1))) for v in ((0, 0, -3), (0, 0, 1)))
    jitter = ad.Float(np.random.default_rng(0).random(64 * rays))

    def attached(far: Any) -> Any:
        t, delta = stratified(dr.full(ad.Float, 2, rays), far, 64, jitter)
        p = points_along(o, d, t, dr.arange(ad.UInt32, 64 * rays) // 64)
        return sample_weights(field.density(p), delta, 64)[1]

    def detached(far: Any) -> Any:
        settings = MarchSettings(samples=64)
        samples = place_samples(
            MarchedField(field, settings), o, d, jitter=jitter, bounds=(None, far)
        )
        return integrate(Evaluation(field, samples, 4096), samples).opacity

    slopes = []
    for opacity in (attached, detached):
        far = dr.full(ad.Float, 3.9, rays)
        dr.enable_grad(far)
        dr.backward(dr.sum(opacity(far)), flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
        slopes.append(float(np.abs(np.array(dr.grad(far))).max()))
    return [Finding("largest ∂ opacity/∂far of 64 rays (exactly 0)", *slopes)]


def box(ad: Any) -> list[Finding]:
    """Row 11: 6000 rays that are parallel to faces, start in them, or meet edges."""
    lower, upper = (-1.0, -0.5, -2.0), (1.0, 1.5, 0.25)
    o, d = awkward_rays(lower, upper, 6000)
    exact = [slow_interval(*ray, lower, upper) for ray in zip(o, d, strict=True)]
    bounds = np.array([(0, 0) if interval is None else interval for interval in exact], float)
    in_a_face = ((o == np.float32(lower)) | (o == np.float32(upper))).any(axis=1)

    def errors(careful: bool) -> tuple[float, float]:
        origin, way = vectors(ad, o), vectors(ad, d)
        dr.enable_grad(origin)
        if careful:
            near, far, _ = box_interval(origin, way, lower, upper)
        else:
            near, far = naive.box_interval(origin, way, lower, upper)
            near = dr.maximum(near, 0)  # a clamp to the origin, at least
            hit = far > near
            near, far = dr.select(hit, near, 0), dr.select(hit, far, 0)
        found = np.stack([np.array(near), np.array(far)], axis=1)
        dr.backward(dr.sum(far - near))
        # An origin that moves along its ray shortens it by as much, or not from outside.
        along = np.sum(np.array(dr.grad(origin)).T * d, axis=1)
        starts_inside = (bounds[:, 0] == 0) & (bounds[:, 1] > 0)
        good = (along == np.where(starts_inside, -1, 0)) | in_a_face
        wrong = (found != bounds).any(axis=1)
        return float(wrong.sum()), float(np.sum(~good))

    what = (
        "rays of 6000 with wrong bounds",
        "rays from outside the faces with wrong ∂(far − near)/∂o along d",
    )
    pairs = zip(what, errors(careful=False), errors(careful=True), strict=True)
    return [Finding(*pair) for pair in pairs]


def projection(ad: Any) -> list[Finding]:
    """Row 12: rays parallel to the image plane, nearly so, and turned away."""
    d = unit([(1, 0, 0), (0.6, -0.8, 0), (1, 0, -1e-30), (0, 0, 1), (0.3, 0, 0.9)])

    def errors(careful: bool) -> tuple[float, float, float]:
        o, way = vectors(ad, np.zeros((5, 3))), vectors(ad, d)
        dr.enable_grad(way)
        if careful:
            rays = Ndc(1.0, 1.0).rays(o, way)
            outputs, seen = [*rays.o, *rays.d], np.array(rays.facing)
        else:
            start, direction = naive.ndc_rays(o, way)
            outputs = [*start, *direction]
            seen = np.isfinite(np.array(start)).all(axis=0)
        dr.backward(sum(dr.sum(v) for v in outputs))
        return (
            float(not_finite(*outputs)),
            float(not_finite(*dr.grad(way))),
            float(np.sum(seen[3:])),
        )

    what = (
        "coordinates of projected rays not finite, of 30",
        "their derivatives with respect to d not finite, of 15",
        "rays turned away, of 2, that pass for good ones",
    )
    pairs = zip(what, errors(careful=False), errors(careful=True), strict=True)
    return [Finding(*pair) for pair in pairs]


def one_sample(ad: Any) -> list[Finding]:
    """Row 18: one sample of one ray through fog of optical depth 1."""

    def error(t: Any, delta: Any) -> float:
        opacity = sample_weights(dr.full(ad.Float, 1, len(t)), delta, 1)[1]
        return relative([t[0], opacity[0]], [2.5, -math.expm1(-1)])

    near, far = dr.opaque(ad.Float, 2), dr.opaque(ad.Float, 3)
    t = naive.linspace(near, far, 1)
    usual = error(t, naive.endless(dr.zeros(ad.Float, 1)))
    ours = error(*stratified(near, far, 1))
    return [Finding("relative error of its place and opacity", usual, ours)]
