"""What the options name, and what they refuse."""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.jobs import open_executor
from mi_nerf.jobs.local import LocalWorkers
from mi_nerf.jobs.on_slurm import parameters


def test_nothing_means_this_process(tmp_path: Path) -> None:
    with open_executor(folder=tmp_path) as executor:
        assert executor is None


def test_an_executor_of_the_caller_stays_open(tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as pool:
        with open_executor(executor=pool, folder=tmp_path) as executor:
            assert executor is pool
        assert pool.submit(divmod, 7, 3).result() == (2, 1)


@pytest.mark.slow
def test_workers_are_processes(tmp_path: Path) -> None:
    with open_executor(3, folder=tmp_path) as executor:
        assert isinstance(executor, LocalWorkers) and executor.count == 3


@pytest.mark.parametrize(
    ("workers", "executor", "message"),
    [
        (-1, None, "workers=-1: expected 0 or more"),
        (2, "dask://localhost:1", "workers=2: of this machine, expected no executor='dask://"),
        (0, "dask:localhost", "executor='dask:localhost': unknown, expected dask://HOST:PORT or"),
        (0, "dask://", "unknown, expected dask://HOST:PORT or slurm"),
        (0, "pbs", "executor='pbs': unknown"),
        (0, "slurm:gpu", "executor='slurm:gpu': expected name=value with commas between"),
    ],
)
def test_refused(workers: int, executor: str | None, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught, open_executor(workers, executor, folder=tmp_path):
        pass
    assert message in str(caught.value)


def test_workers_and_an_executor(tmp_path: Path) -> None:
    with (
        ThreadPoolExecutor(1) as pool,
        pytest.raises(InputError, match="workers=2: of this machine, expected no executor too"),
        open_executor(2, pool, folder=tmp_path),
    ):
        pass


@pytest.mark.parametrize(
    ("name", "package"), [("dask://localhost:1", "distributed"), ("slurm", "submitit")]
)
def test_a_package_that_is_not_there(
    name: str, package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with (
        pytest.raises(InputError, match=rf"needs the package {package}, expected pip install"),
        open_executor(executor=name, folder=tmp_path),
    ):
        pass


def test_parameters_of_slurm() -> None:
    assert parameters("") == {}
    assert parameters("partition=gpu,timeout_min=60") == {"partition": "gpu", "timeout_min": 60}
