"""Measures again what is out of date, the most important first.

    MI_NERF_DATA=… python -m tests.benchmarks.all --minutes 60 --against ../before
    python -m tests.benchmarks.all --list

A command is due until rows in docs/results say that it has measured the present sources. So
the same call goes on where the last one stopped; it begins no command that would take longer
than what is left. Minutes are those of two slow cores, roughly. Run it on an idle machine.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from tests.benchmarks.results import RESULTS, load

# Minutes, the command behind ``python -m``, and whether it compares with another checkout.
PLAN: tuple[tuple[float, str, bool], ...] = (
    (5, "tests.benchmarks.steps", True),
    (27, "tests.benchmarks.resolution --seconds 600", True),
    (12, "tests.benchmarks.resolution --data lego_200 --downscale 2 --seconds 120"
     " --shares 0.25 0.4 0.6", True),
    (18, "tests.benchmarks.resolution --data lego_200 --seconds 300 --shares 0.25 0.4 0.6", True),
    (15, "tests.benchmarks.resolution --data lego_200 --downscale 2 --seconds 120 --presets nerf"
     " --shares 0.4 0.6", True),
    (5, "tests.benchmarks.quality --preset fast --seconds 60", False),
    (8, "tests.benchmarks.quality --preset fast --seconds 120", False),
    (19, "tests.benchmarks.quality --preset fast --seconds 300 --downscale 1", False),
    (9, "tests.benchmarks.quality --preset nerf --seconds 120", False),
    (33, "tests.benchmarks.quality --preset nerf --seconds 600", False),
    (3, "tests.benchmarks.rendering --preset fast --seconds 60", False),
    (3, "tests.benchmarks.rendering --preset nerf --seconds 60", False),
    (4, "tests.benchmarks.reports speed", False),
    (4, "tests.benchmarks.reports curves", False),
    (1, "tests.benchmarks.gradient", False),
    (5, "tests.benchmarks.memory", False),
    (1, "tests.hard_cases", False),
    (1, "tests.benchmarks.rules", False),
    (2, "tests.benchmarks.published_step", False),
    (2, "tests.benchmarks.published_step --rays 4096 --steps 2", False),
    (3, "tests.benchmarks.composite", False),
    (4, "tests.benchmarks.generate", False),
    (4, "tests.benchmarks.inverse_loop", False),
    (6, "tests.benchmarks.unbiased --paths 10", False),
    (15, "tests.benchmarks.robustness --out runs/robustness --set collapse_check=150", False),
    (140, "tests.benchmarks.resolution --seconds 3600", True),
)  # fmt: skip


def main() -> None:
    """Runs what is due, as far as time allows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--against", type=Path, help="another checkout, for the comparisons")
    parser.add_argument("--list", action="store_true", help="say what is due, run nothing")
    options = parser.parse_args()
    end = time.monotonic() + 60 * options.minutes
    for minutes, words in due(options.against, RESULTS):
        command = " ".join(["python -m", *words])
        if options.list:
            print(f"{minutes:5g} minutes: {command}")
        elif time.monotonic() + 60 * minutes > end:
            print(f"left out, takes {minutes:g} minutes: {command}")
        else:
            print(command, flush=True)
            if subprocess.run([sys.executable, "-m", *words], check=False).returncode:
                print(f"failed: {command}")


def due(against: Path | None, results: Path) -> Iterator[tuple[float, list[str]]]:
    """Minutes and words of the commands that have not measured the present sources."""
    rows = [record for file in results.glob("*.json") for record in load(file)]
    done = {record.origin.command for record in rows if record.origin.current()}
    for minutes, command, compares in PLAN:
        words, typed = shlex.split(command), command
        if compares and against is not None:
            words += ["--against", str(against)]
            name = against.name if against.is_absolute() else str(against)
            typed = f"{command} --against {name}"
        if f"python -m {typed}" not in done:
            yield minutes, words


if __name__ == "__main__":
    main()
