"""The tests marked ``cuda``, in several processes, as far as they come in the time given."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
_MOST = 6  # processes that share the device
_OUTCOME = re.compile(r"^(tests/.+?) (PASSED|FAILED|ERROR|SKIPPED|XFAIL)", re.MULTILINE)
_REASON = re.compile(r"^(?:FAILED|ERROR) (tests/.*)$", re.MULTILINE)


def run(variant: str, limit: float, small: bool) -> dict[str, Any]:
    """Numbers of tests that passed, failed and were skipped, and the failures, a line each.

    Args:
        limit: seconds, after which those under way are stopped.
        small: a few tests alone.
    """
    marks = "cuda and not slow" if variant.startswith("cuda") else "not cuda and not slow"
    files = sorted((ROOT / "tests").rglob("test_*.py"), key=lambda p: -p.stat().st_size)
    names = [str(file.relative_to(ROOT)) for file in files]
    if small:
        names = ["tests/march/test_blocks.py", "tests/fields/test_activations.py"]
    count = max(1, min(_MOST, (os.cpu_count() or 2) // 2, len(names)))
    with tempfile.TemporaryDirectory() as folder:
        logs = [Path(folder) / f"{k}.txt" for k in range(count)]
        processes = [_start(names[k::count], marks, logs[k]) for k in range(count)]
        complete = _wait(processes, limit)
        texts = [log.read_text(errors="replace") for log in logs]
    outcomes = [outcome for text in texts for _, outcome in _OUTCOME.findall(text)]
    found: dict[str, Any] = {
        "marks": marks,
        "passed": outcomes.count("PASSED") + outcomes.count("XFAIL"),
        "failed": outcomes.count("FAILED") + outcomes.count("ERROR"),
        "skipped": outcomes.count("SKIPPED"),
        "failures": [line[:300] for text in texts for line in _REASON.findall(text)],
    }
    if not complete:
        found["error"] = f"stopped after {limit:.0f} s"
    elif not outcomes:
        last = [line for text in texts for line in text.strip().splitlines()[-1:]]
        found["error"] = f"no test ran: {' '.join(last)}"[:500]
    return found


def _start(names: list[str], marks: str, log: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "pytest", "-v", "--no-header", "--tb=line", "-m", marks]
    command += ["-p", "no:cacheprovider", "--continue-on-collection-errors", *names]
    with log.open("w") as out:
        return subprocess.Popen(
            command, cwd=ROOT, stdout=out, stderr=subprocess.STDOUT, start_new_session=True
        )


def _wait(processes: list[subprocess.Popen[bytes]], limit: float) -> bool:
    """Whether all of them ended in time; those that did not are stopped."""
    end, complete = time.monotonic() + limit, True
    for process in processes:
        try:
            process.wait(max(0.0, end - time.monotonic()))
        except subprocess.TimeoutExpired:
            complete = False
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    return complete
