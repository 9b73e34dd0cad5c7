"""Jobs of Slurm, through submitit, as an executor."""

from __future__ import annotations

import os
import shutil
import threading
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

from ..base.errors import InputError, Option
from ..base.machine import cores
from .local import use_threads
from .process import WorkerDiedError, outcome, pass_on

_AT_ONCE = 16  # jobs in the queue, where the user does not say how many
# Settings that submitit knows for all kinds of cluster.
_GENERIC = ("timeout_min", "mem_gb", "nodes", "cpus_per_task", "gpus_per_node", "tasks_per_node")
_SECONDS_BETWEEN_LOOKS = 1.0


def parameters(text: str) -> dict[str, str | int]:
    """``partition=gpu,timeout_min=60`` as a dictionary; numbers are numbers.

    Raises:
        InputError: if it is none.
    """
    found: dict[str, str | int] = {}
    for part in filter(None, text.split(",")):
        name, equals, value = part.partition("=")
        if not (name and equals and value):
            raise InputError(
                "{}: expected name=value with commas between, as partition=gpu,timeout_min=60",
                Option("executor", f"slurm:{text}"),
            )
        found[name] = int(value) if value.isdecimal() else value
    return found


class SlurmExecutor(Executor):
    """Puts each job into the queue; submitit and this program are installed where it will run."""

    slow_start = True  # each job waits in the queue, and imports everything

    def __init__(
        self,
        folder: Path,
        settings: dict[str, str | int],
        at_once: int = 0,
        cluster: str = "slurm",
    ) -> None:
        """
        Args:
            folder: of the results; a folder of logs is made beside it.
            settings: those of submitit's ``AutoExecutor.update_parameters``, without ``slurm_``.
            at_once: jobs that are in the queue at a time, 16 by default.
            cluster: as submitit calls it; ``local`` runs jobs on this machine.

        Raises:
            InputError: if there is no Slurm, or it has no such settings.
        """
        import submitit

        if cluster == "slurm" and shutil.which("srun") is None:
            raise InputError(
                "{}: no 'srun' on this machine, expected one that submits to Slurm",
                Option("executor", "slurm"),
            )
        self.width = at_once or _AT_ONCE
        place = folder.absolute()
        self._logs = place.with_name(f"{place.name}.slurm")
        self._executor = submitit.AutoExecutor(folder=self._logs, cluster=cluster)
        named = {n if n in _GENERIC else f"slurm_{n}": value for n, value in settings.items()}
        try:
            self._executor.update_parameters(name="mi_nerf", **named)
        except (AssertionError, NameError, TypeError, ValueError) as error:
            said = " ".join(str(error).split())
            raise InputError("{}: {}", Option("executor", "slurm"), said) from error
        self._under_way: dict[Future[Any], Any] = {}
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._watching = threading.Thread(target=self._watch, daemon=True)
        self._watching.start()

    def __str__(self) -> str:
        return f"Slurm, {self.width} jobs at a time, with logs in {self._logs}"

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Puts a call, without keywords, into the queue."""
        if kwargs:
            raise TypeError(f"{fn}: expected arguments without names")
        future: Future[Any] = Future()
        with self._lock:
            self._under_way[future] = self._executor.submit(_in_job, fn, args)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Waits for what is under way, or takes it out of the queue, running or not."""
        if cancel_futures or not wait:
            with self._lock:
                for job in self._under_way.values():
                    job.cancel(check=False)
                self._under_way.clear()
        while self._under_way:
            time.sleep(_SECONDS_BETWEEN_LOOKS)
        self._over.set()
        self._watching.join()

    def __exit__(self, kind: Any, value: Any, trace: Any) -> None:
        self.shutdown(cancel_futures=kind is not None)

    def _watch(self) -> None:
        """In a thread of its own: passes on what has come of jobs."""
        while not self._over.wait(_SECONDS_BETWEEN_LOOKS):
            with self._lock:
                jobs = dict(self._under_way)
            for future, job in jobs.items():
                if _has_ended(job, future):
                    with self._lock:
                        self._under_way.pop(future, None)


def _has_ended(job: Any, future: Future[Any]) -> bool:
    """Whether a job of submitit has ended; those who wait are told."""
    if future.cancelled():
        job.cancel(check=False)
        future.set_running_or_notify_cancel()
        return True
    if not job.done():
        if job.state.upper() == "RUNNING" and not future.running():
            future.set_running_or_notify_cancel()
        return False
    if not future.running() and not future.set_running_or_notify_cancel():
        return True
    try:
        pass_on(job.result(), future)
    except Exception as error:  # there is no result, or half of one
        future.set_exception(
            WorkerDiedError(f"as {job.paths.stderr} may say: {type(error).__name__}")
        )
    return True


def _in_job(function: Callable[..., Any], arguments: tuple[Any, ...]) -> bytes:
    """Where Slurm runs it: with the cores of the job, not of the machine."""
    use_threads(int(os.environ.get("SLURM_CPUS_PER_TASK", cores())))
    return outcome(function, arguments)
