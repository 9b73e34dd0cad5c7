"""Runs and field files as commands open them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import mi_nerf
from mi_nerf import InputError, load_field, open_target, save_field
from mi_nerf.cli import main
from mi_nerf.training import run as training
from mi_nerf.training.presets import preset
from tests.support.fields import small_file


def change_settings(run: Path, **changes: Any) -> None:
    record = json.loads((run / "config.json").read_text())
    record["settings"] |= changes
    (run / "config.json").write_text(json.dumps(record))


def test_a_run_whose_settings_are_not_known_any_more(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is no longer trained, but it is still looked at."""
    change_settings(run, downscale=2, learning_rate=1e-3, sampling={"strata": 3})
    found = mi_nerf.evaluate(run, views=1)
    assert found["size"] == [12, 12]  # as it was trained
    assert main(["render", str(run), "-o", str(tmp_path / "views"), "--path", "test"]) == 0
    assert main(["info", str(run)]) == 0
    assert "20 steps" in capsys.readouterr().out
    with pytest.raises(InputError, match="not a training configuration of this version"):
        training.start(found_data(run), run, preset("nerf"), "llvm_ad_rgb", resume=True)


def found_data(run: Path) -> Path:
    data = open_target(run).data
    assert data is not None
    return data


@pytest.mark.parametrize("downscale", ["2", 0, None])
def test_a_scale_that_is_none(run: Path, downscale: Any) -> None:
    change_settings(run, downscale=downscale)
    with pytest.raises(InputError, match=r"config.json: downscale=.*, expected a whole number"):
        open_target(run)


def test_seconds_are_those_that_the_weights_have_seen(run: Path) -> None:
    """After a kill, the log is older than the field by up to a minute."""
    contents = load_field(run / "field.safetensors")
    seconds = contents.provenance["seconds"]
    last = json.loads((run / "log.jsonl").read_text().splitlines()[-1])
    assert contents.provenance["steps"] == last["step"] == 20
    assert 0 < last["seconds"] <= seconds + 1e-3
    with (run / "log.jsonl").open("a") as log:
        log.write(json.dumps({**last, "step": 900, "seconds": seconds + 55}) + "\n")
    assert open_target(run).train_seconds == seconds


def test_the_log_tells_where_an_older_field_does_not(run: Path) -> None:
    path = run / "field.safetensors"
    contents = load_field(path)
    contents.provenance.pop("seconds")
    save_field(path, contents)
    last = json.loads((run / "log.jsonl").read_text().splitlines()[-1])
    assert open_target(run).train_seconds == last["seconds"]
    for damaged in ("", "{", "{}", "[1]", '{"seconds": null}'):
        (run / "log.jsonl").write_text(damaged)
        assert open_target(run).train_seconds is None
    (run / "log.jsonl").unlink()
    assert open_target(run).train_seconds is None


def test_a_lone_field_file_tells_no_seconds(tmp_path: Path) -> None:
    assert open_target(small_file(tmp_path)).train_seconds is None
