"""Rays through fields: against closed forms, and the same however the work is divided."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np
import pytest

from mi_nerf.base.box import Corner
from mi_nerf.fields.fourier import FourierEncoding
from mi_nerf.fields.network import NetworkConfig
from mi_nerf.fields.neural import NeuralField, NeuralFieldConfig
from mi_nerf.march import query
from mi_nerf.march import render as render_module
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.occupancy import OccupancyGrid
from mi_nerf.march.placing import place_samples
from mi_nerf.march.quadrature import integrate
from mi_nerf.march.query import Evaluation
from mi_nerf.march.render import RayImage, ray_chunks, render_rays
from mi_nerf.march.settings import MarchSettings
from mi_nerf.march.strata import points_along
from tests.support.analytic import AnalyticField, ball, gaussian, uniform
from tests.support.arrays import unit, vectors

BOX: tuple[Corner, Corner] = ((-1.0, -0.5, -2.0), (1.0, 1.5, 0.25))
SMALL = NeuralFieldConfig(
    *BOX,
    position=FourierEncoding(2),
    direction=FourierEncoding(1),
    network=NetworkConfig(depth=2, width=8, skip=1, view_width=4),
    density_shift=1.0,
)


def make_rays(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Origins around the box of ``BOX`` and directions, of which about a third miss it."""
    rng = np.random.default_rng(seed)
    o = 4 * unit(rng.normal(size=(count, 3)))
    d = unit(rng.uniform(-2.2, 2.2, (count, 3)) - o)
    return o.astype(np.float32), d.astype(np.float32)


def slow_interval(o: np.ndarray, d: np.ndarray, lower: Any, upper: Any) -> np.ndarray:
    """(N, 2) bounds of t in the box, in double precision; equal where a ray misses."""
    o, d = o.astype(float), d.astype(float)
    planes = np.stack([(lower - o) / d, (upper - o) / d])
    near = np.maximum(planes.min(axis=0).max(axis=1), 0)
    return np.stack([near, np.maximum(planes.max(axis=0).min(axis=1), near)], axis=1)


def image(result: RayImage) -> np.ndarray:
    """Colour, opacity and depth, (5, N)."""
    return np.array([np.array(row) for row in (*result.color, result.opacity, result.depth)])


def render(
    ad: Any, field: Any, rays: tuple[np.ndarray, np.ndarray], samples: int = 64, **options: Any
) -> np.ndarray:
    """What :func:`render_rays` sees, (5, N); options are settings, occupancy or jitter."""
    grid, jitter = options.pop("occupancy", None), options.pop("jitter", None)
    settings = MarchSettings(samples=samples, **options)
    o, d = vectors(ad, rays[0]), vectors(ad, rays[1])
    return image(render_rays(MarchedField(field, settings, grid), o, d, jitter=jitter))


# ---- Closed forms -----------------------------------------------------------


@pytest.mark.parametrize("samples", [1, 3, 64])
def test_constant_density(ad: Any, samples: int) -> None:
    """1 − exp(−σ·chord) whatever the number of samples; rays that miss see nothing."""
    rays = make_rays(200)
    near, far = slow_interval(*rays, *BOX).T
    opacity = -np.expm1(-0.7 * (far - near))
    seen = render(ad, AnalyticField(uniform(0.7), None, *BOX), rays, samples)
    assert 30 < np.sum(far == near) < 170
    assert seen[:4] == pytest.approx(np.outer((1, 0.5, 0.25, 1), opacity), abs=2e-6)
    assert not seen[:, far == near].any()
    hit = far > near
    assert (near[hit] <= seen[4, hit]).all() and (seen[4, hit] <= far[hit]).all()


def test_depth_of_a_constant_density(ad: Any) -> None:
    rays = make_rays(50)
    near, far = slow_interval(*rays, *BOX).T
    length = (far - near)[far > near]
    # The mean of t under σ·exp(−σt) on [0, L] is 1/σ − L/(exp(σL) − 1).
    depth = near[far > near] + 1 / 0.7 - length / np.expm1(0.7 * length)
    seen = render(ad, AnalyticField(uniform(0.7), None, *BOX), rays, samples=500)
    assert seen[4, far > near] == pytest.approx(depth, rel=1e-5)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_gaussian_blob(ad: Any, scale: float) -> None:
    """Its optical depth along a ray is an error function, in any unit of length."""
    center, sigma, density = np.array([0.1, 0.3, -0.8]), 0.2, 9.0
    o, d = make_rays(200)
    o, d = o * np.float32(scale), d.astype(float)
    lower, upper = ((scale * x, scale * y, scale * z) for x, y, z in BOX)
    middle = np.sum((scale * center - o) * d, axis=1) / scale  # t of the closest point
    miss = np.linalg.norm(o / scale + middle[:, None] * d - center, axis=1)
    bounds = (slow_interval(o, d, lower, upper) / scale - middle[:, None]) / (math.sqrt(2) * sigma)
    area = [math.erf(b) - math.erf(a) for a, b in bounds]
    peak = density * sigma * math.sqrt(math.pi / 2) * np.exp(-0.5 * (miss / sigma) ** 2)
    opacity = -np.expm1(-peak * area)

    blob = gaussian(tuple((scale * center).tolist()), scale * sigma, density / scale)
    seen = render(ad, AnalyticField(blob, None, lower, upper), (o, d), samples=128)
    assert opacity.max() > 0.9
    assert seen[:4] == pytest.approx(np.outer((1, 0.5, 0.25, 1), opacity), abs=2e-5)
    visible = opacity > 0.05
    assert (np.abs(seen[4] / scale - middle)[visible] < 2 * sigma).all()


def test_coloured_field_against_a_dense_march(ad: Any) -> None:
    """Density and colour vary with the place, the colour with the direction too."""
    field = AnalyticField(
        lambda p: 2 + dr.sin(3 * p.x) * dr.cos(2 * p.z),
        lambda p, d: [0.5 + 0.25 * p.y, dr.square(p.x), dr.abs(d.z)],
        *BOX,
    )
    o, d = make_rays(60)
    bounds, steps, expected = slow_interval(o, d, *BOX), 4000, []
    for i in range(len(o)):
        edges = np.linspace(*bounds[i], steps + 1)
        width, t = edges[1] - edges[0], (edges[:-1] + edges[1:]) / 2
        x, y, z = (o[i].astype(float) + t[:, None] * d[i]).T
        tau = (2 + np.sin(3 * x) * np.cos(2 * z)) * width
        w = np.exp(-(np.cumsum(tau) - tau)) * -np.expm1(-tau)
        color = [np.sum(w * (0.5 + 0.25 * y)), np.sum(w * x**2), np.sum(w * abs(float(d[i, 2])))]
        expected.append([*color, w.sum(), np.sum(w * t) / w.sum() if width > 0 else 0])
    assert render(ad, field, (o, d), samples=512) == pytest.approx(np.transpose(expected), abs=1e-4)


def test_from_inside_and_between_bounds(ad: Any) -> None:
    field = AnalyticField(uniform(1.0))
    rays = np.zeros((1, 3)), np.array([[1.0, 0, 0]])
    for bounds, length in (
        ({}, 1.0),
        ({"near": 0.25}, 0.75),
        ({"far": 0.5}, 0.5),
        ({"near": 0.25, "far": 0.5}, 0.25),
        ({"near": 2.0}, 0.0),
        ({"near": -3.0, "far": 9.0}, 1.0),
    ):
        opacity = render(ad, field, rays, samples=5, **bounds)[3, 0]
        assert opacity == pytest.approx(-math.expm1(-length), rel=1e-5)


def test_bounds_of_single_rays(ad: Any) -> None:
    o, d = vectors(ad, [(0, 0, -3)] * 3), vectors(ad, [(0, 0, 1)] * 3)
    samples = place_samples(
        MarchedField(AnalyticField(uniform(1.0)), MarchSettings(samples=2)),
        o,
        d,
        bounds=(ad.Float([0, 2.5, 3]), ad.Float([9, 3.5, 2.5])),
    )
    assert list(samples.delta) == [1, 1, 0.5, 0.5, 0, 0]
    assert list(samples.t) == [2.5, 3.5, 2.75, 3.25, 0, 0]
    assert list(samples.index) == [0, 1, 2, 3]
    assert samples.rays == 3 and samples.queries == 4


# ---- The same however the work is divided -----------------------------------


@pytest.fixture
def _flattened(monkeypatch: pytest.MonkeyPatch) -> None:
    """Narrow networks take the way of wide ones, too."""
    monkeypatch.setattr(render_module, "can_walk", lambda _: False)


@pytest.mark.usefixtures("_flattened")
@pytest.mark.slow
@pytest.mark.parametrize("chunk", [1, 8, 25, 10_000])
def test_chunks(ad: Any, chunk: int) -> None:
    """One ray at a time, several, or all; also where the last chunk is a smaller one."""
    field, rays = NeuralField.create(SMALL, 0, ad.TensorXf), make_rays(11)
    jitter = ad.Float(np.random.default_rng(0).random(11, np.float32))
    whole = render(ad, field, rays, samples=8, jitter=jitter)
    assert whole[3].any()
    parts = render(ad, field, rays, samples=8, jitter=jitter, chunk=chunk)
    assert parts == pytest.approx(whole, rel=1e-6, abs=1e-7)
    assert not np.array_equal(whole[4], render(ad, field, rays, samples=8)[4])


@pytest.mark.parametrize("rays", [0, 1, 7, 8, 9])
@pytest.mark.parametrize(("chunk", "size"), [(1, 1), (15, 1), (16, 2), (64, 8), (1 << 20, 1 << 17)])
def test_ray_chunks(rays: int, chunk: int, size: int) -> None:
    parts = list(ray_chunks(rays, MarchSettings(samples=8, chunk=chunk)))
    assert [i for start, count in parts for i in range(start, start + count)] == list(range(rays))
    assert all(count <= size for _, count in parts)


@pytest.mark.parametrize("block", [1, 7, 64, 1000])
def test_blocks(ad: Any, block: int) -> None:
    """The field is asked in blocks of one size, of which the last is padded."""
    rays = make_rays(6)
    field = AnalyticField(gaussian((0.0, 0.5, -1.0), 0.5, 3.0), None, *BOX)
    whole = render(ad, field, rays, samples=16, block=4096)
    field.blocks.clear()
    assert np.array_equal(render(ad, field, rays, samples=16, block=block), whole)
    near, far = slow_interval(*rays, *BOX).T
    queries = 16 * int(np.sum(far > near))
    assert field.blocks == [block] * -(-queries // block)


def test_other_numbers_of_queries_reuse_the_kernels(ad: Any) -> None:
    field, (o, d) = NeuralField.create(SMALL, 0, ad.TensorXf), make_rays(40)
    o, d = vectors(ad, o), vectors(ad, d)

    def kernels(far: float) -> tuple[int, set[str]]:
        settings = MarchSettings(samples=8, far=far)
        samples = place_samples(MarchedField(field, settings), o, d)
        dr.eval(samples)
        dr.sync_thread()
        dr.kernel_history_clear()
        Evaluation(field, samples, block=16)
        history = dr.kernel_history([dr.KernelType.JIT])
        return samples.queries, {str(entry["hash"]) for entry in history}

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        few, kernels_for_few = kernels(far=3.0)
        many, kernels_for_many = kernels(far=9.0)
    assert 16 < few < many - 16
    assert kernels_for_few == kernels_for_many != set()


def test_one_origin_for_all_rays(ad: Any) -> None:
    field, (o, d) = AnalyticField(uniform(1.0), None, *BOX), make_rays(20)
    shared = image(
        render_rays(
            MarchedField(field, MarchSettings(samples=4)), vectors(ad, o[:1]), vectors(ad, d)
        )
    )
    assert np.array_equal(shared, render(ad, field, (np.repeat(o[:1], 20, 0), d), samples=4))


# ---- Occupancy --------------------------------------------------------------


def test_full_grid_changes_nothing(ad: Any) -> None:
    field, rays = NeuralField.create(SMALL, 0, ad.TensorXf), make_rays(30)
    grid = OccupancyGrid(*BOX, np.ones((4, 5, 6), bool), ad.Float)
    without = render(ad, field, rays)
    assert without[3].any()
    assert np.array_equal(render(ad, field, rays, occupancy=grid), without)


def test_empty_cells_are_not_evaluated(ad: Any) -> None:
    """A ball in a grid of its own: the same image from a fraction of the queries."""
    field = AnalyticField(ball(0.4, 30.0), lambda p, d: [p.x, p.y, d.z])
    grid = OccupancyGrid(field.lower, field.upper, np.ones((16, 16, 16), bool), ad.Float)
    for turn in range(8):
        grid.refresh(field, dr.rng(seed=turn), turn, queries=8192, threshold=0.01, decay=0.9)
    # Cells that a corner of the ball was never seen in.
    edges = np.abs(np.linspace(-1, 1, 17))
    near = np.minimum(edges[:-1], edges[1:]) ** 2
    touched = np.add.outer(np.add.outer(near, near), near) < 0.4**2
    grid.restore({**grid.state(), "mask": touched})

    o, d = (vectors(ad, v) for v in make_rays(100))
    full = render_rays(MarchedField(field, MarchSettings()), o, d)
    sparse = render_rays(MarchedField(field, MarchSettings(), grid), o, d)
    assert np.array_equal(image(sparse), image(full))
    assert image(full)[3].max() > 0.99
    assert sparse.queries < 0.2 * full.queries


def test_empty_grid(ad: Any) -> None:
    field, rays = AnalyticField(uniform(9.0), None, *BOX), make_rays(20)
    grid = OccupancyGrid(*BOX, np.zeros((2, 2, 2), bool), ad.Float)
    assert not render(ad, field, rays, occupancy=grid).any()
    assert field.blocks == []


# ---- Small and empty batches ------------------------------------------------


def test_all_rays_miss(ad: Any) -> None:
    field = NeuralField.create(SMALL, 0, ad.TensorXf)
    o, d = vectors(ad, [(9, 9, 9)] * 3), vectors(ad, [(1, 0, 0)] * 3)
    result = render_rays(MarchedField(field, MarchSettings(samples=4)), o, d)
    assert image(result).shape == (5, 3) and not image(result).any()
    assert result.queries == 0
    # A step of training on such rays has no gradient, and no complaint.
    dr.enable_grad(field.parameters())
    samples = place_samples(MarchedField(field, MarchSettings(samples=4)), o, d)
    evaluation = Evaluation(field, samples, 16)
    evaluation.enable_grad()
    seen = integrate(evaluation, samples)
    dr.backward(dr.sum(seen.color[0]) + dr.sum(seen.depth))
    evaluation.backward()
    assert not any(np.array(dr.grad(p)).any() for p in field.parameters().values())


def test_no_rays(ad: Any) -> None:
    none = dr.zeros(ad.Array3f, 0)
    result = render_rays(MarchedField(AnalyticField(uniform(1.0)), MarchSettings()), none, none)
    assert image(result).shape == (5, 0) and result.queries == 0


def test_one_ray_and_one_sample(ad: Any) -> None:
    field = NeuralField.create(SMALL, 0, ad.TensorXf)
    rays = np.array([[0.1, 0.2, -4.0]]), np.array([[0.0, 0.0, 1.0]])
    seen = render(ad, field, rays, samples=1)
    p, d = vectors(ad, [(0.1, 0.2, -0.875)]), vectors(ad, rays[1])
    density, color = field.density_emission(p, d)
    opacity = -math.expm1(-density[0] * 2.25)
    expected = [*(c[0] * opacity for c in color), opacity, 4 - 0.875]
    assert seen[:, 0] == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"samples": 0}, "samples=0"),
        ({"block": 0}, "block=0"),
        ({"chunk": -1}, "chunk=-1"),
        ({"near": 2.0, "far": 2.0}, "near=2.0"),
    ],
)
def test_settings_are_validated(change: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        MarchSettings(**change)


# ---- Early termination ------------------------------------------------------


@pytest.mark.usefixtures("short_rounds")
@pytest.mark.parametrize("stop", [1e-1, 1e-2, 1e-4])
def test_early_termination_keeps_its_bound(ad: Any, stop: float) -> None:
    """Opacity loses less than ``stop``, colours less than that times the largest emission."""
    field = AnalyticField(gaussian((0, 0, 0), 0.3, 40.0), lambda p, d: [1.0, 3.0, 0.5 + 0 * p.x])
    rays = make_rays(150, seed=4)
    o, d = (vectors(ad, v) for v in rays)
    dense = render_rays(MarchedField(field, MarchSettings()), o, d)
    short = render_rays(MarchedField(field, MarchSettings(stop=stop)), o, d)
    lost = image(dense) - image(short)
    limit = np.array([1, 3, 0.5, 1])[:, None] * stop + 2e-6
    assert (np.abs(lost[:4]) <= limit).all()
    assert (lost[3] >= -2e-6).all()
    assert short.queries < dense.queries


@pytest.mark.usefixtures("short_rounds")
def test_a_ray_ends_where_nothing_shows_any_more(ad: Any) -> None:
    """Opaque at once: the first round of samples is all that is asked for."""
    rays = make_rays(40)
    field = AnalyticField(uniform(1e4), None, *BOX)
    hits = int((np.diff(slow_interval(*rays, *BOX))[:, 0] > 0).sum())
    o, d = (vectors(ad, v) for v in rays)
    assert render_rays(MarchedField(field, MarchSettings(stop=1e-4)), o, d).queries == 4 * hits
    assert render_rays(MarchedField(field, MarchSettings()), o, d).queries == 128 * hits


def test_few_rays_are_asked_for_more_at_once(ad: Any) -> None:
    """Rounds of few queries would take no less time than longer ones."""
    rays = make_rays(40)
    hits = int((np.diff(slow_interval(*rays, *BOX))[:, 0] > 0).sum())
    o, d = (vectors(ad, v) for v in rays)
    field = AnalyticField(uniform(1e4), None, *BOX)
    assert render_rays(MarchedField(field, MarchSettings(stop=1e-4)), o, d).queries == 128 * hits


def test_rays_that_see_nothing_have_no_rounds(ad: Any) -> None:
    o, d = vectors(ad, [(5, 5, 5)] * 3), vectors(ad, [(0, 0, 1)] * 3)
    seen = render_rays(MarchedField(AnalyticField(uniform(1.0)), MarchSettings(stop=1e-4)), o, d)
    assert seen.queries == 0 and not image(seen).any()


@pytest.mark.usefixtures("_flattened")
@pytest.mark.parametrize("least", [1, 1000, 1 << 14])
def test_rounds_change_nothing_of_what_is_seen(
    ad: Any, least: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the least possible limit, every sample is asked for, in whatever order."""
    monkeypatch.setattr(query, "_LEAST_QUERIES", least)
    field, rays = NeuralField.create(SMALL, 0, ad.TensorXf), make_rays(60)
    dense = render(ad, field, rays)
    rounds = render(ad, field, rays, stop=1e-35)
    assert dense[3].any()
    np.testing.assert_allclose(rounds, dense, atol=1e-6)


# ---- Hidden samples ---------------------------------------------------------


def witnessed(grid: OccupancyGrid, field: AnalyticField, o: Any, d: Any, hidden: float) -> None:
    """Shows the grid what a step of training along these rays asks for."""
    settings = MarchSettings(samples=64, hidden=hidden)
    samples = place_samples(MarchedField(field, settings, grid), o, d)
    grid.witness(samples, Evaluation(field, samples, 4096).density)


@pytest.mark.slow
def test_hidden_samples_are_left_out(ad: Any) -> None:
    """Behind an optical depth that training has seen everywhere, nothing is asked."""
    field = AnalyticField(ball(0.8, 60.0))
    grid = OccupancyGrid(field.lower, field.upper, np.ones((16, 16, 16), bool), ad.Float)
    o, d = (vectors(ad, v) for v in make_rays(200, seed=7))

    def look(hidden: float) -> RayImage:
        settings = MarchSettings(samples=64, hidden=hidden)
        return render_rays(MarchedField(field, settings, grid), o, d)

    assert look(5.0).queries == look(0.0).queries  # nothing was seen yet
    for step in range(250):
        witnessed(grid, field, *(vectors(ad, v) for v in make_rays(2000, seed=step)), 9.0)
        if step % 16 == 0:
            grid.refresh(field, dr.rng(seed=step), step, queries=8192, threshold=0.01, decay=0.9)
    assert (grid.floor() <= 60 * 1.00001).all() and grid.floor().max() > 50
    whole, some = look(0.0), look(9.0)
    assert some.queries < 0.8 * whole.queries
    lost = image(whole)[3] - image(some)[3]
    assert np.abs(lost).max() < 1.1 * math.exp(-9)


def test_the_floor_is_no_more_than_was_seen(ad: Any) -> None:
    """One empty sample is believed at once, dense ones only by and by; looks only lower it."""
    grid = OccupancyGrid(*BOX, np.ones((2, 2, 2), bool), ad.Float)
    rays = [vectors(ad, v) for v in make_rays(500)]
    dense, empty = (AnalyticField(uniform(v), None, *BOX) for v in (10.0, 0.0))
    floors = []
    for field in (dense, dense, empty, dense):
        witnessed(grid, field, *rays, 0.0)
        floors.append(grid.floor())
    first = 0.01 / np.mean(grid.cell_size)
    np.testing.assert_allclose(floors[0], first, rtol=1e-5)
    np.testing.assert_allclose(floors[1], 1.1 * first, rtol=1e-5)
    assert not floors[2].any()
    np.testing.assert_allclose(floors[3], first, rtol=1e-5)
    refresh = {"queries": 16, "threshold": 0.0, "decay": 0.9}
    grid.refresh(dense, dr.rng(seed=0), 0, **refresh)
    assert np.array_equal(grid.floor(), floors[3])
    grid.refresh(empty, dr.rng(seed=0), 0, **refresh)
    assert not grid.floor().any()


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_what_is_seen_past_a_surface_is_not_hidden(ad: Any, share: float) -> None:
    """Rays beside a wall that fills the share of a cell find the cell open, in most steps."""
    edge = 2 * share - 1  # of the wall, in a grid that is one cell wide
    field = AnalyticField(lambda p: dr.select(p[0] < edge, type(p[0])(500), 0))
    grid = OccupancyGrid(field.lower, field.upper, np.ones((1, 1, 8), bool), ad.Float)
    rng, hidden, beside = np.random.default_rng(0), 0, 0
    for _ in range(400):
        x, y = rng.uniform(-1, 1, (2, 5))
        o = vectors(ad, np.stack([x, y, np.full(5, -2)], axis=1))
        d = vectors(ad, np.tile([0.0, 0, 1], (5, 1)))
        settings = MarchSettings(samples=64, hidden=5.0)
        samples = place_samples(MarchedField(field, settings, grid), o, d)
        asked = np.bincount(np.array(samples.index) // 64, minlength=5)
        hidden += int((asked[x >= edge] < 64).sum())
        beside += int((x >= edge).sum())
        witnessed(grid, field, o, d, 5.0)
    assert beside > 300
    assert hidden < 0.02 * beside


def slow_floor(floor: np.ndarray, cells: np.ndarray, density: np.ndarray, first: float) -> Any:
    """Cell by cell: raised by a tenth, from the first number on, to no more than the least."""
    result = floor.astype(float)
    for cell in set(cells):
        risen = max(1.1 * result[cell], first)
        result[cell] = min(risen, density[cells == cell].min())
    return result


def test_the_floor_of_every_cell(ad: Any) -> None:
    """Many samples in a cell at a time, of all densities, NaN too, against one after the other."""
    grid, rng = OccupancyGrid(*BOX, np.ones((3, 2, 2), bool), ad.Float), np.random.default_rng(1)
    marched = MarchedField(AnalyticField(uniform(1), None, *BOX), MarchSettings(samples=8), grid)
    expected, greatest = np.zeros(12), 0.0
    for step in range(80):
        samples = place_samples(marched, *(vectors(ad, v) for v in make_rays(40, seed=step)))
        density = rng.lognormal(3, 2, len(samples.t)).astype(np.float32)
        density[rng.random(len(density)) < 0.003] = np.nan
        if step % 20 > 1:
            density = np.fmax(density, 30)
        grid.witness(samples, ad.Float(density))
        index = np.array(samples.index)
        place = points_along(samples.o, samples.d, samples.t, dr.arange(ad.UInt32, 320) // 8)
        cells = np.array(grid.cell(place))[index]
        expected = slow_floor(
            expected, cells, np.nan_to_num(density[index]), 0.01 / np.mean(grid.cell_size)
        )
        np.testing.assert_allclose(grid.floor().ravel(), expected, rtol=1e-4)
        greatest = max(greatest, expected.max())
    assert greatest > 0.2
