"""The loop over jobs: what is tried again, what ends it, in which order results may come."""

from __future__ import annotations

import random
import threading
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerf.base.errors import InputError
from mi_nerf.jobs import Job, JobError, Permit, permitted, run_jobs
from mi_nerf.jobs.permit import NotPermittedError
from mi_nerf.jobs.process import WorkerDiedError
from tests.support import jobs as work

NOWHERE = Permit(Path("/nowhere/at/all"))


class Scripted(Executor):
    """Ends a job as it is told, in an order of chance: with its result or in an error."""

    def __init__(self, ending: Callable[[int, int], BaseException | None], seed: int = 0) -> None:
        """``ending`` is asked with the job's number and that of the try, from 1."""
        self._ending, self._random = ending, random.Random(seed)
        self._waiting: list[tuple[Future[Any], int]] = []
        self._lock = threading.Lock()
        self.tries: dict[int, int] = {}
        self.most = 0

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        with self._lock:
            self._waiting.append((future, args[1]))
            self.most = max(self.most, len(self._waiting))
        self.some_end(0.5)
        return future

    def some_end(self, share: float) -> None:
        with self._lock:
            ended = [pair for pair in self._waiting if self._random.random() < share]
            self._waiting = [pair for pair in self._waiting if pair not in ended]
        for pair in ended:
            self._end(*pair)

    def _end(self, future: Future[Any], number: int) -> None:
        self.tries[number] = self.tries.get(number, 0) + 1
        error = self._ending(number, self.tries[number])
        if error is None:
            future.set_result(number * number)
        else:
            future.set_exception(error)


def numbered(count: int) -> list[Job]:
    return [Job(f"job {n}", pow, (n,)) for n in range(count)]


def results(executor: Scripted, count: int, **options: Any) -> dict[str, Any]:
    """Runs jobs while another thread ends those that wait."""
    found: dict[str, Any] = {}
    over = threading.Event()

    def end_the_rest() -> None:
        while not over.wait(0.001):
            executor.some_end(0.5)

    thread = threading.Thread(target=end_the_rest)
    thread.start()
    try:
        assert run_jobs(
            numbered(count),
            executor,
            NOWHERE,
            lambda job, result: found.__setitem__(job.name, result),
            **options,
        )
    finally:
        over.set()
        thread.join()
    return found


@given(st.integers(0, 30), st.dictionaries(st.integers(0, 29), st.integers(1, 2)), st.integers())
def test_every_job_is_done_once(count: int, deaths: dict[int, int], seed: int) -> None:
    """Whatever the order, and whichever workers die up to twice at a job."""

    def ending(job: int, number: int) -> BaseException | None:
        return WorkerDiedError("by SIGKILL") if number <= deaths.get(job, 0) else None

    executor = Scripted(ending, seed)
    found = results(executor, count)
    assert found == {f"job {n}": n * n for n in range(count)}
    assert executor.tries == {n: 1 + deaths.get(n, 0) for n in range(count)}


def test_no_more_jobs_are_handed_out_than_the_executor_wants() -> None:
    executor = Scripted(lambda job, number: None)
    executor.width = 3  # type: ignore[attr-defined]
    assert len(results(executor, 20)) == 20
    assert executor.most <= 3


@pytest.mark.parametrize("death", [WorkerDiedError("by SIGSEGV"), BrokenExecutor("by SIGSEGV")])
def test_a_job_that_always_dies_is_named(death: Exception) -> None:
    executor = Scripted(lambda job, number: death if job == 2 else None)
    with pytest.raises(JobError, match=r"^job 2: the worker died 3 times, by SIGSEGV$") as caught:
        results(executor, 5)
    assert caught.value.__cause__ is death and executor.tries[2] == 3


def test_what_a_scheduler_gave_up_is_not_tried_again() -> None:
    """As the exception of dask is called: it has tried on several workers."""
    killed = type("KilledWorker", (Exception,), {})("many words")
    executor = Scripted(lambda job, number: killed if job == 1 else None)
    with pytest.raises(JobError, match="^job 1: the worker died, killed by what it did$"):
        results(executor, 3)
    assert executor.tries[1] == 1


def test_an_executor_that_cannot_go_on() -> None:
    class Broken(Executor):
        def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
            raise BrokenExecutor("a child was killed")

    with pytest.raises(JobError, match="job 0: a worker died, and the executor starts no other"):
        run_jobs(numbered(2), Broken(), NOWHERE, print)


def test_an_error_of_a_job_ends_the_loop() -> None:
    executor = Scripted(lambda job, number: InputError("no such view") if job == 3 else None)
    with pytest.raises(InputError, match="^no such view$"):
        results(executor, 8)
    assert executor.tries[3] == 1


def test_a_request_to_stop_lets_running_jobs_end(tmp_path: Path) -> None:
    stop: list[int] = []
    done: list[str] = []
    with permitted(tmp_path) as permit, ThreadPoolExecutor(1) as pool:
        jobs = [Job(f"job {n}", work.until_withdrawn, (permit,)) for n in range(3)]
        threading.Timer(0.3, stop.append, (2,)).start()
        finished = run_jobs(jobs, pool, permit, lambda job, result: done.append(result), stop=stop)
        assert not permit.path.exists()
    assert not finished and done == ["stopped"]


def test_jobs_that_may_not_begin_any_more_are_no_error(tmp_path: Path) -> None:
    stop: list[int] = []

    class Slow(Executor):
        """Everything runs, and cannot be cancelled, as with dask."""

        def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
            future: Future[Any] = Future()
            future.set_running_or_notify_cancel()
            stop.append(2)
            threading.Timer(0.2, future.set_exception, (NotPermittedError("gone"),)).start()
            return future

    with permitted(tmp_path) as permit:
        assert not run_jobs(numbered(2), Slow(), permit, print, stop=stop)


def test_a_folder_that_is_not_shared_is_an_error(tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as pool, pytest.raises(InputError, match="does not see what is"):
        jobs = [Job("job", work.needs, (Permit(tmp_path / "elsewhere/.working-1"),))]
        run_jobs(jobs, pool, NOWHERE, print)


def test_jobs_of_one_process_take_turns(tmp_path: Path) -> None:
    with permitted(tmp_path) as permit, ThreadPoolExecutor(4) as pool:
        jobs = [Job(f"job {n}", work.alone, (0.02,)) for n in range(8)]
        assert run_jobs(jobs, pool, permit, lambda job, result: None)
