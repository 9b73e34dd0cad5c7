"""Measurements; each module is one command, prints what it finds and writes it to docs/results.

``results`` holds the files, ``tables`` takes them to the documents, ``note`` writes down what
another command has measured, and ``all`` measures again what is out of date. Raw records of other
formats belong into a folder of their own below docs/results.

They need no more than the package and, where they say so, the folder of datasets that
the variable MI_NERF_DATA names. Run them on an otherwise idle machine.
"""

from __future__ import annotations

import os
import platform
import sys
from pathlib import Path


def machine() -> str:
    """The processor and what runs on it, for the head of a table."""
    name = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return f"{name}, {os.cpu_count()} cores, Python {platform.python_version()}"


def data_folder(name: str) -> Path:
    """A dataset below MI_NERF_DATA; leaves with a message if there is none."""
    root = os.environ.get("MI_NERF_DATA")
    if not root or not (Path(root) / name).is_dir():
        sys.exit(f"set MI_NERF_DATA to a folder that holds {name}/")
    return Path(root) / name


def resident_megabytes() -> float:
    """Resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
