"""Datasets made by several processes: the same bytes, whatever happens to these."""

from __future__ import annotations

import json
import multiprocessing
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.generation import Options
from mi_nerf.generation import run as generation
from mi_nerf.jobs import JobError
from tests.generation.test_run import VARIANT, ball, contents, make
from tests.support.processes import children, ends

# The scene is made anew where a file is, so that processes die where they load it.
DEADLY = """
import os
from pathlib import Path
from mi_nerf.generation import run

trace = run.Tracer.trace

def dying(self, view):
    marker = Path(os.environ["DEADLY_MARKERS"]) / view.name.replace("/", "_")
    if os.environ["DEADLY_VIEW"] == view.name and not marker.exists():
        if os.environ["DEADLY_ONCE"]:
            marker.touch()
        os.kill(os.getpid(), 9)
    return trace(self, view)

run.Tracer.trace = dying
"""


def few(**changes: Any) -> Options:
    return Options(**{"train": 4, "val": 1, "test": 1, "size": (16, 16), "spp": 6, **changes})


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, bytes]]:
    """A scene, and the files of a dataset of it that one process has made."""
    folder = tmp_path_factory.mktemp("whole")
    make(ball(folder), folder / "data", few())
    return folder / "ball.xml", contents(folder / "data")


@pytest.fixture
def deadly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, bool], None]:
    """Processes that are started from now on die at a view: at its first try, or at each."""

    def set_up(view: str, once: bool) -> None:
        place = tmp_path / "deadly"
        place.mkdir()
        (place / "deadly.py").write_text(DEADLY)
        monkeypatch.setenv("DEADLY_MARKERS", str(place))
        monkeypatch.setenv("DEADLY_VIEW", view)
        monkeypatch.setenv("DEADLY_ONCE", "yes" if once else "")
        monkeypatch.syspath_prepend(str(place))
        monkeypatch.setattr(generation, "_make_views", _deadly)

    return set_up


def _deadly(*arguments: Any) -> Any:
    """Runs in the worker: :data:`DEADLY`, and then the job as it is."""
    import importlib

    importlib.import_module("deadly")
    return generation._make_views(*arguments)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2, 3])
def test_the_same_bytes(workers: int, whole: tuple[Path, dict[str, bytes]], tmp_path: Path) -> None:
    scene, files = whole
    record = make(scene, tmp_path / "data", few(), workers=workers)
    assert record["complete"] and contents(tmp_path / "data") == files


@pytest.mark.slow
def test_forward_captures(tmp_path: Path) -> None:
    scene = ball(tmp_path)
    options = few(protocol="forward", train=7, val=0, test=None)
    make(scene, tmp_path / "one", options)
    make(scene, tmp_path / "two", options, workers=2)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    assert (tmp_path / "two/poses_bounds.npy").exists()


@pytest.mark.slow
def test_a_worker_that_dies_loses_nothing(
    whole: tuple[Path, dict[str, bytes]], deadly: Callable[[str, bool], None], tmp_path: Path
) -> None:
    scene, files = whole
    deadly("train/r_2", True)
    record = make(scene, tmp_path / "data", few(), workers=2)
    assert (tmp_path / "deadly/train_r_2").exists()
    assert record["complete"] and contents(tmp_path / "data") == files


@pytest.mark.slow
def test_a_view_that_always_kills_is_named(
    whole: tuple[Path, dict[str, bytes]], deadly: Callable[[str, bool], None], tmp_path: Path
) -> None:
    """The views before it are kept."""
    scene, files = whole
    deadly("test/r_0", False)
    out = tmp_path / "data"
    with pytest.raises(JobError, match=r"^view test/r_0: the worker died 3 times, by SIGKILL$"):
        make(scene, out, few(), workers=1)
    record = json.loads((out / "dataset.json").read_text())
    assert not record["complete"] and len(record["views"]) == 5
    assert make(scene, out, few(), resume=True)["complete"] and contents(out) == files


@pytest.mark.slow
def test_resume_with_another_number_of_workers(
    whole: tuple[Path, dict[str, bytes]], tmp_path: Path
) -> None:
    scene, files = whole
    out = tmp_path / "data"
    make(scene, out, few())
    for number, name in enumerate(("train/r_1.png", "val/r_0_depth.exr", "test/r_0.exr")):
        (out / name).write_bytes(b"damaged")
        # As processes leave them that are killed while they write.
        (out / f"train/.r_0-{number:016x}.png").touch()
        assert make(scene, out, few(), resume=True, workers=number)["complete"]
        assert contents(out) == files
    with pytest.raises(InputError, match="another dataset: settings.spp"):
        make(scene, out, few(spp=8), resume=True, workers=2)
    assert contents(out) == files


@pytest.mark.slow
def test_executors_of_the_caller(whole: tuple[Path, dict[str, bytes]], tmp_path: Path) -> None:
    scene, files = whole
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, mp_context=spawn) as pool:
        make(scene, tmp_path / "processes", few(), executor=pool)
        # The same processes, with what they know of another scene.
        other = ball(tmp_path, **{'value="$radius"/>': 'value="0.3"/>'})
        make(other, tmp_path / "other", few(), executor=pool)
        make(scene, tmp_path / "again", few(), executor=pool)
    assert contents(tmp_path / "processes") == contents(tmp_path / "again") == files
    assert contents(tmp_path / "other").keys() == files.keys()
    with ThreadPoolExecutor(2) as threads:
        make(scene, tmp_path / "threads", few(), executor=threads)
    assert contents(tmp_path / "threads") == files


@pytest.mark.slow
def test_several_views_are_one_job_where_jobs_start_slowly(
    whole: tuple[Path, dict[str, bytes]], tmp_path: Path
) -> None:
    class Queue(ThreadPoolExecutor):
        slow_start, width = True, 1
        jobs = 0

        def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Any:
            self.jobs += 1
            return super().submit(fn, *args, **kwargs)

    scene, files = whole
    with Queue(1) as queue:
        make(scene, tmp_path / "data", few(), executor=queue)
    assert queue.jobs == 3 and contents(tmp_path / "data") == files


@pytest.mark.slow
def test_a_scene_that_was_changed_is_loaded_again(tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as threads:
        for radius in ("0.5", "0.3"):
            scene = ball(tmp_path, **{'value="$radius"/>': f'value="{radius}"/>'})
            make(scene, tmp_path / f"here {radius}", few())
            make(scene, tmp_path / f"there {radius}", few(), executor=threads)
            here, there = (contents(tmp_path / f"{p} {radius}") for p in ("here", "there"))
            assert here == there


@pytest.mark.slow
def test_a_machine_that_differs_is_named(
    whole: tuple[Path, dict[str, bytes]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, _ = whole
    prepared = generation._prepared

    def changed(source: bytes) -> Any:
        tracer, plan, record = prepared(source)
        return tracer, plan, {**record, "versions": {**record["versions"], "numpy": "1.0"}}

    changed.cache_clear = prepared.cache_clear  # type: ignore[attr-defined]
    monkeypatch.setattr(generation, "_prepared", changed)
    with ThreadPoolExecutor(1) as threads:
        with pytest.raises(InputError, match=r'the worker on .* differs: versions.numpy is "1.0"'):
            make(scene, tmp_path / "data", few(), executor=threads)
    assert not (tmp_path / "data").exists()


@pytest.mark.slow
def test_a_scene_that_fails_leaves_nothing(tmp_path: Path) -> None:
    scene = ball(tmp_path, **{'value="0.8"': 'value="1e39"'})
    with pytest.raises(InputError, match=r"view \w+/r_\d: .*% of its samples are NaN or inf"):
        make(scene, tmp_path / "out", few(), workers=2)
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="cannot load this scene"):
        scene.write_text(scene.read_text().replace("</scene>", "</scen>"))
        make(scene, tmp_path / "out", few(), workers=1)
    assert not (tmp_path / "out").exists() and not children()


def started(out: Path, scene: Path, *options: str) -> subprocess.Popen[str]:
    """The command, in a process, once it has made a view."""
    arguments = ["generate", scene, out, "--train", "300", "--size", "64", "64", "--spp", "64"]
    command = [sys.executable, "-u", "-m", "mi_nerf.cli", *map(str, arguments), *options]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=Path.cwd()
    )
    while not list(out.glob("train/r_*_normal.exr")):
        assert process.poll() is None
        time.sleep(0.02)
    return process


@pytest.mark.slow
@pytest.mark.parametrize("signals", [1, 2])
def test_ctrl_c(signals: int, tmp_path: Path) -> None:
    """Once: what runs is finished and recorded. Twice: at once. Nobody stays in either case."""
    scene, out = ball(tmp_path), tmp_path / "data"
    process = started(out, scene, "--workers", "2")
    workers = children(process.pid)
    assert len(workers) == 2
    for _ in range(signals):
        process.send_signal(signal.SIGINT)
        time.sleep(0.05)
    text, errors = process.communicate(timeout=60)
    assert process.returncode == 130 and "Traceback" not in errors
    assert errors.count("\n") == 1 and all(map(ends, workers))
    record = json.loads((out / "dataset.json").read_text())
    assert not record["complete"] and not list(out.glob(".working*"))
    pictures = {str(p.relative_to(out)) for p in out.rglob("r_*.png")}
    if signals == 1:
        assert "go on with --resume" in text
        assert {f"{name}.png" for name in record["views"]} == pictures
    assert {f"{name}.png" for name in record["views"]} <= pictures
    # What is there is taken as it is, and the rest is made.
    shutil.copytree(out, tmp_path / "copy")
    small = Options(train=300, size=(64, 64), spp=64)
    held = generation._resumed_views
    kept = held(tmp_path / "copy", record, _plan(scene, small))
    assert kept == record["views"]


def _plan(scene: Path, options: Options) -> Any:
    from mi_nerf.base.variants import using_variant
    from mi_nerf.scene_xml.scene_file import SceneFile

    with using_variant(VARIANT):
        return generation.prepare(SceneFile(scene), options)[1]


@pytest.mark.slow
def test_a_killed_command_leaves_nobody(tmp_path: Path) -> None:
    scene, out = ball(tmp_path), tmp_path / "data"
    process = started(out, scene, "--workers", "2")
    workers = children(process.pid)
    process.kill()
    process.communicate()
    assert len(workers) == 2 and all(map(ends, workers))


@pytest.mark.slow
def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from mi_nerf.cli import main

    out = tmp_path / "data"
    options = ["--train", "2", "--val", "0", "--test", "1", "--size", "16", "16", "--spp", "4"]
    scene = str(ball(tmp_path))
    assert main(["generate", scene, str(out), *options, "--workers", "2"]) == 0
    text, errors = capsys.readouterr()
    assert "views are traced by 2 processes with" in text and errors == ""
    assert f"{out}: 3 views of 16x16" in text
    assert not children()


def test_bad_options(refused: Callable[..., str], tmp_path: Path) -> None:
    scene, out = ball(tmp_path), tmp_path / "out"
    assert "--workers -1: expected 0 or more" in refused("generate", scene, out, "--workers", "-1")
    line = refused("generate", scene, out, "--executor", "pbs://here")
    assert "--executor pbs://here: unknown, expected dask://HOST:PORT or slurm" in line
    line = refused("generate", scene, out, "--workers", "2", "--executor", "dask://here:1")
    assert "--workers 2: of this machine, expected no --executor dask://here:1 too" in line
