"""Many trainings in one folder: resumable, with failures as results."""

from __future__ import annotations

import itertools
import statistics
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..base.errors import InputError
from ..base.files import make_folder, read_json, write_json
from ..training import run as training
from ..training.config import TrainConfig
from ..training.run import Run, TrainingError
from ..training.run_folder import CONFIG, read_config

RESULT = "eval.json"


def all_trained(
    record: dict[str, Any],
    rows: Mapping[str, TrainConfig],
    seeds: int,
    train: Callable[[str, TrainConfig], dict[str, Any] | None],
    summary: Callable[[str, list[dict[str, Any]]], dict[str, Any]],
    file: Path,
    what: str,
) -> dict[str, Any]:
    """``record`` with the results of every row, trained with every seed from its own on.

    Args:
        train: gives the result of the row of that name and seed, or ``None`` if interrupted.
        summary: of all results of a row.
        file: holds the record, ``complete`` once nothing is missing.
        what: it is a record of, e.g. "an ablation".

    Raises:
        InputError: if the folder of the file holds something else.
    """
    check_same(file.parent, file.name, record["settings"], what)
    make_folder(file.parent)
    write_json(file, record)
    results: dict[str, list[dict[str, Any]]] = {name: [] for name in rows}
    record["complete"] = True
    # Whole sets first: an early end leaves something to compare.
    for seed, name in itertools.product(range(seeds), rows):
        result = train(name, replace(rows[name], seed=rows[name].seed + seed))
        if result is None:
            record["complete"] = False
            break
        results[name].append(result)
    record["rows"] = [summary(name, runs) for name, runs in results.items() if runs]
    write_json(file, record)
    return record


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
) -> dict[str, Any] | None:
    """The result of one run, trained now or before; ``None`` if the training is interrupted.

    Args:
        measure: says what there is to say of a finished run.
        given: as in :func:`mi_nerf.training.run.start`.
        after_step: as in :meth:`mi_nerf.training.run.Run.train`.

    Returns:
        What ``measure`` says, and ``restarts`` and ``failed``: why training ended in an error,
        or ``None``.
    """
    if (folder / RESULT).exists():
        found: dict[str, Any] = read_json(folder / RESULT, "the evaluation of a run")
        return found
    if (folder / CONFIG).exists():
        config, _ = read_config(folder)
    started = time.monotonic()
    run = training.start(data, folder, config, variant, resume=True, started=started, given=given)
    try:
        run.train(after_step=after_step)
    except TrainingError as error:
        result = {"failed": str(error), "restarts": run.trainer.attempt}
        write_json(folder / RESULT, result)
        return result
    if run.progress < 1:
        return None
    result = {**measure(run), "restarts": run.trainer.attempt, "failed": None}
    write_json(folder / RESULT, result)
    return result


def mean(values: Iterable[float | None]) -> float | None:
    """Of the values that there are."""
    numbers = [value for value in values if value is not None]
    return statistics.fmean(numbers) if numbers else None
