"""Table 2 in small: what each row changes, and that it can be stopped."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import pytest

from mi_nerf.cli import main
from mi_nerf.tasks import ablate as ablation
from mi_nerf.tasks.ablate import OCTAVES, ROWS, ablate, complete, table
from mi_nerf.training import run as training
from mi_nerf.training.config import TrainConfig, with_settings
from mi_nerf.training.presets import preset
from mi_nerf.training.run import Run, TrainingError

TINY = ["network.width=8", "network.view_width=8", "sampling.batch=512"]
TINY += ["sampling.samples=8", "sampling.fine=8", "sampling.render_samples=8"]


def tiny(**changes: int) -> TrainConfig:
    return replace(with_settings(preset("nerf"), TINY), steps=3, **changes)


def row(name: str) -> TrainConfig:
    return ROWS[name].change(complete(preset("paper")))


def test_rows_of_octaves_differ_in_octaves_alone() -> None:
    whole = complete(preset("nerf"))
    for count in (1, 4, 10, 16):
        found = OCTAVES[f"L={count}"].change(whole)
        assert found.position.frequencies == count
        assert replace(found, position=whole.position) == whole


def test_rows_are_those_of_the_paper() -> None:
    """(N_c, N_f), L, view dependence and views of each row of Table 2."""
    whole = row("complete")
    assert (whole.position.frequencies, whole.direction.frequencies) == (10, 4)
    assert (whole.sampling.samples, whole.sampling.fine) == (64, 128)
    assert whole.network.view_dependent and whole.views is None
    for name in ("no-pe", "no-pe-vd-h"):
        assert row(name).position.frequencies == row(name).direction.frequencies == 0
    for name in ("no-vd", "no-pe-vd-h"):
        assert not row(name).network.view_dependent
    for name in ("no-h", "no-pe-vd-h"):
        assert (row(name).sampling.samples, row(name).sampling.fine) == (256, 0)
        assert row(name).sampling.render_samples == 256
    assert [row(n).views for n in ("25-images", "50-images")] == [25, 50]
    assert [row(n).position.frequencies for n in ("l5", "l15")] == [5, 15]
    # Nothing else differs.
    for name in ROWS:
        same = replace(
            row(name),
            position=whole.position,
            direction=whole.direction,
            network=whole.network,
            sampling=whole.sampling,
            views=None,
        )
        assert same == whole


def test_small_presets_get_a_hierarchy_too() -> None:
    config = complete(preset("nerf"))
    assert config.sampling.fine == 32 and not config.occupancy.enabled
    assert config.position.frequencies == 10


@pytest.mark.slow
def test_a_table_with_seeds(blob: Path, tmp_path: Path) -> None:
    rows = ["no-h", "complete"]
    record = ablate(blob, tmp_path / "out", tiny(), "llvm_ad_rgb", rows=rows, seeds=2)
    assert record["complete"] and [r["name"] for r in record["rows"]] == rows
    assert record == json.loads((tmp_path / "out/ablation.json").read_text())
    for entry in record["rows"]:
        values = [run["psnr"] for run in entry["runs"]]
        assert len(values) == entry["seeds"] == 2 and entry["failures"] == 0
        assert entry["psnr"] == pytest.approx(sum(values) / 2)
        assert values[0] != values[1]
    whole = record["rows"][1]
    assert whole["parameters"] == 2 * record["rows"][0]["parameters"]
    text = (tmp_path / "out/ablation.md").read_text()
    assert text == table(record)
    assert f"| Complete model | {whole['psnr']:.2f} |" in text and text.count("0 of 2") == 2
    assert iio.imread(tmp_path / "out/ablation.png").ndim == 3


@pytest.mark.slow
def test_it_goes_on_where_it_was_stopped(
    blob: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows, out = ["no-vd", "complete"], tmp_path / "out"
    through = ablate(blob, tmp_path / "through", tiny(), "llvm_ad_rgb", rows=rows)
    started: list[str] = []
    train = Run.train

    def stopping(self: Run, show_bar: bool = True, after_step: object = None) -> None:
        started.append(self.folder.parent.name)
        if len(started) == 2:
            self._advance()
            self._settle()
            self.save()
        else:
            train(self, show_bar)

    monkeypatch.setattr(Run, "train", stopping)
    record = ablate(blob, out, tiny(), "llvm_ad_rgb", rows=rows)
    assert not record["complete"] and [r["name"] for r in record["rows"]] == ["no-vd"]
    record = ablate(blob, out, tiny(), "llvm_ad_rgb", rows=rows)
    assert record["complete"] and started == ["no-vd", "complete", "complete"]
    for a, b in zip(record["rows"], through["rows"], strict=True):
        assert a["psnr"] == b["psnr"]
    more = ablate(blob, out, tiny(), "llvm_ad_rgb", rows=[*rows, "l5"])
    assert started[3:] == ["l5"] and len(more["rows"]) == 3


@pytest.mark.slow
def test_failures_are_counted(blob: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(self: Run, show_bar: bool = True, after_step: object = None) -> None:
        raise TrainingError("collapsed")

    monkeypatch.setattr(Run, "train", failing)
    record = ablate(blob, tmp_path / "out", tiny(), "llvm_ad_rgb", rows=["complete"])
    assert record["rows"][0]["failures"] == 1 and record["rows"][0]["psnr"] is None
    assert "| n/a |" in table(record) and "1 of 1" in table(record)
    assert not (tmp_path / "out/ablation.png").exists()


@pytest.mark.slow
def test_fewer_images(blob: Path, tmp_path: Path) -> None:
    config = replace(complete(tiny()), views=3)
    run = training.start(blob, tmp_path / "run", config, "llvm_ad_rgb")
    assert json.loads((tmp_path / "run/config.json").read_text())["data"]["views"] == 3
    assert run.trainer._source._views == 3


@pytest.mark.slow
def test_bad_input(refused: Callable[..., str], blob: Path, tmp_path: Path) -> None:
    data, out = shutil.copytree(blob, tmp_path / "data"), tmp_path / "out"
    assert "row 'no-pee': unknown" in refused("ablate", data, "--out", out, "--rows", "no-pee")
    assert "--seeds 0" in refused("ablate", data, "--out", out, "--seeds", "0")
    assert "holds no ablation.json" in refused("ablate", data, "--out", data)
    ablate(data, out, tiny(), "llvm_ad_rgb", rows=["complete"])
    assert "with other settings" in refused("ablate", data, "--out", out, "--steps", "3")


@pytest.mark.slow
def test_the_command(blob: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--rows", "complete", "--steps", "2", "--views", "2", "--set", *TINY]
    assert main(["ablate", str(blob), "--out", str(tmp_path / "out"), *options]) == 0
    assert "| Complete model |" in capsys.readouterr().out
    assert ablation.RECORD in {p.name for p in (tmp_path / "out").iterdir()}
