"""How Dr.Jit divides a kernel among the threads of the CPU."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import drjit as dr

# Lanes that one thread takes at a time. Dr.Jit's own choice is 16384, so that a kernel over the
# 16384 queries of a training step would run on one thread. 128 to 1024 measured alike.
LANES = 1024


def work_item() -> int | None:
    """Lanes of a kernel that one thread takes at a time; ``None`` where that is not known."""
    function = _function("_Z19jit_llvm_block_sizev")
    if function is None:
        return None
    function.restype = ctypes.c_uint32
    return int(function())


def set_work_item(lanes: int) -> bool:
    """Sets :func:`work_item`; returns whether this Dr.Jit offers to. Kernels stay the same."""
    function = _function("_Z23jit_llvm_set_block_sizej")
    if function is None:
        return False
    function.argtypes, function.restype = [ctypes.c_uint32], None
    function(lanes)
    return True


def _function(symbol: str) -> Any:
    """A function of Dr.Jit's header ``jit.h`` that Python does not see; ``None`` without it."""
    library = Path(dr.__file__).parent / "libdrjit-core.so"
    try:
        return getattr(ctypes.CDLL(str(library)), symbol)
    except (AttributeError, OSError):  # another platform or version
        return None
