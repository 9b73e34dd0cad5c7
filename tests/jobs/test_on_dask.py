"""A scheduler of dask and two worker processes, one of which is killed in the middle."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.cli import main
from mi_nerf.jobs import Job, JobError, open_executor, permitted, run_jobs
from tests.generation.test_run import ball, contents, make
from tests.generation.test_workers import few
from tests.support import jobs as work
from tests.support.dask_cluster import Cluster, dask_cluster

pytest.importorskip("distributed")
import dask  # noqa: E402

pytestmark = [
    pytest.mark.slow,
    # Of the client's threads and sockets, when schedulers and workers are killed.
    pytest.mark.filterwarnings("default"),
]


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    """A scheduler with two workers."""
    folder = tmp_path / "dask"
    folder.mkdir()
    with dask_cluster(folder) as found:
        yield found


def kill_when(path: Path, process_of: Cluster) -> threading.Thread:
    """Kills the first worker once a file is there."""

    def kill() -> None:
        end = time.monotonic() + 120
        while not path.exists() and time.monotonic() < end:
            time.sleep(0.005)
        process_of.workers[0].send_signal(signal.SIGKILL)

    thread = threading.Thread(target=kill)
    thread.start()
    return thread


def test_jobs_and_their_errors(cluster: Cluster, tmp_path: Path) -> None:
    found: dict[str, tuple[int, int]] = {}
    with (
        open_executor(executor=cluster.address, folder=tmp_path) as executor,
        permitted(tmp_path / "out") as permit,
    ):
        assert executor is not None
        jobs = [Job(f"job {n}", work.total, (n, n)) for n in range(12)]
        assert run_jobs(jobs, executor, permit, lambda job, r: found.__setitem__(job.name, r))
        assert {name: total for name, (total, _) in found.items()} == {
            f"job {n}": 2 * n for n in range(12)
        }
        processes = {pid for _, pid in found.values()}
        assert os.getpid() not in processes
        assert executor.submit(work.threads).result() == 1  # those that the worker has
        with pytest.raises(InputError, match="value=3: expected another"):
            run_jobs([Job("wrong", work.refuse, (3,))], executor, permit, print)
    assert all(worker.poll() is None for worker in cluster.workers)  # they are not ours


def test_a_dataset_while_a_worker_is_killed(cluster: Cluster, tmp_path: Path) -> None:
    scene, out = ball(tmp_path), tmp_path / "data"
    options = few(train=16)
    make(scene, tmp_path / "whole", options)
    killer = kill_when(out / "train/r_2.exr", cluster)
    record = make(scene, out, options, executor=cluster.address)
    killer.join()
    assert cluster.workers[0].wait(10) == -signal.SIGKILL and cluster.workers[1].poll() is None
    assert record["complete"] and contents(out) == contents(tmp_path / "whole")


def test_a_request_to_stop_reaches_jobs_elsewhere(cluster: Cluster, tmp_path: Path) -> None:
    stop: list[int] = []
    done: list[str] = []
    with (
        open_executor(executor=cluster.address, folder=tmp_path) as executor,
        permitted(tmp_path / "out") as permit,
    ):
        assert executor is not None
        jobs = [Job(f"job {n}", work.until_withdrawn, (permit,)) for n in range(6)]
        threading.Timer(4, stop.append, (2,)).start()
        assert not run_jobs(jobs, executor, permit, lambda job, r: done.append(r), stop=stop)
    assert done and set(done) == {"stopped"}


def test_the_command(cluster: Cluster, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, out = str(ball(tmp_path)), tmp_path / "data"
    options = ["--train", "3", "--val", "0", "--test", "0", "--size", "16", "16", "--spp", "4"]
    assert main(["generate", scene, str(out), *options, "--executor", cluster.address]) == 0
    text, errors = capsys.readouterr()
    assert "of tcp://127.0.0.1:" in text and "3 views of 16x16" in text and errors == ""
    assert json.loads((out / "dataset.json").read_text())["complete"]


def test_a_scheduler_that_goes(cluster: Cluster, tmp_path: Path) -> None:
    """One line, after some seconds in which the client tries to find it again."""
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "1s"}),
        pytest.raises(JobError, match="^tcp://127.0.0.1:.*: the scheduler is gone$"),
        open_executor(executor=cluster.address, folder=tmp_path) as executor,
        permitted(tmp_path / "out") as permit,
    ):
        assert executor is not None
        threading.Timer(3, cluster.scheduler.kill).start()
        jobs = [Job(f"job {n}", work.until_withdrawn, (permit,)) for n in range(3)]
        run_jobs(jobs, executor, permit, print)


def test_no_scheduler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mi_nerf.jobs.on_dask._SECONDS_TO_CONNECT", 0.5)
    with (
        pytest.raises(InputError, match="tcp://127.0.0.1:9': cannot be reached, expected a sched"),
        open_executor(executor="dask://127.0.0.1:9", folder=tmp_path),
    ):
        pass
