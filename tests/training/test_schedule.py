"""Learning rates and the sharpness of images over a run."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerf.fields.hash_grid import HashGridConfig
from mi_nerf.training.config import OptimizerConfig, PyramidConfig
from mi_nerf.training.schedule import grid_level_weights, image_level, learning_rate

LATE = 1000  # a step after warm-up


@pytest.mark.parametrize(
    ("schedule", "progress", "expected"),
    [
        ("exponential", 0.5, math.sqrt(1e-2 * 1e-4)),
        ("linear", 0.25, 0.75 * 1e-2 + 0.25 * 1e-4),
        ("cosine", 0.5, (1e-2 + 1e-4) / 2),
        ("cosine", 1 / 3, 1e-4 + 0.75 * (1e-2 - 1e-4)),
    ],
)
def test_values(schedule: str, progress: float, expected: float) -> None:
    options = OptimizerConfig(lr=1e-2, lr_final=1e-4, schedule=schedule)  # type: ignore[arg-type]
    assert learning_rate(options, progress, LATE) == pytest.approx(expected)


@given(st.sampled_from(["exponential", "linear", "cosine"]), st.floats(0, 1), st.floats(0, 1))
def test_rates_fall_from_first_to_last(schedule: str, one: float, other: float) -> None:
    options = OptimizerConfig(lr=3e-3, lr_final=2e-5, schedule=schedule)  # type: ignore[arg-type]
    early, late = (learning_rate(options, p, LATE) for p in sorted((one, other)))
    assert late <= early * (1 + 1e-12)
    assert learning_rate(options, 0.0, LATE) == pytest.approx(3e-3)
    assert learning_rate(options, 1.0, LATE) == pytest.approx(2e-5)


@pytest.mark.parametrize("schedule", ["linear", "cosine"])
def test_a_rate_may_end_at_zero(schedule: str) -> None:
    options = OptimizerConfig(lr=1e-2, lr_final=0, schedule=schedule)  # type: ignore[arg-type]
    assert learning_rate(options, 1.0, LATE) == pytest.approx(0, abs=1e-17)
    assert learning_rate(options, 0.9, LATE) > 0


def test_an_exponential_never_does() -> None:
    with pytest.raises(ValueError, match="lr_final=0, expected a number above 0"):
        OptimizerConfig(lr_final=0)


@pytest.mark.parametrize("schedule", ["exponential", "linear", "cosine"])
def test_warm_up_comes_first(schedule: str) -> None:
    options = OptimizerConfig(lr=1e-2, warmup=10, schedule=schedule)  # type: ignore[arg-type]
    rates = [learning_rate(options, 0.0, step) for step in range(12)]
    assert rates == pytest.approx([1e-3 * min(k, 10) for k in range(1, 13)])


def test_images_sharpen_evenly_and_stay_sharp() -> None:
    options = PyramidConfig(levels=3, until=0.6)
    levels = [image_level(options, p) for p in (0, 0.1, 0.2, 0.4, 0.6, 0.8, 1)]
    assert levels == pytest.approx([3, 2.5, 2, 1, 0, 0, 0], abs=1e-12)


def test_images_without_coarser_ones_are_sharp_from_the_start() -> None:
    assert image_level(PyramidConfig(levels=0), 0.0) == 0
    assert image_level(PyramidConfig(levels=3, until=0.0), 0.0) == 0


# ---- Levels of the grid --------------------------------------------------------------


def test_levels_join_as_the_images_sharpen() -> None:
    grid = HashGridConfig(levels=7, coarsest=16, finest=1024)  # a level an octave
    options = PyramidConfig(levels=3, until=0.6)
    assert grid_level_weights(options, grid, 0.0) == pytest.approx([1, 1, 1, 1, 0, 0, 0])
    assert grid_level_weights(options, grid, 0.1) == pytest.approx([1, 1, 1, 1, 0.5, 0, 0])
    assert grid_level_weights(options, grid, 0.5) == pytest.approx([1, 1, 1, 1, 1, 1, 0.5])
    assert grid_level_weights(options, grid, 0.6) == pytest.approx([1] * 7)


@given(st.integers(1, 12), st.integers(0, 5), st.floats(0, 1), st.floats(0, 1))
def test_weights_of_levels(levels: int, coarser: int, one: float, other: float) -> None:
    grid = HashGridConfig(levels=levels, coarsest=16, finest=512)
    options = PyramidConfig(levels=coarser, until=0.5)
    early, late = (grid_level_weights(options, grid, p) for p in sorted((one, other)))
    assert len(early) == levels and early[0] == 1
    assert all(0 <= a <= b + 1e-9 <= 1 + 2e-9 for a, b in zip(early, late, strict=True))
    assert early == sorted(early, reverse=True)
    assert grid_level_weights(options, grid, 1.0) == pytest.approx([1] * levels)
