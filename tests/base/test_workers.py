"""Dr.Jit's threads: kernels divided among them stay the same, and so does Python's work."""

from __future__ import annotations

import sys

import drjit as dr
import numpy as np
import pytest

from mi_nerf.base import workers
from mi_nerf.base.workers import LANES, parallel, set_work_item, work_item

linux = pytest.mark.skipif(sys.platform != "linux", reason="the library is named otherwise")


@linux
def test_the_package_sets_it() -> None:
    assert work_item() == LANES


@linux
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


def nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither the functions of Dr.Jit's libraries nor threadpoolctl."""
    monkeypatch.setattr(workers, "_function", lambda *_: None)
    monkeypatch.setitem(sys.modules, "threadpoolctl", None)  # import fails
    workers._pools.cache_clear()


def test_a_library_without_the_function(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing(monkeypatch)
    assert work_item() is None and not set_work_item(64)
    assert parallel(lambda part: part**2, range(5)) == [0, 1, 4, 9, 16]
    workers._pools.cache_clear()


def test_results_are_in_order_whoever_makes_them() -> None:
    def work(part: int) -> int:
        a = np.full((200, 200), float(part))
        return int((a @ a)[0, 0])

    assert parallel(work, range(64)) == [200 * part**2 for part in range(64)]


def test_what_it_raised_is_raised() -> None:
    def work(part: int) -> int:
        if part == 3:
            raise ValueError("of the fourth part")
        return part

    with pytest.raises(ValueError, match="of the fourth part"):
        parallel(work, range(8))
