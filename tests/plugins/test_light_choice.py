"""Which points of light sources paths are connected to, against sums over all of them."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.plugins.test_nerf_path import agree, floor, overhead, paths, point_light, statistics
from tests.support.composed import place, rgb, scene_of

pytestmark = pytest.mark.usefixtures("variant")


def chosen(weights: list[float], choices: int = 20000) -> tuple[np.ndarray, np.ndarray]:
    """Which of M points is chosen, and by what it counts, for evenly spread numbers in [0, 1)."""
    from mi_nerf.plugins.light_choice import choose

    count, known = len(weights), mi.Float(weights)

    def brings(number: Any) -> Any:
        return dr.gather(mi.Float, known, mi.UInt32(dr.round(number.x * count)) % count)

    choice = (dr.arange(mi.Float, choices) + 0.5) / choices
    number = dr.zeros(mi.Point2f, choices)
    found = choose(brings, number, choice, count, mi.Bool(True))
    x = np.array(found.number.x)
    return np.rint(x * count).astype(int) % count, np.array(found.weight, np.float64) + 0 * x


@given(st.lists(st.one_of(st.just(0.0), st.floats(1e-3, 1e3)), min_size=1, max_size=9))
def test_every_point_counts_alike_on_average(weights: list[float]) -> None:
    """Each as 1/M, whatever the light that is expected: the estimate has no bias."""
    which, counts = chosen(weights)
    mean = np.bincount(which, counts, minlength=len(weights)) / len(which)
    # The rarest point has about 20000 · 0.05 / 9 of the choices, give or take a few.
    np.testing.assert_allclose(mean, 1 / len(weights), rtol=5e-2)


@given(st.lists(st.one_of(st.just(0.0), st.floats(1e-3, 1e3)), min_size=2, max_size=9))
def test_no_point_brings_much_more_than_the_mean(weights: list[float]) -> None:
    which, counts = chosen(weights, 2000)
    brought = np.array(weights)[which] * counts
    assert brought.max() <= np.mean(weights) / 0.95 * (1 + 1e-4)
    if min(weights) > 0:  # nearly always the very mean
        exact = np.abs(brought / np.mean(weights) - 1 / 0.95) < 0.2
        assert exact.mean() > 0.5


def test_points_of_the_lattice_are_spread_evenly() -> None:
    """Over all of them and over the first one; each M-th of the unit interval has one."""
    from mi_nerf.plugins.light_choice import lattice_point

    rng = np.random.default_rng(0)
    first = rng.random((2, 4096)).astype(np.float32)
    points = np.array(
        [np.array(lattice_point(mi.Point2f(*first), mi.UInt32(j), 8)) for j in range(8)]
    )
    assert points.min() >= 0 and points.max() < 1
    np.testing.assert_allclose(points[0], first, atol=1e-7)
    strata = np.sort((points[:, 0] * 8).astype(int), axis=0)
    assert (strata == np.arange(8)[:, None]).mean() > 0.999  # but for rounding
    for j in range(8):
        for axis in points[j]:
            assert np.abs(np.histogram(axis, 8, (0, 1))[0] / 512 - 1).max() < 0.2


def lights() -> dict[str, Any]:
    """Of all kinds, most of them of no use to most of the floor."""
    weak = {"type": "constant", "radiance": 0.05}
    behind = {
        "type": "rectangle",
        "to_world": place().translate([0, 0, -3]).scale(2),
        "emitter": {"type": "area", "radiance": rgb((50, 40, 30))},
    }
    return {
        "lamp": overhead((9, 8, 7)),
        "behind": behind,
        "point": point_light([1.5, -1, 2], 5.0),
        "sky": weak,
    }


@pytest.mark.slow
def test_candidates_change_the_noise_and_not_the_mean() -> None:
    metal = {"type": "roughconductor", "alpha": 0.2}
    solids = {
        "floor": floor(),
        "ball": {"type": "sphere", "center": [0, 0, -0.4], "radius": 0.5, "bsdf": metal},
    }
    seen = [
        statistics(
            scene_of(paths(max_depth=3, emitter_candidates=n), **solids, **lights()), 64, runs=12
        )
        for n in (1, 8)
    ]
    agree(*seen)
    noise = [np.square(error).mean() for _, error in seen]
    assert noise[1] < noise[0] / 2, noise  # 2.6 when it was made


def test_a_scene_without_lights_is_dark() -> None:
    from tests.support.composed import render

    assert render(scene_of(paths(), floor=floor()))[..., :3].max() == 0
