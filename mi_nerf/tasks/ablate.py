"""The ablations of the paper (NeRF, Table 2) on one dataset: runs, table, figure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from ..base.errors import InputError
from ..base.files import write_text
from ..fields.fourier import FourierEncoding
from ..jobs import Permit
from ..training.config import TrainConfig, to_json
from ..training.run import Run
from .evaluate import evaluate
from .series import Series, all_trained, mean, trained
from .tables import markdown_table, number, save_figure, spread

RECORD, TABLE, FIGURE = "ablation.json", "ablation.md", "ablation.png"


class Row(NamedTuple):
    """One line of the table: what is changed of the complete model."""

    title: str
    change: Callable[[TrainConfig], TrainConfig]


def complete(config: TrainConfig) -> TrainConfig:
    """The paper's whole model at the scale of ``config``: L = 10 and 4, two networks.

    What spares queries in a way that the paper does not know is switched off, so that the
    rows differ in what they are named after alone.
    """
    sampling = config.sampling
    if not sampling.fine:
        sampling = replace(sampling, samples=32, fine=32, render_samples=32)
    return replace(
        config,
        position=FourierEncoding(frequencies=10),
        direction=FourierEncoding(frequencies=4),
        occupancy=replace(config.occupancy, enabled=False),
        sampling=replace(sampling, hidden=0.0, render_stop=0.0),
    )


def _no_encoding(config: TrainConfig) -> TrainConfig:
    plain = FourierEncoding(frequencies=0)
    return replace(config, position=plain, direction=plain)


def _no_view_dependence(config: TrainConfig) -> TrainConfig:
    return replace(config, network=replace(config.network, view_dependent=False))


def _no_hierarchy(config: TrainConfig) -> TrainConfig:
    """One network, and as many samples as both had queries (64 + 192 = 256 in the paper)."""
    old = config.sampling
    samples = 2 * old.samples + old.fine
    sampling = replace(
        old,
        samples=samples,
        fine=0,
        render_samples=samples,
        render_fine=None,
        batch=None if old.batch is None else max(old.batch, samples),
    )
    return replace(config, sampling=sampling)


def _octaves(count: int) -> Callable[[TrainConfig], TrainConfig]:
    return lambda config: replace(config, position=FourierEncoding(frequencies=count))


def _views(count: int) -> Callable[[TrainConfig], TrainConfig]:
    return lambda config: replace(config, views=count)


ROWS = {
    "no-pe-vd-h": Row(
        "No PE, VD, H", lambda c: _no_hierarchy(_no_view_dependence(_no_encoding(c)))
    ),
    "no-pe": Row("No positional encoding", _no_encoding),
    "no-vd": Row("No view dependence", _no_view_dependence),
    "no-h": Row("No hierarchical sampling", _no_hierarchy),
    "25-images": Row("Far fewer images (25)", _views(25)),
    "50-images": Row("Fewer images (50)", _views(50)),
    "l5": Row("Fewer frequencies (L = 5)", _octaves(5)),
    "l15": Row("More frequencies (L = 15)", _octaves(15)),
    "complete": Row("Complete model", lambda c: c),
}

# Besides the paper's table: the choice of L, which its critics found to depend on the scene.
OCTAVES = {f"L={n}": Row(f"L = {n}", _octaves(n)) for n in range(1, 17)}
_ALL = ROWS | OCTAVES


def ablate(
    data: str | Path,
    out: str | Path,
    config: TrainConfig,
    variant: str,
    *,
    rows: Sequence[str] = tuple(ROWS),
    seeds: int = 1,
    split: str = "test",
    views: int | None = None,
    workers: int = 0,
    executor: str | Executor | None = None,
) -> dict[str, Any]:
    """Trains and evaluates every row with every seed; goes on where it was interrupted.

    Args:
        config: scale and budget of all rows; :func:`complete` makes the last row of it.
        split, views: what the rows are evaluated on.
        workers, executor: who trains, as in :func:`mi_nerf.jobs.open_executor`; this process by
            default. Budgets in seconds buy fewer steps where runs share a machine.

    Returns:
        What ``ablation.json`` holds; its ``complete`` is false after Ctrl-C.

    Raises:
        InputError: if a row is unknown, or the folder holds another ablation.
        JobError: if the process of a run dies again and again.
    """
    for name in rows:
        if name not in _ALL:
            known = f"{', '.join(ROWS)}, or L=1 to L={len(OCTAVES)}"
            raise InputError(f"row '{name}': unknown, expected one of {known}")
    if config.preset == "auto":
        raise InputError("preset 'auto': decides what rows differ in, expected nerf, fast or paper")
    folder = Path(out)
    base = complete(config)
    settings: dict[str, Any] = {"data": str(Path(data).resolve()), "split": split, "views": views}
    settings["base"] = to_json(base)
    record: dict[str, Any] = {"settings": settings, "complete": False, "rows": []}

    configs = {name: _ALL[name].change(base) for name in rows}
    place = folder.absolute()
    train = partial(_train, data=settings["data"], folder=place, settings=settings, variant=variant)
    all_trained(
        record,
        Series(configs, seeds, workers, executor),
        train,
        _summary,
        folder / RECORD,
        "an ablation",
        on_run=lambda name, seed: print(f"{name}, seed {seed}", flush=True),
    )
    write_text(folder / TABLE, table(record).splitlines())
    if any(row["psnr"] is not None for row in record["rows"]):
        _draw(folder / FIGURE, record)
    return record


def _train(
    name: str,
    config: TrainConfig,
    permit: Permit | None,
    *,
    data: str | Path,
    folder: Path,
    settings: dict[str, Any],
    variant: str,
) -> dict[str, Any] | None:
    """The result of one row with one seed; ``None`` if interrupted."""
    measure = partial(_quality, settings=settings, variant=variant)
    place = folder / name / f"seed_{config.seed}"
    return trained(data, place, config, variant, measure, permit=permit)


def _quality(run: Run, settings: dict[str, Any], variant: str) -> dict[str, Any]:
    """What the table says of a finished run."""
    found = evaluate(
        run.folder, variant, split=settings["split"], views=settings["views"], geometry=False
    )
    names = ("queries_per_ray", "parameters", "views", "size")
    return {**found["mean"], "train_seconds": run.seconds, **{n: found[n] for n in names}}


# ---- Table and figure --------------------------------------------------------


def _summary(name: str, runs: list[dict[str, Any]]) -> dict[str, Any]:
    """A row of the record: means over the runs that did not fail."""
    good = [run for run in runs if run["failed"] is None]
    keys = ("psnr", "ssim", "train_seconds", "queries_per_ray", "parameters")
    means = {key: mean(run[key] for run in good) for key in keys}
    counts = {"seeds": len(runs), "failures": len(runs) - len(good)}
    return {"name": name, "title": _ALL[name].title, **means, **counts, "runs": runs}


def table(record: dict[str, Any]) -> str:
    """The rows as Markdown."""
    head = "|PSNR (dB)|range|SSIM|train (s)|queries/ray|parameters|failures"
    rows = [
        [
            row["title"],
            number(row["psnr"], ".2f"),
            spread([run["psnr"] for run in row["runs"] if run.get("psnr") is not None]),
            number(row["ssim"], ".4f"),
            number(row["train_seconds"], ".0f"),
            number(row["queries_per_ray"], ".1f"),
            number(row["parameters"], ",.0f"),
            f"{row['failures']} of {row['seeds']}",
        ]
        for row in record["rows"]
    ]
    return "\n".join(markdown_table(head.split("|"), rows)) + "\n"


def _draw(path: Path, record: dict[str, Any]) -> None:
    """PSNR of every row: the mean as a bar, the seeds as points."""
    from matplotlib.figure import Figure

    rows = [row for row in record["rows"] if row["psnr"] is not None]
    figure = Figure(figsize=(7, 0.9 + 0.4 * len(rows)), layout="constrained")
    axes = figure.subplots()
    axes.barh(range(len(rows)), [row["psnr"] for row in rows], color="#9db4c9")
    for place, row in enumerate(rows):
        values = [run["psnr"] for run in row["runs"] if run.get("psnr") is not None]
        axes.plot(values, [place] * len(values), "o", color="#1d3a52", markersize=4)
        axes.annotate(
            f"{row['psnr']:.2f}", (min(values), place), (-34, -4), textcoords="offset points"
        )
    axes.set_yticks(range(len(rows)), [row["title"] for row in rows])
    axes.invert_yaxis()
    axes.set_xlim(left=min(row["psnr"] for row in rows) - 3)
    axes.set_xlabel("PSNR (dB), mean of seeds; points: each seed")
    save_figure(path, figure)
