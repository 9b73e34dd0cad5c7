"""What the machine offers, containers included."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from mi_nerf.base.machine import available_memory, gpu_query, machine

THERE = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
LIMIT = 1 << 20  # less than any machine has


def system(root: Path, groups: str, **limits: object) -> Path:
    """A root of files with the cgroups of this process and limits; ``__`` stands for a slash."""
    (root / "proc/self").mkdir(parents=True)
    (root / "proc/self/cgroup").write_text(groups)
    for name, value in limits.items():
        folder, _, file = name.rpartition("__")
        folder = f"sys/fs/cgroup/{folder.replace('__', '/')}"
        (root / folder).mkdir(parents=True, exist_ok=True)
        (root / folder / file.replace("memory_", "memory.")).write_text(f"{value}\n")
    return root


def test_without_limits_it_is_all_there_is(tmp_path: Path) -> None:
    assert available_memory(tmp_path) == THERE  # no /proc, no cgroups
    limits = {"a__memory_max": "max", "memory_max": 2 * THERE}
    assert available_memory(system(tmp_path, "0::/a\n", **limits)) == THERE


def test_a_system_that_does_not_say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As Windows: less is assumed than most machines have."""
    monkeypatch.delattr(os, "sysconf")
    assert available_memory(tmp_path) == 8 << 30


@pytest.mark.parametrize("limited", ["memory_max", "a__memory_max", "a__b__memory_max"])
def test_the_least_limit_of_the_groups_above_counts(tmp_path: Path, limited: str) -> None:
    """Version 2: a group of its own, one around it, or that of a container."""
    limits = {"a__memory_max": "max", "a__b__memory_max": 2 * LIMIT, limited: LIMIT}
    assert available_memory(system(tmp_path, "0::/a/b\n", **limits)) == LIMIT


@pytest.mark.parametrize("limited", ["memory", "memory__docker__c0ffee"])
def test_version_1(tmp_path: Path, limited: str) -> None:
    """Outside the container its group has a path that is not there inside."""
    groups = "5:cpu,cpuacct:/x\n4:memory:/docker/c0ffee\n1:name=systemd:/\n0::/\n"
    unlimited = {"memory__memory_limit_in_bytes": 9223372036854771712}
    root = system(tmp_path, groups, **unlimited | {f"{limited}__memory_limit_in_bytes": LIMIT})
    assert available_memory(root) == LIMIT


def test_this_machine() -> None:
    assert 0 < available_memory() <= THERE


def test_a_card_is_named_by_its_driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "nvidia-smi"
    monkeypatch.setenv("PATH", str(tmp_path))
    assert gpu_query("name") is None, "there is no such program"
    program.write_text('#!/bin/sh\necho "what was asked: $1"\necho "of another card"\n')
    program.chmod(0o755)
    asked = "what was asked: --query-gpu=name"
    assert gpu_query("name") == asked
    if not Path("/proc/driver/nvidia").exists():
        assert machine("cuda_ad_rgb")["gpu"] == asked
    assert machine("llvm_ad_rgb")["gpu"] is None
    program.write_text("#!/bin/sh\necho no devices were found\nexit 6\n")
    assert gpu_query("name") is None
