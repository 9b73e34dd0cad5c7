"""Reports: emission over the hemisphere of directions, and the profile of a run's steps."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import imageio.v3 as iio
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerf.base.errors import InputError
from mi_nerf.base.variants import array_module, choose_variant
from mi_nerf.cameras.ndc import Ndc
from mi_nerf.cameras.pinhole import Intrinsics
from mi_nerf.cli import main
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.settings import MarchSettings
from mi_nerf.report.view_dependence import (
    draw_view_dependence,
    emission_over_hemisphere,
    find_points,
    surface_normal,
)
from tests.support.analytic import AnalyticField, ball, gaussian
from tests.support.arrays import unit
from tests.support.datasets import orbit_poses

VARIANT = choose_variant()
BACKEND = array_module(VARIANT)

directions = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


@pytest.mark.slow
@given(directions)
def test_the_disc_is_the_hemisphere_from_above(direction: Any) -> None:
    """A field that emits half of one plus the direction in which light travels."""
    normal = unit(np.array([direction]))[0]
    field = AnalyticField(
        gaussian((0, 0, 0), 0.3, 5.0), lambda p, d: [0.5 - 0.5 * d[i] for i in range(3)]
    )
    size = 33
    image = emission_over_hemisphere(field, (0.1, 0.2, 0), normal, BACKEND, size)
    assert image.shape == (size, size, 4)
    y, x = (np.mgrid[:size, :size] + 0.5) / size * 2 - 1
    inside = x**2 + y**2 < 1
    assert (image[..., 3] == inside).all() and (image[~inside] == 0).all()
    towards = 2 * image[..., :3] - 1  # rays travel the other way
    assert np.linalg.norm(towards[inside], axis=-1) == pytest.approx(1, abs=1e-5)
    expected = np.sqrt(1 - x**2 - y**2, where=inside, out=np.zeros_like(x))
    assert (towards @ normal)[inside] == pytest.approx(expected[inside], abs=1e-5)
    assert towards[size // 2, size // 2] == pytest.approx(normal, abs=1e-5)
    # Right-handed, seen from above: a step right and a step up span the normal.
    right = towards[size // 2, size // 2 + 2] - towards[size // 2, size // 2]
    up = towards[size // 2 - 2, size // 2] - towards[size // 2, size // 2]
    assert np.cross(right, up) @ normal > 0


@pytest.mark.slow
@given(directions)
def test_normals_point_out_of_a_blob(direction: Any) -> None:
    out = unit(np.array([direction]))[0]
    field = AnalyticField(gaussian((0.1, 0, -0.1), 0.3, 5.0))
    point = np.array([0.1, 0, -0.1]) + 0.3 * out
    assert surface_normal(field, point, BACKEND) == pytest.approx(out, abs=1e-2)


def test_fields_of_forward_facing_captures() -> None:
    """A ball of scene space, asked about in normalised device coordinates."""
    ndc = Ndc(1.2, 1.6)
    center, radius = np.array([0.2, -0.1, -3.0]), 0.4

    def density(p: Any) -> Any:
        z = 2 / (p[2] - 1)  # appendix C, solved for the original point
        x, y = -p[0] * z / 1.2, -p[1] * z / 1.6
        offset = type(p)(x, y, z) - type(p)(*center.tolist())
        return dr.exp(-0.5 / radius**2 * dr.squared_norm(offset))

    field = AnalyticField(density, lambda p, d: [0.5 - 0.5 * d[i] for i in range(3)], ndc=ndc)
    out = unit(np.array([[0.3, 0.5, 0.8]]))[0]
    point = center + radius * out
    assert surface_normal(field, point, BACKEND) == pytest.approx(out, abs=2e-2)
    middle = emission_over_hemisphere(field, point, out, BACKEND, 33)[16, 16, :3]
    assert 2 * middle - 1 == pytest.approx(out, abs=1e-5)


def test_even_density_has_no_normal() -> None:
    field = AnalyticField(lambda p: dr.zeros(type(p[0]), len(p[0])))
    with pytest.raises(InputError, match="no surface there"):
        surface_normal(field, (0, 0, 0), BACKEND)


@pytest.mark.slow
def test_points_lie_on_what_cameras_see() -> None:
    field = AnalyticField(ball(0.5, 1000.0))
    camera = Intrinsics.from_angle_x(32, 32, 0.5)
    march = MarchSettings(samples=512)
    points = find_points(MarchedField(field, march), camera, orbit_poses(6), BACKEND, count=4)
    assert np.linalg.norm(points, axis=1) == pytest.approx(0.5, abs=0.01)
    apart = np.linalg.norm(points[:, None] - points, axis=-1) + 9 * np.eye(4)
    assert apart.min() > 0.4
    empty = AnalyticField(ball(0.5, 0.0))
    with pytest.raises(InputError, match="expected points"):
        find_points(MarchedField(empty, march), camera, orbit_poses(6), BACKEND)


@pytest.mark.slow
def test_deviation_measures_view_dependence(tmp_path: Path) -> None:
    dull = AnalyticField(gaussian((0, 0, 0), 0.3, 5.0))
    shiny = AnalyticField(
        gaussian((0, 0, 0), 0.3, 5.0), lambda p, d: [dr.square(d[2]) for _ in range(3)]
    )
    point = np.array([[0.2, 0.1, 0.2]])
    found = [draw_view_dependence(tmp_path / "a.png", f, point, VARIANT) for f in (dull, shiny)]
    assert found[0][0]["deviation"] == pytest.approx(0, abs=1e-6)
    assert found[1][0]["deviation"] > 0.05
    assert iio.imread(tmp_path / "a.png").ndim == 3


@pytest.mark.slow
def test_the_command(blob_run: Path, tmp_path: Path) -> None:
    points = ["--point", "0.1", "0.2", "0.3", "--point", "-0.2", "0", "0.1"]
    out = ["--out", str(tmp_path / "out"), "--no-profile", "--no-speed"]
    assert main(["report", str(blob_run), *out, *points]) == 0
    record = json.loads((tmp_path / "out/report.json").read_text())
    found = [entry["point"] for entry in record["view_dependence"]]
    assert found == [[0.1, 0.2, 0.3], [-0.2, 0, 0.1]]
    text = (tmp_path / "out/report.md").read_text()
    assert "| 0.10, 0.20, 0.30 |" in text and "(view_dependence.png)" in text
    assert (tmp_path / "out/view_dependence.png").exists()
    assert record["step"] is None and "Left out: not asked for." in text
    assert not (tmp_path / "out/step_time.png").exists()


@pytest.mark.slow
def test_steps_of_a_run_are_measured_and_the_run_stays_as_it_is(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.read_bytes() for path in run.iterdir()}
    point = ["--point", "0", "0", "0.4"]
    assert main(["report", str(run), "--out", str(tmp_path / "out"), "--no-speed", *point]) == 0
    assert {path: path.read_bytes() for path in run.iterdir()} == before
    step = json.loads((tmp_path / "out/report.json").read_text())["step"]
    assert sum(step["stages"].values()) == pytest.approx(step["step_ms"])
    assert step["compiled"] == 0
    best = max(step["product_gflops"].values())
    assert step["share"] == pytest.approx(step["gflops"] / best) and 0 < step["share"] < 1
    text = (tmp_path / "out/report.md").read_text()
    assert "## Where a step's time goes" in text and "(step_time.png)" in text
    assert iio.imread(tmp_path / "out/step_time.png").ndim == 3
    assert f"a training step takes {step['step_ms']:.1f} ms" in capsys.readouterr().out


@pytest.mark.slow
def test_without_a_readable_checkpoint_the_profile_is_left_out(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    point = ["--point", "0", "0", "0.4", "--no-speed"]
    (run / "checkpoint.safetensors").write_bytes(b"damaged")
    for target, reason in (
        (run, f"{run / 'checkpoint.safetensors'}: "),
        (run / "field.safetensors", "a field file, expected a run with its checkpoint"),
    ):
        assert main(["report", str(target), "--out", str(tmp_path / "out"), *point]) == 0
        record = json.loads((tmp_path / "out/report.json").read_text())
        assert record["step"] is None and reason in record["step_left_out"]
        assert reason in capsys.readouterr().out
        assert reason in (tmp_path / "out/report.md").read_text()


def test_a_run_whose_data_is_gone(
    run: Path, tmp_path: Path, refused: Callable[..., str], capsys: pytest.CaptureFixture[str]
) -> None:
    config, gone = json.loads((run / "config.json").read_text()), tmp_path / "gone"
    config["data"]["path"] = str(gone)
    (run / "config.json").write_text(json.dumps(config))
    out = tmp_path / "out"
    assert f"{gone}: no such dataset folder" in refused("report", run, "--out", out)
    assert main(["report", str(run), "--out", str(out), "--no-speed"]) == 0
    reason = f"{gone}: no such dataset folder"
    assert f"no profile of training steps: {reason}" in capsys.readouterr().out
    assert f"Left out: {reason}." in (out / "report.md").read_text()


def test_bad_input(refused: Callable[..., str], run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    line = refused("report", run, "--out", out, "--point", "9", "0", "0")
    assert "--point 9 0 0: outside the field's box" in line
    line = refused("report", run, "--out", out, "--point", "9", "0", "0", "--no-speed")
    assert "outside the field's box" in line
