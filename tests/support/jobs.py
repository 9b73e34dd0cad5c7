"""Jobs for workers, which find them by their names here."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import drjit as dr

from mi_nerf.base.errors import InputError, Option
from mi_nerf.jobs import Permit

_inside = threading.Lock()


def total(*numbers: int) -> tuple[int, int]:
    """A sum, and the process that made it."""
    return sum(numbers), os.getpid()


def die_once(marker: Path, result: str) -> str:
    """Ends its process in the first of all calls with this file."""
    if not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return result


def die(tries: Path) -> None:
    """Ends its process always, and leaves a character for each time."""
    with tries.open("a") as file:
        file.write("x")
    os._exit(3)


def refuse(value: int) -> None:
    """Finds its argument wrong."""
    raise InputError("{}: expected another", Option("value", value))


class StubbornError(Exception):
    """Can be written and not read back, for want of its arguments."""

    def __init__(self, first: int, second: int) -> None:
        super().__init__(f"{first} and {second}")


def fail_stubbornly() -> None:
    """Raises what cannot travel."""
    raise StubbornError(1, 2)


class Local:
    """Is known where it was made, and nowhere else."""

    def __reduce__(self) -> tuple[Any, ...]:
        return _only_in, (os.getpid(),)


def _only_in(pid: int) -> None:
    if os.getpid() != pid:
        raise ImportError("not here")


def give_what_cannot_be_read() -> Local:
    """A result that can be written here and read nowhere else."""
    return Local()


def nap(seconds: float, started: Path) -> int:
    """Says that it has begun, waits, and names its process."""
    started.write_text(str(os.getpid()))
    time.sleep(seconds)
    return os.getpid()


def alone(seconds: float) -> None:
    """Fails if another job is at work in this process."""
    assert _inside.acquire(blocking=False)
    time.sleep(seconds)
    _inside.release()


def until_withdrawn(permit: Permit) -> str:
    """Works for as long as it may."""
    permit.require()
    may_go_on = permit.watched()
    end = time.monotonic() + 60
    while may_go_on() and time.monotonic() < end:
        time.sleep(0.02)
    return "stopped" if time.monotonic() < end else "never stopped"


def needs(permit: Permit) -> None:
    """Works only where the folder is seen."""
    permit.require(patience=0.1)


def threads() -> int:
    """Of Dr.Jit, in this process."""
    return int(dr.thread_count())


def variable(name: str) -> Any:
    """Of the environment."""
    return os.environ.get(name)
