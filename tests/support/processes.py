"""Other processes: which there are, and whether they end."""

from __future__ import annotations

import os
import time
from pathlib import Path


def alive(pid: int) -> bool:
    """Whether a process runs; one that has ended and is not waited for does not."""
    return _state(pid)[0] not in ("", "Z")


def ends(pid: int, seconds: float = 20) -> bool:
    """Whether a process ends in time."""
    end = time.monotonic() + seconds
    while alive(pid) and time.monotonic() < end:
        time.sleep(0.02)
    return not alive(pid)


def children(parent: int | None = None) -> list[int]:
    """The living workers of a process, this one by default; other children do not count."""
    wanted = os.getpid() if parent is None else parent
    pids = [int(path.name) for path in Path("/proc").iterdir() if path.name.isdecimal()]
    return [pid for pid in pids if _state(pid)[1] == wanted and alive(pid) and _is_worker(pid)]


def _is_worker(pid: int) -> bool:
    try:
        return b"mi_nerf.jobs.process" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


def _state(pid: int) -> tuple[str, int]:
    """The letter of its state, and its parent."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return "", 0
    return fields[0], int(fields[1])
