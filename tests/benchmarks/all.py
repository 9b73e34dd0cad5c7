"""Measures again what is out of date, the most important first.

    MI_NERF_DATA=… python -m tests.benchmarks.all --minutes 60 --against ../before
    python -m tests.benchmarks.all --list

A command is due until rows in docs/results say that it has measured the present sources. So
the same call goes on where the last one stopped; it begins no command that would take longer
than what is left. Minutes are those of two slow cores, roughly. Run it on an idle machine;
``--untimed`` leaves out what a busy one would change. What other commands have measured, and
``tests.benchmarks.note`` has written down, is listed only.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mi_nerf.base.variants import available_variants
from tests.benchmarks.results import RESULTS, Record, load


@dataclass(frozen=True)
class Task:
    """One of the commands."""

    minutes: float
    command: str  # behind ``python -m``
    compares: bool = False  # with another checkout
    timed: bool = True  # figures depend on how fast the machine is
    needs: str = ""  # a variant that must be there


PLAN = (
    Task(5, "tests.benchmarks.steps", compares=True),
    Task(27, "tests.benchmarks.resolution --seconds 600", compares=True),
    Task(6, "tests.benchmarks.gpu --seconds 60", needs="cuda_ad_rgb"),
    Task(12, "tests.benchmarks.resolution --data lego_200 --downscale 2 --seconds 120"
         " --shares 0.25 0.4 0.6", compares=True),
    Task(18, "tests.benchmarks.resolution --data lego_200 --seconds 300"
         " --shares 0.25 0.4 0.6", compares=True),
    Task(15, "tests.benchmarks.resolution --data lego_200 --downscale 2 --seconds 120"
         " --presets nerf --shares 0.4 0.6", compares=True),
    Task(5, "tests.benchmarks.quality --preset fast --seconds 60"),
    Task(8, "tests.benchmarks.quality --preset fast --seconds 120"),
    Task(19, "tests.benchmarks.quality --preset fast --seconds 300 --downscale 1"),
    Task(9, "tests.benchmarks.quality --preset nerf --seconds 120"),
    Task(33, "tests.benchmarks.quality --preset nerf --seconds 600"),
    Task(20, "tests.benchmarks.shape"),
    Task(20, "tests.benchmarks.octaves", timed=False),
    Task(4, "tests.benchmarks.startup", compares=True),
    Task(12, "tests.benchmarks.frames", compares=True),
    Task(3, "tests.benchmarks.rendering --preset fast --seconds 60"),
    Task(3, "tests.benchmarks.rendering --preset nerf --seconds 60"),
    Task(4, "tests.benchmarks.reports speed"),
    Task(4, "tests.benchmarks.reports curves"),
    Task(1, "tests.hard_cases", timed=False),
    Task(1, "tests.benchmarks.rules", timed=False),
    Task(1, "tests.benchmarks.gradient", timed=False),
    Task(6, "tests.benchmarks.unbiased --paths 10", timed=False),
    Task(5, "tests.benchmarks.memory", timed=False),
    Task(2, "tests.benchmarks.rules --preset fast"),
    Task(2, "tests.benchmarks.rules --preset nerf"),
    Task(2, "tests.benchmarks.published_step"),
    Task(2, "tests.benchmarks.published_step --rays 4096 --steps 2"),
    Task(3, "tests.benchmarks.composite"),
    Task(3, "tests.benchmarks.light_transport", compares=True),
    Task(4, "tests.benchmarks.generate"),
    Task(4, "tests.benchmarks.inverse_loop"),
    Task(4, "tests.benchmarks.native"),
    Task(2, "tests.benchmarks.path_gradient"),
    Task(10, "tests.benchmarks.recover"),
    Task(12, "tests.benchmarks.reduced_paper"),
    Task(15, "tests.benchmarks.robustness --out runs/robustness --set collapse_check=150"),
    Task(140, "tests.benchmarks.resolution --seconds 3600", compares=True),
)  # fmt: skip


def main() -> None:
    """Runs what is due, as far as time allows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--against", type=Path, help="another checkout, for the comparisons")
    parser.add_argument("--untimed", action="store_true", help="only what takes no times")
    parser.add_argument("--list", action="store_true", help="say what is due, run nothing")
    options = parser.parse_args()
    end = time.monotonic() + 60 * options.minutes
    for task, words in due(options.against, RESULTS):
        command = " ".join(["python -m", *words])
        if options.untimed and task.timed:
            continue
        if options.list:
            print(f"{task.minutes:5g} minutes: {command}")
        elif time.monotonic() + 60 * task.minutes > end:
            print(f"left out, takes {task.minutes:g} minutes: {command}")
        else:
            print(command, flush=True)
            if subprocess.run([sys.executable, "-m", *words], check=False).returncode:
                print(f"failed: {command}")
    if options.list and not options.untimed:
        for command in by_hand(RESULTS):
            print(f"out of date, by hand: {command}")


def due(against: Path | None, results: Path) -> Iterator[tuple[Task, list[str]]]:
    """The commands that have not measured the present sources, and their words."""
    done = {record.origin.command for record in _records(results) if record.origin.current()}
    for task in PLAN:
        words, typed = shlex.split(task.command), task.command
        if task.compares and against is not None:
            words += ["--against", str(against)]
            name = against.name if against.is_absolute() else str(against)
            typed = f"{task.command} --against {name}"
        here = not task.needs or task.needs in available_variants()
        if here and f"python -m {typed}" not in done:
            yield task, words


def by_hand(results: Path) -> list[str]:
    """The commands of rows out of date that no module of this folder measures."""
    old = [r.origin.command for r in _records(results) if not r.origin.current()]
    return list(dict.fromkeys(c for c in old if not c.startswith("python -m tests.")))


def _records(results: Path) -> list[Record]:
    return [record for file in sorted(results.glob("*.json")) for record in load(file)]


if __name__ == "__main__":
    main()
