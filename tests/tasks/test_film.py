"""Frames by other processes: the same files as by one."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_nerf.cli import main
from mi_nerf.tasks.film import _parts
from tests.generation.test_run import SENSOR_Y_UP, ball, contents
from tests.support.processes import children
from tests.tasks.test_render import read_video


def test_parts_are_all_numbers_in_order() -> None:
    for count in (0, 1, 4, 5, 17):
        parts = _parts(range(count))
        assert [number for part in parts for number in part] == list(range(count))
        assert all(0 < len(part) <= 4 for part in parts)


def rendered(*words: str | Path) -> None:
    assert main(["render", *map(str, words)]) == 0


@pytest.mark.slow
def test_a_folder_of_frames_of_a_run(blob_run: Path, tmp_path: Path) -> None:
    options = ["--path", "orbit", "--frames", "6", "--size", "16", "12"]
    rendered(blob_run, "-o", tmp_path / "one", *options)
    rendered(blob_run, "-o", tmp_path / "two", *options, "--workers", "2")
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    assert len(contents(tmp_path / "two")) == 6
    assert {path.name for path in tmp_path.iterdir()} == {"one", "two"} and not children()


@pytest.mark.slow
def test_a_video_and_a_picture_of_a_scene(tmp_path: Path) -> None:
    sensor = SENSOR_Y_UP.replace("stratified", "independent")
    scene = ball(tmp_path, sensor)
    options = ["--path", "orbit", "--frames", "5", "--size", "32", "32", "--spp", "4"]
    rendered(scene, "-o", tmp_path / "one.mp4", *options)
    rendered(scene, "-o", tmp_path / "two.mp4", *options, "--workers", "2")
    one, two = (read_video(tmp_path / name).astype(int) for name in ("one.mp4", "two.mp4"))
    # Mitsuba adds up what its filter spreads in an order of chance: last bits differ.
    assert one.shape == (5, 32, 32, 3) and np.abs(one - two).max() <= 2
    assert np.abs(one[0] - one[2]).max() > 20
    options = ["--size", "24", "24", "--spp", "4"]
    rendered(scene, "-o", tmp_path / "one.exr", *options)
    rendered(scene, "-o", tmp_path / "two.exr", *options, "--workers", "1")
    images = [np.array(mi.Bitmap(str(tmp_path / name))) for name in ("one.exr", "two.exr")]
    assert images[0].shape == (24, 24, 4) and np.allclose(*images, atol=1e-5)


@pytest.mark.slow
def test_a_scene_that_fails_leaves_nothing(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    scene = ball(tmp_path)  # without a sensor
    words = ["render", str(scene), "-o", str(tmp_path / "new/out.exr"), "--workers", "1"]
    assert main(words) == 2
    assert "has no sensor" in capsys.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} == {"ball.xml"} and not children()
