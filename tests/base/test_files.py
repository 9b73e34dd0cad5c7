"""Files that mi_nerf writes: whole or not at all, and read back to the last bit."""

from __future__ import annotations

import json
import os
import stat
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save_file

from mi_nerf import FieldFile, NeuralFieldConfig, load_field, save_field
from mi_nerf.base.errors import InputError
from mi_nerf.base.files import (
    check_file,
    check_folder,
    make_folder,
    read_json,
    remove_leftovers,
    replacing,
    write_json,
)
from mi_nerf.base.tensor_file import read_metadata, read_tensors, write_tensors
from mi_nerf.cli import main
from mi_nerf.fields.fourier import FourierEncoding
from mi_nerf.fields.network import NetworkConfig, initial_weights
from mi_nerf.march.settings import MarchSettings


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


# ---- Replacing files ------------------------------------------------------------


def test_a_new_file_appears_when_the_block_ends(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    with replacing(target) as temporary:
        assert temporary.parent == tmp_path and temporary.suffix == ".txt"
        temporary.write_text("new")
        assert not target.exists()
    assert target.read_text() == "new"
    assert names(tmp_path) == {"a.txt"}


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_a_failing_block_leaves_the_old_file(tmp_path: Path, error: type) -> None:
    target = tmp_path / "a.txt"
    target.write_text("old")
    with pytest.raises(error), replacing(target) as temporary:
        temporary.write_text("half")
        raise error
    assert target.read_text() == "old"
    assert names(tmp_path) == {"a.txt"}


def test_permissions_follow_the_umask(tmp_path: Path) -> None:
    """Temporary files are private; the files that replace others must not be."""
    before = os.umask(0o027)
    try:
        with replacing(tmp_path / "a") as temporary:
            temporary.write_text("x")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == 0o640


def test_the_umask_is_never_touched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It belongs to the whole process: files of other threads would be open to all meanwhile."""
    monkeypatch.setattr(os, "umask", lambda _: pytest.fail("the umask is changed"))
    with replacing(tmp_path / "a") as temporary:
        temporary.write_text("x")


def test_a_writer_may_replace_the_temporary_file(tmp_path: Path) -> None:
    with replacing(tmp_path / "a") as temporary:
        mode = stat.S_IMODE(temporary.stat().st_mode)
        (tmp_path / "b").touch(0o600)
        (tmp_path / "b").replace(temporary)
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == mode


def test_content_reaches_the_disk_before_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a power failure may leave an empty file under the final name."""
    calls: list[str] = []
    sync, rename = os.fsync, os.replace

    def fsync(handle: int) -> None:
        kind = "folder" if stat.S_ISDIR(os.fstat(handle).st_mode) else "file"
        calls.append(f"{kind} synced, {len(list(tmp_path.glob('a')))} named")
        sync(handle)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", lambda *a: (calls.append("renamed"), rename(*a)))
    with replacing(tmp_path / "a") as temporary:
        temporary.write_text("x")
    assert calls == ["file synced, 0 named", "renamed", "folder synced, 1 named"]


def test_what_killed_processes_leave_is_removed(tmp_path: Path) -> None:
    for name in ("r_0.png", "a.b-c.safetensors", "plain"):
        with replacing(tmp_path / name) as temporary:  # whatever its name is like
            left = temporary
            copy = tmp_path / f"copy of {name}"
            copy.write_text("")
        copy.rename(left)
    others = {".hidden", ".hidden.png", ".cache-123.png", "r_0-0123456789abcdef.png"}
    for name in others:
        (tmp_path / name).touch()
    assert len(names(tmp_path)) == 10
    remove_leftovers(tmp_path)
    assert names(tmp_path) == others | {"r_0.png", "a.b-c.safetensors", "plain"}


def test_a_folder_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    with pytest.raises(InputError, match="a: cannot be written"), replacing(tmp_path / "a") as t:
        t.write_text("x")
    assert names(tmp_path) == {"a"}


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with (
        pytest.raises(InputError, match="none/a: cannot be written"),
        replacing(tmp_path / "none" / "a"),
    ):
        pytest.fail("the block runs")


def test_json(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"b": [1, None, "ü"]})
    assert read_json(tmp_path / "a.json", "a thing") == {"b": [1, None, "ü"]}
    with pytest.raises(TypeError):
        write_json(tmp_path / "a.json", {"b": object()})
    assert read_json(tmp_path / "a.json", "a thing") == {"b": [1, None, "ü"]}
    assert names(tmp_path) == {"a.json"}
    (tmp_path / "a.json").write_text("{")
    with pytest.raises(InputError, match=r"a.json: cannot be read as a thing"):
        read_json(tmp_path / "a.json", "a thing")
    with pytest.raises(InputError, match=r"b.json: not found, expected a thing"):
        read_json(tmp_path / "b.json", "a thing")


# ---- Folders ----------------------------------------------------------------------


def test_folders_are_made_with_their_parents(tmp_path: Path) -> None:
    check_folder(tmp_path / "a" / "b")
    check_file(tmp_path / "a" / "b" / "c.txt")
    assert names(tmp_path) == set()  # only looked at
    assert make_folder(tmp_path / "a" / "b") == tmp_path / "a" / "b"
    assert (tmp_path / "a" / "b").is_dir()
    make_folder(tmp_path / "a" / "b")
    assert names(tmp_path / "a" / "b") == set()


def test_relative_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    check_file("a.txt")
    make_folder("b/c")
    assert (tmp_path / "b" / "c").is_dir()


def test_files_in_the_place_of_folders(tmp_path: Path) -> None:
    (tmp_path / "a").touch()
    for check in (check_folder, make_folder):
        with pytest.raises(InputError, match="a: expected an output folder, but this is a file"):
            check(tmp_path / "a")
        with pytest.raises(InputError, match="a/b: expected an output folder, but .*/a is a file"):
            check(tmp_path / "a" / "b")
    with pytest.raises(InputError, match="expected an output file, this is a folder"):
        check_file(tmp_path)


# ---- Tensor files -------------------------------------------------------------------


def test_tensors_come_back(tmp_path: Path) -> None:
    arrays = {
        "a": np.arange(6, dtype=np.float32).reshape(2, 3).T,  # not contiguous
        "b": np.array([True, False]),
        "c": np.array(7, np.uint64),
    }
    description = {"x": [1, {"y": None}], "ü": "ß"}
    path = tmp_path / "a.safetensors"
    write_tensors(path, arrays, kind="thing", version=3, description=description)
    found, text = read_tensors(path, kind="thing", newest=3)
    assert text == description
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype
        assert np.array_equal(found[name], array)
    assert read_metadata(path)["format"] == "mi_nerf.thing"


def test_tensors_of_another_kind_or_version(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    write_tensors(path, {}, kind="thing", version=3, description={})
    with pytest.raises(InputError, match=r"a.*: holds 'mi_nerf.thing', expected 'mi_nerf.field'"):
        read_tensors(path, kind="field", newest=3)
    for newest in (3, 4):
        read_tensors(path, kind="thing", newest=newest, oldest=3)
    with pytest.raises(InputError, match=r"newer than this program: .* version 3, .* up to 2; upd"):
        read_tensors(path, kind="thing", newest=2)
    with pytest.raises(InputError, match=r"thing file of format version 3, expected 4 or newer"):
        read_tensors(path, kind="thing", newest=5, oldest=4)
    with pytest.raises(InputError, match=r"b.safetensors: not found, expected a .safetensors file"):
        read_tensors(tmp_path / "b.safetensors", kind="thing", newest=3)
    save_file({}, path, {"format": "mi_nerf.thing", "version": "3.1"})
    with pytest.raises(InputError, match=r"damaged thing file: its format version is '3.1'"):
        read_tensors(path, kind="thing", newest=3)


def test_tensors_cut_anywhere_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    write_tensors(path, {"a": np.ones(9)}, kind="thing", version=1, description={"b": 1})
    whole = path.read_bytes()
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        with pytest.raises(InputError, match="a.safetensors: not a complete safetensors file"):
            read_tensors(path, kind="thing", newest=1)


# ---- Field files ----------------------------------------------------------------------

CONFIG = NeuralFieldConfig(
    lower=(-0.1, -0.2, -1 / 3),
    upper=(0.3, 0.4, 0.7),
    color_space="linear",
    position=FourierEncoding(frequencies=3, convention="two_pi", include_input=False),
    direction=FourierEncoding(frequencies=1),
    network=NetworkConfig(depth=3, width=5, skip=1, view_depth=2, view_width=3),
    density_activation="exp",
    density_shift=-0.7,
    density_scale=1 / 7,
    color_activation="exp",
    input_center=(0.1, 0.1, 0.2),
    input_scale=1.9,
)


@pytest.mark.parametrize("shape", [None, (1, 1, 1), (3, 4, 5), (8, 8, 8)])
def test_fields_come_back(tmp_path: Path, shape: tuple[int, ...] | None) -> None:
    cells = None if shape is None else np.random.default_rng(0).random(shape) < 0.4
    contents = FieldFile(
        CONFIG,
        initial_weights(CONFIG.shapes(), 1),
        cells,
        MarchSettings(samples=33, near=0.25, far=None),
        {"from": "a test", "steps": 3},
    )
    path = tmp_path / "field.safetensors"
    save_field(path, contents)
    found = load_field(path)
    assert found.config == CONFIG
    assert found.weights.keys() == contents.weights.keys()
    for name, array in contents.weights.items():
        assert found.weights[name].dtype == np.float32
        assert found.weights[name].tobytes() == array.tobytes(), name
    if cells is None:
        assert found.occupancy is None
    else:
        assert found.occupancy is not None and found.occupancy.dtype == bool
        assert np.array_equal(found.occupancy, cells)
    assert (found.march.samples, found.march.near, found.march.far) == (33, 0.25, None)
    assert found.provenance == contents.provenance


def test_a_failing_write_leaves_the_old_field(tmp_path: Path) -> None:
    path = tmp_path / "field.safetensors"
    contents = FieldFile(CONFIG, initial_weights(CONFIG.shapes(), 1))
    save_field(path, contents)
    first = path.read_bytes()
    with pytest.raises(TypeError):
        save_field(path, FieldFile(CONFIG, contents.weights, provenance={"a": object()}))
    assert path.read_bytes() == first
    assert names(tmp_path) == {"field.safetensors"}


@pytest.mark.slow
def test_nothing_in_a_run_is_half_written_or_pickled(blob_run: Path) -> None:
    assert names(blob_run) == {
        "config.json",
        "checkpoint.safetensors",
        "field.safetensors",
        "log.jsonl",
    }
    for path in blob_run.glob("*.safetensors"):
        assert b"pickle" not in path.read_bytes()


# ---- info ---------------------------------------------------------------------------


@pytest.fixture
def info(capsys: pytest.CaptureFixture[str]) -> Any:
    """Calls ``mi-nerf info`` and returns its rows."""

    def call(*arguments: Path) -> dict[str, str]:
        capsys.readouterr()
        assert main(["info", *map(str, arguments)]) == 0
        out, err = capsys.readouterr()
        assert err == ""
        rows = [line.split("  ", 1) for line in out.splitlines()]
        return {name: value.strip() for name, value in rows}

    return call


def test_info_on_the_system(info: Any) -> None:
    import drjit as dr
    import mitsuba as mi

    import mi_nerf

    rows = info()
    assert rows["mi_nerf"] == mi_nerf.__version__
    assert rows["mitsuba"] == mi.__version__
    assert rows["drjit"] == dr.__version__
    assert rows["cores"] == str(os.cpu_count())
    assert rows["default"] in rows["variants"].split(", ")
    assert rows["default"].endswith("_ad_rgb")


@pytest.mark.slow
def test_info_on_a_run(info: Any, blob: Path, blob_run: Path) -> None:
    rows = info(blob_run)
    assert rows["run"] == str(blob_run)
    assert rows["preset"] == "nerf"
    assert rows["data"] == f"{blob.resolve()}, 8 views of 24x24"
    assert rows["budget"] == "20 steps"
    assert rows["step"] == "20"
    parameters = json.loads((blob_run / "config.json").read_text())["field"]["parameters"]
    assert rows["network"].startswith("2x16,") and f", {parameters} parameters" in rows["network"]
    assert "% of (16, 16, 16)" in rows["occupied"]


def test_info_on_a_run_without_a_checkpoint(info: Any, run: Path) -> None:
    (run / "checkpoint.safetensors").unlink()
    (run / "field.safetensors").unlink()
    rows = info(run)
    assert rows["budget"] == "20 steps"
    assert "step" not in rows and "network" not in rows


def test_info_on_single_files(info: Any, blob_run: Path, tmp_path: Path) -> None:
    checkpoint = info(blob_run / "checkpoint.safetensors")
    assert (checkpoint["step"], checkpoint["restarts"]) == ("20", "0")
    path = tmp_path / "field.safetensors"
    save_field(path, FieldFile(CONFIG, initial_weights(CONFIG.shapes(), 1)))
    field = info(path)
    assert field["box"] == "(-0.100, -0.200, -0.333) to (0.300, 0.400, 0.700)"
    assert field["encoding"] == "L=3 (position), 1 (direction), convention two_pi"
    assert field["colour"] == "exp, linear"
    assert field["occupied"] == "no grid"


def test_info_on_a_dataset(info: Any, blob: Path) -> None:
    rows = info(blob)
    assert rows["train"] == "8 views of 24x24, srgb RGBA, field of view 34.4 degrees"
    assert rows["test"] == "5 views of 24x24, srgb RGBA, field of view 34.4 degrees"


def test_info_on_other_things(refused: Any, blob: Path, tmp_path: Path) -> None:
    assert f"{tmp_path}: expected a run with its config.json, or a dataset" in refused(
        "info", tmp_path
    )
    assert "transforms_train.json: not a complete safetensors file" in refused(
        "info", blob / "transforms_train.json"
    )
    write_tensors(tmp_path / "a", {}, kind="thing", version=1, description={})
    assert "a: format 'mi_nerf.thing', expected a field file or a checkpoint" in refused(
        "info", tmp_path / "a"
    )
