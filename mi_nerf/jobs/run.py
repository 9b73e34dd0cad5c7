"""Hands independent jobs to an executor, again where their process died, until all are done."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from typing import Any, NamedTuple

from .permit import NotPermittedError, Permit
from .process import JobError, WorkerDiedError, perform

TRIES = 3
_SECONDS_BETWEEN_LOOKS = 0.1  # at a request to stop
_JOBS_EACH = 4  # of a worker that is slow to start: enough for all to end at about one time


class Job(NamedTuple):
    """A call that depends on no other one and may be repeated."""

    name: str  # in messages
    function: Callable[..., Any]  # found by its name where it runs
    arguments: tuple[Any, ...] = ()


def run_jobs(
    jobs: Iterable[Job],
    executor: Executor,
    permit: Permit,
    on_done: Callable[[Job, Any], object],
    *,
    stop: Collection[object] = (),
    tries: int = TRIES,
) -> bool:
    """Runs all jobs, in any order.

    A job whose process dies is tried again, in another process, up to ``tries`` times in all.
    Jobs of one process take turns.

    Args:
        permit: withdrawn when ``stop`` comes: jobs that look at it end early.
        on_done: called in this thread with every finished job and its result, in the order in
            which they happen to end.
        stop: no further job begins once it is not empty; those that run are waited for.

    Returns:
        Whether all jobs are done.

    Raises:
        JobError: if a process died each time that a job was tried.
        Exception: the first that a job raised; others that run are not waited for.
    """
    todo = deque((job, 1) for job in jobs)  # with the number of the try
    under_way: dict[Future[Any], tuple[Job, int]] = {}
    left, stopping = len(todo), False
    while todo or under_way:
        if stop and not stopping:
            stopping = True
            permit.withdraw()
            todo.clear()
            for future in [future for future in under_way if future.cancel()]:
                del under_way[future]
        while todo and len(under_way) < _width(executor):
            job, number = todo.popleft()
            under_way[_submitted(executor, job)] = job, number
        ended, _ = wait(under_way, _SECONDS_BETWEEN_LOOKS, FIRST_COMPLETED)
        for future in ended:
            job, number = under_way.pop(future)
            try:
                result = future.result()
            except NotPermittedError:
                if not stopping:
                    raise
                continue
            except Exception as error:
                how = _death(error)
                if how is None:
                    raise
                if not stopping:
                    todo.appendleft((job, _next_try(job, number, tries, how, error)))
                continue
            left -= 1
            on_done(job, result)
    return left == 0


def together(executor: Executor, count: int) -> int:
    """How many of ``count`` short tasks to make one job of, where each job is slow to start."""
    if not getattr(executor, "slow_start", False):
        return 1
    return max(1, round(count / (_JOBS_EACH * _width(executor))))


def _width(executor: Executor) -> float:
    """How many jobs to hand out at a time: those that come from here say so."""
    return float(getattr(executor, "width", float("inf")))


def _submitted(executor: Executor, job: Job) -> Future[Any]:
    try:
        return executor.submit(perform, job.function, *job.arguments)
    except BrokenExecutor as error:  # of the caller's own: it cannot be made anew from here
        raise JobError(
            f"{job.name}: a worker died, and the executor starts no other one: {error}"
        ) from error


def _death(error: Exception) -> str | None:
    """How the process of a job ended, or ``None`` if the error is the job's own."""
    if isinstance(error, WorkerDiedError | BrokenExecutor):
        return str(error)
    # Known by name, as the package may not be there.
    return "killed by what it did" if type(error).__name__ == "KilledWorker" else None


def _next_try(job: Job, number: int, tries: int, how: str, error: Exception) -> int:
    # A scheduler of dask has tried it on several workers before it says so.
    if number < tries and type(error).__name__ != "KilledWorker":
        return number + 1
    times = "" if number == 1 else f" {number} times"
    raise JobError(f"{job.name}: the worker died{times}, {how}") from error
