"""The grid of a field in training: a closed form as the field, whose cells are known."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from mi_nerf.fields.closed_form import closed_form
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.occupancy import OccupancyGrid
from mi_nerf.march.placing import place_samples
from mi_nerf.march.samples import Samples
from mi_nerf.march.settings import MarchSettings
from mi_nerf.march.strata import points_along
from mi_nerf.march.trained import _EVERY, _START, TrainedGrid
from tests.support.arrays import vectors


def slab(ad: Any) -> Any:
    """Dense in the lower half of the box [-1, 1]^3."""
    numbers = {"position": 0.0, "before": 20.0, "beyond": 0.0, "edge": 0.0}
    return closed_form("step", numbers, ad.TensorXf)


def trained(ad: Any, cells: np.ndarray) -> TrainedGrid:
    field = slab(ad)
    return TrainedGrid(OccupancyGrid(field.lower, field.upper, cells, ad.Float), ad.Float)


def test_it_finds_what_is_empty_within_its_cells(ad: Any) -> None:
    cells = np.zeros((8, 8, 8), bool)
    cells[1:7, :, 2:7] = True
    grid, field = trained(ad, cells), slab(ad)
    with dr.suspend_grad():
        for _ in range(_START + 4 * _EVERY):
            grid.follow(field)
    dense = np.zeros_like(cells)
    dense[..., :4] = True  # z is the last axis, the step at 0 in the middle
    np.testing.assert_array_equal(grid.mask(), cells & dense)


def test_it_looks_seldom_and_not_from_the_start(ad: Any) -> None:
    grid, field, looks = trained(ad, np.ones((8, 8, 8), bool)), slab(ad), []
    refresh = grid.refresh

    def spy(*args: Any, **options: Any) -> None:
        looks.append(options["queries"])
        refresh(*args, **options)

    grid.refresh = spy  # type: ignore[method-assign]
    for _ in range(_START - 1):
        grid.follow(field)
    assert looks == [] and grid.fraction() == 1
    for _ in range(10 * _EVERY):
        grid.follow(field)
    assert looks == [128 * 8] * 10


def test_it_knows_what_is_dense_everywhere(ad: Any) -> None:
    """Below the step, the least density of a cell rises to what it is; beyond, it stays 0."""
    grid, field = trained(ad, np.ones((4, 4, 4), bool)), slab(ad)
    rays = np.random.default_rng(0).uniform(-1, 1, (2000, 3))
    rays[:, 2] = 1  # from above
    o, d = vectors(ad, rays), vectors(ad, np.tile([0.0, 0, -1], (2000, 1)))

    def train() -> None:
        samples = place_samples(MarchedField(field, MarchSettings(samples=16), grid), o, d)
        grid.follow(field)
        grid.witness(samples, field.density(points(ad, samples)))

    for _ in range(10):
        train()
    assert not grid.floor().any()  # not from the start
    for _ in range(_START + 100):
        train()
    floor = grid.floor()
    assert floor[..., :2].min() > 15 and floor[..., :2].max() <= 20
    assert floor[..., 2:].max() == 0


def points(ad: Any, samples: Samples) -> Any:
    """Where all samples are."""
    ray = dr.arange(ad.UInt32, len(samples.t)) // samples.count
    return points_along(samples.o, samples.d, samples.t, ray)
