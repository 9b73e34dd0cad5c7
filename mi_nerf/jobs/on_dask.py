"""Workers of a scheduler of dask, which is already there, as an executor."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future
from contextlib import suppress
from typing import Any

from ..base.errors import InputError, Option
from .local import use_threads
from .process import JobError

_SECONDS_TO_CONNECT = 10.0


class DaskExecutor(Executor):
    """Hands as many jobs to a scheduler as it has workers: a job waits here, not in a queue there.

    A job whose worker dies is tried elsewhere by the scheduler itself, as often as its setting
    ``distributed.scheduler.allowed-failures`` says. Jobs that run cannot be cancelled: they end
    by the permit that they have.
    """

    def __init__(self, address: str) -> None:
        """
        Raises:
            InputError: if no scheduler answers.
        """
        from distributed import Client

        try:
            self._client = Client(address, timeout=_SECONDS_TO_CONNECT, set_as_default=False)
        except (OSError, ValueError) as error:  # what it raises has changed between versions
            raise InputError(
                "{}: cannot be reached, expected a scheduler of dask", Option("executor", address)
            ) from error
        self._address = address
        self._known = 0  # workers

    @property
    def width(self) -> int:
        """Processes that the scheduler has at present; at least one, so that it asks for more."""
        return max(1, self._workers())

    def __str__(self) -> str:
        count = self._workers()
        workers = "1 worker" if count == 1 else f"{count or 'no'} workers"
        return f"{workers} of {self._address}" + ("" if count else " yet")

    def _workers(self) -> int:
        with suppress(OSError):  # if the scheduler is gone for good, the jobs will tell
            self._known = len(self._client.nthreads())
        return self._known

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Calls a function on one of the workers."""
        future: Future[Any] = Future()
        future.set_running_or_notify_cancel()
        remote = self._client.submit(_on_worker, fn, args, kwargs, pure=False)
        remote.add_done_callback(lambda done: self._pass_on(done, future))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Leaves the scheduler and its workers as they are."""
        self._client.close()

    def _pass_on(self, remote: Any, future: Future[Any]) -> None:
        """In a thread of the client: what has come of a job."""
        try:
            result = remote.result()
        except BaseException as error:
            gone = JobError(f"{self._address}: the scheduler is gone")
            future.set_exception(gone if remote.cancelled() else error)  # never cancelled by us
        else:
            future.set_result(result)


def _on_worker(function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Where a worker of dask calls a job: Dr.Jit gets the threads that the worker has."""
    from distributed import get_worker

    _share(get_worker().state.nthreads)
    return function(*args, **kwargs)


_shared = threading.Lock()
_threads: int | None = None


def _share(count: int) -> None:
    global _threads
    with _shared:
        if _threads != count:
            use_threads(count)
            _threads = count
