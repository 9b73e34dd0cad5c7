"""Dr.Jit's own threads on a CPU: how kernels are divided among them, and work of Python's there.

A thread of Dr.Jit that has nothing to do looks for work all the time, for some 20 ms, and takes
a core from any other thread. So work between two kernels is best given to these very threads,
through the library with which Dr.Jit itself does so. Where it is not to be had, the calling
thread does everything.

NumPy's matrix products run in one thread each meanwhile: a product that is split among threads
waits for the slowest, and with another process on one of the cores that takes milliseconds.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import drjit as dr

S = TypeVar("S")
T = TypeVar("T")

# Lanes that one thread takes at a time. Dr.Jit's own choice is 16384, so that a kernel over the
# 16384 queries of a training step would run on one thread. 128 to 1024 measured alike.
LANES = 1024

_POINTER, _NUMBER = ctypes.c_void_p, ctypes.c_uint32
_TASK = ctypes.CFUNCTYPE(None, _NUMBER, _POINTER)
_SUBMIT = (
    *(_POINTER, _POINTER, _NUMBER, _NUMBER, _TASK, _POINTER, _NUMBER, _POINTER),
    *(ctypes.c_int, ctypes.c_int),
)


def work_item() -> int | None:
    """Lanes of a kernel that one thread takes at a time; ``None`` where that is not known."""
    function = _function("drjit-core", "_Z19jit_llvm_block_sizev", _NUMBER)
    return None if function is None else int(function())


def set_work_item(lanes: int) -> bool:
    """Sets :func:`work_item`; returns whether this Dr.Jit offers to. Kernels stay the same."""
    function = _function("drjit-core", "_Z23jit_llvm_set_block_sizej", None, _NUMBER)
    if function is None:
        return False
    function(lanes)
    return True


def parallel(work: Callable[[S], T], parts: Iterable[S]) -> list[T]:
    """What ``work`` makes of each of the parts, in their order, by several threads at a time.

    Raises:
        Exception: the first that ``work`` raised.
    """
    todo = list(parts)
    submit = _function("nanothread", "task_submit_dep", _POINTER, *_SUBMIT)
    wait = _function("nanothread", "task_wait_and_release", None, _POINTER)
    with _one_thread():
        if len(todo) < 2 or submit is None or wait is None:
            return [work(part) for part in todo]
        results: list[Any] = [None] * len(todo)
        errors: list[BaseException] = []

        def run(index: int, _: Any) -> None:
            try:
                results[index] = work(todo[index])
            except BaseException as error:  # nothing may leave a thread that is not Python's
                errors.append(error)

        function = _TASK(run)  # alive until all is done
        task = submit(None, None, 0, len(todo), function, None, 0, None, 0, 0)
        if task:  # else the calling thread has done it
            wait(task)
        if errors:
            raise errors[0]
        return results


@cache
def _function(library: str, symbol: str, result: Any, *arguments: Any) -> Any:
    """A C function of a library that Dr.Jit has loaded and Python does not see, or none."""
    for path in sorted(Path(dr.__file__).parent.glob(f"*{library}*")):
        try:
            function = getattr(ctypes.CDLL(str(path)), symbol)
        except (AttributeError, OSError):  # another platform or version
            continue
        function.restype, function.argtypes = result, arguments
        return function
    return None


def _one_thread() -> AbstractContextManager[Any]:
    """In which matrix products run in one thread each."""
    pools = _pools()
    return nullcontext() if pools is None else pools.limit(limits=1, user_api="blas")


@cache
def _pools() -> Any:
    try:  # here, because only a CPU needs it: a GPU may be lent without
        from threadpoolctl import ThreadpoolController
    except ImportError:
        return None
    return ThreadpoolController()
