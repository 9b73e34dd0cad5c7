"""Speed against error: points against the oracle, the Pareto front, and what the report says."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import imageio.v3 as iio
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mi_nerf.base.errors import InputError
from mi_nerf.base.variants import array_module, choose_variant
from mi_nerf.cli import main
from mi_nerf.fields.closed_form import closed_form
from mi_nerf.fields.neural import NeuralField
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.occupancy import OccupancyGrid
from mi_nerf.march.render import render_rays
from mi_nerf.march.settings import MarchSettings
from mi_nerf.report import (
    Knobs,
    choose,
    conclusions,
    load,
    open_subject,
    pareto_front,
    plot_speed,
    sweep,
)
from mi_nerf.report.grids import Grids, resampled
from mi_nerf.report.speed import Setting, settings_of
from mi_nerf.report.speed_text import markdown
from mi_nerf.tasks.evaluate import evaluate
from mi_nerf.tasks.target import open_target
from tests.support import closed_forms as oracle
from tests.support.analytic import AnalyticField
from tests.support.fields import SMALL, small_file

VARIANT = choose_variant()
BACKEND = array_module(VARIANT)
NONE = Knobs(samples=(), rules=(), splits=(), stops=(), resolutions=(8,), thresholds=())
FEW = Knobs(
    samples=(8, 32), rules=("constant", "cells", "linear"), stops=(0.0, 0.05), resolutions=(8,)
)

# ---- The Pareto front -------------------------------------------------------------

few_numbers = st.integers(0, 5).map(float) | st.just(math.nan) | st.floats(0, 5)


@given(st.lists(st.tuples(few_numbers, few_numbers), max_size=12))
def test_pareto_front_by_brute_force(points: list[tuple[float, float]]) -> None:
    """Ties, equal points and NaN included."""

    def beaten(a: tuple[float, float]) -> bool:
        return any(b[0] <= a[0] and b[1] <= a[1] and b != a for b in points)

    expected = [not any(map(math.isnan, p)) and not beaten(p) for p in points]
    costs, errors = zip(*points, strict=True) if points else ((), ())
    assert pareto_front(costs, errors) == expected


# ---- Grids ------------------------------------------------------------------------


@settings(max_examples=30)
@given(st.integers(0, 99), *[st.tuples(*[st.integers(1, 7)] * 3)] * 2)
def test_resampled_cells_overlap(
    seed: int, shape: tuple[int, int, int], wanted: tuple[int, int, int]
) -> None:
    """Against the overlap of intervals, cell by cell."""
    cells = np.random.default_rng(seed).random(shape) < 0.3
    found = resampled(cells, wanted)
    assert found.shape == wanted
    for place in np.ndindex(*wanted):
        near = [
            [i for i in range(n) if i * m < (k + 1) * n and (i + 1) * m > k * n]
            for k, n, m in zip(place, shape, wanted, strict=True)
        ]
        assert found[place] == cells[np.ix_(*near)].any()


def test_grids_of_a_ball(ad: Any) -> None:
    """One half of optical thickness 100 a cell, one of ¼; none beyond it, or the own grid."""

    def density(p: Any) -> Any:
        return dr.select(dr.norm(p) < 0.6, dr.select(p[0] > 0, type(p[0])(400), 1), 0)

    field = AnalyticField(density)
    own = np.ones((4, 4, 4), bool)
    own[:, 0] = False
    grids = Grids(field, OccupancyGrid(field.lower, field.upper, own, ad.Float), ad.Float)
    edges = np.linspace(-1, 1, 9)
    low, high = (
        np.stack(np.meshgrid(*[e] * 3, indexing="ij"), -1) for e in (edges[:-1], edges[1:])
    )
    outside = np.linalg.norm(np.clip(0, low, high), axis=-1) > 0.6
    inside = np.linalg.norm((low + high) / 2, axis=-1) < 0.45
    within, dense = np.ones((2, 8, 8, 8), bool)
    within[:, :2] = False
    dense[:4] = False
    for threshold, half in ((0.1, True), (0.5, dense)):
        found = grids.at(8, threshold).mask()
        assert not found[outside | ~within | ~(within & half)].any()
        assert found[inside & within & half].all()
    assert (grids.at(8, 0).mask() == within).all()


# ---- Settings ---------------------------------------------------------------------


def subject_of(field: Any, march: MarchSettings, rays: int = 64) -> Any:
    base = open_subject("slab", VARIANT, rays=rays, views=1)
    return replace(base, formula=False, marched=MarchedField(field, march))


def test_every_setting_once_and_the_own_first() -> None:
    subject = open_subject("slab", VARIANT, rays=8)
    found = settings_of(subject, Knobs())
    assert list(found)[0] == Setting(subject.marched.settings)
    assert set(found[Setting(subject.marched.settings)]) == {"own", "samples", "stop"}
    by_knob = [[s for s, names in found.items() if k in names] for k in ("samples", "stop")]
    assert [len(s) for s in by_knob] == [12, 5]
    for setting, names in found.items():
        if "stop" in names:
            assert replace(setting.march, stop=0.0) == subject.marched.settings
        if "threshold" in names:
            assert setting.grid is not None and setting.march == subject.marched.settings


@pytest.mark.slow
def test_splits_make_equally_many_queries() -> None:
    """Counted while the field is rendered: 2 · coarse + fine samples of rays in the box."""
    coarse = NeuralField.create(SMALL, 1, BACKEND.TensorXf)
    field = NeuralField.create(SMALL, 0, BACKEND.TensorXf, coarse)
    subject = subject_of(field, MarchSettings(samples=8, fine=16))
    found = settings_of(subject, Knobs(samples=(4,), rules=("constant",), splits=(0, 0.125, 0.25)))
    splits = [s.march for s, names in found.items() if "split" in names]
    assert [(m.samples, m.fine) for m in splits] == [(8, 16), (32, 0), (4, 24)]
    asked = {render_rays(MarchedField(field, m), subject.o, subject.d).queries for m in splits}
    assert len(asked) == 1
    (half,) = [s.march for s in found if s.march.samples == 4 and s.march.fine == 8]
    assert half.rule == "constant"


# ---- Errors -----------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "values"), [("gaussian", {"peak": 20.0}), ("shell", {"edge": 0.0})]
)
def test_errors_are_those_against_the_oracle(kind: str, values: dict[str, Any]) -> None:
    """Up to what the reference states of itself, for every setting of the field without a grid."""
    subject = open_subject(kind, VARIANT, values=values, rays=300, views=3)
    record = sweep(subject, FEW, repeats=1)
    field = closed_form(kind, values, BACKEND.TensorXf64)
    o, d = (np.array(v, np.float64).T for v in (subject.o, subject.d))
    rays = oracle.Rays.in_box(o, d, field.lower, field.upper)
    exact = oracle.seen(kind, oracle.values_of(field.config), rays)
    stated = record["reference"]["error"]
    compared = 0
    for point in record["points"]:
        march = MarchSettings(**{k: point[k] for k in ("samples", "fine", "rule", "stop")})
        if point["grid"] is not None:
            continue
        seen = render_rays(MarchedField(subject.field, march), subject.o, subject.d)
        off = {
            "color": np.transpose(seen.color) - exact[:, :3],
            "opacity": np.array(seen.opacity) - exact[:, 3],
            "depth": (np.array(seen.depth) - exact[:, 4])[exact[:, 3] > 0.5],
        }
        for name, difference in off.items():
            expected = np.sqrt(np.mean(difference**2))
            assert point["error"][name] == pytest.approx(expected, abs=1.1 * stated[name] + 1e-7)
            assert stated[name] < 0.02
        assert point["queries_per_ray"] == seen.queries / 300
        assert point["psnr"] is None
        compared += 1
    assert compared == 10
    by_rule = {(p["samples"], p["rule"]): p["error"]["depth"] for p in record["points"]}
    assert by_rule[8, "cells"] == pytest.approx(by_rule[8, "constant"], rel=1e-3)
    if kind == "gaussian":  # at jumps they are alike
        assert by_rule[32, "linear"] > 1.5 * by_rule[32, "constant"]


@pytest.mark.slow
def test_grids_leave_out_what_their_threshold_says() -> None:
    """Opacity lost to a grid grows with the threshold; queries fall."""
    subject = open_subject("gaussian", VARIANT, rays=400, views=2)
    knobs = replace(NONE, resolutions=(), thresholds=(1e-4, 1e-2, 0.3))
    own, *points = sweep(subject, knobs, repeats=1)["points"]
    errors = [p["error"]["opacity"] for p in points]
    queries = [p["queries_per_ray"] for p in points]
    assert errors == sorted(errors) and errors[-1] > 10 * own["error"]["opacity"]
    assert errors[0] < 1e-3
    assert queries == sorted(queries, reverse=True) and queries[0] < own["queries_per_ray"]


@pytest.mark.slow
def test_slow_fields_are_measured_on_fewer_rays() -> None:
    subject = open_subject("slab", VARIANT, rays=2000)
    record = sweep(subject, NONE, repeats=1, seconds=1e-4)
    assert record["rays"] == 256
    assert record["reference"]["max_intervals"] == 512


@pytest.mark.slow
def test_rays_are_pixels_of_the_views(blob_run: Path) -> None:
    """All pixels: the PSNR is that of the evaluation's images taken together."""
    subject = open_subject(blob_run, VARIANT, views=2)
    assert subject.rays == 2 * 24 * 24 and subject.views["split"] == "test"
    record = sweep(subject, replace(NONE, resolutions=(), stops=(0.3,)), repeats=1, seconds=3)
    found = evaluate(open_target(blob_run), VARIANT, views=2)
    mse = [10 ** (-image["psnr"] / 10) for image in found["images"]]
    assert record["points"][0]["psnr"] == pytest.approx(-10 * np.log10(np.mean(mse)), abs=1e-3)
    assert record["points"][0]["queries_per_ray"] == pytest.approx(found["queries_per_ray"])
    # A part of them is a part.
    some = open_subject(blob_run, VARIANT, views=2, rays=50)
    assert np.array(some.d) == pytest.approx(np.array(subject.d)[:, :50])
    assert (some.truth == subject.truth[:50]).all() and some.first(20).rays == 20


def test_what_display_values_may_be_off_by(blob_run: Path) -> None:
    """By colours and opacities at their worst; in linear fields the slope of sRGB counts."""
    subject = open_subject(blob_run, VARIANT, views=1, rays=5)
    rng = np.random.default_rng(0)
    opacity = rng.random(1000)
    color = opacity[:, None] * rng.random((1000, 3))
    error = rng.random((1000, 4)) * 1e-2
    for space in ("srgb", "linear"):
        field = AnalyticField(lambda p: p[0])
        field.color_space = space
        seen = replace(subject, marched=replace(subject.marched, field=field))
        bound = seen.shown_error(color, opacity, error)
        for _ in range(20):
            off = error * rng.uniform(-1, 1, error.shape)
            moved = seen.shown(color + off[:, :3], opacity + off[:, 3]) - seen.shown(color, opacity)
            assert (np.abs(moved) <= bound + 1e-12).all()
        assert bound.max() > 0.9 * np.abs(error[:, :3] + error[:, 3:]).max()
    assert (open_subject("slab", VARIANT, rays=5).shown_error(color, opacity, error)).max() < 1e-2


# ---- What is said -----------------------------------------------------------------


def point(samples: int, ms: float, error: float, psnr: float | None, **more: Any) -> dict[str, Any]:
    base = {
        "knobs": ["samples"],
        **{"samples": samples, "fine": 0, "rule": "constant", "stop": 0.0, "grid": None},
        **{"milliseconds": ms, "fastest": ms, "slowest": ms, "queries_per_ray": samples / 2},
        "error": {"color": error, "opacity": error, "depth": error},
        **{"psnr": psnr, "pareto": True},
    }
    return {**base, **more}


def a_record(*points: dict[str, Any], psnr: float | None = None) -> dict[str, Any]:
    return {
        **{"field": "x", "formula": psnr is None, "unit": "radiance", "rays": 1000, "repeats": 3},
        "views": {"data": None, "views": 2, "size": [10, 10], "seed": 0},
        "machine": {"gpu": None, "cores": 2, "processor": "abacus", "variant": "llvm_ad_rgb"},
        "own_grid": None,
        "by": "depth" if psnr is None else "color",
        "reference": {
            "psnr": psnr,
            "max_intervals": 512,
            "error": dict.fromkeys(("color", "opacity", "depth"), 1e-6),
        },
        "points": list(points),
    }


def test_conclusions_tell_quadrature_from_model() -> None:
    own = point(64, 10, 1e-2, 29.5, knobs=["own", "samples"])
    record = a_record(own, point(128, 20, 2.5e-3, 29.9), point(256, 40, 6e-4, 30.0), psnr=30.0)
    text = "\n".join(conclusions(record))
    assert "that is 29.50 dB" in text and "has 30.00 dB, the model error alone" in text
    assert "costs 0.50 dB" in text and "change it by +0.50 dB" in text
    assert "to the power of -2.0" in text
    assert "The fastest within 0.1 dB of perfect quadrature: 128 samples" in text
    record["points"][0]["psnr"] = 30.0
    text = "\n".join(conclusions(record))
    assert "costs nothing" in text and "More samples buy nothing: 256 a ray" in text


def test_conclusions_about_formulas() -> None:
    own = point(64, 10, 1e-4, None, knobs=["own", "samples"])
    other = point(64, 12, 1e-4, None, rule="linear")
    other["error"]["depth"] = 3e-4
    text = "\n".join(conclusions(a_record(own, point(128, 20, 2.5e-5, None), other)))
    assert "`linear` has 3.00 to 3.00 times the error of `constant` (by the depth)" in text
    assert (
        "The fastest with an error of the depth below 0.001: 64 samples" in text
        and "dB" not in text
    )


def test_choosing_for_a_budget() -> None:
    record = a_record(point(64, 10, 1e-2, None), point(128, 20, 1e-3, None))
    assert choose(record, milliseconds=15)["samples"] == 64
    assert choose(record, milliseconds=20)["samples"] == 128
    assert choose(record, error=1e-2)["samples"] == 64
    assert choose(record, error=5e-3)["samples"] == 128
    with pytest.raises(InputError, match="9 ms: expected at least 10 ms"):
        choose(record, milliseconds=9)
    with pytest.raises(InputError, match="expected at least 0.001"):
        choose(record, error=1e-4)
    for limits in ({}, {"milliseconds": 1, "error": 1}):
        with pytest.raises(ValueError, match="either"):
            choose(record, **limits)


# ---- The command ------------------------------------------------------------------


@pytest.mark.slow
def test_report_of_a_run(blob_run: Path, tmp_path: Path, capsys: Any) -> None:
    out = tmp_path / "out"
    options = ["--no-profile", "--rays", "300", "--views", "2", "--repeats", "2"]
    options += ["--samples", "8", "16", "--stops", "0", "0.1", "--resolutions", "8"]
    options += ["--thresholds", "0.1", "--point", "0.1", "0.2", "0.3"]
    assert main(["report", str(blob_run), "--out", str(out), *options]) == 0
    record = load(out)
    assert record == json.loads((out / "report.json").read_text())
    speed, text = record["speed"], (out / "report.md").read_text()
    assert speed["rays"] == 300 and {p["rule"] for p in speed["points"]} == {"constant", "linear"}
    assert speed["machine"]["versions"].keys() >= {"mi_nerf", "drjit"}
    assert speed["own_grid"] is not None and speed["reference"]["psnr"] > 5
    printed = capsys.readouterr().out
    for sentence in record["conclusions"]:
        assert f"- {sentence}\n" in text and sentence in printed
    assert "\n".join(markdown(speed, "speed.png")) in text
    assert iio.imread(out / "speed.png").ndim == 3
    costs = [p["milliseconds"] for p in speed["points"]]
    for p in speed["points"]:
        assert p["fastest"] <= p["milliseconds"] <= p["slowest"]
        row = f"| {p['queries_per_ray']:.1f} | {p['error']['color']:.1e} |"
        assert row in text
        assert f"| {p['psnr']:.2f} |" in text
    assert speed["points"][costs.index(min(costs))]["pareto"]


@pytest.mark.slow
def test_report_of_a_formula(tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = ["--set", "density=20", "edge=0", "--rays", "300", "--repeats", "1"]
    assert main(["report", "shell", "--out", str(out), *options, "--samples", "16", "32"]) == 0
    record = load(out)
    assert record["target"] == "shell" and record["speed"]["formula"]
    text = (out / "report.md").read_text()
    assert "Left out: shell is a formula: --point says where to look." in text
    assert "Left out: shell: a formula, which is not trained." in text
    assert "PSNR (dB) |" not in text
    panels = plot_speed(record["speed"]).get_axes()
    assert [axes.get_xscale() for axes in panels] == ["log", "log"]
    assert [axes.get_yscale() for axes in panels] == ["log", "log"]
    lines = {line.get_label() for line in panels[0].get_lines()}
    assert {"rule constant", "rule linear", "own settings"} <= lines


@pytest.mark.slow
def test_report_of_a_field_file(tmp_path: Path) -> None:
    """Looked at from around its box; without images there is no model error."""
    path = small_file(tmp_path, samples=16)
    options = ["--rays", "200", "--repeats", "1", "--samples", "8", "--stops"]
    assert main(["report", str(path), "--out", str(tmp_path / "out"), *options]) == 0
    record = load(tmp_path / "out")
    assert record["speed"]["reference"]["psnr"] is None
    assert record["speed"]["views"]["data"] is None and "stop" not in str(
        [p["knobs"] for p in record["speed"]["points"]]
    )
    assert "which knows no cameras" in record["view_dependence_left_out"]


@pytest.mark.slow
def test_bad_input(refused: Callable[..., str], run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert "spher: not found, expected a run folder, a field file or one of slab" in refused(
        "report", "spher", "--out", out
    )
    assert "'radius' is no parameter of 'shell'" in refused(
        "report", "shell", "--out", out, "--set", "radius=1"
    )
    assert "--set density=x: expected a number" in refused(
        "report", "shell", "--out", out, "--set", "density=x"
    )
    assert "--set density: " in refused("report", run, "--out", out, "--set", "density=1")
    empty = ["--samples", "--rules", "--splits", "--stops", "--resolutions", "--thresholds"]
    assert "nothing to sweep" in refused("report", "shell", "--out", out, *empty)
    for option, value in (("stops", "1"), ("samples", "0"), ("splits", "0.5"), ("stops", "nan")):
        assert f"{option}: " in refused("report", "shell", "--out", out, f"--{option}", value)
    assert "--rays 0" in refused("report", "shell", "--out", out, "--rays", "0")
    assert "--repeats 0" in refused("report", "shell", "--out", out, "--repeats", "0")
    assert "this is a file" in refused("report", "shell", "--out", run / "config.json")
    assert "either TARGET or --train" in refused("report", "--out", out)
    assert "--vary: of trainings" in refused("report", "shell", "--out", out, "--vary", "seed=1,2")
    assert "transforms_x.json: no such file" in refused("report", run, "--out", out, "--split", "x")
