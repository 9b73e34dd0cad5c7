"""Sizes that follow the resolution of the images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerf.cameras.pinhole import Intrinsics
from mi_nerf.data import Dataset
from mi_nerf.training.config import TrainConfig, from_json, to_json, with_settings
from mi_nerf.training.model import field_config
from mi_nerf.training.presets import preset
from mi_nerf.training.scaling import (
    Sizes,
    fitting_batch,
    fitting_entries,
    pixels_across,
    resolved,
    sizes,
    summary,
    usual_batch,
)

USUAL = {  # of version 0.1.0
    "fast": Sizes(log2_entries=16, cells=64, queries=8192, samples=64, render_samples=128),
    "nerf": Sizes(log2_entries=16, cells=96, queries=16384, samples=64, render_samples=128),
}


def views(size: int, side: float = 2.0, distance: float = 4.0) -> Dataset:
    """Two views of size×size pixels that take no memory, of a box with sides ``side``."""
    images = np.broadcast_to(np.uint8(0), (2, size, size, 4))
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[0, 2, 3], poses[1, :3, :3] = distance, np.diag([-1, 1, -1])
    poses[1, 2, 3] = -distance
    camera, half = Intrinsics(size, size, 1.4 * size, 1.4 * size, size / 2, size / 2), side / 2
    box = ((-half, -half, -half), (half, half, half))
    return Dataset(
        Path("views"), "train", ("a", "b"), images, "srgb", False, poses, camera, box=box
    )


def found(name: str, size: int, *settings: str) -> TrainConfig:
    return resolved(with_settings(preset(name), list(settings)), views(size))


def sizes_of(config: TrainConfig) -> dict[str, Any]:
    grid = {"log2_entries": config.grid.log2_entries} if config.grid is not None else {}
    return {
        **grid,
        "cells": config.occupancy.resolution,
        "queries": config.occupancy.queries,
        "samples": config.sampling.samples,
        "render_samples": config.sampling.render_samples,
    }


def test_pixels_across_the_box() -> None:
    dataset = views(100)
    assert pixels_across(dataset, (-1, -1, -1), (1, 1, 1)) == pytest.approx(140 * 2 / 4)


@pytest.mark.parametrize("name", ["nerf", "fast"])
@pytest.mark.parametrize("pixels", [1, 40, 82, 105, 165, 210, 220])
def test_small_images_have_the_sizes_of_before(name: str, pixels: float) -> None:
    assert sizes(pixels, name == "fast") == USUAL[name]


def test_full_size_lego() -> None:
    expected = Sizes(log2_entries=17, cells=128, queries=16384, samples=128, render_samples=256)
    assert sizes(677, features=True) == expected


@given(st.floats(1, 1e5), st.floats(1, 1e5), st.booleans())
def test_sizes_grow_with_the_resolution(one: float, other: float, features: bool) -> None:
    small, large = (vars(sizes(p, features)) for p in sorted((one, other)))
    assert all(small[name] <= large[name] for name in small)
    assert large["log2_entries"] <= 22 and large["samples"] % 16 == 0


def test_twice_the_entries_for_twice_the_pixels() -> None:
    entries = [sizes(220 * 2**octave, features=True).log2_entries for octave in range(4)]
    assert entries == [16, 17, 18, 19]


@pytest.mark.parametrize("name", ["nerf", "fast"])
@pytest.mark.parametrize("size", [100, 200])
def test_presets_at_small_sizes_are_what_they_were(name: str, size: int) -> None:
    config = found(name, size)
    usual = {k: v for k, v in vars(USUAL[name]).items() if name == "fast" or k != "log2_entries"}
    assert sizes_of(config) == usual
    assert config.sampling.batch == {"nerf": 4096, "fast": 16384}[name]
    assert config.pyramid.levels == 0


def test_presets_grow_with_the_images() -> None:
    config = found("fast", 800)  # 560 pixels across the box
    assert sizes_of(config) == vars(sizes(560, features=True))
    assert config.pyramid.levels == 3
    assert found("fast", 400).pyramid.levels == 2
    field = field_config(config, views(800))
    assert field.grid is not None and field.grid.log2_entries == config.grid.log2_entries


def test_what_is_set_stays() -> None:
    settings = ["grid.log2_entries=12", "occupancy.resolution=40", "occupancy.queries=100"]
    settings += ["sampling.samples=48", "sampling.render_samples=7", "sampling.batch=999"]
    config = found("fast", 800, *settings, "pyramid.levels=1")
    assert sizes_of(config) == vars(
        Sizes(log2_entries=12, cells=40, queries=100, samples=48, render_samples=7)
    )
    assert config.sampling.batch == 999 and config.pyramid.levels == 1


def test_strata_and_batch_suit_each_other() -> None:
    assert found("fast", 800, "sampling.batch=32").sampling.samples == 32
    assert found("fast", 100, "sampling.samples=50000").sampling.batch == 50000


@pytest.mark.parametrize("name", ["nerf", "fast", "paper", "auto"])
def test_a_resolved_configuration_survives_json_and_resolving(name: str) -> None:
    config = found(name, 800)
    assert from_json(to_json(config), "here") == config
    assert resolved(config, views(100)) == config


def test_the_box_is_found_once() -> None:
    dataset = views(100)
    assert resolved(preset("fast"), dataset).box == (-1, -1, -1, 1, 1, 1)
    given = replace(preset("fast"), box=(0.0, 0.0, 0.0, 1.0, 1.0, 1.0))
    assert resolved(given, dataset).box == given.box


def test_a_batch_fits_in_memory() -> None:
    assert fitting_batch(16384, 64, 8 << 30) == 16384
    assert fitting_batch(16384, 64, 256 << 20) == 4096
    assert fitting_batch(16384, 5000, 64 << 20) == 5000
    assert usual_batch(features=True) == 16384 and usual_batch(features=False) == 4096


def test_a_table_fits_in_memory() -> None:
    assert fitting_entries(19, 8, 4, 24 << 30) == 19
    assert fitting_entries(22, 8, 4, 4 << 30) == 20  # 2^20 · 32 numbers: 128 of 205 MiB
    assert fitting_entries(22, 8, 4, 1 << 20) == 12


def test_the_summary_says_what_was_found() -> None:
    dataset = views(800)
    config = resolved(preset("fast"), dataset)
    text = summary(config, field_config(config, dataset), 4 * 2 * 800 * 800)
    assert "2^17 entries" in text and "strata" in text and "images of 5 MiB" in text
    assert "images from 1/8 size on" in text
