"""``mi-nerf report``: a folder of tables and plots about one target."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..backend import array_module
from ..data import load_dataset
from ..errors import InputError
from ..field import Field
from ..files import make_folder, replacing, write_json
from ..occupancy import OccupancyGrid
from ..target import Target
from . import profile as step_profile
from .view_dependence import draw_view_dependence, field_position, find_points

Point = tuple[float, float, float]

FIGURE = "view_dependence.png"


def report(
    target: Target,
    out: str | Path,
    variant: str,
    points: Sequence[Point] = (),
    *,
    profile: bool = True,
    on_step: Callable[[], object] | None = None,
) -> dict[str, Any]:
    """Writes ``report.json``, ``report.md`` and their plots.

    Args:
        points: where to look at the emission over directions; without any, places that the
            run's training cameras see.
        profile: measure training steps; left out, with the reason, where that is impossible.
        on_step: called after every training step.

    Returns:
        What ``report.json`` holds.

    Raises:
        InputError: if a point lies outside the field or where it is even.
    """
    field, occupancy = target.contents.build(array_module(variant))
    chosen = _places(target, field, occupancy, points, variant)
    folder = make_folder(out)
    record: dict[str, Any] = {
        "target": str(target.path),
        "variant": variant,
        "view_dependence": draw_view_dependence(folder / FIGURE, field, chosen, variant),
        "step": None,
        "step_left_out": None if profile else "not asked for",
    }
    if profile:
        try:
            record["step"] = step_profile.profile_run(target, variant, on_step)
            step_profile.draw(folder / step_profile.FIGURE, record["step"])
        except InputError as error:
            record["step_left_out"] = str(error)
    write_json(folder / "report.json", record)
    with replacing(folder / "report.md") as temporary:
        temporary.write_text(_markdown(record))
    return record


def _places(
    target: Target,
    field: Field,
    occupancy: OccupancyGrid | None,
    points: Sequence[Point],
    variant: str,
) -> np.ndarray[Any, Any]:
    """``points``, if they are in the field; without any, some that cameras see."""
    for point in points:
        place = field_position(field, np.array(point, np.float64)[:, None])[:, 0]
        if not (np.array(field.lower) <= place).all() or not (place <= field.upper).all():
            raise InputError(
                f"--point {' '.join(map(str, point))}: outside the field's box "
                f"{field.lower} to {field.upper}"
            )
    if len(points):
        return np.array(points, np.float64)
    if target.data is None:
        raise InputError(f"{target.path}: a field file knows no cameras, expected --point")
    views = load_dataset(target.data, "train", downscale=target.downscale)
    camera, poses, march = views.intrinsics, views.cam_to_world, target.contents.march
    return find_points(field, occupancy, camera, poses, march, array_module(variant))


def _markdown(record: dict[str, Any]) -> str:
    lines = [
        f"# Report on {record['target']}",
        "",
        "## View dependence",
        "",
        "Colour that leaves a point towards every direction of the hemisphere around its normal,",
        "seen from above (NeRF, Fig. 3). The deviation is the root mean square over directions of",
        "display values; 0 means that the point looks the same from everywhere.",
        "",
        f"![Emission over directions]({FIGURE})",
        "",
        "| point | normal | mean colour | deviation |",
        "|---|---|---|---|",
    ]
    for entry in record["view_dependence"]:
        cells = [", ".join(f"{v:.2f}" for v in entry[k]) for k in ("point", "normal", "color")]
        lines.append(f"| {' | '.join(cells)} | {entry['deviation']:.3f} |")
    lines += ["", "## Where a step's time goes", ""]
    if record["step"] is None:
        lines.append(f"Left out: {record['step_left_out']}.")
    else:
        lines += step_profile.markdown(record["step"])
    return "\n".join(lines) + "\n"
