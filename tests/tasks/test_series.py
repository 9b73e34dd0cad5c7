"""Trainings by other processes: the same results, whatever happens to these."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mi_nerf.cli import main
from mi_nerf.jobs import JobError
from mi_nerf.report.curves import training_curves
from mi_nerf.tasks import ablate as ablation
from mi_nerf.tasks.ablate import ablate
from tests.support.processes import children
from tests.tasks.test_ablate import TINY, tiny

pytestmark = pytest.mark.slow
VARIANT = "llvm_ad_rgb"
_train = ablation._train


def timeless(record: Any) -> Any:
    """A record without what clocks say."""
    if isinstance(record, dict):
        return {key: timeless(value) for key, value in record.items() if "seconds" not in key}
    return [timeless(value) for value in record] if isinstance(record, list) else record


def dying_once(name: str, config: Any, permit: Any, **rest: Any) -> Any:
    """Kills its process in the middle of the first training of a row."""
    marker = Path(os.environ["MARKERS"]) / f"{name} {config.seed}"
    if not marker.exists():
        marker.touch()
        threading.Timer(2.0, os.kill, (os.getpid(), signal.SIGKILL)).start()
        time.sleep(60)
    return _train(name, config, permit, **rest)


def dying(*_: Any, **__: Any) -> Any:
    """Kills its process always."""
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize("workers", [1, 2])
def test_an_ablation(workers: int, blob: Path, tmp_path: Path) -> None:
    rows = ["no-h", "complete"]
    here = ablate(blob, tmp_path / "here", tiny(), VARIANT, rows=rows, seeds=2)
    there = ablate(blob, tmp_path / "there", tiny(), VARIANT, rows=rows, seeds=2, workers=workers)
    assert there["complete"] and timeless(there) == timeless(here)
    assert there == json.loads((tmp_path / "there/ablation.json").read_text())
    assert not list((tmp_path / "there").glob(".*")) and not children()


def test_curves(blob: Path, tmp_path: Path) -> None:
    rows = {"a": tiny(), "b, c": tiny(seed=5)}
    options: dict[str, Any] = {"seeds": 2, "looks": 2, "views": 2}
    told: list[tuple[str, int]] = []
    here = training_curves(blob, tmp_path / "here", rows, VARIANT, **options)
    there = training_curves(
        blob,
        tmp_path / "there",
        rows,
        VARIANT,
        **options,
        workers=2,
        on_run=lambda name, seed: told.append((name, seed)),
    )
    assert there["complete"] and timeless(there) == timeless(here)
    assert sorted(told) == [("a", 0), ("a", 1), ("b, c", 5), ("b, c", 6)]


def test_a_worker_that_dies(blob: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here = ablate(blob, tmp_path / "here", tiny(), VARIANT, rows=["no-vd"], seeds=2)
    monkeypatch.setenv("MARKERS", str(tmp_path))
    monkeypatch.setattr(ablation, "_train", dying_once)
    out = tmp_path / "there"
    there = ablate(blob, out, tiny(), VARIANT, rows=["no-vd"], seeds=2, workers=2)
    assert {p.name for p in tmp_path.glob("no-vd *")} == {"no-vd 0", "no-vd 1"}
    assert timeless(there) == timeless(here)
    monkeypatch.setattr(ablation, "_train", dying)
    with pytest.raises(JobError, match="^complete, seed 0: the worker died 3 times, by SIGKILL$"):
        ablate(blob, out, tiny(), VARIANT, rows=["complete"], workers=1)


def test_ctrl_c_and_another_number_of_workers(blob: Path, tmp_path: Path) -> None:
    """Trainings are saved where they are, and go on from there."""
    config = replace(tiny(), steps=1500)
    whole = ablate(blob, tmp_path / "whole", config, VARIANT, rows=["no-h"])

    out = tmp_path / "out"

    def interrupt() -> None:
        end = time.monotonic() + 60
        while not (out / "no-h/seed_0/config.json").exists() and time.monotonic() < end:
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    record = ablate(blob, out, config, VARIANT, rows=["no-h"], workers=2)
    assert not record["complete"] and not record["rows"] and not children()
    assert (out / "no-h/seed_0/checkpoint.safetensors").exists()
    assert not (out / "no-h/seed_0/eval.json").exists()
    record = ablate(blob, out, config, VARIANT, rows=["no-h"], workers=1)
    assert timeless(record) == timeless(whole)


def test_the_commands(blob: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--steps", "2", "--views", "2", "--set", *TINY]
    out = tmp_path / "ablation"
    words = ["ablate", str(blob), "--out", str(out), "--rows", "complete", *options]
    assert main([*words, "--workers", "2"]) == 0
    assert "| Complete model |" in capsys.readouterr().out
    words = ["report", "--train", str(blob), "--out", str(tmp_path / "curves"), "--seeds", "2"]
    words += ["--presets", "nerf", "--looks", "1", *options]
    assert main([*words, "--workers", "2"]) == 0
    text, errors = capsys.readouterr()
    assert "nerf, seed 0" in text and "nerf, seed 1" in text and errors == ""
    assert not children()


def test_bad_options(refused: Any, tmp_path: Path) -> None:
    line = refused("report", "slab", "--out", tmp_path / "out", "--workers", "2")
    assert "--workers: of trainings, expected --train DATA" in line
