"""The hard cases: what goes wrong with the usual formula must not go wrong with ours.

One section a row of docs/stability.md. The first test of a section asserts, of the numbers
measured in :mod:`tests.hard_cases`, that the usual formula violates what ours satisfies; the
names of the tests are those of the table. Random numbers follow in test_stability_fuzz.py.
"""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest

from mi_nerf.base.variants import array_module
from mi_nerf.cameras.pinhole import Intrinsics
from mi_nerf.data import Dataset, load_dataset
from mi_nerf.fields.network import initial_weights
from mi_nerf.training.config import TrainConfig, with_settings
from mi_nerf.training.optimizer import Adam
from mi_nerf.training.presets import preset
from mi_nerf.training.trainer import Trainer
from tests.benchmarks.results import RESULTS, Row, load
from tests.hard_cases import Case, Finding, fields, media, networks, rays, training
from tests.hard_cases.cases import CASES
from tests.support.datasets import blob_images, orbit_poses, write_blob_dataset

SMALL = [
    *("network.width=16", "network.view_width=8", "sampling.batch=1024", "sampling.samples=24"),
    *("occupancy.resolution=16", "occupancy.start=4", "occupancy.every=4"),
    "occupancy.queries=512",
]


def small(*settings: str) -> TrainConfig:
    return with_settings(preset("nerf"), [*SMALL, *settings])


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = write_blob_dataset(tmp_path_factory.mktemp("blob"), train=4, test=1, size=16)
    return load_dataset(folder, "train")


@functools.cache
def measured(case: Callable[[Any], list[Finding]], ad: Any) -> list[Finding]:
    """The numbers of a case: those of its row, and those of the table."""
    return case(ad)


def losses(trainer: Trainer, steps: int) -> np.ndarray:
    found = np.array([float(trainer.step(5e-3).loss[0]) for _ in range(steps)])
    assert all(np.isfinite(w).all() for w in trainer.field.weights().values())
    return found


# ---- 1: thin fog --------------------------------------------------------------


def test_row_01_thin_media(ad: Any) -> None:
    *values, slope = measured(media.thin_media, ad)
    assert all(v.naive > low for v, low in zip(values, (0.99, 0.1, 0.01), strict=True))
    assert all(v.ours < 1e-6 for v in values)
    assert slope.naive > 0.1 and slope.ours < 1e-6


# ---- 2: transmittance -----------------------------------------------------------


def test_row_02_transmittance(ad: Any) -> None:
    depth, slope, leak = measured(media.transmittance, ad)
    assert depth.naive > 1e-2 and depth.ours < 1e-5
    assert slope.naive > 1e-2 and slope.ours < 1e-5
    assert leak.naive > 1e-11 and leak.ours < 1e-30


# ---- 3: the last interval ---------------------------------------------------------


def test_row_03_last_interval(ad: Any) -> None:
    opacity, slope, infinite = measured(media.last_interval, ad)
    assert opacity.naive == 1 and opacity.ours == pytest.approx(1e-6, rel=1e-5)
    assert slope.naive > 1e9 and slope.ours < 1e-6
    assert math.isnan(infinite.naive) and infinite.ours == 0


# ---- 4: overflow of the exponential --------------------------------------------------


def test_row_04_density_overflow(ad: Any) -> None:
    value, slope, clipped = measured(media.density_overflow, ad)
    assert math.isinf(value.naive) and math.isfinite(value.ours)
    assert math.isinf(slope.naive) and slope.ours == pytest.approx(math.exp(15), rel=1e-5)
    assert clipped.naive == 0 < clipped.ours


# ---- 5: behind opaque surfaces ----------------------------------------------------------


def test_row_05_opaque_walls(ad: Any) -> None:
    lost, front = measured(media.opaque_walls, ad)
    assert lost.naive > 0 and lost.ours == 0
    assert front.ours < 1e-6  # and the surface still moves


# ---- 6: dead density -------------------------------------------------------------------------


@pytest.mark.slow
def test_row_06_dead_density(ad: Any) -> None:
    """How collapsed runs are found and restarted: training/test_run.py, "Failures"."""
    density, gradient, shifted = measured(networks.dead_density, ad)
    assert density.naive >= 1 and density.ours == 0
    assert gradient.naive >= 1 and gradient.ours == 0
    assert shifted.naive == networks.SEEDS and shifted.ours == 0


@pytest.mark.slow
def test_row_06_the_published_activation_with_our_weights(ad: Any) -> None:
    """The preset ``paper`` keeps the ReLU."""
    assert preset("paper").density.activation == "relu"
    assert networks.densities(ad, networks.PUBLISHED, initial_weights) == (0, 0)


# ---- 7: inverse transform with empty bins -------------------------------------------------------


def test_row_07_empty_bins(ad: Any) -> None:
    """All-zero weights and exact ends: march/test_importance.py. No gradient: row 8."""
    (collapsed,) = measured(rays.empty_bins, ad)
    assert collapsed.naive == 30 and collapsed.ours == 0


# ---- 8: gradients through sample positions ------------------------------------------------------


def test_row_08_sample_positions(ad: Any) -> None:
    """In training, and for rays: training/ and march/test_query_gradients.py."""
    (slope,) = measured(rays.sample_positions, ad)
    assert slope.naive > 10 and slope.ours == 0


# ---- 9: high octaves ----------------------------------------------------------------------------


def test_row_09_high_octaves(ad: Any) -> None:
    """At every octave and in every convention: fields/test_fourier.py."""
    value, slope, plain, half = measured(networks.high_octaves, ad)
    for finding in (value, slope, plain, half):
        assert finding.naive > 0.01 and finding.ours < 1e-6


# ---- 10: NaN and infinity -----------------------------------------------------------------------


def test_row_10_not_a_number(ad: Any) -> None:
    """Skipped steps are counted, and end a run: training/test_run.py, "Failures"."""
    passing, lost = measured(networks.not_a_number, ad)
    assert passing.naive == 0 and passing.ours == 1
    assert lost.naive == 50 and lost.ours == 0


def test_row_10_a_step_is_taken_after_one_that_was_not(ad: Any) -> None:
    """Moments and corrections for bias are those of a run that never saw the NaN."""
    found = []
    for skipped in (True, False):
        parameters = {"w": ad.TensorXf(np.ones(100, np.float32))}
        optimizer = Adam(parameters)
        for gradient in networks.gradients(ad)[0 if skipped else 1 :]:
            dr.set_grad(parameters["w"], gradient)
            optimizer.step(0.1, ad.Bool(True))
        found.append({**optimizer.state(), "w": np.array(parameters["w"])})
    assert all(np.array_equal(found[0][name], found[1][name]) for name in found[1])
    assert (found[0]["w"] < 1).all()


# ---- 11: rays against the box -------------------------------------------------------------------


def test_row_11_box(ad: Any) -> None:
    """Every kind of ray by its name: march/test_strata.py."""
    bounds, slope = measured(rays.box, ad)
    assert bounds.naive > 100 and bounds.ours == 0
    assert slope.ours == 0


# ---- 12: normalised device coordinates ----------------------------------------------------------


def test_row_12_projection(ad: Any) -> None:
    """Captures that look around are refused: data/test_llff.py, test_forward_facing.py."""
    coordinates, slopes, behind = measured(rays.projection, ad)
    assert coordinates.naive > 0 and coordinates.ours == 0
    assert slopes.naive > 0 and slopes.ours == 0
    assert behind.naive == 2 and behind.ours == 0


# ---- 13: empty rays -----------------------------------------------------------------------------


def test_row_13_empty_rays(ad: Any) -> None:
    """Next to nothing still has its depth: march/test_quadrature.py."""
    depth, slope = measured(media.empty_rays, ad)
    assert math.isnan(depth.naive) and depth.ours == 0
    assert slope.naive == 4 and slope.ours == 0


# ---- 14: a thin sheet ---------------------------------------------------------------------------


def test_row_14_thin_sheet(ad: Any) -> None:
    opacity, slope = measured(fields.thin_sheet, ad)
    assert opacity.naive == 1 and opacity.ours < 0.02
    assert slope.naive == 1 and slope.ours < 0.02


def test_row_14_the_hierarchy_finds_what_its_samples_can_hit(ad: Any) -> None:
    """128 fine samples in 1/16 are 5e-4 apart: half a sheet of that is not resolved."""
    errors = {w: fields.sheet_errors(ad, w) for w in fields.THICKNESSES}
    assert all(e["64 + 128"][0] < 0.02 for w, e in errors.items() if w >= 1e-3)
    assert all(e["192 even"][0] == 1 for w, e in errors.items() if w <= 3e-3)


# ---- 15: from inside ----------------------------------------------------------------------------


@pytest.mark.slow
def test_row_15_inside_the_volume(ad: Any) -> None:
    """With near and far planes: march/test_render.py."""
    opacity, slope = measured(fields.inside_the_volume, ad)
    assert opacity.naive > 0.1 and opacity.ours < 1e-5
    assert slope.naive > 0.1 and slope.ours < 1e-5


# ---- 16: the unit of the scene ------------------------------------------------------------------


@pytest.mark.slow
def test_row_16_scene_unit(ad: Any) -> None:
    opacity, slope = measured(fields.scene_unit, ad)
    assert opacity.naive > 0.99 and opacity.ours < 1e-5
    assert slope.naive > 0.99 and slope.ours < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("scale", [2.0**-10, 2.0**13])
def test_row_16_training_knows_no_unit(ad: Any, views: Dataset, scale: float) -> None:
    """Powers of 2 change no digit: every step must be the same."""
    poses = views.cam_to_world.copy()
    poses[:, :3, 3] *= scale
    expected = losses(Trainer(small(), views, ad), 12)
    found = losses(Trainer(small(), replace(views, cam_to_world=poses), ad), 12)
    assert found == pytest.approx(expected, rel=1e-4)


# ---- 17: saturated colours, white on white ------------------------------------------------------


def test_row_17_saturation(ad: Any) -> None:
    """Slopes at both ends of the range: fields/test_activations.py."""
    logarithm, pull = measured(networks.saturation, ad)
    assert math.isinf(logarithm.naive) and math.isfinite(logarithm.ours)
    assert pull.naive == 0 and pull.ours > 0.1


@pytest.mark.slow
def test_row_17_white_objects_become_opaque(ad: Any, views: Dataset) -> None:
    """Training places images with alpha before random colours unless it is told otherwise."""
    images = views.premultiplied().copy()
    images[..., :3] = images[..., 3:]  # premultiplied white
    white = replace(views, images=images)
    opacities = {}
    for background in ("white", "auto"):
        trainer = Trainer(small(f"background={background}", "occupancy.hull=false"), white, ad)
        losses(trainer, 150)
        density = trainer.field.density(dr.zeros(ad.Array3f, 1))
        opacities[background] = -math.expm1(-float(density[0]) * 0.8)
    assert opacities["auto"] > 0.9 > opacities["white"]


# ---- 18: next to nothing ------------------------------------------------------------------------


def test_row_18_one_sample(ad: Any) -> None:
    """Tiny films, crop windows: plugins/test_nerf.py; no rays: march/test_render.py."""
    (error,) = measured(rays.one_sample, ad)
    assert math.isnan(error.naive) and error.ours < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize(("count", "width", "height"), [(1, 1, 1), (1, 9, 1), (1, 8, 8), (3, 1, 7)])
def test_row_18_training_on_next_to_nothing(ad: Any, count: int, width: int, height: int) -> None:
    """One view, one pixel, one row, one column."""
    poses = orbit_poses(count)
    images = blob_images(poses, 16, 0.6)[:, 4 : 4 + height, 4 : 4 + width] / np.float32(255)
    images[..., :3] *= images[..., 3:]
    dataset = Dataset(
        path=Path(),
        split="train",
        names=tuple(map(str, range(count))),
        images=images.astype(np.float32),
        color_space="srgb",
        has_alpha=True,
        cam_to_world=poses,
        intrinsics=Intrinsics.from_angle_x(width, height, 0.6),
    )
    trainer = Trainer(small(), dataset, ad)
    assert np.isfinite(losses(trainer, 9)).all()
    assert trainer.step(5e-3).queries > 0


@pytest.mark.slow
def test_row_18_steps_that_see_nothing(ad: Any, views: Dataset) -> None:
    """All views look away from the box."""
    config = small("box=20,20,20,21,21,21")
    assert np.isfinite(losses(Trainer(config, views, ad), 9)).all()


@pytest.mark.slow
def test_row_18_one_ray_and_one_sample_a_step(ad: Any, views: Dataset) -> None:
    config = small("sampling.rays=1", "sampling.samples=1", "sampling.batch=1")
    assert np.isfinite(losses(Trainer(config, views, ad), 9)).all()


# ---- 19: targets of high dynamic range ----------------------------------------------------------


def test_row_19_hdr_targets(ad: Any) -> None:
    for finding in measured(training.hdr_targets, ad):
        assert finding.naive > 1e9 and finding.ours < 2


@pytest.mark.slow
def test_row_19_linear_images_get_the_relative_loss(ad: Any, views: Dataset) -> None:
    """From 1e-3 to 1e4 in one picture."""
    images = views.premultiplied().copy()
    images[..., :3] *= np.logspace(-3, 4, 16, dtype=np.float32)[:, None]
    trainer = Trainer(small(), replace(views, images=images, color_space="linear"), ad)
    assert trainer._loss.kind == "relative"
    assert np.isfinite(losses(trainer, 20)).all()


# ---- 20: many steps -----------------------------------------------------------------------------


def test_row_20_many_steps(ad: Any) -> None:
    """Exact resumption: training/test_run.py; memory over 2000 steps: benchmarks/memory.py."""
    (rate,) = measured(training.many_steps, ad)
    assert rate.naive > 1e-3 and rate.ours < 1e-12


@pytest.mark.parametrize("start", [0, 1000, 100_000])
def test_row_20_corrections_for_bias_do_not_drift(ad: Any, start: int) -> None:
    """Under a constant gradient every step of Adam has the length of its rate."""
    parameters = {"w": ad.TensorXf(np.zeros(1, np.float32))}
    optimizer = Adam(parameters, beta1=0.9, beta2=0.999)
    moments = {
        f"{kind}.w": -np.expm1(start * np.log([beta], dtype=float)).astype(np.float32)
        for kind, beta in (("first", 0.9), ("second", 0.999))
    }
    optimizer.restore({**moments, "steps": np.array([start], np.float32)})
    places = [0.0]
    for _ in range(20):
        dr.set_grad(parameters["w"], ad.TensorXf(np.ones(1, np.float32)))
        optimizer.step(1e-2, ad.Bool(True))
        places.append(float(parameters["w"].array[0]))
    assert -np.diff(places) == pytest.approx(np.full(20, 1e-2), rel=1e-3)


@pytest.mark.slow
def test_row_20_a_step_far_on(ad: Any, views: Dataset) -> None:
    """Seeds, refreshes and schedules of step 1e5 are numbers like any other."""
    trainer = Trainer(small(), views, ad)
    trainer.step_count = training.STEPS
    trainer.optimizer.restore({**trainer.optimizer.state(), "steps": np.float32([training.STEPS])})
    assert np.isfinite(losses(trainer, 9)).all()


# ---- The table ----------------------------------------------------------------------------------


def recorded(name: str) -> list[Row]:
    """The rows of a file of figures, which the tables of docs/stability.md are made from."""
    return [record.row for record in load(RESULTS / f"{name}.json")]


def agrees(printed: float, value: float) -> bool:
    """Whether a recorded number is the one measured; errors of rounding by their order."""
    if not math.isfinite(value):
        return str(printed) == str(value)
    smaller, larger = sorted((abs(printed), abs(value)))
    if larger < 1e-5:
        return larger <= 30 * max(smaller, 1e-8)
    return printed == pytest.approx(value, rel=0.05)


def test_rows_are_those_of_the_documentation() -> None:
    """With the test that the table names."""
    here = {name for name, value in globals().items() if inspect.isfunction(value)}
    assert [case.row for case in CASES] == list(range(1, 21))
    heads = [row.labels for row in recorded("hard_cases") if row.labels["row"]]
    for case, labels in zip(CASES, heads, strict=True):
        assert case.test in here
        expected = {"row": str(case.row), "case": case.name, "formula": case.naive}
        assert expected.items() <= labels.items()


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=lambda case: str(case.row))
def test_numbers_are_those_of_the_documentation(case: Case) -> None:
    rows = [r for r in recorded("hard_cases") if r.labels["test"] == f"`{case.test}`"]
    found = measured(case.measure, array_module("llvm_ad_rgb"))
    assert [row.labels["measured"] for row in rows] == [finding.what for finding in found]
    for row, finding in zip(rows, found, strict=True):
        figures, values = row.figures, {"usual": finding.naive, "ours": finding.ours}
        assert all(agrees(figures[name].value, v) for name, v in values.items()), (row, values)


@pytest.mark.slow
def test_sheets_are_those_of_the_documentation() -> None:
    rows = recorded("thin_sheet")
    assert [float(row.labels["thickness"]) for row in rows] == list(fields.THICKNESSES)
    for row, thickness in zip(rows, fields.THICKNESSES, strict=True):
        errors = fields.sheet_errors(array_module("llvm_ad_rgb"), thickness)
        for figure, (opacity, _) in zip(row.figures.values(), errors.values(), strict=True):
            assert figure.value == pytest.approx(opacity, rel=0.1), thickness
