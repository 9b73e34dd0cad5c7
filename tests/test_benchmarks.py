"""Benchmarks that train, on tiny data: what they save has the columns that the documents show."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import mi_nerf
from tests.benchmarks import trained
from tests.benchmarks.results import ROOT, load
from tests.support.datasets import write_blob_dataset

TINY = ["network.width=8", "network.view_width=8", "sampling.samples=8", "sampling.fine=8"]


@pytest.fixture(scope="module")
def data_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders of data, in which lego_200 is a ball; it is measured on its test views."""
    root = tmp_path_factory.mktemp("root")
    folder = write_blob_dataset(root / "lego_200")
    (folder / "transforms_val.json").write_text((folder / "transforms_test.json").read_text())
    return root


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "name", "labels", "figures"),
    [
        ("quality --seconds 1 --seeds 1 --preset fast", "quality", ["lego_200"], ["psnr"]),
        (
            "reduced_paper --steps 3 --no-published --set " + " ".join(TINY),
            "reduced_paper",
            ["3 steps", "lego_200, 12×12"],
            ["psnr", "learning_rate", "seconds", "parameters"],
        ),
        (
            "startup --presets fast --repeat 1",
            "startup",
            ["empty", "warm", "lego_200, 12×12", "this"],
            ["seconds", "cpu_seconds"],
        ),
        (
            "frames --presets fast --steps 3 --size 12 12 --frames 1 --repeats 1",
            "frames",
            ["fast", "12×12", "all", "this"],
            ["busy", "wall", "first"],
        ),
        (
            "rules --preset fast --seconds 2 --views 2 --rays 64",
            "rules_trained",
            ["fast", "256"],
            ["constant_off", "jittered_linear_psnr"],
        ),
    ],
    ids=["quality", "reduced_paper", "startup", "frames", "rules"],
)
def test_it_saves_rows(
    words: str, name: str, labels: list[str], figures: list[str], data_root: Path, tmp_path: Path
) -> None:
    module, *options = words.split()
    subprocess.run(
        [sys.executable, "-m", f"tests.benchmarks.{module}", *options, "--results", str(tmp_path)],
        cwd=ROOT,
        env={**os.environ, "MI_NERF_DATA": str(data_root)},
        check=True,
    )
    assert [file.stem for file in tmp_path.iterdir()] == [name]
    records = load(tmp_path / f"{name}.json")
    assert all(record.origin.current() for record in records)
    assert {record.origin.command for record in records} == {f"python -m tests.benchmarks.{words}"}
    assert set(labels) <= {label for r in records for label in r.row.labels.values()}
    assert set(figures) <= {figure for r in records for figure in r.row.figures}


def test_what_a_training_came_to(blob_run: Path) -> None:
    measured = mi_nerf.evaluate(blob_run, views=2)
    found = trained.outcome(blob_run, measured)
    last = json.loads((blob_run / "log.jsonl").read_text().splitlines()[-1])
    assert found["steps"] == last["step"] == 20 and found["restarts"] == 0
    assert found["psnr"] == measured["mean"]["psnr"] and found["learning_rate"] > 0
    assert found["seconds"] == pytest.approx(last["seconds"], abs=1)
    other = {**found, "psnr": found["psnr"] + 2}
    row = trained.row({"what": "a ball"}, [found, other], "blob", (0, 1))
    assert row.figures.keys() == trained.UNITS.keys()
    assert row.figures["psnr"].value == pytest.approx(found["psnr"] + 1)
    assert row.figures["psnr"].spread == (found["psnr"], other["psnr"])
    assert row.protocol is not None and row.protocol.resolution == (24, 24)
    assert row.protocol.views == 2 and row.seeds == (0, 1)
