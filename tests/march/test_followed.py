"""The occupancy grid that keeps up with a field that changes."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest

from mi_nerf.march.followed import FollowedGrid
from mi_nerf.march.occupancy import OccupancyGrid
from tests.support.analytic import AnalyticField, ball, uniform

CELLS = 16


def followed(ad: Any, field: AnalyticField, kept: np.ndarray | None = None) -> FollowedGrid:
    """A grid of ``kept`` cells, by default those in which the field is seen to be dense."""
    grid = OccupancyGrid.surveyed(field, np.ones((CELLS,) * 3, bool), ad.Float, looks=8)
    grid.draw_line(0.01)
    if kept is not None:
        grid = OccupancyGrid(field.lower, field.upper, kept, ad.Float)
    return FollowedGrid(grid, field, ad.Float)


def shell(radius: float, thickness: float, density: float = 1000.0) -> AnalyticField:
    return AnalyticField(
        lambda p: dr.select(
            dr.abs(dr.norm(p) - radius) < thickness / 2, type(p[0])(density), type(p[0])(0)
        )
    )


def on_a_sphere(radius: float) -> np.ndarray:
    """Cells that a sphere passes through, by many of its points."""
    v = np.random.default_rng(0).normal(size=(400_000, 3))
    p = radius * v / np.linalg.norm(v, axis=1, keepdims=True)
    cells = np.zeros((CELLS,) * 3, bool)
    cells[tuple(np.floor((p + 1) / 2 * CELLS).astype(int).T)] = True
    return cells


def test_the_same_field_keeps_the_same_cells(ad: Any) -> None:
    field = AnalyticField(ball(0.7, 50.0))
    grid = followed(ad, field)
    before = grid.mask()
    for _ in range(40):
        grid.follow(field)
    # Cells that a ball hardly touches may be seen now.
    assert grid.mask()[before].all() and grid.mask().sum() <= 1.1 * before.sum()


def test_one_look_where_little_changes(ad: Any) -> None:
    field = AnalyticField(ball(0.7, 50.0))
    grid = followed(ad, field)
    grid.follow(field)
    field.asked = 0
    for _ in range(10):
        grid.follow(field)
    assert field.asked <= 12 * 2 * 16384  # a block for the cells, one to compare


def test_what_the_grid_excluded_stays_hidden_while_it_is_the_same(ad: Any) -> None:
    """As behind a visual hull: the field is dense everywhere, and the grid knows better."""
    kept = np.zeros((CELLS,) * 3, bool)
    kept[4:9, 5:11, 6:12] = True
    grid = followed(ad, AnalyticField(uniform(20.0)), kept)
    for density in (21.0, 15.0, 40.0):
        grid.follow(AnalyticField(uniform(density)))
        assert np.array_equal(grid.mask(), kept)
    # Something much denser in the midst of it is no leftover of training.
    grid.follow(AnalyticField(lambda p: dr.select(p[0] > 0.5, 2000.0, 20.0)))
    mask = grid.mask()
    assert mask[12:].all() and mask[kept].all()
    assert not mask[:11][~kept[:11]].any()  # but for neighbours


def test_another_field_altogether(ad: Any) -> None:
    """What was excluded as a leftover counts if hardly anything is as it was."""
    kept = np.zeros((CELLS,) * 3, bool)
    kept[:4] = True
    grid = followed(ad, AnalyticField(uniform(20.0)), kept)
    grid.follow(AnalyticField(lambda p: dr.select(p[1] > 0.25, 30.0, 0.0)))
    assert grid.mask()[:, 10:].all()


@pytest.mark.parametrize("thickness", [0.02, 0.005])
def test_a_thin_shell_is_found(ad: Any, thickness: float) -> None:
    """It fills a sixth of its cells, or a twenty-fifth; before, there was a ball within."""
    grid = followed(ad, AnalyticField(ball(0.3, 50.0)))
    grid.follow(shell(0.8, thickness))
    missed = on_a_sphere(0.8) & ~grid.mask()
    assert missed.sum() <= 0.002 * on_a_sphere(0.8).sum()
    assert grid.fraction() < 0.6


def test_a_field_that_grows_step_by_step(ad: Any) -> None:
    grid = followed(ad, AnalyticField(ball(0.2, 50.0)))
    for radius in np.linspace(0.2, 0.9, 15):
        grid.follow(AnalyticField(ball(float(radius), 50.0)))
    edges = np.abs(np.linspace(-1, 1, CELLS + 1))
    far = np.maximum(edges[:-1], edges[1:])
    inside = np.add.outer(np.add.outer(far**2, far**2), far**2) < 0.88**2
    assert grid.mask()[inside].all()
    # And cells are given up when it shrinks again.
    for _ in range(150):
        grid.follow(AnalyticField(ball(0.2, 50.0)))
    assert grid.fraction() < 0.05


def test_an_unlucky_look_empties_no_cell(ad: Any) -> None:
    """A sheet that is hardly ever hit: the grid's cells stay."""
    sheet = AnalyticField(lambda p: dr.select(dr.abs(p[2] - 0.06) < 0.002, 500.0, 0.0))
    kept = np.zeros((CELLS,) * 3, bool)
    kept[:, :, CELLS // 2] = True
    grid = followed(ad, sheet, kept)
    for _ in range(60):
        grid.follow(sheet)
    assert grid.mask()[kept].all()


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_what_is_no_number_counts_as_full(ad: Any, value: float) -> None:
    grid = followed(ad, AnalyticField(ball(0.5, 50.0)))
    grid.follow(AnalyticField(uniform(value)))
    assert grid.fraction() == 1 and np.isfinite(grid.values()).all()
    for _ in range(150):
        grid.follow(AnalyticField(ball(0.5, 50.0)))
    assert grid.fraction() < 0.2


def test_a_grid_without_cells_is_no_verdict(ad: Any) -> None:
    field = AnalyticField(uniform(20.0))
    grid = followed(ad, field, np.zeros((CELLS,) * 3, bool))
    grid.follow(field)
    assert grid.fraction() == 1


def test_the_same_looks_every_time(ad: Any) -> None:
    masks = []
    for _ in range(2):
        grid = followed(ad, AnalyticField(ball(0.3, 50.0)))
        grid.follow(shell(0.8, 0.01))
        masks.append(grid.mask())
    assert np.array_equal(*masks)


def test_the_unit_of_length_does_not_matter(ad: Any) -> None:
    masks = []
    for scale in (1.0, 1000.0):

        def field(radius: float, s: float = scale) -> AnalyticField:
            density = ball(radius * s, 50.0 / s)
            return AnalyticField(density, None, (-s, -s, -s), (s, s, s))

        grid = followed(ad, field(0.3))
        grid.follow(field(0.7))
        masks.append(grid.mask())
    assert (masks[0] != masks[1]).sum() <= 2  # by rounding
