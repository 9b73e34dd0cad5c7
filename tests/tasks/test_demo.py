"""The main job end to end, as small as it gets."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.base.variants import choose_variant
from mi_nerf.cli import main
from mi_nerf.data import load_dataset
from mi_nerf.tasks.demo import run_demo

VIEWS = {"train": 6, "test": 2}


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any], str]:
    """The folder of a demo, the record that it returned and what it printed."""
    import contextlib
    import io

    folder = tmp_path_factory.mktemp("demo")  # empty folders are welcome
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        record = run_demo(folder, choose_variant(), seconds=3, **VIEWS, size=20, spp=4)
    return folder, record, text.getvalue()


@pytest.mark.slow
def test_everything_is_there(demo: tuple[Path, dict[str, Any], str]) -> None:
    folder, record, text = demo
    assert {p.name for p in folder.iterdir()} == {
        "data",
        "run",
        "eval.json",
        "comparison.png",
        "scene.xml",
    }
    assert json.loads((folder / "eval.json").read_text()) == record
    assert (record["views"], record["size"]) == (2, [20, 20])
    assert f"{record['mean']['psnr']:.2f} dB" in text
    for part in ("1/4", "2/4", "3/4", "4/4", str(folder / "comparison.png")):
        assert part in text
    # A row for each of two views; truth, reconstruction and error; everything twice as large.
    assert iio.imread(folder / "comparison.png").shape == (2 * 40, 3 * 40, 3)


@pytest.mark.slow
def test_the_dataset(demo: tuple[Path, dict[str, Any], str]) -> None:
    folder = demo[0]
    for split, count in VIEWS.items():
        dataset = load_dataset(folder / "data", split)
        assert len(dataset) == count and dataset.has_alpha
        alpha = dataset.premultiplied()[..., 3]
        assert (alpha[:, 0] == 0).all()  # empty background
        assert (alpha[:, 10, 10] == 1).all()  # something in the middle
        assert dataset.premultiplied()[..., :3].std() > 0.05
        positions = dataset.cam_to_world[:, :3, 3]
        assert np.linalg.norm(positions, axis=1) == pytest.approx(np.full(count, 4.0))
        assert (positions[:, 2] > 0).all()
    assert not np.isin(
        load_dataset(folder / "data", "test").cam_to_world[:, 0, 3],
        load_dataset(folder / "data", "train").cam_to_world[:, 0, 3],
    ).any()  # held out


@pytest.mark.slow
def test_the_comparison_begins_with_the_truth(demo: tuple[Path, dict[str, Any], str]) -> None:
    folder = demo[0]
    picture = iio.imread(folder / "comparison.png")[::2, ::2].astype(float)
    straight = iio.imread(folder / "data" / "test" / "r_0.png") / 255
    truth = np.rint(255 * (straight[..., :3] * straight[..., 3:] + 1 - straight[..., 3:]))
    assert np.array_equal(picture[:20, :20], truth)
    error = np.abs(truth - picture[:20, 20:40])
    assert picture[:20, 40:] == pytest.approx(np.minimum(5 * error, 255), abs=1)


@pytest.mark.slow
def test_the_scene_renders(
    demo: tuple[Path, dict[str, Any], str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # the field is found from anywhere
    options = ["-o", "field.png", "--size", "24", "18", "--spp", "1"]
    assert main(["render", str(demo[0] / "scene.xml"), *options]) == 0
    picture = iio.imread(tmp_path / "field.png")
    assert picture.shape == (18, 24, 4)
    assert picture[..., 3].max() > 0


def test_a_folder_in_use_is_refused(tmp_path: Path) -> None:
    (tmp_path / "something").touch()
    with pytest.raises(InputError, match="expected a new or an empty folder"):
        run_demo(tmp_path, "llvm_ad_rgb")
    with pytest.raises(InputError, match="expected a new or an empty folder"):
        run_demo(tmp_path / "something", "llvm_ad_rgb")
    assert [p.name for p in tmp_path.iterdir()] == ["something"]


def test_default_folders_are_numbered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from mi_nerf.tasks import demo

    monkeypatch.chdir(tmp_path)
    names = [str(demo._fresh_folder(None)) for _ in range(3)]
    assert names == ["mi-nerf-demo", "mi-nerf-demo-2", "mi-nerf-demo-3"]
