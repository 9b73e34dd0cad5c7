"""Kernels divided among threads: the same kernels, the same results."""

from __future__ import annotations

import sys

import drjit as dr
import numpy as np
import pytest

from mi_nerf.base import work_items
from mi_nerf.base.work_items import LANES, set_work_item, work_item

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the library is named otherwise")


def test_the_package_sets_it() -> None:
    assert work_item() == LANES


def test_sizes_change_no_kernel_and_no_result() -> None:
    import drjit.llvm.ad as ad

    x = ad.Float(np.random.default_rng(0).random(5000, dtype=np.float32))
    results, misses = [], []
    try:
        for lanes in (16384, 1024, 128):
            assert set_work_item(lanes) and work_item() == lanes
            with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
                dr.kernel_history_clear()
                y = dr.sin(x) * 3
                dr.eval(y)
                misses.append(sum(e.get("cache_hit", 1) == 0 for e in dr.kernel_history()))
            results.append(np.array(y))
    finally:
        set_work_item(LANES)
    assert misses[1:] == [0, 0]
    assert all(np.array_equal(r, results[0]) for r in results)


def test_a_library_without_the_function(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(work_items, "_function", lambda symbol: None)
    assert work_item() is None and not set_work_item(64)
