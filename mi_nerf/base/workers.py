"""Runs Python functions in Dr.Jit's own threads, for work that NumPy does.

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
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import drjit as dr
from threadpoolctl import ThreadpoolController

S = TypeVar("S")
T = TypeVar("T")

_TASK = ctypes.CFUNCTYPE(None, ctypes.c_uint32, ctypes.c_void_p)


def parallel(work: Callable[[S], T], parts: Iterable[S]) -> list[T]:
    """What ``work`` makes of each of the parts, in their order, by several threads at a time.

    Raises:
        Exception: the first that ``work`` raised.
    """
    todo, library = list(parts), _library()
    with _products().limit(limits=1, user_api="blas"):
        if len(todo) < 2 or library is None:
            return [work(part) for part in todo]
        results: list[Any] = [None] * len(todo)
        errors: list[BaseException] = []

        def run(index: int, _: Any) -> None:
            try:
                results[index] = work(todo[index])
            except BaseException as error:  # nothing may leave a thread that is not Python's
                errors.append(error)

        function = _TASK(run)  # alive until all is done
        task = library.task_submit_dep(None, None, 0, len(todo), function, None, 0, None, 0, 0)
        if task:  # else the calling thread has done it
            library.task_wait_and_release(task)
        if errors:
            raise errors[0]
        return results


@cache
def _library() -> Any:
    """Dr.Jit's thread pool (nanothread), or none."""
    for path in sorted(Path(dr.__file__).parent.glob("*nanothread*")):
        try:
            library = ctypes.CDLL(str(path))  # the one that Dr.Jit has loaded
            submit, wait = library.task_submit_dep, library.task_wait_and_release
        except (OSError, AttributeError):
            continue
        pointer, number = ctypes.c_void_p, ctypes.c_uint32
        submit.restype, wait.restype, wait.argtypes = pointer, None, [pointer]
        submit.argtypes = [
            *(pointer, pointer, number, number, _TASK, pointer, number, pointer),
            *(ctypes.c_int, ctypes.c_int),
        ]
        return library
    return None


@cache
def _products() -> ThreadpoolController:
    return ThreadpoolController()
