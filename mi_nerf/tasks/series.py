"""Many trainings in one folder: resumable, with failures as results, here or by workers."""

from __future__ import annotations

import itertools
import statistics
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from ..base.errors import InputError
from ..base.files import make_folder, read_json, remove_leftovers, write_json
from ..base.interrupts import interruptible
from ..base.progress_bar import progress_bar
from ..jobs import Job, Permit, open_executor, permitted, run_jobs
from ..training import run as training
from ..training.config import TrainConfig
from ..training.run import Run, TrainingError
from ..training.run_folder import CONFIG, read_config

RESULT = "eval.json"


Result = dict[str, Any]


class Series(NamedTuple):
    """What is trained, and by whom."""

    rows: Mapping[str, TrainConfig]  # by name
    seeds: int  # runs of each row, with seeds from its own on
    workers: int = 0  # and executor, as in mi_nerf.jobs.open_executor
    executor: str | Executor | None = None

    def runs(self) -> list[tuple[str, TrainConfig]]:
        """Each row with each seed. Whole sets first: an early end leaves something to compare."""
        return [
            (name, replace(config, seed=config.seed + seed))
            for seed, (name, config) in itertools.product(range(self.seeds), self.rows.items())
        ]


def all_trained(
    record: Result,
    series: Series,
    train: Callable[[str, TrainConfig, Permit | None], Result | None],
    summary: Callable[[str, list[Result]], Result],
    file: Path,
    what: str,
    on_run: Callable[[str, int], object] | None = None,
) -> Result:
    """``record`` with the results of all runs of a series.

    Args:
        train: gives the result of the row of that name and seed, or ``None`` if interrupted;
            found by its name where workers run it, with the permit that they have.
        summary: of all results of a row.
        file: holds the record, ``complete`` once nothing is missing.
        what: it is a record of, e.g. "an ablation".
        on_run: called with name and seed before each run, or when a worker has ended it.

    Raises:
        InputError: if the folder of the file holds something else.
        JobError: if the process of a run dies again and again.
    """
    check_same(file.parent, file.name, record["settings"], what)
    make_folder(file.parent)
    write_json(file, record)
    runs = series.runs()
    tell = on_run or (lambda name, seed: None)
    with open_executor(series.workers, series.executor, folder=file.parent) as others:
        if others is None:
            found = _by_this_process(runs, train, tell)
        else:
            found = _by_others(runs, train, tell, others, file.parent)
    # In the order of the runs, whichever ended first.
    by_row = {
        n: [found[i] for i, run in enumerate(runs) if run[0] == n and i in found]
        for n in series.rows
    }
    record["complete"] = len(found) == len(runs)
    record["rows"] = [summary(name, results) for name, results in by_row.items() if results]
    write_json(file, record)
    return record


def _by_this_process(
    runs: Sequence[tuple[str, TrainConfig]], train: Any, tell: Callable[[str, int], object]
) -> dict[int, Result]:
    """The results of runs by their place in the list; after an interruption, of the first ones."""
    found: dict[int, Result] = {}
    for place, (name, config) in enumerate(runs):
        tell(name, config.seed)
        result = train(name, config, None)
        if result is None:
            break
        found[place] = result
    return found


def _by_others(
    runs: Sequence[tuple[str, TrainConfig]],
    train: Any,
    tell: Callable[[str, int], object],
    others: Executor,
    folder: Path,
) -> dict[int, Result]:
    """The same by the workers of an executor, of those that have ended."""
    found: dict[int, Result] = {}
    with (
        interruptible() as interrupted,
        permitted(folder) as permit,
        progress_bar(f"by {others}", "run", len(runs)) as bar,
    ):
        jobs = [
            Job(f"{name}, seed {config.seed}", _permitted, (place, train, name, config, permit))
            for place, (name, config) in enumerate(runs)
        ]

        def add(job: Job, result: Result | None) -> None:
            place = job.arguments[0]
            if result is not None:
                found[place] = result
                tell(runs[place][0], runs[place][1].seed)
                bar.update()

        run_jobs(jobs, others, permit, add, stop=interrupted)
    return found


def _permitted(
    _place: int, train: Any, name: str, config: TrainConfig, permit: Permit
) -> Result | None:
    """The job of a worker: the result of one run."""
    permit.require()
    return train(name, config, permit)


def check_same(folder: Path, record_name: str, settings: dict[str, Any], what: str) -> None:
    """Refuses a folder with other things in it than trainings of the same ``settings``.

    Args:
        record_name: the JSON file whose ``settings`` tell.
        what: it is a record of, e.g. "an ablation".
    """
    path = folder / record_name
    if not path.exists():
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise InputError(f"{folder}: holds no {record_name}, expected a new or empty folder")
        return
    found = read_json(path, f"the record of {what}")
    if not isinstance(found, dict) or found.get("settings") != settings:
        raise InputError(f"{path}: holds {what} with other settings, expected another folder")


def trained(
    data: str | Path,
    folder: Path,
    config: TrainConfig,
    variant: str,
    measure: Callable[[Run], dict[str, Any]],
    *,
    given: Collection[str] = (),
    after_step: Callable[[Run], object] | None = None,
    permit: Permit | None = None,
) -> Result | None:
    """The result of one run, trained now or before; ``None`` if the training is interrupted.

    Args:
        measure: says what there is to say of a finished run.
        given: as in :func:`mi_nerf.training.run.start`.
        after_step: as in :meth:`mi_nerf.training.run.Run.train`.
        permit: of a worker; training is interrupted when it is withdrawn.

    Returns:
        What ``measure`` says, and ``restarts`` and ``failed``: why training ended in an error,
        or ``None``.
    """
    if (folder / RESULT).exists():
        found: Result = read_json(folder / RESULT, "the evaluation of a run")
        return found
    if folder.is_dir():
        remove_leftovers(folder)
    if (folder / CONFIG).exists():
        config, _ = read_config(folder)
    started = time.monotonic()
    run = training.start(data, folder, config, variant, resume=True, started=started, given=given)
    try:
        if permit is None:
            run.train(after_step=after_step)
        else:
            run.train(show_bar=False, after_step=_while_permitted(permit, after_step))
    except _WithdrawnError:
        return None
    except TrainingError as error:
        result = {"failed": str(error), "restarts": run.trainer.attempt}
        write_json(folder / RESULT, result)
        return result
    if run.progress < 1:
        return None
    result = {**measure(run), "restarts": run.trainer.attempt, "failed": None}
    write_json(folder / RESULT, result)
    return result


class _WithdrawnError(Exception):
    """The permit is gone in the middle of a training, which is saved."""


def _while_permitted(
    permit: Permit, after_step: Callable[[Run], object] | None
) -> Callable[[Run], None]:
    """``after_step``, and an end once the permit is withdrawn."""
    may_go_on = permit.watched()

    def after(run: Run) -> None:
        if after_step is not None:
            after_step(run)
        if not may_go_on() and run.progress < 1:
            run.save()
            raise _WithdrawnError

    return after


def mean(values: Iterable[float | None]) -> float | None:
    """Of the values that there are."""
    numbers = [value for value in values if value is not None]
    return statistics.fmean(numbers) if numbers else None
