"""PSNR against seconds of training, for several models and seeds."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..base.checks import at_least_one
from ..base.errors import InputError, Option
from ..base.files import read_json, write_text
from ..base.machine import machine
from ..data import load_dataset, split_to_measure
from ..jobs import Permit
from ..tasks.evaluate import evaluate
from ..tasks.series import Series, all_trained, mean, trained
from ..tasks.target import Target
from ..training.config import TrainConfig, setting_names, to_json, with_settings
from ..training.presets import preset
from ..training.run import Run
from ..training.run_folder import CONFIG

Record = dict[str, Any]

RECORD = "report.json"
CURVE = "curve.jsonl"  # in the folder of a run: a line for each look at its field
_FIRST = 1 / 16  # of the budget, after which a field is first looked at


def rows_of(
    presets: Sequence[str], vary: Mapping[str, Sequence[str]], settings: Sequence[str] = ()
) -> dict[str, TrainConfig]:
    """A configuration for each preset and each combination of varied settings, by its name.

    Args:
        vary: values of settings, as ``{"network.width": ["32", "64"]}``.
        settings: ``key=value`` for all of them.

    Raises:
        InputError: for unknown presets, settings or values, or none of them.
    """
    for key, values in vary.items():
        if not values:
            raise InputError("{}: expected at least one value", Option("vary", key))
        if key not in setting_names():
            with_settings(preset("nerf"), [f"{key}={values[0]}"])  # says what may be meant
    if not presets:
        raise InputError("{}: nothing to train, expected at least one", Option("presets"))
    rows = {}
    for name in presets:
        base = with_settings(preset(name), list(settings))
        for values in itertools.product(*vary.values()):
            changes = [f"{key}={value}" for key, value in zip(vary, values, strict=True)]
            rows[", ".join([name, *changes])] = with_settings(base, changes)
    return rows


def training_curves(
    data: str | Path,
    out: str | Path,
    rows: Mapping[str, TrainConfig],
    variant: str,
    *,
    seeds: int = 3,
    split: str | None = None,
    views: int = 10,
    looks: int = 8,
    given: Sequence[str] = (),
    on_run: Callable[[str, int], object] | None = None,
    workers: int = 0,
    executor: str | Executor | None = None,
) -> Record:
    """Trains every row with every seed, and measures held-out views from time to time.

    The clock of training stands still meanwhile; what it shows includes reading the images
    and compiling. Called again, it goes on where it was interrupted.

    Args:
        rows: by name; each with its budget, ``steps`` or ``max_seconds`` (:func:`rows_of`).
        seeds: runs of each row, with seeds from its own on.
        split: views to measure; default: test, or what there is beside train.
        views: so many of them, evenly spread.
        looks: how often in each training, at shares of its budget from 1/16 to 1 that grow
            by a constant factor.
        given: names of settings that preset ``auto`` must not choose.
        on_run: called with the name and the seed before each training, or after it by workers.
        workers, executor: who trains, as in :func:`mi_nerf.jobs.open_executor`; this process by
            default. What the clock shows is that of a machine with several trainings then.

    Returns:
        What ``out/report.json`` holds: ``rows``, each with ``name``, ``curve`` (means of the
        seeds that did not fail, a point a look: ``seconds``, ``psnr``, ``least``,
        ``greatest``), ``psnr`` at the end, ``seeds``, ``failures`` and ``runs``. ``complete`` is
        false after Ctrl-C.

    Raises:
        InputError: if the data cannot be read, or the folder holds something else.
    """
    at_least_one(seeds=seeds, views=views, looks=looks)
    split = split_to_measure(data, split)
    load_dataset(data, split, limit=1)  # before hours of work
    folder = Path(out)
    settings = {
        "data": str(Path(data).resolve()),
        "split": split,
        "views": views,
        "looks": looks,
        "rows": {name: to_json(config) for name, config in rows.items()},
    }
    record = {"settings": settings, "machine": machine(variant), "complete": False, "rows": []}

    look = partial(_look, split=split, views=views)
    train = partial(
        _train,
        data=str(settings["data"]),
        folder=folder.absolute(),
        variant=variant,
        looks=looks,
        look=look,
        given=tuple(given),
    )
    series, file = Series(rows, seeds, workers, executor), folder / RECORD
    return all_trained(record, series, train, summary, file, "a report on trainings", on_run)


def _train(
    name: str,
    config: TrainConfig,
    permit: Permit | None,
    *,
    data: str,
    folder: Path,
    variant: str,
    looks: int,
    look: Callable[[Run], Record],
    given: Sequence[str],
) -> Record | None:
    """The result of one row with one seed; ``None`` if interrupted."""
    place = folder / "runs" / _slug(name) / f"seed_{config.seed}"
    watch = Watch(place, looks, look)
    result = trained(
        data, place, config, variant, _ending, given=given, after_step=watch, permit=permit
    )
    return result and {**result, "seed": config.seed, "curve": read_curve(place)}


class Watch:
    """Looks at a run now and then, and keeps what it sees in the run's folder."""

    def __init__(self, folder: Path, looks: int, look: Callable[[Run], Record]) -> None:
        self._file, self._look = folder / CURVE, look
        self._shares = np.geomspace(_FIRST, 1, looks) if looks > 1 else np.ones(1)
        self._lines: list[Record] | None = None

    def __call__(self, run: Run) -> None:
        """To be called after every step."""
        if self._lines is None:
            # A run that was killed goes on from a checkpoint: looks after that are repeated.
            before = read_curve(self._file.parent)
            self._lines = [line for line in before if line["step"] < run.trainer.step_count]
        due = int(np.sum(self._shares <= run.progress))
        if due <= max((line["look"] for line in self._lines), default=0):
            return
        with run.clock_stopped():
            seen = {"look": due, "step": run.trainer.step_count, "seconds": run.seconds}
            self._lines.append({**seen, **self._look(run)})
            write_text(self._file, map(json.dumps, self._lines))


def read_curve(folder: Path) -> list[Record]:
    """What a :class:`Watch` has written: ``look`` (from 1), ``step``, ``seconds``, ``psnr``, ...

    Raises:
        InputError: if the file is damaged.
    """
    path = folder / CURVE
    if not path.exists():
        return []
    try:
        return [json.loads(line) for line in path.read_text().splitlines()]
    except ValueError as error:
        raise InputError(f"{path}: cannot be read as a curve of training: {error}") from error


def _look(run: Run, split: str, views: int) -> Record:
    """The quality of a field in training."""
    config = read_json(run.folder / CONFIG, "the config.json of a run")
    settings = run.config
    target = Target(run.folder, run.field_file(), config, settings.downscale, settings.images)
    found = evaluate(target, run.variant, split=split, views=views, geometry=False)
    return {**found["mean"], "queries_per_ray": found["queries_per_ray"]}


def _ending(run: Run) -> Record:
    parameters = run.field_file().parameter_count()
    return {"seconds": run.seconds, "steps": run.trainer.step_count, "parameters": parameters}


def _slug(name: str) -> str:
    """A name as that of a folder."""
    return "".join(c if c.isalnum() or c in "._-=" else "_" for c in name.replace(", ", "__"))


def summary(name: str, runs: list[Record]) -> Record:
    """A row of the record: means of the seeds that did not fail."""
    good = [run for run in runs if run["failed"] is None and run["curve"]]
    curve = []
    for look in sorted({line["look"] for run in good for line in run["curve"]}):
        lines = [line for run in good for line in run["curve"] if line["look"] == look]
        values = [line["psnr"] for line in lines if line["psnr"] is not None]
        if values:
            point = {"seconds": mean(line["seconds"] for line in lines), "psnr": mean(values)}
            point |= {"least": min(values), "greatest": max(values), "seeds": len(values)}
            curve.append(point)
    last = [run["curve"][-1] for run in good]
    keys = ("psnr", "ssim", "queries_per_ray", "seconds")
    return {
        "name": name,
        **{key: mean(line[key] for line in last) for key in keys},
        "parameters": mean(run["parameters"] for run in good),
        "seeds": len(runs),
        "failures": len(runs) - sum(run["failed"] is None for run in runs),
        "curve": curve,
        "runs": runs,
    }
