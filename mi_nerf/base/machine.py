"""What a figure was measured on: the processor, its cores, the versions."""

from __future__ import annotations

import os
import platform
import subprocess
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

import drjit as dr

_USUAL_MEMORY = 8 << 30  # bytes, where the system does not say how much there is


def processor() -> str:
    """The name of the CPU, as far as the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def cores() -> int:
    """How many cores this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on this system
        return os.cpu_count() or 1


def available_memory(system: Path = Path("/")) -> int:
    """Bytes that this process may use: the machine's, or the least limit of its cgroups.

    Args:
        system: the folder that holds ``proc`` and ``sys``.
    """
    try:
        limits = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    except (AttributeError, ValueError):  # Windows does not say
        limits = [_USUAL_MEMORY]
    for file in _memory_limits(system):
        try:
            limits.append(int(file.read_text()))
        except (OSError, ValueError):  # no such file, or "max"
            continue
    return min(limits)


def _memory_limits(system: Path) -> Iterator[Path]:
    """Where the cgroups of this process and those around them may have their limits."""
    try:
        lines = (system / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        group = PurePosixPath(path.lstrip("/"))
        for part in (group, *group.parents):
            if not controllers:  # version 2
                yield system / "sys/fs/cgroup" / part / "memory.max"
            elif "memory" in controllers.split(","):
                yield system / "sys/fs/cgroup/memory" / part / "memory.limit_in_bytes"


def machine(variant: str) -> dict[str, Any]:
    """What reports record of the machine; plain JSON values."""
    return {
        "processor": processor(),
        "cores": cores(),
        "gpu": _gpu() if variant.startswith("cuda") else None,
        "variant": variant,
        "versions": versions(),
    }


def versions() -> dict[str, str]:
    """The versions of mi_nerf and of what it computes with."""
    import mitsuba as mi

    from .._version import __version__

    return {
        "mi_nerf": __version__,
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
        "python": platform.python_version(),
    }


def machine_line(record: dict[str, Any]) -> str:
    """A record of :func:`machine` in one line, for captions."""
    device = record["gpu"] or f"{record['cores']} cores of {record['processor']}"
    return f"{device}, {record['variant']}"


def _gpu() -> str:
    """The NVIDIA GPUs of this machine, as their driver lists them."""
    names = []
    for file in sorted(Path("/proc/driver/nvidia/gpus").glob("*/information")):
        for line in file.read_text().splitlines():
            if line.startswith("Model:"):
                names.append(line.partition(":")[2].strip())
    return ", ".join(names) or gpu_query("name") or "NVIDIA GPU"


def gpu_query(what: str) -> str | None:
    """What ``nvidia-smi`` says of the first device; nothing where it does not work."""
    command = ["nvidia-smi", f"--query-gpu={what}", "--format=csv,noheader,nounits"]
    try:
        found = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    lines = found.stdout.splitlines()
    return lines[0].strip() if lines else None
