"""The command line: what it accepts, and how it refuses."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from safetensors import safe_open
from safetensors.numpy import save_file

from mi_nerf.base import variants as backend
from mi_nerf.base.errors import InputError
from mi_nerf.cli import main
from mi_nerf.commands import COMMANDS
from mi_nerf.training import run as training
from mi_nerf.training.config import TrainConfig
from tests.support.datasets import write_exr

Refused = Callable[..., str]


def change_json(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Rewrites a JSON file after ``change`` has altered its content in place."""
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def change_tensors(path: Path, change: Callable[[dict[str, str], dict[str, Any]], object]) -> None:
    """Rewrites a safetensors file after ``change(metadata, arrays)``."""
    with safe_open(path, framework="numpy") as file:
        metadata = dict(file.metadata())
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    change(metadata, arrays)
    save_file(arrays, path, metadata)


def change_description(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Rewrites the description in a safetensors file."""

    def rewrite(metadata: dict[str, str], _arrays: dict[str, Any]) -> None:
        description = json.loads(metadata["description"])
        change(description)
        metadata["description"] = json.dumps(description)

    change_tensors(path, rewrite)


def cut(path: Path, size: int) -> None:
    """Keeps the first ``size`` bytes of a file."""
    path.write_bytes(path.read_bytes()[:size])


# --------------------------------------------------------------------------
#   Help
# --------------------------------------------------------------------------


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_examples(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert "Examples:" in text
    assert text.split("Examples:")[1].count(f"mi-nerf {command}") >= 2


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"]])
def test_help_lists_the_commands(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert all(name in text for name in COMMANDS)
    assert "Examples:" not in text  # those of one command alone


@pytest.mark.slow
def test_every_example_is_accepted_by_the_parser(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    for command in COMMANDS.values():
        monkeypatch.setattr(command, "run", lambda *_: None)
        for line in (command.__doc__ or "").splitlines():
            if line.strip().startswith("mi-nerf "):
                assert main(line.split()[1:]) == 0, line


# --------------------------------------------------------------------------
#   Usage
# --------------------------------------------------------------------------

LONG = "/a/very/long/path/that/fits/in/no/line/of/a/terminal/of/eighty/columns/at/all/picture.png"


@pytest.mark.parametrize(
    ("line", "said"),
    [
        # ---- What the parser itself refuses ----
        ("trian {data}", "trian: unknown command, did you mean train?"),
        ("qqq", "qqq: unknown command, expected one of demo, generate, train, "),
        ("--qqq", "--qqq: unknown option of mi-nerf, see mi-nerf --help"),
        ("train", "train: missing DATA and --out PATH, see mi-nerf train --help"),
        ("train {data}", "train: missing --out PATH"),
        ("train --out {out}", "train: missing DATA"),
        ("eval", "eval: missing TARGET"),
        ("render {run}", "render: missing --out PATH"),
        ("train {data} --out {out} --qqq 3", "--qqq: unknown option of mi-nerf train, see"),
        ("train {data} --out {out} --max-second 3", "--max-second: unknown option of mi-nerf"),
        ("train {data} --out {out} --max-second 3", "did you mean --max-seconds?"),
        (f"train {{data}} {LONG} --out {{out}}", f"{LONG}: unknown argument of mi-nerf train"),
        ("train {data} --out {out} --steps", "--steps: expected a value"),
        ("train {data} --out {out} --steps many", "--steps many: expected a whole number"),
        ("train {data} --out {out} --steps 1.5", "--steps 1.5: expected a whole number"),
        ("train {data} --out {out} --steps=1.5", "--steps 1.5: expected a whole number"),
        ("train {data} --out {out} --max-seconds x", "--max-seconds x: expected a number"),
        ("render {run} -o {out} --size 10", "--size 10: expected 2 whole numbers"),
        ("render {run} -o {out} --size 1 2 3", "--size 1 2 3: expected 2 whole numbers"),
        ("render {run} -o {out} --path up", "--path up: expected one of orbit, spiral, test"),
        ("render {run} -o {out} --path None", "--path None: expected one of orbit, spiral, test"),
        # ---- Values out of range ----
        ("train {data} --out {out} --steps 0", "--steps 0: expected a number above 0"),
        ("train {data} --out {out} --max-seconds -1", "--max-seconds -1: expected a number"),
        ("train {data} --out {out} --max-seconds nan", "--max-seconds nan: expected a number"),
        ("train {data} --out {out} --max-seconds inf", "--max-seconds inf: expected a number"),
        ("train {data} --out {out} --downscale 0", "--downscale 0: expected a number above 0"),
        ("train {data} --out {out} --downscale 25", "downscale 25 leaves no pixel of 24x24"),
        ("train {data} --out {out} --seed -1", "--seed -1: expected a number from 0 to"),
        ("train {data} --out {out} --seed 2147483648", "--seed 2147483648: expected a number"),
        ("train {data} --out {out} --preset new", "preset 'new': unknown, expected one of nerf"),
        ("train {data} --out {out} --variant scalar_rgb", "'scalar_rgb': has no derivatives, ex"),
        ("eval {run} --views 0", "--views 0: expected at least 1"),
        ("eval {run} --views -2", "--views -2: expected at least 1"),
        ("eval {run} --downscale 0", "--downscale 0: expected at least 1"),
        ("eval {run} --split qqq", "transforms_qqq.json: no such file; splits in this folder: tr"),
        ("render {run} -o {out}.png --size 0 10", "--size 0 10: expected two numbers of at least"),
        ("render {run} -o {out}.png --frames 0", "--frames 0: expected a number above 0"),
        ("render {run} -o {out}.png --spp -1", "--spp -1: expected a number above 0"),
        ("demo --out {out} --seconds 0", "--seconds 0: expected a number above 0"),
        ("demo --out {out} --seed -1", "--seed -1: expected a number from 0 to"),
        # ---- --set ----
        ("train {data} --out {out} --set", "--set: expected a value"),
        ("train {data} --out {out} --set width", "--set width: expected key=value"),
        ("train {data} --out {out} --set qqq=1", "--set qqq=1: unknown setting, expected one of"),
        ("train {data} --out {out} --set network.width=wide", "=wide: expected a whole number"),
        ("train {data} --out {out} --set network.width=0", "network.width=0: network: width=0, e"),
        ("train {data} --out {out} --set optimizer.lr=0", "lr=0: lr=0.0, expected a number above"),
        ("train {data} --out {out} --set seed=1 preset=x", "--set preset=x: expected --preset x"),
    ],
)
def test_usage(line: str, said: str, refused: Refused, blob: Path, blob_run: Path, tmp_path: Path):
    words = [
        word.format(data=blob, run=blob_run, out=tmp_path / "out" / "sub") for word in line.split()
    ]
    assert said in refused(*words)


def test_long_usage_message_is_one_line(refused: Refused, blob: Path, tmp_path: Path) -> None:
    message = refused("train", blob, "--out", tmp_path / "out", "--set", "qqq.q=1")
    assert "network.width" in message and "optimizer.lr" in message


@pytest.fixture
def configs(monkeypatch: pytest.MonkeyPatch) -> list[TrainConfig]:
    """Collects the configurations that training would start with."""
    found: list[TrainConfig] = []

    def start(_data: Path, _out: Path, config: TrainConfig, *_: Any, **__: Any) -> None:
        found.append(config)
        raise InputError("stop")

    monkeypatch.setattr(training, "start", start)
    return found


@pytest.mark.parametrize(
    "line",
    [
        "{data} --out {out} --set network.width=8 steps=1 optimizer.lr=0.5",
        "{data} --out {out} --set network.width=8 --set steps=1 --set optimizer.lr=0.5",
        "{data} --out {out} --set=network.width=8 --set steps=1 optimizer.lr=0.5",
        "{data} --set network.width=8 steps=1 --out {out} --set optimizer.lr=0.5",
        "--set network.width=8 steps=1 optimizer.lr=0.5 --out {out} {data}",
    ],
)
def test_set_may_be_repeated_or_list(
    line: str, configs: list[TrainConfig], blob: Path, tmp_path: Path
) -> None:
    main(["train", *line.format(data=blob, out=tmp_path / "run").split()])
    (config,) = configs
    assert config.network.width == 8
    assert config.optimizer.lr == 0.5
    assert (config.steps, config.max_seconds) == (1, None)


def test_defaults_of_training(configs: list[TrainConfig], blob: Path, tmp_path: Path) -> None:
    words = ["train", str(blob), "--out", str(tmp_path)]
    main(words)
    main([*words, "--steps", "7", "--seed", "3", "--downscale", "2", "--preset", "paper"])
    main([*words, "--max-seconds", "1.5"])
    assert [(c.steps, c.max_seconds) for c in configs] == [(None, 600), (7, None), (None, 1.5)]
    assert [c.preset for c in configs] == ["nerf", "paper", "nerf"]
    assert (configs[1].seed, configs[1].downscale) == (3, 2)


# --------------------------------------------------------------------------
#   Variants
# --------------------------------------------------------------------------


def test_no_usable_backend(
    refused: Refused, blob: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backend, "available_variants", lambda: [])
    message = refused("train", blob, "--out", tmp_path / "out")
    assert "no usable backend" in message
    assert "NVIDIA GPU" in message and "LLVM" in message and "DRJIT_LIBLLVM_PATH" in message


def test_variant_of_another_machine(
    refused: Refused, blob_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backend, "available_variants", lambda: ["llvm_ad_rgb"])
    message = refused("eval", blob_run, "--variant", "cuda_ad_rgb")
    assert "'cuda_ad_rgb': does not work on this machine, expected one such as 'llvm_ad" in message


def test_info_works_without_a_backend(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("drjit.has_backend", lambda _backend: False)
    assert main(["info"]) == 0
    assert "none works on this machine" in capsys.readouterr().out


# --------------------------------------------------------------------------
#   Datasets
# --------------------------------------------------------------------------


def _pose_nan(data: Path) -> None:
    def change(meta: dict[str, Any]) -> None:
        meta["frames"][2]["transform_matrix"][0][3] = float("nan")

    change_json(data / "transforms_train.json", change)


def _save(data: Path, pixels: np.ndarray) -> None:
    Image.fromarray(pixels).save(data / "train" / "r_3.png")


def _exr_in_between(data: Path) -> None:
    write_exr(data / "train" / "r_3.exr", **{c: np.ones((24, 24), np.float32) for c in "RGB"})

    def change(meta: dict[str, Any]) -> None:
        meta["frames"][3]["file_path"] += ".exr"

    change_json(data / "transforms_train.json", change)


DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing folder": (shutil.rmtree, "data: no such dataset folder"),
    "missing json": (
        lambda d: (d / "transforms_train.json").unlink(),
        "transforms_train.json: no such file",
    ),
    "broken json": (
        lambda d: cut(d / "transforms_train.json", 200),
        "transforms_train.json: expected valid JSON",
    ),
    "no frames": (
        lambda d: change_json(d / "transforms_train.json", lambda m: m.pop("frames")),
        'transforms_train.json: expected an object with a list of "frames"',
    ),
    "empty split": (
        lambda d: change_json(d / "transforms_train.json", lambda m: m.update(frames=[])),
        "transforms_train.json: the split is empty",
    ),
    "no field of view": (
        lambda d: change_json(d / "transforms_train.json", lambda m: m.pop("camera_angle_x")),
        'transforms_train.json: expected "camera_angle_x" or "fl_x"',
    ),
    "nan pose": (_pose_nan, '"./train/r_2": "transform_matrix" holds NaN or infinity'),
    "missing image": (lambda d: (d / "train" / "r_3.png").unlink(), "r_3.png: no such image"),
    "corrupt image": (lambda d: cut(d / "train" / "r_3.png", 60), "r_3.png: corrupt"),
    "grey image": (
        lambda d: _save(d, np.zeros((24, 24), np.uint8)),
        "r_3.png: expected RGB or RGBA, got 1 channel",
    ),
    "two channels": (
        lambda d: Image.new("LA", (24, 24)).save(d / "train" / "r_3.png"),
        "r_3.png: expected RGB or RGBA, got 2 channel",
    ),
    "other size": (
        lambda d: _save(d, np.zeros((20, 24, 4), np.uint8)),
        "must agree in size",
    ),
    "other colour space": (_exr_in_between, "must agree in colour space"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_bad_dataset(name: str, refused: Refused, data: Path, tmp_path: Path) -> None:
    damage, said = DAMAGES[name]
    damage(data)
    assert said in refused("train", data, "--out", tmp_path / "out", "--steps", "1")


def test_evaluation_of_a_bad_dataset_leaves_nothing(
    refused: Refused, blob_run: Path, data: Path, tmp_path: Path
) -> None:
    (data / "test" / "r_4.png").unlink()
    outputs = ["--json", tmp_path / "a" / "x.json", "--images", tmp_path / "b"]
    assert "r_4.png: no such image" in refused("eval", blob_run, "--data", data, *outputs)


def test_a_run_whose_dataset_is_gone(refused: Refused, run: Path, tmp_path: Path) -> None:
    gone = str(tmp_path / "gone")
    change_json(run / "config.json", lambda c: c["data"].update(path=gone))
    assert f"{gone}: the dataset of {run} is gone, expected --data" in refused("eval", run)
    assert gone in refused("render", run, "-o", tmp_path / "out.png")


# --------------------------------------------------------------------------
#   Output
# --------------------------------------------------------------------------


@pytest.mark.parametrize(
    "line",
    [
        "train {data} --out {bad} --steps 1",
        "eval {run} --json {bad}/x.json",
        "eval {run} --images {bad}",
        "render {run} -o {bad}/x.png",
        "render {run} -o {bad}/x.mp4",
        "render {run} -o {bad}/sub --frames 1",
        "demo --out {bad}",
    ],
)
@pytest.mark.parametrize("place", ["file", "below file", "/proc"])
def test_output_that_cannot_be_written(
    line: str, place: str, refused: Refused, blob: Path, blob_run: Path, tmp_path: Path
) -> None:
    file = tmp_path / "file"
    file.write_text("precious")
    bad = {"file": file, "below file": file / "sub", "/proc": Path("/proc/nothing")}[place]
    message = refused(*(w.format(data=blob, run=blob_run, bad=bad) for w in line.split()))
    assert str(bad) in message
    assert "expected" in message or "cannot be written" in message


def test_an_output_file_that_is_a_folder(refused: Refused, blob_run: Path, tmp_path: Path) -> None:
    message = refused("eval", blob_run, "--json", tmp_path)
    assert f"{tmp_path}: expected an output file, this is a folder" in message


@pytest.mark.parametrize("name", ["x.gif", "x.jpg", "x.tar.gz", "v1.2"])
def test_output_of_another_kind(name: str, refused: Refused, blob_run: Path, tmp_path: Path):
    message = refused("render", blob_run, "-o", tmp_path / "new" / name)
    assert f"{name}: expected an .exr, .png or .mp4 file, or a folder" in message


def test_many_frames_are_no_picture(refused: Refused, blob_run: Path, tmp_path: Path) -> None:
    message = refused("render", blob_run, "-o", tmp_path / "new" / "x.png", "--frames", "3")
    assert "x.png: one picture for 3 frames, expected an .mp4 or a folder" in message


def test_demo_wants_a_folder_of_its_own(refused: Refused, tmp_path: Path) -> None:
    (tmp_path / "something").touch()
    assert f"{tmp_path}: expected a new or an empty folder" in refused("demo", "--out", tmp_path)


# --------------------------------------------------------------------------
#   Runs
# --------------------------------------------------------------------------


def test_a_run_is_not_overwritten(refused: Refused, blob: Path, run: Path) -> None:
    message = refused("train", blob, "--out", run, "--steps", "1")
    assert f"{run}: already holds a run, expected --resume or another folder" in message


def test_resume_with_other_data(refused: Refused, blob: Path, data: Path, run: Path) -> None:
    message = refused("train", data, "--out", run, "--resume", "--steps", "21")
    assert f"{data}: expected {blob}" in message


@pytest.mark.parametrize(
    "options",
    ["--set network.width=17", "--seed 3", "--downscale 2", "--preset paper", "--set loss=mse"],
)
def test_resume_with_other_settings(options: str, refused: Refused, blob: Path, run: Path) -> None:
    message = refused("train", blob, "--out", run, "--resume", *options.split())
    assert f"{run}: a resumed run keeps its settings" in message


@pytest.mark.slow
def test_resume_with_the_same_settings(blob: Path, run: Path) -> None:
    options = ["--resume", "--steps", "21", "--set", "network.width=16"]
    assert main(["train", str(blob), "--out", str(run), *options]) == 0
    assert json.loads((run / "log.jsonl").read_text().splitlines()[-1])["step"] == 21


RUN_DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "no config": (
        lambda r: (r / "config.json").unlink(),
        "no config.json beside the checkpoint.safetensors",
    ),
    "broken config": (lambda r: cut(r / "config.json", 100), "config.json: cannot be read as"),
    "empty config": (lambda r: (r / "config.json").write_text("{}"), "config.json: no 'settings'"),
    "no data": (
        lambda r: change_json(r / "config.json", lambda c: c.pop("data")),
        "config.json: no 'data'",
    ),
    "unknown setting": (
        lambda r: change_json(r / "config.json", lambda c: c["settings"].update(qqq=1)),
        "config.json: not a training configuration of this version: unknown setting 'qqq'",
    ),
    "newer settings": (
        lambda r: change_json(r / "config.json", lambda c: c["format"].update(version=3)),
        "config.json: newer than this program: config.json of format version 3, this mi_nerf",
    ),
    "other seed": (
        lambda r: change_json(r / "config.json", lambda c: c["settings"].update(seed=1)),
        "does not fit this run: it was trained with seed=0, expected 1 as in the run",
    ),
    "text for a number": (
        lambda r: change_json(r / "config.json", lambda c: c["settings"].update(seed="1")),
        "seed='1', expected a whole number",
    ),
    "list for settings": (
        lambda r: change_json(r / "config.json", lambda c: c["settings"].update(network=[1])),
        "in place of the settings of NetworkConfig",
    ),
    "other width": (
        lambda r: change_json(
            r / "config.json", lambda c: c["settings"]["network"].update(width=24)
        ),
        "does not fit this run: it was trained with network.width=16, expected 24",
    ),
    "cut in the header": (
        lambda r: cut(r / "checkpoint.safetensors", 1000),
        "checkpoint.safetensors: not a complete safetensors file (truncated",
    ),
    "cut at the end": (
        lambda r: cut(r / "checkpoint.safetensors", 20_000),
        "checkpoint.safetensors: not a complete safetensors file (truncated",
    ),
    "empty checkpoint": (
        lambda r: cut(r / "checkpoint.safetensors", 0),
        "checkpoint.safetensors: not a complete safetensors file (truncated",
    ),
    "other version": (
        lambda r: change_tensors(r / "checkpoint.safetensors", lambda m, _: m.update(version="99")),
        "newer than this program: checkpoint file of format version 99, this mi_nerf reads up to 3",
    ),
    "other kind": (
        lambda r: shutil.copy(r / "field.safetensors", r / "checkpoint.safetensors"),
        "holds 'mi_nerf.field', expected 'mi_nerf.checkpoint'",
    ),
    "no step": (
        lambda r: change_description(r / "checkpoint.safetensors", lambda d: d.pop("step")),
        "checkpoint.safetensors: damaged checkpoint: 'step' is missing",
    ),
    "no progress": (
        lambda r: change_description(r / "checkpoint.safetensors", lambda d: d.update(progress={})),
        "checkpoint.safetensors: damaged checkpoint: 'progress.seconds' is missing",
    ),
    "moments of another shape": (
        lambda r: change_tensors(
            r / "checkpoint.safetensors",
            lambda _, a: a.update({"adam.first.density.bias": np.zeros(7, np.float32)}),
        ),
        "tensor 'first.density.bias' is (7,), expected (1,)",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", RUN_DAMAGES)
def test_resume_of_a_bad_run(name: str, refused: Refused, blob: Path, run: Path) -> None:
    damage, said = RUN_DAMAGES[name]
    damage(run)
    message = refused("train", blob, "--out", run, "--resume", "--steps", "21")
    assert str(run) in message and said in message


FIELD_DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (lambda f: f.unlink(), "no field.safetensors yet"),
    "cut in the header": (lambda f: cut(f, 500), "not a complete safetensors file (truncated"),
    "cut at the end": (lambda f: cut(f, 5000), "not a complete safetensors file (truncated"),
    "no safetensors": (lambda f: f.write_bytes(b"PK" * 99), "not a complete safetensors file"),
    "other version": (
        lambda f: change_tensors(f, lambda m, _: m.update(version="99")),
        "newer than this program: field file of format version 99, this mi_nerf reads up to 1",
    ),
    "no description": (
        lambda f: change_tensors(f, lambda m, _: m.pop("description")),
        "damaged field file",
    ),
    "empty description": (
        lambda f: change_tensors(f, lambda m, _: m.update(description="{}")),
        "damaged field description: 'field' is missing",
    ),
    "list for a description": (
        lambda f: change_tensors(f, lambda m, _: m.update(description="[]")),
        "damaged field file: its description is no JSON object",
    ),
    "unknown field": (
        lambda f: change_description(f, lambda d: d["field"].update(kind="hash")),
        "field kind 'hash', expected 'neural'",
    ),
    "unknown key": (
        lambda f: change_description(f, lambda d: d["field"]["network"].update(qqq=1)),
        "damaged field description: unknown key 'field.network.qqq'",
    ),
    "text for a number": (
        lambda f: change_description(f, lambda d: d["field"]["network"].update(depth="1")),
        "damaged field description: 'field.network.depth' is '1', expected int",
    ),
    "box upside down": (
        lambda f: change_description(f, lambda d: d["field"].update(lower=[9, 9, 9])),
        "must lie below upper",
    ),
    "tensor of another shape": (
        lambda f: change_tensors(
            f, lambda _, a: a.update({"weights.density.bias": np.zeros(3, np.float32)})
        ),
        "tensor 'density.bias' is (3,), expected (1,)",
    ),
    "tensor missing": (
        lambda f: change_tensors(f, lambda _, a: a.pop("weights.density.bias")),
        "tensor 'density.bias' is missing, expected (1,)",
    ),
    "tensor too many": (
        lambda f: change_tensors(
            f, lambda _, a: a.update({"weights.qqq": np.zeros(3, np.float32)})
        ),
        "tensor 'qqq' is (3,), expected no such tensor",
    ),
    "integers": (
        lambda f: change_tensors(
            f, lambda _, a: a.update({"weights.density.bias": np.zeros(1, np.int32)})
        ),
        "tensor 'density.bias' holds int32, expected floating-point numbers",
    ),
    "occupancy cut short": (
        lambda f: change_description(f, lambda d: d.update(occupancy_shape=[50, 50, 50])),
        "does not fit the shape (50, 50, 50)",
    ),
}


@pytest.mark.parametrize("name", FIELD_DAMAGES)
def test_evaluation_of_a_bad_field(name: str, refused: Refused, run: Path, tmp_path: Path) -> None:
    damage, said = FIELD_DAMAGES[name]
    damage(run / "field.safetensors")
    message = refused("eval", run, "--json", tmp_path / "x.json")
    assert str(run) in message and said in message


@pytest.mark.parametrize("command", ["eval", "render"])
def test_a_folder_that_is_no_run(
    command: str, refused: Refused, blob: Path, tmp_path: Path
) -> None:
    options = ["-o", tmp_path / "x.png"] if command == "render" else []
    message = refused(command, blob, *options)
    assert f"{blob}: no config.json in it, expected the folder of a run" in message


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("eval", "not found, expected a run folder or a field file"),
        ("render", "not found, expected a run folder or a Mitsuba XML scene"),
        ("info", "not found, expected a run, a .safetensors file, a dataset folder or an XML"),
    ],
)
def test_nothing_there(command: str, said: str, refused: Refused, tmp_path: Path) -> None:
    options = ["-o", tmp_path / "new" / "x.png"] if command == "render" else []
    assert f"{tmp_path / 'qqq'}: {said}" in refused(command, tmp_path / "qqq", *options)


def test_a_lone_field_file_needs_data(refused: Refused, blob_run: Path, tmp_path: Path) -> None:
    field = blob_run / "field.safetensors"
    assert f"{field}: a field file knows no dataset, expected --data" in refused("eval", field)
    message = refused("render", field, "-o", tmp_path / "x.png")
    assert f"{field}: a field file knows no cameras, expected a run" in message


def test_checkpoint_in_place_of_a_field(refused: Refused, blob: Path, blob_run: Path) -> None:
    message = refused("eval", blob_run / "checkpoint.safetensors", "--data", blob)
    assert "holds 'mi_nerf.checkpoint', expected 'mi_nerf.field'" in message


# --------------------------------------------------------------------------
#   Scenes
# --------------------------------------------------------------------------

NERF = """<scene version="3.0.0"><integrator type="nerf"/><sensor type="perspective"/>
<shape type="{shape}"><bsdf type="null"/><medium type="nerfmedium" name="interior">
<string name="filename" value="{field}"/></medium></shape></scene>"""


@pytest.mark.parametrize(
    ("xml", "said"),
    [
        (None, "not found, expected a run folder or a Mitsuba XML scene"),
        ("", "Mitsuba cannot load this scene"),
        ("not XML", "Mitsuba cannot load this scene"),
        ('<scene version="3.0.0"><integrator', "Mitsuba cannot load this scene"),
        ('<sensor type="perspective" version="3.0.0"/>', "expected <scene> as the outermost"),
        ('<scene version="3.0.0"><shape type="qqq"/></scene>', 'Plugin "qqq" not found'),
        ('<scene version="3.0.0"><integrator type="path"/></scene>', "has no sensor"),
        (
            '<scene version="3.0.0"><sensor type="perspective"><float name="qqq" value="1"/>'
            "</sensor></scene>",
            'unreferenced property in sensor plugin of type "perspective": - float "qqq"',
        ),
        (
            '<scene version="3.0.0"><integrator type="nerf"/><sensor type="perspective"/></scene>',
            "the scene holds no 'nerfmedium', expected at least one",
        ),
        (NERF.format(shape="cube", field="qqq.safetensors"), "qqq.safetensors: not found"),
        (NERF.format(shape="cube", field="bad.safetensors"), "not a complete safetensors file"),
        (NERF.format(shape="sphere", field="{field}"), "inside a shape of type 'Sphere', exp"),
    ],
)
def test_bad_scene(
    xml: str | None, said: str, refused: Refused, blob_run: Path, tmp_path: Path
) -> None:
    (tmp_path / "bad.safetensors").write_bytes(b"\0" * 64)
    scene = tmp_path / "scene.xml"
    if xml is not None:
        scene.write_text(xml.replace("{field}", str(blob_run / "field.safetensors")))
    message = refused("render", scene, "-o", tmp_path / "new" / "x.png", "--spp", "1")
    assert message.startswith(f"mi-nerf: {scene}: ") and said in message


def test_frames_of_a_scene_need_a_path(refused: Refused, blob_run: Path, tmp_path: Path) -> None:
    scene = tmp_path / "scene.xml"
    scene.write_text(NERF.format(shape="cube", field=blob_run / "field.safetensors"))
    message = refused("render", scene, "-o", tmp_path / "new", "--frames", "3")
    assert "--frames 3: the sensors of a scene give one frame each, expected --path" in message
    message = refused("render", scene, "-o", tmp_path / "new", "--path", "test")
    assert f"{scene}: a scene has no test views, expected --path orbit or --path spiral" in message


# --------------------------------------------------------------------------
#   As a program of its own
# --------------------------------------------------------------------------


def call(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, "-m", "mi_nerf.cli", *map(str, arguments)]
    folder = Path(__file__).parents[2]
    return subprocess.run(words, capture_output=True, text=True, cwd=folder, timeout=60)


@pytest.mark.slow
def test_a_refusing_process(blob_run: Path, tmp_path: Path) -> None:
    """Nothing that Mitsuba, Dr.Jit or Python say themselves gets in between."""
    scene = tmp_path / "scene.xml"
    scene.write_text(NERF.format(shape="sphere", field=blob_run / "field.safetensors"))
    result = call("render", scene, "-o", tmp_path / "x.png")
    assert result.returncode == 2
    assert result.stdout == ""
    assert result.stderr == (
        f"mi-nerf: {scene}: nerfmedium: inside a shape of type 'Sphere', expected a 'cube'\n"
    )


@pytest.mark.slow
def test_a_succeeding_process(blob_run: Path, tmp_path: Path) -> None:
    result = call("eval", blob_run, "--views", "1", "--json", tmp_path / "x.json")
    assert (result.returncode, result.stderr) == (0, "")  # no bar in a log
    assert result.stdout.startswith("test, 1 views of 24x24: PSNR ")
    assert (tmp_path / "x.json").is_file()
