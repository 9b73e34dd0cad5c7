"""Unbiased estimates: means against closed forms and the reference, by Z-tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mi_nerf
from mi_nerf.base.variants import choose_variant
from mi_nerf.cameras.ndc import Ndc
from mi_nerf.estimators import tracking
from mi_nerf.estimators.majorant import Majorants, least_majorant
from mi_nerf.estimators.reference import reference
from mi_nerf.estimators.tracking import Tracked, track
from mi_nerf.fields.closed_form import closed_form
from mi_nerf.fields.network import NetworkConfig
from mi_nerf.fields.neural import NeuralField
from mi_nerf.march.intervals import ray_segments
from mi_nerf.march.occupancy import OccupancyGrid
from tests.fields.test_closed_form import BLOB, JUMPS, VALUES, directed, within
from tests.support import closed_forms as oracle
from tests.support.analytic import AnalyticField, gaussian, uniform
from tests.support.arrays import unit, vectors
from tests.support.fields import SMALL, scene_dict, small_file

CASES = [*VALUES.items(), *JUMPS.items()]
NAMES = [*VALUES, *map("{}-0".format, JUMPS)]
BOX = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


def estimates(
    ad: Any,
    field: Any,
    o: np.ndarray,
    d: np.ndarray,
    majorants: Any,
    paths: int,
    seed: int = 5,
    **options: Any,
) -> tuple[np.ndarray, Tracked]:
    """Colour and opacity of ``paths`` walks along each of R rays: (4, R, paths)."""
    o, d = (vectors(ad, np.repeat(v, paths, axis=0)) for v in (o, d))
    rays = len(o[0])
    state = np.random.default_rng(seed).integers(0, 1 << 63, rays, np.uint64)
    random = ad.PCG32(initstate=ad.UInt64(state), initseq=dr.arange(ad.UInt64, rays))
    seen = track(field, ray_segments(field, o, d), majorants, random, **options)
    values = np.array([*map(np.array, seen.color), np.array(seen.opacity)], float)
    return values.reshape(4, -1, paths), seen


def z_scores(values: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """How many standard errors the means of (4, R, paths) values are from (R, 4) exact ones.

    Weights of 0.1 that survive once in a million paths may not turn up at all.
    """
    error = values.std(axis=-1) / np.sqrt(values.shape[-1])
    return (values.mean(axis=-1) - exact.T) / np.maximum(error, 1e-5)


def check_z(z: np.ndarray) -> None:
    """No single one is beyond chance, nor are all of them together."""
    assert np.abs(z).max() < 4.5
    if z.shape[1] > 4:  # rays; their channels depend on each other
        assert np.sqrt(np.mean(z**2)) < 1.5


# ---- Means --------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "values"), CASES, ids=NAMES)
def test_means_of_closed_forms(ad: Any, kind: str, values: dict[str, Any]) -> None:
    """With majorants as they were seen in the cells, growing; 0.7 million paths in all."""
    field = closed_form(kind, values, ad.TensorXf)
    o, d = directed(8)
    exact = oracle.seen(kind, oracle.values_of(field.config), within(field, o, d))[:, :4]
    majorants = Majorants.seen(field, None, ad.Float)
    found, _ = estimates(ad, field, o, d, majorants, 1 << 13, grow=True)
    check_z(z_scores(found, exact))
    assert np.abs(found.mean(axis=-1)[3] - exact[:, 3]).max() < 0.02
    assert (found[:, 3] == 0).all()  # the ray that misses the box


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["slab", "step", "gaussian", "shell"])
def test_majorants_below_the_density(ad: Any, kind: str) -> None:
    """Half to a third of it: transmittances change their sign, means stay right.

    Had the density been cut off at the majorant, the test would see it.
    """
    field = closed_form(kind, VALUES[kind], ad.TensorXf)
    o, d = directed(8)
    v, rays = oracle.values_of(field.config), within(field, o, d)
    exact = oracle.seen(kind, v, rays)[:, :4]
    length = (rays.far - rays.near)[:, None]
    place = rays.near[:, None] + (np.arange(2000) + 0.5) / 2000 * length
    density = oracle.density(kind, v, rays.at(place))
    low = 0.4 * float(density.max())
    found, _ = estimates(ad, field, o, d, Majorants.constant(field, low, None, ad.Float), 1 << 15)
    check_z(z_scores(found, exact))
    assert found[3].max() > 1.1  # a negative transmittance
    opacity = -np.expm1(-np.minimum(density, low).mean(axis=1) * length[:, 0])
    assert np.abs(z_scores(found[3:], opacity[:, None])).max() > 20


def test_second_moment_of_the_transmittance(ad: Any) -> None:
    """exp(∫ σ(σ/σ̄ − 2) dt): finite with a majorant of a third. No |T| is weak here."""
    field = AnalyticField(uniform(0.75), None, (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    majorants = Majorants.constant(field, 0.25, None, ad.Float)
    ray = np.array([[0.1, 0.2, -3.0]]), np.array([[0.0, 0.0, 1.0]])
    found, _ = estimates(ad, field, *ray, majorants, 1 << 17)
    through = 1 - found[3, 0]
    assert set(np.unique(through)) >= {1, -2, 4}
    # The fourth moment, by the same reasoning, is exp(15/4).
    error = np.sqrt((np.exp(3.75) - np.exp(1.5)) / through.size)
    assert np.mean(through**2) == pytest.approx(np.exp(0.75), abs=4 * error)


@pytest.mark.slow
@pytest.mark.parametrize("width", [16, 72])
def test_learned_field_agrees_with_the_reference(ad: Any, width: int) -> None:
    """Narrow networks are asked in one kernel, wide ones in padded blocks."""
    config = replace(SMALL, network=NetworkConfig(depth=2, width=width, skip=1, view_width=8))
    field = NeuralField.create(config, 3, ad.TensorXf)
    o, d = directed(8)
    exact = reference(field, vectors(ad, o), vectors(ad, d))
    assert exact.opacity.max() > 0.5 and exact.error[:, :4].max() < 2e-5
    majorants = Majorants.seen(field, None, ad.Float)
    found, seen = estimates(ad, field, o, d, majorants, 1 << 12, grow=True, block=4096)
    check_z(z_scores(found, np.column_stack([exact.color, exact.opacity])))
    assert 0 < seen.queries / found[0].size < 20


@pytest.mark.slow
def test_normalised_device_coordinates(ad: Any) -> None:
    rng = np.random.default_rng(0)
    o = rng.uniform(-0.2, 0.2, (6, 3))
    d = unit(np.c_[rng.uniform(-0.4, 0.4, (6, 2)), -np.ones(6)])
    d[0] = (0, 0, 1)  # looks away
    field = AnalyticField(
        gaussian((0.0, 0.0, 0.0), 0.5, 3.0), lambda p, d: [d.x, d.y, d.z], ndc=Ndc(1.4, 1.8)
    )
    exact = reference(field, vectors(ad, o), vectors(ad, d))
    found, _ = estimates(ad, field, o, d, Majorants.seen(field, None, ad.Float), 1 << 13)
    assert exact.opacity[1:].min() > 0.1
    check_z(z_scores(found, np.column_stack([exact.color, exact.opacity])))


@pytest.mark.slow
def test_more_rays_than_slots(ad: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rays start as others end; each sees the same as if all were under way at once."""
    field = closed_form("gaussian", VALUES["gaussian"], ad.TensorXf)
    o, d = directed(8)
    majorants = Majorants.constant(field, 8.0, None, ad.Float)
    whole, one = estimates(ad, field, o, d, majorants, 100)
    monkeypatch.setattr(tracking, "_SLOTS", 64)
    parts, other = estimates(ad, field, o, d, majorants, 100)
    assert whole == pytest.approx(parts, abs=1e-6) and one.queries == other.queries


def test_nothing_is_hit(ad: Any) -> None:
    field = closed_form("slab", {}, ad.TensorXf)
    ray = np.array([[3.0, 3.0, 3.0]]), np.array([[1.0, 0.0, 0.0]])
    found, seen = estimates(ad, field, *ray, Majorants.seen(field, None, ad.Float), 3)
    assert (found == 0).all() and seen.queries == 0


# ---- Majorants ------------------------------------------------------------------


def slow_collision(
    values: np.ndarray, lower: Any, upper: Any, o: np.ndarray, d: np.ndarray, t: Any, depth: Any
) -> tuple[float, float]:
    """Where a ray has passed an optical depth, and the density there; NaN if it never does."""
    shape = np.array(values.shape)
    size = (np.array(upper) - lower) / shape
    ends = [t]
    for i in range(3):
        if d[i] != 0:
            planes = lower[i] + size[i] * np.arange(shape[i] + 1)
            ends += [x for x in (planes - o[i]) / d[i] if x > t]
    ends = np.sort(ends)
    for a, b in zip(ends[:-1], ends[1:], strict=True):
        cell = np.floor((o + 0.5 * (a + b) * d - lower) / size).astype(int)
        if (cell < 0).any() or (cell >= shape).any():
            continue
        density = values[tuple(cell)]
        if depth <= density * (b - a):
            return a + depth / density, density
        depth -= density * (b - a)
    return np.nan, 0.0


def test_collisions_against_a_slow_walk(ad: Any) -> None:
    """Through cells of all densities, some 0; along axes too, and from the middle of the box."""
    rng = np.random.default_rng(0)
    lower, upper, count = np.array([-1.0, 0.5, -2.0]), np.array([1.0, 3.5, 1.0]), 400
    values = rng.exponential(2, (4, 6, 5)) * (rng.random((4, 6, 5)) < 0.6)
    majorants = Majorants(lower, upper, values, ad.Float)
    assert majorants.values() == pytest.approx(values)
    target = rng.uniform(lower, upper, (count, 3))
    o = target + 6 * unit(rng.normal(size=(count, 3)))
    d = unit(target - o)
    d[:20], o[:20] = np.eye(3)[rng.integers(0, 3, 20)], target[:20]
    d[10:20] *= -1
    box = AnalyticField(uniform(1.0), None, (-1.0, 0.5, -2.0), (1.0, 3.5, 1.0))
    segments = ray_segments(box, vectors(ad, o), vectors(ad, d))
    near = np.array(segments.near, float)
    depth = rng.exponential(1, count)
    t, density, cell = majorants.collide(
        segments.o, segments.d, segments.near, segments.far, ad.Float(depth)
    )
    slow = [
        slow_collision(values, lower, upper, *ray) for ray in zip(o, d, near, depth, strict=True)
    ]
    place, expected = np.array(slow).T
    hit = np.isfinite(place)
    assert 100 < hit.sum() < 350
    assert np.array(density)[hit] == pytest.approx(expected[hit], rel=1e-6)
    assert np.array(t)[hit] == pytest.approx(place[hit], abs=2e-5)
    assert (np.array(density)[~hit] == 0).all()
    assert values.ravel()[np.array(cell)[hit]] == pytest.approx(expected[hit], rel=1e-6)


def test_cells_marked_as_empty_are_empty(ad: Any) -> None:
    """Half of the box along the ray, however dense the field is there."""
    field = AnalyticField(uniform(1.0))
    cells = np.zeros((2, 2, 4), bool)
    cells[:, :, [1, 3]] = True
    occupancy = OccupancyGrid(*BOX, cells, ad.Float)
    ray = np.array([[0.1, 0.2, -3.0]]), np.array([[0.0, 0.0, 1.0]])
    for majorants in (
        Majorants.seen(field, occupancy, ad.Float),
        Majorants.constant(field, 2.0, occupancy, ad.Float),
    ):
        assert (majorants.values() > 0).tolist() == cells.tolist()
        found, _ = estimates(ad, field, *ray, majorants, 1 << 15)
        check_z(z_scores(found[3:], np.array([[-np.expm1(-1.0)]])))


def test_majorants_follow_what_was_seen(ad: Any) -> None:
    """Close to the greatest density of each cell, half of its neighbours', and never 0."""
    field = AnalyticField(gaussian((0.2, 0.0, 0.0), 0.15, 20.0))
    values = Majorants.seen(field, None, ad.Float).values()
    assert values.shape == (32, 32, 32)
    edge = (np.arange(32) + 0.5) / 16 - 1
    x, y, z = np.meshgrid(edge, edge, edge, indexing="ij")
    middle = 20 * np.exp(-((x - 0.2) ** 2 + y**2 + z**2) / (2 * 0.15**2))
    assert (values > 0.9 * middle).mean() > 0.99 and (values > 0.5 * middle).all()
    assert values.max() < 20 and values.mean() < 2 * np.maximum(middle, 1 / 12**0.5).mean()
    assert values.min() == pytest.approx(least_majorant(field)) == pytest.approx(1 / 12**0.5)


def test_majorants_grow_where_more_is_met(ad: Any) -> None:
    field = AnalyticField(uniform(2.0))
    ray = np.array([[0.1, 0.2, -3.0]]), np.array([[0.0, 0.0, 1.0]])
    exact = np.array([[*(-np.expm1(-4.0) * np.array([1, 0.5, 0.25])), -np.expm1(-4.0)]])
    for grow in (False, True):
        majorants = Majorants(*BOX, np.full((1, 1, 4), 1.0), ad.Float)
        found, _ = estimates(ad, field, *ray, majorants, 1 << 15, grow=grow)
        check_z(z_scores(found, exact))
        assert (majorants.values() == (2 if grow else 1)).all()


# ---- In scenes ------------------------------------------------------------------


@pytest.fixture
def variant() -> str:
    mi.set_variant(choose_variant())
    return mi.variant()


def batches(scene: dict[str, Any], integrator: dict[str, Any], count: int, spp: int) -> np.ndarray:
    """Images of different seeds, (count, H, W, channels)."""
    loaded = mi.load_dict({**scene, "integrator": integrator})
    return np.array([np.array(mi.render(loaded, seed=s, spp=spp)) for s in range(count)], float)


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"majorant": 2.0}])
@pytest.mark.parametrize("color_space", ["linear", "srgb"])
def test_images_agree_with_quadrature(
    variant: str, tmp_path: Path, color_space: str, options: dict[str, Any]
) -> None:
    """A learned field before an environment, pixel by pixel, by Z-tests."""
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [0.2, 0.5, 2.0]}}
    scene = scene_dict(small_file(tmp_path, color_space=color_space), size=(8, 6), sky=sky)
    encoded = {"encoded": color_space == "srgb", "aovs": "opacity"}
    quadrature = batches(scene, {"type": "nerf", "samples": 256, "stop": 0.0, **encoded}, 8, 128)
    tracked = batches(scene, {"type": "nerf_tracking", **encoded, **options}, 48, 256)
    assert 0.5 < quadrature[..., 3].max() < 0.9999 and np.ptp(quadrature[..., 3]) > 0.4
    variance = sum(v.var(axis=0, ddof=1) / len(v) for v in (quadrature, tracked))
    z = (tracked.mean(axis=0) - quadrature.mean(axis=0)) / np.sqrt(variance + 1e-10)
    assert np.abs(z).max() < 5 and np.sqrt(np.mean(z**2)) < 1.3
    assert tracked[..., 3] == pytest.approx(tracked[..., 4], abs=1e-5)


@pytest.mark.slow
def test_from_xml_through_the_near_and_far(variant: str) -> None:
    """The blob of another test, cut in half by the integrator."""
    text = BLOB.replace(
        '<integrator type="nerf"/>', '<integrator type="nerf_tracking">{}</integrator>'
    )
    whole, half = (
        np.array(mi.render(mi.load_string(text.format(options)), spp=1024))
        for options in ("", '<float name="far" value="4"/>')
    )
    tau = 12 * 0.2 * np.sqrt(2 * np.pi)
    for image, depth in ((whole, tau), (half, tau / 2)):
        assert image[9:12, 9:12, 3].mean() == pytest.approx(-np.expm1(-depth), abs=0.01)
        assert image[9:12, 9:12, 0].mean() == pytest.approx(-1.5 * np.expm1(-depth), abs=0.02)
    assert np.abs(whole[0, 0]).max() < 0.02


@pytest.mark.slow
def test_moved_cubes_and_seeds(variant: str, tmp_path: Path) -> None:
    """Distances scale with the cube, densities are the field's own."""
    file = small_file(tmp_path, color_space="linear")
    grown = scene_dict(file, to_world=mi.ScalarTransform4f().scale(50.0), spp=256)
    grown["sensor"]["near_clip"] = 0.5
    tracking_ = {"type": "nerf_tracking", "majorant": 3.0}
    images = [
        np.array(mi.render(mi.load_dict({**scene, "integrator": tracking_}), seed=3))
        for scene in (scene_dict(file, spp=256), grown)
    ]
    assert images[0] == pytest.approx(images[1], abs=0.3)
    assert images[0].mean(axis=(0, 1)) == pytest.approx(images[1].mean(axis=(0, 1)), abs=5e-3)
    scene = mi.load_dict({**scene_dict(file), "integrator": {"type": "nerf_tracking"}})
    first, again, other = (np.array(mi.render(scene, seed=s)) for s in (5, 5, 6))
    assert (first == again).all() and np.abs(first - other).max() > 0.1
    fixed = {"type": "stratified", "sample_count": 1, "jitter": False}
    still = scene_dict(file)
    still["sensor"]["sampler"], still["integrator"] = fixed, {"type": "nerf_tracking"}
    scene = mi.load_dict(still)
    assert (np.array(mi.render(scene, seed=5)) != np.array(mi.render(scene, seed=6))).any()


@pytest.mark.parametrize("majorant", [0.0, -1.0, float("nan"), float("inf")])
def test_bad_majorants(variant: str, majorant: float) -> None:
    with pytest.raises(RuntimeError, match="nerf_tracking: majorant=.*a finite number above 0"):
        mi.load_dict({"type": "nerf_tracking", "majorant": majorant})


@pytest.mark.slow
def test_what_there_is_not(variant: str, tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="nerf_tracking: aov 'depth' is unknown, expected opac"):
        mi.load_dict({"type": "nerf_tracking", "aovs": "depth"})

    def refused(act: Callable[[], Any]) -> str:
        with pytest.raises((RuntimeError, mi_nerf.InputError)) as failure:
            act()
        return str(failure.value.__cause__ or failure.value)

    integrator = {"type": "nerf_tracking"}
    scene = mi.load_dict({**scene_dict(small_file(tmp_path)), "integrator": integrator})
    assert "expected encoded=true" in refused(lambda: mi.render(scene))
    linear = scene_dict(small_file(tmp_path, color_space="linear"))
    scene = mi.load_dict({**linear, "integrator": integrator})
    params = mi.traverse(scene)
    key = "box.interior_medium.color_bias"
    dr.enable_grad(params[key])
    params.update()
    image = mi.render(scene, params)
    assert "nerf_tracking: has no derivatives" in refused(lambda: dr.backward(image))
