"""Processes of this machine as an executor, each of which may die alone.

The pool of Python's own library ends all processes when one of them dies, and with it the work of
the others; it imports the caller's main module in each, which therefore has to be written for it;
and when the caller is killed, its processes stay. Here each process has a thread that waits for it.
"""

from __future__ import annotations

import os
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future
from contextlib import suppress
from pathlib import Path
from typing import Any

from ..base.machine import cores
from .process import WorkerDiedError, call, pass_on, receive, send

# What is printed goes with the errors: the standard output is for replies.
_PROGRAM = """
import os, sys
replies = os.dup(1)
os.dup2(2, 1)
sys.path[:] = sys.argv[1:]
from mi_nerf.jobs.process import serve
serve(replies)
"""

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")

Call = tuple[Callable[..., Any], tuple[Any, ...]]
_Task = tuple["Future[Any]", bytes]


class LocalWorkers(Executor):
    """So many processes, which share the cores, and the GPUs if there are several.

    A future whose process dies gets a :class:`~mi_nerf.jobs.process.WorkerDiedError`; another
    process takes its place. Leaving a ``with`` block by an exception kills all at once.
    """

    def __init__(self, count: int, first: Call | None = None) -> None:
        """
        Args:
            first: a call with which each process begins. What it raises is not heard of.
        """
        self.count = count
        self.threads = max(1, cores() // count)  # of Dr.Jit, in each
        calls: list[Call] = [(use_threads, (self.threads,)), *([] if first is None else [first])]
        self._begin = [call(*each, heard=False) for each in calls]
        self._todo: queue.SimpleQueue[_Task | None] = queue.SimpleQueue()
        self._ended = self._killed = False
        self._starting = threading.Lock()
        self._processes = [self._started(index) for index in range(count)]
        self._attendants = [
            threading.Thread(target=self._attend, args=(index,), daemon=True)
            for index in range(count)
        ]
        for attendant in self._attendants:
            attendant.start()

    @property
    def width(self) -> int:
        """Jobs to hand out at a time: one for each process, and one that waits for it."""
        return 2 * self.count

    def __str__(self) -> str:
        threads = "1 thread" if self.threads == 1 else f"{self.threads} threads"
        if self.count == 1:
            return f"1 process with {threads}"
        return f"{self.count} processes with {threads} each"

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Calls a function, without keywords, in one of the processes."""
        if self._ended:
            raise RuntimeError("the processes have ended")
        if kwargs:
            raise TypeError(f"{fn}: expected arguments without names")
        future: Future[Any] = Future()
        self._todo.put((future, call(fn, args)))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Ends all processes, after what was submitted, or what runs if the rest is cancelled."""
        self._ended = True
        if cancel_futures:
            self._cancel()
        for _ in self._attendants:
            self._todo.put(None)
        if wait:
            for attendant in self._attendants:
                attendant.join()

    def kill(self) -> None:
        """Ends all processes at once, whatever they do."""
        with self._starting:
            self._ended = self._killed = True
            self._cancel()
            for process in self._processes:
                process.kill()
        self.shutdown()

    def __exit__(self, kind: Any, value: Any, trace: Any) -> None:
        self.shutdown() if kind is None else self.kill()

    def _cancel(self) -> None:
        with suppress(queue.Empty):
            while True:
                task = self._todo.get_nowait()
                if task is not None:
                    task[0].cancel()
                    task[0].set_running_or_notify_cancel()

    def _attend(self, index: int) -> None:
        """Hands one task after the other to a process, and waits for what it says."""
        while (task := self._todo.get()) is not None:
            future, request = task
            if future.set_running_or_notify_cancel():
                self._do(index, future, request)
        process = self._processes[index]
        if process.stdin is not None:
            with suppress(OSError):
                process.stdin.close()  # upon which it ends
        process.wait()
        if process.stdout is not None:
            process.stdout.close()

    def _do(self, index: int, future: Future[Any], request: bytes) -> None:
        process = self._processes[index]
        assert process.stdin is not None and process.stdout is not None
        try:
            send(process.stdin, request)
            reply = receive(process.stdout)
        except (EOFError, OSError):
            how = _ending(process)
            with self._starting:
                if not self._killed:
                    self._processes[index] = self._started(index)
            future.set_exception(WorkerDiedError(how))
            return
        pass_on(reply, future)

    def _started(self, index: int) -> subprocess.Popen[bytes]:
        folders = [folder or os.getcwd() for folder in sys.path]
        process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM, *folders],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **environment(index, self.threads)},
            start_new_session=True,  # Ctrl-C is for this process alone, which decides
        )
        assert process.stdin is not None
        with suppress(OSError):  # it may have died: that is found out later
            for request in self._begin:
                send(process.stdin, request)
        return process


def use_threads(count: int) -> None:
    """How many threads Dr.Jit's kernels run in from now on, in this process."""
    import drjit as dr

    dr.set_thread_count(count)


def environment(index: int, threads: int) -> dict[str, str]:
    """The variables by which a process keeps to its share: of cores, and of several GPUs."""
    shares = {name: str(threads) for name in _THREADS if name not in os.environ}
    devices = _devices()
    if len(devices) > 1:
        shares["CUDA_VISIBLE_DEVICES"] = devices[index % len(devices)]
    return shares


def _devices(system: Path = Path("/proc/driver/nvidia/gpus")) -> list[str]:
    """What CUDA calls the GPUs that this process may use."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        return [name for name in visible.split(",") if name]
    return [str(number) for number, _ in enumerate(system.glob("*/information"))]


def _ending(process: subprocess.Popen[bytes]) -> str:
    """How a process ended, in words; it is ended if need be."""
    for stream in (process.stdin, process.stdout):
        if stream is not None:
            with suppress(OSError):
                stream.close()
    try:
        code = process.wait(timeout=10)
    except subprocess.TimeoutExpired:  # it has closed its output and lives on
        process.kill()
        code = process.wait()
    if code >= 0:
        return f"with exit status {code}"
    with suppress(ValueError):
        return f"by {signal.Signals(-code).name}"
    return f"by signal {-code}"
