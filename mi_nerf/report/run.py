"""``mi-nerf report``: a folder of tables and plots about one target, or about trainings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError, Option
from ..base.files import check_folder, make_folder, read_json, write_json, write_text
from ..base.machine import machine
from ..data import load_dataset
from ..tasks.tables import markdown_table, save_figure
from ..tasks.target import Target, open_target
from ..training.config import TrainConfig
from . import curves_text, speed_text
from . import profile as step_profile
from .curves import RECORD, training_curves
from .speed import Knobs, sweep
from .speed_plot import plot_speed
from .subject import Subject, open_field, open_subject
from .view_dependence import draw_view_dependence, field_position, find_points, surface_normal

Point = tuple[float, float, float]

TEXT = "report.md"
FIGURE, SPEED_FIGURE, CURVES_FIGURE = "view_dependence.png", "speed.png", "training.png"


def report(
    target: Target | str | Path,
    out: str | Path,
    variant: str,
    points: Sequence[Point] = (),
    *,
    knobs: Knobs | None = None,
    repeats: int = 7,
    profile: bool = True,
    values: Mapping[str, Any] | None = None,
    data: str | Path | None = None,
    on_step: Callable[[], object] | None = None,
    on_render: Callable[[int], object] | None = None,
    **rays: Any,
) -> dict[str, Any]:
    """Writes ``report.json``, ``report.md`` and their plots.

    Args:
        target: a run folder, a field file or the name of a formula.
        points: where to look at the emission over directions; without any, places that the
            run's training cameras see.
        knobs, repeats: what :func:`mi_nerf.report.sweep` tries; without knobs, speed and error
            are left out.
        profile: measure training steps; left out, with the reason, where that is impossible.
        values: parameters of a formula.
        data: the dataset, if it is not that of the run.
        on_step: called after every training step.
        on_render: called after every rendering of the sweep with their number in all.
        rays: further arguments of :func:`mi_nerf.report.open_subject`.

    Returns:
        What ``report.json`` holds: ``conclusions``, ``speed`` (of :func:`sweep`),
        ``view_dependence``, ``step``, and for each why it was left out, if it was.

    Raises:
        InputError: if the target or its images cannot be read, a point lies outside the field
            or where it is even, or ``out`` cannot be written.
    """
    check_folder(out)
    subject = open_field(target, variant, values=values)
    if knobs is not None:
        seen = open_subject(target, variant, values=values, data=data, **rays)
    opened = None if subject.formula else open_target(target)
    places, no_places = _places(opened, subject, points, data)
    speed = None
    if knobs is not None:
        speed = sweep(seen, knobs, repeats=repeats, on_render=on_render)
    folder = make_folder(out)
    record: dict[str, Any] = {
        "target": subject.name,
        "variant": variant,
        "machine": machine(variant),
        "conclusions": [] if speed is None else speed_text.conclusions(speed),
        "speed": speed,
        "speed_left_out": None if knobs is not None else "not asked for",
        "view_dependence": [],
        "view_dependence_left_out": no_places,
        "step": None,
        "step_left_out": None if profile else "not asked for",
    }
    if speed is not None:
        save_figure(folder / SPEED_FIGURE, plot_speed(speed))
    if places is not None:
        record["view_dependence"] = draw_view_dependence(
            folder / FIGURE, subject.field, places, variant
        )
    if profile:
        try:
            if opened is None:
                raise InputError(f"{subject.name}: a formula, which is not trained")
            record["step"] = step_profile.profile_run(opened, variant, on_step)
            step_profile.draw(folder / step_profile.FIGURE, record["step"])
        except InputError as error:
            record["step_left_out"] = str(error)
    write_json(folder / RECORD, record)
    write_text(folder / TEXT, _markdown(record))
    return record


def report_training(
    data: str | Path, out: str | Path, rows: Mapping[str, TrainConfig], variant: str, **options: Any
) -> dict[str, Any]:
    """The same for trainings: :func:`mi_nerf.report.training_curves`, its table and its plot.

    Raises:
        InputError: as that does.
    """
    record = training_curves(data, out, rows, variant, **options)
    folder = Path(out)
    save_figure(folder / CURVES_FIGURE, curves_text.plot_curves(record))
    write_text(folder / TEXT, curves_text.markdown(record, CURVES_FIGURE))
    return record


def load(folder: str | Path) -> dict[str, Any]:
    """The record that ``mi-nerf report`` has written to a folder.

    Of a target it has ``speed``, as :func:`mi_nerf.report.sweep` gives it; of trainings it is
    what :func:`mi_nerf.report.training_curves` gives.

    Raises:
        InputError: if there is none.
    """
    path = Path(folder) / RECORD
    record = read_json(path, "the record of a report")
    if not isinstance(record, dict) or not ("speed" in record or "rows" in record):
        raise InputError(f"{path}: expected the record of a report")
    return record


def _places(
    target: Target | None, subject: Subject, points: Sequence[Point], data: str | Path | None
) -> tuple[np.ndarray[Any, Any] | None, str | None]:
    """``points``, if they are in the field; without any, some that cameras see, or why not."""
    field = subject.field
    for point in points:
        place = field_position(field, np.array(point, np.float64)[:, None])[:, 0]
        if not (np.array(field.lower) <= place).all() or not (place <= field.upper).all():
            raise InputError(
                "{}: outside the field's box {} to {}",
                Option("points", tuple(point)),
                field.lower,
                field.upper,
            )
        surface_normal(field, point, subject.backend)  # there is one
    if len(points):
        return np.array(points, np.float64), None
    folder = data if data is not None or target is None else target.data
    if target is None or folder is None:
        kind = "a formula" if target is None else "a field file, which knows no cameras"
        return None, f"{subject.name} is {kind}: --point says where to look"
    try:
        views = load_dataset(folder, "train", downscale=target.downscale, images=target.images)
        found = find_points(subject.marched, views.intrinsics, views.cam_to_world, subject.backend)
    except InputError as error:
        return None, str(error)
    return found, None


# ---- report.md -------------------------------------------------------------------


def _markdown(record: dict[str, Any]) -> list[str]:
    lines = [f"# Report on {record['target']}", ""]
    lines += [f"- {sentence}" for sentence in record["conclusions"]]
    for key, title, section in (
        ("speed", "Speed against error", partial(speed_text.markdown, figure=SPEED_FIGURE)),
        ("view_dependence", "View dependence", _view_dependence),
        ("step", "Where a step's time goes", step_profile.markdown),
    ):
        left_out = [f"Left out: {record[f'{key}_left_out']}."]
        lines += ["", f"## {title}", "", *(section(record[key]) if record[key] else left_out)]
    return lines


def _view_dependence(entries: list[dict[str, Any]]) -> list[str]:
    rows = []
    for entry in entries:
        cells = [", ".join(f"{v:.2f}" for v in entry[k]) for k in ("point", "normal", "color")]
        rows.append([*cells, f"{entry['deviation']:.3f}"])
    return [
        "Colour that leaves a point towards every direction of the hemisphere around its normal,",
        "seen from above (NeRF, Fig. 3). The deviation is the root mean square over directions of",
        "display values; 0 means that the point looks the same from everywhere.",
        "",
        f"![Emission over directions]({FIGURE})",
        "",
        *markdown_table(("point", "normal", "mean colour", "deviation"), rows),
    ]
