"""The occupancy grid: which cell a point is in, and which cells it may call empty."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest

from mi_nerf.base.box import grid_shape
from mi_nerf.march.occupancy import OccupancyGrid, greatest_around
from tests.support.analytic import AnalyticField, ball, uniform
from tests.support.arrays import vectors

LOWER, UPPER = (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)
CELLS = 8  # a side, where nothing else is said


def full_grid(ad: Any, shape: tuple[int, ...] = (CELLS,) * 3) -> OccupancyGrid:
    return OccupancyGrid(LOWER, UPPER, np.ones(shape, bool), ad.Float)


def refresh(
    ad: Any,
    grid: OccupancyGrid,
    field: AnalyticField,
    turns: int = 1,
    *,
    first: int = 0,
    queries: int = 2 * CELLS**3,
    threshold: float = 0.01,
    decay: float = 0.9,
) -> None:
    """As many refreshes, of which each looks into every cell unless ``queries`` is less."""
    for turn in range(first, first + turns):
        rng = dr.rng(seed=turn)
        grid.refresh(field, rng, turn, queries=queries, threshold=threshold, decay=decay)


# ---- Lookup -----------------------------------------------------------------


def slow_occupied(mask: np.ndarray, lower: Any, upper: Any, p: np.ndarray) -> list[bool]:
    """Cell by cell; what is outside belongs to the nearest cell of the border."""
    result = []
    for point in p.astype(float):
        share = (point - lower) / (np.array(upper) - lower) * mask.shape
        cell = np.clip(np.floor(share).astype(int), 0, np.array(mask.shape) - 1)
        result.append(bool(mask[tuple(cell)]))
    return result


def test_lookup_on_faces_and_outside(ad: Any) -> None:
    """A cell owns its lower faces; all numbers here are exact in float32."""
    mask = np.random.default_rng(0).random((4, 8, 2)) < 0.5
    ticks = np.array([-1.5, -1.125, -1, -0.5, -0.25, 0, 0.125, 0.5, 0.75, 1, 1.125, 9])
    p = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).reshape(-1, 3)
    grid = OccupancyGrid(LOWER, UPPER, mask, ad.Float)
    assert np.array_equal(
        grid.occupied(grid.cell(vectors(ad, p))), slow_occupied(mask, LOWER, UPPER, p)
    )


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_lookup_at_random_points(ad: Any, scale: float) -> None:
    lower, upper = (-0.3 * scale, 1.7 * scale, 2.0 * scale), (0.9 * scale, 2.3 * scale, 7 * scale)
    rng = np.random.default_rng(1)
    mask = rng.random((5, 3, 11)) < 0.5
    share = rng.uniform(-0.1, 1.1, (3000, 3)) * mask.shape
    share = share[(np.abs(share - np.rint(share)) > 1e-4).all(axis=1)]  # off the faces
    p = (lower + share / mask.shape * (np.array(upper) - lower)).astype(np.float32)
    grid = OccupancyGrid(lower, upper, mask, ad.Float)
    assert np.array_equal(
        grid.occupied(grid.cell(vectors(ad, p))), slow_occupied(mask, lower, upper, p)
    )


def test_infinite_and_invalid_points_stay_within_the_grid(ad: Any) -> None:
    p = [(np.nan, 0, 0), (np.inf, 0, 0), (0, -np.inf, 0), (3e38, -3e38, 1e30)]
    grid = full_grid(ad)
    assert np.array(grid.occupied(grid.cell(vectors(ad, p)))).all()


def test_contents(ad: Any) -> None:
    mask = np.random.default_rng(2).random((2, 3, 4)) < 0.4
    grid = OccupancyGrid((0.0, 0.0, 0.0), (1.0, 3.0, 8.0), mask, ad.Float)
    assert np.array_equal(grid.mask(), mask)
    assert grid.fraction() == pytest.approx(mask.mean())
    assert grid.cell_size.tolist() == [0.5, 1, 2]
    assert np.array_equal(grid.values() > 0, mask)


def test_the_given_array_may_change_afterwards(ad: Any) -> None:
    cells, saved = np.ones((16, 16, 16), bool), np.ones((16, 16, 16), bool)
    grid = OccupancyGrid(LOWER, UPPER, cells, ad.Float)
    restored = full_grid(ad, cells.shape)
    restored.restore({**grid.state(), "mask": saved})
    cells[:] = saved[:] = False
    assert grid.fraction() == restored.fraction() == 1


# ---- Refresh ----------------------------------------------------------------


@pytest.mark.parametrize("turns", [1, 6])
def test_a_ball_is_found(ad: Any, turns: int) -> None:
    """Cells inside it are occupied, cells outside are not; its rim may be either."""
    n, radius = CELLS, 0.8
    grid = full_grid(ad)
    refresh(ad, grid, AnalyticField(ball(radius, 50.0)), turns)
    edges = np.abs(np.linspace(-1, 1, n + 1))
    near = np.minimum(edges[:-1], edges[1:])
    far = np.maximum(edges[:-1], edges[1:])
    inside = np.add.outer(np.add.outer(far**2, far**2), far**2) < radius**2
    outside = np.add.outer(np.add.outer(near**2, near**2), near**2) > radius**2
    mask = grid.mask()
    assert inside.sum() > 20 and outside.sum() > 200
    assert mask[inside].all() and not mask[outside].any()
    assert grid.values()[inside] == pytest.approx(50)


@pytest.mark.parametrize(("density", "expected"), [(0.99, 0.0), (1.01, 1.0)])
def test_threshold_is_the_optical_thickness_of_a_cell(
    ad: Any, density: float, expected: float
) -> None:
    grid = full_grid(ad)
    # Cells are 0.25 wide; half of the box is so dense that the mean is far above.
    field = AnalyticField(lambda p: dr.select(p.x < 0, 100.0, density))
    refresh(ad, grid, field, threshold=0.25)
    assert grid.fraction() == 0.5 + 0.5 * expected


def test_thin_fog_everywhere_is_kept(ad: Any) -> None:
    """2e-4 over the whole box: what is all there is must not be taken for empty."""
    grid = full_grid(ad)
    refresh(ad, grid, AnalyticField(uniform(1e-4)), 20)
    assert grid.fraction() == 1


def test_cells_are_kept_until_they_are_looked_at(ad: Any) -> None:
    """Nothing anywhere: an eighth of the cells is found empty at a time, all in the end."""
    grid, field = full_grid(ad), AnalyticField(uniform(0.0))
    fractions = []
    for turn in range(8):
        refresh(ad, grid, field, first=turn, queries=2 * CELLS**3 // 8)
        fractions.append(grid.fraction())
    assert fractions[0] == 1 - 1 / 8
    assert all(a <= 1 - (i + 1) / 8 for i, a in enumerate(fractions))
    assert fractions[-1] == 0
    assert field.asked <= 8 * 2 * CELLS**3 // 8


def test_a_cell_that_fills_is_found_again(ad: Any) -> None:
    grid = full_grid(ad)
    refresh(ad, grid, AnalyticField(uniform(0.0)))
    assert grid.fraction() == 0
    # Now there is no cell left that is sampled, and yet all come up again in turn.
    refresh(ad, grid, AnalyticField(uniform(5.0)), 4, first=1, queries=2 * CELLS**3 // 4)
    assert grid.fraction() == 1


def test_values_fade_when_the_field_does(ad: Any) -> None:
    grid = full_grid(ad)
    refresh(ad, grid, AnalyticField(uniform(8.0)))
    assert (grid.values() == 8).all()
    refresh(ad, grid, AnalyticField(uniform(0.0)), decay=0.5)
    # Looked at twice: once among all cells, once among those sampled.
    assert grid.values() == pytest.approx(np.full((CELLS,) * 3, 2.0))
    refresh(ad, grid, AnalyticField(uniform(0.0)), 20, decay=0.5)
    assert grid.fraction() == 0


def test_a_thin_dense_sheet_is_not_lost(ad: Any) -> None:
    """A sheet that fills a third of its cells is missed by most looks, yet it stays."""
    width = 2 / CELLS

    def density(p: Any) -> Any:
        return dr.select(dr.abs(p.z - 0.25 * width) < width / 6, type(p.z)(1000.0), 0)

    sheet = np.zeros((CELLS,) * 3, bool)
    sheet[:, :, CELLS // 2] = True
    grid = full_grid(ad)
    refresh(ad, grid, AnalyticField(density), 30)
    for turn in range(30, 40):
        refresh(ad, grid, AnalyticField(density), first=turn)
        assert np.array_equal(grid.mask(), sheet)


@pytest.mark.parametrize("threshold", [0.01, 0.0])
def test_what_the_hull_excludes_stays_empty(ad: Any, threshold: float) -> None:
    hull = np.random.default_rng(3).random((CELLS,) * 3) < 0.3
    grid = OccupancyGrid(LOWER, UPPER, hull, ad.Float)
    # The hull is smaller than the batch, so that its cells are gone through repeatedly.
    refresh(ad, grid, AnalyticField(uniform(9.0)), 3, threshold=threshold)
    assert np.array_equal(grid.mask(), hull)
    assert np.array_equal(grid.values(), np.where(hull, np.float32(9), 0))


def test_no_candidates_at_all(ad: Any) -> None:
    grid = OccupancyGrid(LOWER, UPPER, np.zeros((2, 2, 2), bool), ad.Float)
    field = AnalyticField(uniform(9.0))
    refresh(ad, grid, field, 2)
    assert grid.fraction() == 0 and field.asked == 0
    assert not np.array(grid.occupied(grid.cell(vectors(ad, [(0.5, 0, 0)])))).any()


def test_long_and_short_cells(ad: Any) -> None:
    """Points of every cell are looked up where they were drawn."""
    lower, upper, shape = (0.0, -3.0, 2.0), (8.0, -1.0, 2.5), (4, 2, 3)
    field = AnalyticField(lambda p: p.x + 100 * (p.y + 3) + 10000 * (p.z - 2), None, lower, upper)
    grid = OccupancyGrid(lower, upper, np.ones(shape, bool), ad.Float)
    refresh(ad, grid, field, threshold=0)
    x, y, z = np.meshgrid(*(np.arange(n) for n in shape), indexing="ij")
    low = 2 * x + 100 * y + 10000 * z * (0.5 / 3)
    assert (grid.values() >= low * 0.9999).all()
    assert (grid.values() <= (low + 2 + 100 + 10000 * 0.5 / 3) * 1.0001).all()


# ---- State ------------------------------------------------------------------


def test_restore(ad: Any) -> None:
    field = AnalyticField(ball(0.6, 50.0))
    first, second = full_grid(ad), full_grid(ad)
    refresh(ad, first, field, 3)
    second.restore(first.state())
    for _ in range(2):
        assert np.array_equal(first.mask(), second.mask())
        assert np.array_equal(first.values(), second.values())
        assert np.array_equal(first.floor(), second.floor())
        refresh(ad, first, field, first=3)
        refresh(ad, second, field, first=3)


def test_restore_refuses_another_shape(ad: Any) -> None:
    grid, other = full_grid(ad, (4, 4, 4)), full_grid(ad, (8, 4, 2))
    with pytest.raises(ValueError, match=r"\(8, 4, 2\), expected \(4, 4, 4\)"):
        grid.restore({**grid.state(), "values": other.values()})
    with pytest.raises(ValueError, match=r"\(8, 4, 2\), expected \(4, 4, 4\)"):
        grid.restore({**grid.state(), "mask": other.mask()})
    with pytest.raises(ValueError, match=r"\(8, 4, 2\), expected \(4, 4, 4\)"):
        grid.restore({**grid.state(), "floor": other.floor()})


@pytest.mark.parametrize(
    ("upper", "shape"),
    [
        ((1.0, 1.0, 1.0), (64, 64, 64)),
        ((2.0, 1.0, 0.5), (64, 32, 16)),
        ((1e-3, 1e-6, 1e-3), (64, 1, 64)),
        ((3e4, 1e4, 2e4), (64, 21, 43)),
    ],
)
def test_grid_shape(upper: Any, shape: tuple[int, int, int]) -> None:
    assert grid_shape((0.0, 0.0, 0.0), upper, 64) == shape


# ---- Survey -----------------------------------------------------------------


def test_a_survey_looks_everywhere_and_remembers_the_most(ad: Any) -> None:
    cells = np.ones((CELLS,) * 3, bool)
    cells[:, 2] = False
    field = AnalyticField(lambda p: dr.select(p.x < 0, 9.0, 0.001))
    grid = OccupancyGrid.surveyed(field, cells, ad.Float, looks=4, block=100)
    assert np.array_equal(grid.mask(), cells)
    expected = np.full((CELLS,) * 3, np.float32(0.001))
    expected[: CELLS // 2] = 9
    assert np.array_equal(grid.values(), np.where(cells, expected, 0))
    assert 4 * cells.sum() <= field.asked <= 4 * (cells.sum() + 100)
    grid.draw_line(0.01)
    assert np.array_equal(grid.mask(), cells & (expected > 1))


def test_a_survey_looks_at_every_cell_twice_however_few_are_wanted(ad: Any) -> None:
    field = AnalyticField(uniform(3.0))
    grid = OccupancyGrid.surveyed(
        field, np.ones((4, 4, 4), bool), ad.Float, looks=8, most=1, block=64
    )
    assert (grid.values() == 3).all() and field.asked == 2 * 4**3


def test_neighbours() -> None:
    values = np.zeros((4, 5, 3), np.float32)
    values[0, 2, 1], values[3, 4, 2] = 2, 7
    found = greatest_around(values)
    assert (found[:2, 1:4] == 2).all() and (found[2:, 3:, 1:] == 7).all()
    assert (found > 0).sum() == 18 + 8
    assert np.array_equal(greatest_around(values > 0), found > 0)
