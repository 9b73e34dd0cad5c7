"""``python -m tests.benchmarks.gpu``: tried on the CPU, with parts that fail or take too long."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from mi_nerf.base.variants import available_variants
from mi_nerf.training.presets import PRESETS
from tests.benchmarks import gpu, gpu_tests
from tests.benchmarks.results import Figure, Protocol, load

ROOT = Path(__file__).parents[1]
COMMAND = [sys.executable, "-m", "tests.benchmarks.gpu"]


def figures_in(folder: Path) -> dict[str, dict[str, Figure]]:
    """The figures of all rows, by what they are of."""
    return {r.row.labels["what"]: dict(r.row.figures) for r in load(folder / "gpu.json")}


@pytest.mark.slow
def test_all_parts_on_the_cpu(tmp_path: Path) -> None:
    words = ["--variant", "llvm_ad_rgb", "--seconds", "5", "--small", "--views", "2"]
    subprocess.run([*COMMAND, *words, "--results", str(tmp_path)], check=True, cwd=ROOT)
    records = load(tmp_path / "gpu.json")
    notes = [record.row.labels["notes"] for record in records]
    assert not [note for note in notes if "error" in note]
    assert "surfaces: works; half_precision: works" in notes
    assert {r.origin.machine["variant"] for r in records} == {"llvm_ad_rgb"}
    assert {r.origin.machine["gpu"] for r in records} == {None}
    assert all(record.origin.current() for record in records)
    found = figures_in(tmp_path)
    tests = found["tests marked `not cuda and not slow`"]
    assert tests["passed"].value > 10 and tests["failed"].value == 0
    trainings = [f"`fast`{half}, trained for {s} s" for half, s in (("", 1.25), ("", 5))]
    for name in (*trainings, "`fast`, half precision, trained for 1.25 s"):
        row = found[name]
        assert row["steps"].value >= 1 and row["parameters"].value > 1000
        assert 0 < row["begun"].value <= row["first_step"].value
    protocols = [r.row.protocol for r in records if r.row.labels["what"] == trainings[1]]
    assert protocols == [Protocol("a ball, 24x24", "test", 2, (24, 24))]
    short, long = (found[name] for name in trainings)
    assert long["psnr"].value >= short["psnr"].value
    assert long["seconds"].value > 5 and long["allocated"].value > 1
    frame = found["a frame by mi.render, 32×32"]["frame"]
    assert frame.spread is not None and 0 < frame.spread[0] <= frame.value <= frame.spread[1]
    for name in (*PRESETS, "fast, half precision", "fast, as on a CPU"):
        row = found[f"steps: {name}"]
        step = row["step"].value
        assert row["steps_a_second"].value == pytest.approx(1e3 / step, rel=1e-4)
        stages = sum(f.value for key, f in row.items() if key.startswith("stage_"))
        assert stages == pytest.approx(step, rel=1e-3)


@pytest.mark.slow
@pytest.mark.skipif("cuda_ad_rgb" in available_variants(), reason="there is a GPU")
def test_without_a_gpu_it_says_so(tmp_path: Path) -> None:
    words = [*COMMAND, "--results", str(tmp_path)]
    found = subprocess.run(words, capture_output=True, text=True, cwd=ROOT)
    assert found.returncode == 1 and found.stdout == "" and found.stderr.count("\n") == 1
    assert found.stderr.startswith("cuda_ad_rgb does not work on this machine (")
    assert "expected an NVIDIA GPU" in found.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("code", "limit", "said"),
    [
        ("pass", 30, None),
        ("print('first'); raise SystemExit('the last word')", 30, "exit status 1: the last word"),
        ("import os; os.abort()", 30, "exit status -6: nothing was said"),
        ("import time; time.sleep(60)", 0.2, "stopped after 0 s"),
    ],
)
def test_a_part_ends_in_time_and_says_why(
    code: str, limit: float, said: str | None, tmp_path: Path
) -> None:
    assert gpu._run([sys.executable, "-c", code], limit, tmp_path / "log") == said


def test_what_a_part_had_found_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A part that is stopped has an error and its figures; the others go on."""
    steps = {"nerf": {"step_ms": 3.0, "fastest_ms": 2.0, "slowest_ms": 5.0}, "fast": {"error": "x"}}

    def run(command: list[str], limit: float, log: Path) -> str | None:
        name = command[3]
        if name == "device":
            log.with_suffix(".json").write_text('{"machine": {"gpu": "card"}}')
            return None
        assert figures_in(tmp_path).keys() == {"the device"}
        log.with_suffix(".json").write_text(json.dumps(steps))
        return f"stopped after {limit:.0f} s by /some/where/program: it | that"

    monkeypatch.setattr(gpu, "_run", run)
    words = ["gpu", "--variant", "none", "--only", "device", "steps", "--results", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", words)
    gpu.main()
    found = figures_in(tmp_path)
    assert found["steps: nerf"] == {"step": Figure(3.0, "ms", (2.0, 5.0))}
    assert found["steps: fast"] == {"took": Figure(0.0, "s")}
    notes = [record.row.labels["notes"] for record in load(tmp_path / "gpu.json")]
    assert notes == ["–", "error: stopped after 75 s by program: it / that", "–", "error: x"]


def test_no_part_begins_without_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu, "run_part", lambda *_: {"machine": {}, "took": 1.0})
    words = ["gpu", "--variant", "llvm_ad_rgb", "--budget", "5.5", "--results", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", words)
    clock = iter(range(1000))
    monkeypatch.setattr(gpu.time, "monotonic", lambda: 0.4 * next(clock))
    gpu.main()
    notes = [record.row.labels["notes"] for record in load(tmp_path / "gpu.json")]
    assert notes[0] == "–" and notes[-1] == "error: no time was left"


def test_limits_leave_room_in_six_minutes() -> None:
    """What matters most fits even if every part before it takes all of its time."""
    options = gpu.argparse.Namespace(seconds=60.0)
    names = [part.name for part in gpu.parts(options)]
    limits = [part.limit for part in gpu.parts(options)]
    assert sum(limits[: names.index("train_short") + 1]) + 60 < gpu._BUDGET < 360


def test_outcomes_of_tests_are_counted() -> None:
    log = "tests/a.py::test_b[x y] PASSED [ 5%]\ntests/a.py::test_c FAILED [ 9%]\n"
    log += "FAILED tests/a.py::test_c - ValueError: 3\nERROR tests/d.py - ImportError\n"
    assert gpu_tests._OUTCOME.findall(log) == [
        ("tests/a.py::test_b[x y]", "PASSED"),
        ("tests/a.py::test_c", "FAILED"),
    ]
    reasons = ["tests/a.py::test_c - ValueError: 3", "tests/d.py - ImportError"]
    assert gpu_tests._REASON.findall(log) == reasons
