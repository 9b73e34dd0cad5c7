"""Processes of this machine: what they do, how they die, and that none stays."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.base.machine import cores
from mi_nerf.jobs import Job, JobError, local, permitted, run_jobs
from mi_nerf.jobs.local import LocalWorkers, environment
from mi_nerf.jobs.process import WorkerDiedError
from tests.support import jobs as work
from tests.support.processes import alive, ends


@pytest.fixture(scope="module")
def two() -> Iterator[LocalWorkers]:
    """Two processes."""
    with LocalWorkers(2) as workers:
        yield workers


def seen(path: Path, seconds: float = 60) -> str:
    """What a file holds, once it is there."""
    end = time.monotonic() + seconds
    while not path.exists() or not path.read_text():
        assert time.monotonic() < end
        time.sleep(0.02)
    return path.read_text()


def test_results_come_from_other_processes(two: LocalWorkers) -> None:
    found = [f.result() for f in [two.submit(work.total, n, n) for n in range(20)]]
    assert [total for total, _ in found] == [2 * n for n in range(20)]
    processes = {pid for _, pid in found}
    assert len(processes) <= 2 and os.getpid() not in processes


def test_errors_come_back_with_where_they_were_raised(two: LocalWorkers) -> None:
    error = two.submit(work.refuse, 3).exception()
    assert isinstance(error, InputError) and str(error) == "value=3: expected another"
    assert "in refuse" in str(error.__cause__)
    error = two.submit(work.fail_stubbornly).exception()
    assert isinstance(error, RuntimeError) and str(error) == "StubbornError: 1 and 2"
    with pytest.raises(ImportError, match="not here"):
        two.submit(work.give_what_cannot_be_read).result()
    with pytest.raises((AttributeError, pickle.PicklingError)):
        two.submit(lambda: 1)
    assert two.submit(work.total, 1).result()[0] == 1


def test_threads_are_shared(two: LocalWorkers) -> None:
    share = max(1, cores() // 2)
    assert two.threads == share == two.submit(work.threads).result()
    expected = os.environ.get("OMP_NUM_THREADS", str(share))
    assert two.submit(work.variable, "OMP_NUM_THREADS").result() == expected
    assert str(two) == f"2 processes with {share} thread{'s' * (share > 1)} each"


def test_one_that_dies_takes_nothing_with_it(two: LocalWorkers, tmp_path: Path) -> None:
    other = two.submit(work.nap, 1.0, tmp_path / "pid")
    seen(tmp_path / "pid")
    dying = two.submit(work.die_once, tmp_path / "marker", "never")
    with pytest.raises(WorkerDiedError, match="by SIGKILL"):
        dying.result()
    assert other.result() == int((tmp_path / "pid").read_text())
    assert two.submit(work.die_once, tmp_path / "marker", "again").result() == "again"
    with pytest.raises(WorkerDiedError, match="with exit status 3"):
        two.submit(work.die, tmp_path / "tries").result()


def test_jobs_that_kill_their_process(two: LocalWorkers, tmp_path: Path) -> None:
    found: dict[str, str] = {}
    with permitted(tmp_path / "out") as permit:
        jobs = [
            Job(f"job {n}", work.die_once, (tmp_path / f"marker {n % 3}", f"result {n}"))
            for n in range(9)
        ]
        assert run_jobs(jobs, two, permit, lambda job, r: found.__setitem__(job.name, r))
        assert found == {f"job {n}": f"result {n}" for n in range(9)}
        always = Job("the last one", work.die, (tmp_path / "tries",))
        with pytest.raises(JobError, match="^the last one: the worker died 3 times, with exit s"):
            run_jobs([always], two, permit, print)
    assert (tmp_path / "tries").read_text() == "xxx"


@pytest.mark.slow
def test_leaving_by_an_exception_kills(tmp_path: Path) -> None:
    started = time.monotonic()
    with pytest.raises(KeyboardInterrupt), LocalWorkers(1) as workers:
        future = workers.submit(work.nap, 600.0, tmp_path / "pid")
        waiting = workers.submit(work.total, 1)
        pid = int(seen(tmp_path / "pid"))
        raise KeyboardInterrupt
    assert not alive(pid) and time.monotonic() - started < 60
    assert isinstance(future.exception(), WorkerDiedError) and waiting.cancelled()
    with pytest.raises(RuntimeError, match="have ended"):
        workers.submit(work.total, 1)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_none_outlives_its_parent(tmp_path: Path, number: int) -> None:
    """Whatever ends that one, in the middle of a job or before the process is up."""
    program = f"""
from pathlib import Path
from mi_nerf.jobs.local import LocalWorkers
from tests.support import jobs
workers = LocalWorkers(2, (jobs.nap, (0.0, Path({str(tmp_path / "first")!r}))))
workers.submit(jobs.nap, 600.0, Path({str(tmp_path / "busy")!r})).result()
"""
    parent = subprocess.Popen([sys.executable, "-c", program], cwd=Path.cwd())
    pids = [int(seen(tmp_path / name)) for name in ("first", "busy")]
    parent.send_signal(number)
    assert parent.wait(timeout=20) == -number
    assert all(map(ends, pids))


@pytest.mark.slow
def test_a_script_needs_no_guard(tmp_path: Path) -> None:
    """Workers do not import the main module, unlike those of multiprocessing."""
    script = tmp_path / "script.py"
    script.write_text(
        "from mi_nerf.jobs.local import LocalWorkers\n"
        "print('once')\n"
        "with LocalWorkers(1) as workers:\n"
        "    print(workers.submit(divmod, 7, 3).result())\n"
    )
    done = subprocess.run(
        [sys.executable, script],
        env={**os.environ, "PYTHONPATH": str(Path.cwd())},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "once\n(2, 1)\n" and done.stderr == ""


def test_several_gpus_are_shared(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,5,7")
    assert [environment(n, 1).get("CUDA_VISIBLE_DEVICES") for n in range(4)] == ["2", "5", "7", "2"]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2")
    assert "CUDA_VISIBLE_DEVICES" not in environment(0, 1)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    for name in ("0000:01:00.0", "0000:02:00.0"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "information").touch()
    assert local._devices(tmp_path) == ["0", "1"] and local._devices(tmp_path / "none") == []


def test_variables_of_the_user_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    shares = environment(0, 3)
    assert "OMP_NUM_THREADS" not in shares and shares["OPENBLAS_NUM_THREADS"] == "3"
