"""Rays drawn from the pixels of a dataset."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.cameras.pinhole import Intrinsics
from mi_nerf.commands.shared import flag
from mi_nerf.data import Dataset
from mi_nerf.images.metrics import tone_mapped
from mi_nerf.images.read import average_blocks
from mi_nerf.training import pixels
from mi_nerf.training.batches import RayBatch, RaySource, blank_loss, step_rng
from mi_nerf.training.config import PyramidConfig
from tests.training.test_pixels import views as random_views


def views(width: int, height: int) -> Dataset:
    """One black view that takes no memory, whatever its size."""
    images = np.broadcast_to(np.float32(0), (1, height, width, 4))
    camera = Intrinsics.from_angle_x(width, height, 0.7)
    return Dataset(Path("huge"), "train", ("r_0",), images, "srgb", True, np.eye(4)[None], camera)


def test_more_values_than_an_index_can_tell_apart(ad: Any) -> None:
    with pytest.raises(InputError) as refused:
        RaySource(views(1 << 15, 1 << 15), "white", ad.Float)
    assert str(refused.value) == (
        "huge: 1 views of 32768x32768 hold 4294967296 values, expected less than 4294967296 "
        "by a larger downscale"
    )
    assert refused.value.told(flag).endswith("a larger --downscale")


def test_one_value_less_is_drawn_from(ad: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pixels, "MOST_VALUES", 101)
    drawn = RaySource(views(5, 5), "white", ad.Float).draw(7, step_rng(ad.Float, 0, 0))
    assert len(drawn.alpha) == 7
    monkeypatch.setattr(pixels, "MOST_VALUES", 100)
    with pytest.raises(InputError, match="hold 100 values, expected less than 100"):
        RaySource(views(5, 5), "white", ad.Float)


# ---- Coarse images -------------------------------------------------------------------


def colored(ad: Any, pyramid: PyramidConfig) -> tuple[Dataset, RaySource]:
    """Two views of 24×18 random pixels from different places."""
    dataset = random_views(np.uint8, (2, 18, 24))
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, 3] = (0.5, -2, 3)
    dataset = replace(dataset, cam_to_world=poses)
    return dataset, RaySource(dataset, "white", ad.Float, pyramid)


def film_points(dataset: Dataset, drawn: RayBatch) -> tuple[np.ndarray[Any, Any], Any, Any]:
    """The view of each ray, and where it crosses the film, in pixels of the images."""
    o, d = np.array(drawn.o).T, np.array(drawn.d).T
    view = np.argmin(np.linalg.norm(o[:, None] - dataset.cam_to_world[:, :3, 3], axis=-1), axis=1)
    film = dataset.intrinsics
    return view, film.cx - film.fx * d[:, 0] / d[:, 2], film.cy + film.fy * d[:, 1] / d[:, 2]


@pytest.mark.parametrize("level", [0, 1, 2, 3])
def test_rays_of_a_level_see_the_downscaled_images(ad: Any, level: int) -> None:
    dataset, source = colored(ad, PyramidConfig(levels=3))
    drawn = source.draw(20000, step_rng(ad.Float, 3, 0), level=float(level))
    k = 2**level
    images = np.stack([average_blocks(dataset.image(i), k) for i in range(2)])
    view, x, y = film_points(dataset, drawn)
    column, row = x / k - 0.5, y / k - 0.5  # through the middle of the coarse pixels
    assert np.abs(column - np.rint(column)).max() < 1e-3
    assert np.abs(row - np.rint(row)).max() < 1e-3
    column, row = np.rint(column).astype(int), np.rint(row).astype(int)
    expected = images[view, row, column]
    found = np.stack([np.array(c) for c in (*drawn.color, drawn.alpha)], axis=-1)
    assert found == pytest.approx(expected, abs=1e-6)
    everywhere = len({*zip(view, row, column, strict=True)})
    assert everywhere == images[..., 0].size  # every coarse pixel has its turn


def sizes_of_blocks(dataset: Dataset, drawn: RayBatch, levels: int) -> np.ndarray[Any, Any]:
    """Level of each ray, by the block whose mean is its colour."""
    view, x, y = film_points(dataset, drawn)
    found = np.stack([np.array(c) for c in (*drawn.color, drawn.alpha)], axis=-1)
    result = np.full(len(found), -1)
    for level in range(levels + 1):
        k = 2**level
        images = np.stack([average_blocks(dataset.image(i), k) for i in range(2)])
        column, row = ((n / k + 1e-4).astype(int) for n in (x, y))
        inside = (row < images.shape[1]) & (column < images.shape[2])
        column, row = (np.where(inside, n, 0) for n in (column, row))
        same = np.abs(images[view, row, column] - found).max(axis=-1) < 1e-5
        result[same & inside] = level
    return result


def test_between_two_levels_each_has_its_share(ad: Any) -> None:
    dataset, source = colored(ad, PyramidConfig(levels=3))
    drawn = source.draw(4000, step_rng(ad.Float, 3, 0), level=1.25)
    levels = sizes_of_blocks(dataset, drawn, 3)
    assert set(levels) == {1, 2}
    assert np.mean(levels == 2) == pytest.approx(0.25, abs=0.03)  # 4 standard deviations


def test_a_mixed_share_sees_every_level(ad: Any) -> None:
    dataset, source = colored(ad, PyramidConfig(levels=3, mixed=0.4))
    levels = sizes_of_blocks(dataset, source.draw(4000, step_rng(ad.Float, 3, 0)), 3)
    shares = [np.mean(levels == level) for level in range(4)]
    assert shares == pytest.approx([0.7, 0.1, 0.1, 0.1], abs=0.03)


def test_jitter_stays_within_the_coarse_pixel(ad: Any) -> None:
    dataset, source = colored(ad, PyramidConfig(levels=2, jitter=True))
    drawn = source.draw(4000, step_rng(ad.Float, 3, 0), level=2.0)
    assert (sizes_of_blocks(dataset, drawn, 2) == 2).mean() > 0.999  # but for rounding at edges
    _, x, _ = film_points(dataset, drawn)
    places = np.histogram(x % 4, bins=4, range=(0, 4))[0] / len(x)
    assert places == pytest.approx([0.25] * 4, abs=0.03)


def test_the_middle_of_the_images_at_a_coarse_level(ad: Any) -> None:
    dataset, source = colored(ad, PyramidConfig(levels=1))
    drawn = source.draw(2000, step_rng(ad.Float, 3, 0), crop=0.5, level=1.0)
    _, x, y = film_points(dataset, drawn)
    assert (x.min(), x.max()) == pytest.approx((7, 17), abs=1e-3)
    assert (y.min(), y.max()) == pytest.approx((5, 11), abs=1e-3)


def test_without_levels_rays_are_what_they_were(ad: Any) -> None:
    _, plain = colored(ad, PyramidConfig())
    dataset, _ = colored(ad, PyramidConfig())
    drawn = plain.draw(500, step_rng(ad.Float, 3, 0))
    chosen = step_rng(ad.Float, 3, 0).integers(ad.UInt32, 500, high=2 * 18 * 24)
    expected = dataset.premultiplied().reshape(-1, 4)[np.array(chosen)]
    found = np.stack([np.array(c) for c in (*drawn.color, drawn.alpha)], axis=-1)
    assert found == pytest.approx(expected, abs=3e-7)


def test_another_level_compiles_nothing(ad: Any) -> None:
    _, source = colored(ad, PyramidConfig(levels=3, mixed=0.1, jitter=True))
    source.draw(512, step_rng(ad.Float, 3, 0), level=3.0)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for step, level in enumerate([3.0, 2.6, 1.0, 0.2, 0.0]):
            source.draw(512, step_rng(ad.Float, 3, step + 1), level=level)
        history = dr.kernel_history([dr.KernelType.JIT])
    assert history and all(entry["cache_hit"] for entry in history)


@pytest.mark.parametrize("background", ["white", "black", "random"])
def test_a_collapsed_field_at_a_coarse_level(background: str) -> None:
    dataset = random_views(np.uint8, (3, 16, 16))
    blocks = [average_blocks(dataset.image(i), 4) for i in range(3)]
    camera = dataset.intrinsics.downscale(4)
    coarse = replace(dataset, images=np.stack(blocks), intrinsics=camera)
    found = blank_loss(dataset, background, level=2)
    assert found == pytest.approx(blank_loss(coarse, background))
    assert found < blank_loss(dataset, background)


@pytest.mark.parametrize("background", ["white", "black", "random"])
def test_a_collapsed_field_of_radiance(background: str) -> None:
    """Errors after tone mapping; with random backgrounds, of what is premultiplied."""
    rng = np.random.default_rng(0)
    alpha = rng.random((3, 8, 8, 1)).astype(np.float32)
    color = alpha * 10 ** rng.uniform(-3, 3, (3, 8, 8, 3)).astype(np.float32)
    images = np.concatenate([color, alpha], axis=-1)
    camera = Intrinsics.from_angle_x(8, 8, 0.6)
    base = random_views(np.uint8, (3, 8, 8))
    dataset = replace(base, images=images, color_space="linear", intrinsics=camera)
    behind = 1.0 if background == "white" else 0.0
    seen = tone_mapped(color.astype(np.float64) + (1 - alpha) * behind).reshape(-1, 3)
    empty = np.mean((seen - tone_mapped(np.float64(behind))) ** 2)
    even = np.mean((seen - seen.mean(axis=0)) ** 2)
    expected = empty if background == "random" else min(empty, even)
    assert blank_loss(dataset, background, 0, "relative") == pytest.approx(expected, rel=1e-5)
