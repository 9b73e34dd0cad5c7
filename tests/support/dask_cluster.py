"""A scheduler of dask and workers, each a process of its own, started by dask's own commands."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]


class Cluster(NamedTuple):
    """What was started."""

    address: str  # dask://HOST:PORT
    scheduler: subprocess.Popen[bytes]
    workers: list[subprocess.Popen[bytes]]  # each with one thread, no nanny that restarts it


def _start(*arguments: str, log: Path) -> subprocess.Popen[bytes]:
    with log.open("wb") as file:
        return subprocess.Popen(
            [sys.executable, "-m", "distributed.cli." + arguments[0], *arguments[1:]],
            stdout=file,
            stderr=file,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )


@contextmanager
def dask_cluster(folder: Path, workers: int = 2) -> Iterator[Cluster]:
    """On this machine only; ends with the block."""
    about = folder / "scheduler.json"
    options = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
    started = [
        _start(
            "dask_scheduler",
            *options,
            "--scheduler-file",
            str(about),
            log=folder / "scheduler.log",
        )
    ]
    try:
        _wait_for(about, started[0])
        address = json.loads(about.read_text())["address"]
        for number in range(workers):
            options = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", "127.0.0.1"]
            options += ["--local-directory", str(folder), "--name", str(number)]
            log = folder / f"worker {number}.log"
            started.append(_start("dask_worker", address, *options, log=log))
        yield Cluster(address.replace("tcp:", "dask:"), started[0], started[1:])
    finally:
        for process in reversed(started):
            process.send_signal(signal.SIGKILL)
            process.wait()


def _wait_for(path: Path, process: subprocess.Popen[bytes]) -> None:
    end = time.monotonic() + 60
    while not path.exists() or not path.read_text():
        assert process.poll() is None and time.monotonic() < end, "no scheduler"
        time.sleep(0.05)
