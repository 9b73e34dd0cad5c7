"""Jobs through submitit, whose executor for this machine stands for Slurm."""

from __future__ import annotations

from pathlib import Path

import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.jobs import Job, open_executor, permitted, run_jobs
from tests.generation.test_run import ball, contents, make
from tests.support import jobs as work

pytest.importorskip("submitit")
from mi_nerf.jobs.on_slurm import SlurmExecutor  # noqa: E402
from tests.generation.test_workers import few  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("default")]


def test_jobs_deaths_and_errors(tmp_path: Path) -> None:
    found: dict[str, str] = {}
    out = tmp_path / "out"
    with (
        SlurmExecutor(out, {}, at_once=2, cluster="local") as executor,
        permitted(out) as permit,
    ):
        jobs = [Job(f"job {n}", work.die_once, (tmp_path / "marker", f"{n}")) for n in range(3)]
        assert run_jobs(jobs, executor, permit, lambda job, r: found.__setitem__(job.name, r))
        assert found == {f"job {n}": f"{n}" for n in range(3)}
        with pytest.raises(InputError, match="value=3: expected another"):
            run_jobs([Job("wrong", work.refuse, (3,))], executor, permit, print)
    assert list((tmp_path / "out.slurm").glob("*_log.err"))  # beside the results, not among them
    assert not list(out.iterdir())


def test_a_dataset(tmp_path: Path) -> None:
    scene, out = ball(tmp_path), tmp_path / "data"
    make(scene, tmp_path / "whole", few())
    with SlurmExecutor(out, {}, at_once=2, cluster="local") as executor:
        assert make(scene, out, few(), executor=executor)["complete"]
    assert contents(out) == contents(tmp_path / "whole")


def test_settings(tmp_path: Path) -> None:
    SlurmExecutor(tmp_path, {"timeout_min": 5, "partition": "gpu"}, cluster="local").shutdown()
    with pytest.raises(InputError, match="executor='slurm': no 'srun' on this machine"):
        with open_executor(executor="slurm:partition=gpu", folder=tmp_path):
            pass
