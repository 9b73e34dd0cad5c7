"""PSNR against seconds: looks at a training that do not change it, tables that go on."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.cli import main
from mi_nerf.report import load, plot_curves, rows_of, training_curves
from mi_nerf.report.curves import Watch, read_curve, summary
from mi_nerf.report.curves_text import conclusions, seconds_to
from mi_nerf.training import run as training
from mi_nerf.training.config import TrainConfig
from mi_nerf.training.run import Run, TrainingError
from tests.support.clock import Clock

TINY = ["network.width=8", "network.view_width=8", "sampling.batch=512", "sampling.samples=8"]
TINY += ["sampling.render_samples=8", "occupancy.resolution=8", "steps=6"]
VARIANT = "llvm_ad_rgb"


def tiny(*vary: tuple[str, list[str]]) -> dict[str, TrainConfig]:
    return rows_of(["nerf"], dict(vary), TINY)


# ---- Rows ---------------------------------------------------------------------------


def test_rows_are_all_combinations() -> None:
    vary = {"network.width": ["8", "16"], "position.frequencies": ["4", "6"]}
    rows = rows_of(["nerf", "fast"], vary, ["sampling.samples=9"])
    assert len(rows) == 8
    config = rows["fast, network.width=16, position.frequencies=6"]
    assert (config.preset, config.network.width, config.position.frequencies) == ("fast", 16, 6)
    assert all(c.sampling.samples == 9 for c in rows.values())
    with pytest.raises(InputError, match=r"unknown setting, expected .*network.width"):
        rows_of(["nerf"], {"network.widht": ["8"]})
    with pytest.raises(InputError, match="settings='network.width=x': expected a whole number"):
        rows_of(["nerf"], {"network.width": ["x"]})
    with pytest.raises(InputError, match="nothing to train"):
        rows_of([], {})


# ---- Looking at a run ---------------------------------------------------------------


@pytest.mark.slow
def test_looks_take_no_training_time_and_change_nothing(
    blob: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (config,) = tiny().values()
    plain = training.start(blob, tmp_path / "plain", config, VARIANT)
    plain.train(show_bar=False)
    seen: list[float] = []

    def look(run: Run) -> dict[str, Any]:
        run.field_file().build(run.trainer._backend)
        seen.append(run.progress)
        clock.now += 1000
        return {}

    monkeypatch.setattr(time, "monotonic", clock := Clock())
    watched = training.start(blob, tmp_path / "watched", config, VARIANT)
    watch = Watch(tmp_path / "watched", 3, look)
    watched.train(show_bar=False, after_step=watch)
    # Shares of 1/16, 1/4 and 1 of 6 steps: after the first, the second and the last.
    assert seen == pytest.approx([1 / 6, 2 / 6, 1])
    lines = read_curve(tmp_path / "watched")
    assert [line["step"] for line in lines] == [1, 2, 6]
    assert 0 < lines[-1]["seconds"] <= watched.seconds < 1
    for name, weights in plain.trainer.field.weights().items():
        assert (weights == watched.trainer.field.weights()[name]).all(), name


def test_looks_that_a_checkpoint_has_not_seen_are_repeated(tmp_path: Path) -> None:
    """A run that was killed at step 5 and goes on from step 2."""
    (config,) = tiny().values()
    lines = [{"look": k, "step": s, "seconds": 1.0, "psnr": 9.0} for k, s in ((1, 1), (2, 4))]
    (tmp_path / "curve.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))

    class Fake:
        def __init__(self, step: int) -> None:
            self.trainer = type("T", (), {"step_count": step})
            self.progress, self.seconds = step / 6, 0.5 * step
            self.clock_stopped = lambda: open("/dev/null")

    watch = Watch(tmp_path, 3, lambda run: {"psnr": 10.0})
    for step in range(3, 7):
        watch(Fake(step))
    assert [(v["look"], v["step"], v["psnr"]) for v in read_curve(tmp_path)] == [
        *((1, 1, 9.0), (2, 3, 10.0), (3, 6, 10.0))
    ]


# ---- The whole ----------------------------------------------------------------------


@pytest.mark.slow
def test_models_and_seeds(blob: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows, out = tiny(("network.width", ["8", "12"])), tmp_path / "out"
    options: dict[str, Any] = {"seeds": 2, "views": 2, "looks": 3}
    record = training_curves(blob, out, rows, VARIANT, **options)
    assert record["complete"] and record == load(out)
    assert [row["name"] for row in record["rows"]] == list(rows)
    for row in record["rows"]:
        assert row["seeds"] == 2 and row["failures"] == 0 and len(row["curve"]) == 3
        ends = [run["curve"][-1]["psnr"] for run in row["runs"]]
        assert ends[0] != ends[1] and row["psnr"] == pytest.approx(np.mean(ends))
        last = row["curve"][-1]
        assert (last["least"], last["greatest"]) == (min(ends), max(ends))
        for run in row["runs"]:
            times = [line["seconds"] for line in run["curve"]]
            assert times == sorted(times) and times[-1] <= run["seconds"]
    # What is there is not trained again.
    monkeypatch.setattr(Run, "train", None)
    assert training_curves(blob, out, rows, VARIANT, **options)["rows"] == record["rows"]
    with pytest.raises(InputError, match="with other settings"):
        training_curves(blob, out, rows, VARIANT, **{**options, "looks": 4})


@pytest.mark.slow
def test_it_goes_on_where_it_was_stopped(
    blob: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options: dict[str, Any] = {"seeds": 2, "views": 1, "looks": 2}
    train = Run.train
    started: list[int] = []

    def stopping(self: Run, show_bar: bool = True, after_step: Any = None) -> None:
        started.append(self.config.seed)
        if len(started) == 2:
            self._advance()
            self._settle()
            after_step(self)
            self.save()
        else:
            train(self, show_bar, after_step)

    monkeypatch.setattr(Run, "train", stopping)
    record = training_curves(blob, tmp_path / "out", tiny(), VARIANT, **options)
    assert not record["complete"] and record["rows"][0]["seeds"] == 1
    record = training_curves(blob, tmp_path / "out", tiny(), VARIANT, **options)
    assert record["complete"] and started == [0, 1, 1]
    assert [line["step"] for line in record["rows"][0]["runs"][1]["curve"]] == [1, 6]


@pytest.mark.slow
def test_failures_are_counted(blob: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(self: Run, show_bar: bool = True, after_step: Any = None) -> None:
        raise TrainingError("collapsed")

    monkeypatch.setattr(Run, "train", failing)
    record = training_curves(blob, tmp_path / "out", tiny(), VARIANT, seeds=2)
    (row,) = record["rows"]
    assert row["failures"] == 2 and row["psnr"] is None and row["curve"] == []
    assert conclusions(record) == ["No run has come to an end."]


def curve(*points: tuple[float, float]) -> list[dict[str, Any]]:
    return [
        {"look": i + 1, "seconds": s, "psnr": p, "ssim": 0.5, "queries_per_ray": 2.0, "step": i}
        for i, (s, p) in enumerate(points)
    ]


def test_what_curves_say() -> None:
    ending = {"parameters": 10, "steps": 5, "failed": None}
    runs = [{"curve": curve((1, 10 + k), (4, 20 + k)), **ending} for k in (0, 2)]
    fast = summary("fast", [*runs, {"failed": "collapsed", "curve": []}])
    assert fast["psnr"] == 21 and fast["failures"] == 1 and fast["seeds"] == 3
    assert [(p["least"], p["greatest"]) for p in fast["curve"]] == [(10, 12), (20, 22)]
    assert seconds_to(fast["curve"], 16) == pytest.approx(2)  # half of it in the logarithm
    assert seconds_to(fast["curve"], 5) == 1 and seconds_to(fast["curve"], 22) is None
    slow = summary("nerf", [{"curve": curve((2, 9), (4, 16)), **ending}])
    text = "\n".join(conclusions({"rows": [slow, fast]}))
    assert "21.00 dB after 4 s (2 seeds, 20.00 to 22.00)" in text
    assert "It ends 5.00 dB above `nerf` (16.00 dB after 4 s), and passes that after 2 s." in text
    assert "1 runs failed" in text


@pytest.mark.slow
def test_the_command(blob: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    options = ["--presets", "nerf", "--vary", "network.width=8,12", "--seeds", "1", "--steps", "3"]
    options += ["--views", "1", "--looks", "2", "--set", *TINY[1:-1]]
    assert main(["report", "--train", str(blob), "--out", str(out), *options]) == 0
    record, text = load(out), (out / "report.md").read_text()
    printed = capsys.readouterr().out
    for sentence in conclusions(record):
        assert f"- {sentence}\n" in text and sentence in printed
    for row in record["rows"]:
        assert f"| `{row['name']}` | {row['psnr']:.2f} |" in text
    assert iio.imread(out / "training.png").ndim == 3
    (axes,) = plot_curves(record).get_axes()
    assert axes.get_xscale() == "log" and len(axes.get_lines()) == 2


def test_bad_input(refused: Callable[..., str], data: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    train = ["report", "--train", str(data), "--out", str(out)]
    assert "preset 'quick': unknown" in refused(*train, "--presets", "quick")
    assert "network.wdth" in refused(*train, "--vary", "network.wdth=8,16")
    assert "--vary network.width: expected name=value" in refused(*train, "--vary", "network.width")
    assert "--seeds 0" in refused(*train, "--seeds", "0")
    assert "--max-seconds -1" in refused(*train, "--max-seconds", "-1")
    assert "holds no report.json" in refused("report", "--train", data, "--out", data)
    assert "no such dataset folder" in refused("report", "--train", tmp_path / "none", "--out", out)
    (data / "transforms_test.json").unlink()
    assert "has training views alone" in refused(*train)
