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

ROOT = Path(__file__).parents[1]
COMMAND = [sys.executable, "-m", "tests.benchmarks.gpu"]


@pytest.mark.slow
def test_all_parts_on_the_cpu(tmp_path: Path) -> None:
    out = tmp_path / "gpu.json"
    words = ["--variant", "llvm_ad_rgb", "--seconds", "5", "--small", "--views", "2"]
    subprocess.run([*COMMAND, *words, "--out", str(out)], check=True, cwd=ROOT)
    found = json.loads(out.read_text())
    assert found["machine"]["variant"] == "llvm_ad_rgb" and found["machine"]["gpu"] is None
    parts = found["parts"]
    errors = {name: part["error"] for name, part in parts.items() if "error" in part}
    assert not errors
    assert parts["device"]["half_precision"] == parts["device"]["surfaces"] == "works"
    assert parts["tests"]["passed"] > 10 and parts["tests"]["failed"] == 0
    for name in ("train_short", "train_long", "train_half"):
        assert parts[name]["steps"] >= 1 and parts[name]["views"] == 2
        assert 0 < parts[name]["begun"] <= parts[name]["first_step"]
    assert parts["train_long"]["psnr"] >= parts["train_short"]["psnr"]
    assert parts["train_long"]["seconds"] > 5 and parts["train_long"]["watermark_mib"] > 1
    assert 0 < parts["render"]["least"] <= parts["render"]["median"] <= parts["render"]["greatest"]
    for name in (*PRESETS, "fast, half precision", "fast, as on a CPU"):
        row = parts["steps"][name]
        row = parts["steps"][row["as"]] if "as" in row else row
        assert row["steps_per_second"] == pytest.approx(1e3 / row["step_ms"])
        assert sum(row["stages"].values()) == pytest.approx(row["step_ms"])


@pytest.mark.slow
@pytest.mark.skipif("cuda_ad_rgb" in available_variants(), reason="there is a GPU")
def test_without_a_gpu_it_says_so(tmp_path: Path) -> None:
    words = [*COMMAND, "--out", str(tmp_path / "gpu.json")]
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
    out, names = tmp_path / "gpu.json", iter(["device", "steps"])

    def run(command: list[str], limit: float, log: Path) -> str | None:
        name = command[3]
        if name == "device":
            log.with_suffix(".json").write_text('{"machine": {"gpu": "card"}}')
            return None
        assert json.loads(out.read_text())["parts"].keys() == {"device"}
        log.with_suffix(".json").write_text('{"nerf": {"step_ms": 3.0}}')
        return f"stopped after {limit:.0f} s"

    monkeypatch.setattr(gpu, "_run", run)
    monkeypatch.setattr(
        sys, "argv", ["gpu", "--variant", "none", "--only", *names, "--out", str(out)]
    )
    gpu.main()
    found = json.loads(out.read_text())
    assert found["machine"] == {"gpu": "card"}
    assert found["parts"]["steps"]["nerf"] == {"step_ms": 3.0}
    assert found["parts"]["steps"]["error"] == "stopped after 75 s"


def test_no_part_begins_without_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "gpu.json"
    monkeypatch.setattr(gpu, "run_part", lambda *_: {"machine": {}})
    monkeypatch.setattr(sys, "argv", ["gpu", "--budget", "5.5", "--out", str(out)])
    clock = iter(range(1000))
    monkeypatch.setattr(gpu.time, "monotonic", lambda: 0.4 * next(clock))
    gpu.main()
    parts = json.loads(out.read_text())["parts"]
    assert "error" not in parts["device"] and parts["train_half"]["error"] == "no time was left"


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
