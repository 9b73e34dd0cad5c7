"""Who does the jobs: what ``--workers`` and ``--executor`` name, as executors."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from pathlib import Path

from ..base.errors import InputError, Option
from .local import Call, LocalWorkers

SCHEMES = ("dask", "tcp", "tls", "ucx")  # of addresses of schedulers of dask
SLURM = "slurm"


@contextmanager
def open_executor(
    workers: int = 0,
    executor: str | Executor | None = None,
    *,
    folder: str | Path,
    first: Call | None = None,
) -> Iterator[Executor | None]:
    """Starts workers or finds a cluster; ``None`` if this process is to do everything itself.

    Leaving the block by an exception ends what runs, as far as that is possible.

    Args:
        workers: local processes; with ``slurm``, jobs that are queued at a time.
        executor: ``dask://HOST:PORT`` or another address of a scheduler of dask,
            ``slurm`` or ``slurm:partition=NAME,timeout_min=60`` with parameters as submitit has
            them, or an executor, which stays open.
        folder: of the results; logs of Slurm lie beside it.
        first: a call with which each local process begins.

    Raises:
        InputError: if there is no such executor, or it lacks a package.
    """
    if workers < 0:
        raise InputError("{}: expected 0 or more", Option("workers", workers))
    if executor is None:
        if workers == 0:
            yield None
            return
        with LocalWorkers(workers, first) as local:
            yield local
        return
    queued = isinstance(executor, str) and executor.partition(":")[0] == SLURM
    if workers and not queued:
        raise InputError(
            "{}: of this machine, expected no {} too",
            Option("workers", workers),
            Option("executor", executor if isinstance(executor, str) else None),
        )
    if not isinstance(executor, str):
        yield executor
        return
    with _named(executor, workers, Path(folder)) as cluster:
        yield cluster


def _named(name: str, workers: int, folder: Path) -> Executor:
    scheme, _, rest = name.partition(":")
    try:
        if scheme == SLURM:
            from .on_slurm import SlurmExecutor, parameters

            return SlurmExecutor(folder, parameters(rest), workers)
        if scheme in SCHEMES and rest.startswith("//") and len(rest) > 2:
            from .on_dask import DaskExecutor

            return DaskExecutor(f"tcp:{rest}" if scheme == "dask" else name)
    except ImportError as error:
        raise InputError(
            "{}: needs the package {}, expected pip install 'mi_nerf[cluster]'",
            Option("executor", name),
            error.name,
        ) from error
    raise InputError("{}: unknown, expected dask://HOST:PORT or slurm", Option("executor", name))
