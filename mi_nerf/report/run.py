"""``mi-nerf report``: a folder of tables and plots about one target."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..backend import array_module
from ..data import load_dataset
from ..errors import InputError
from ..files import make_folder, replacing, write_json
from ..target import Target
from .view_dependence import draw_view_dependence, field_position, find_points

Point = tuple[float, float, float]

FIGURE = "view_dependence.png"


def report(
    target: Target, out: str | Path, variant: str, points: Sequence[Point] = ()
) -> dict[str, Any]:
    """Writes ``report.json``, ``report.md`` and their plots.

    Args:
        points: where to look at the emission over directions; without any, places that the
            run's training cameras see.

    Returns:
        What ``report.json`` holds.

    Raises:
        InputError: if a point lies outside the field or where it is even.
    """
    backend = array_module(variant)
    field, occupancy = target.contents.build(backend)
    for point in points:
        place = field_position(field, np.array(point, np.float64)[:, None])[:, 0]
        if not (np.array(field.lower) <= place).all() or not (place <= field.upper).all():
            raise InputError(
                f"--point {' '.join(map(str, point))}: outside the field's box "
                f"{field.lower} to {field.upper}"
            )
    chosen = np.array(points, np.float64)
    if not len(points):
        if target.data is None:
            raise InputError(f"{target.path}: a field file knows no cameras, expected --point")
        views = load_dataset(target.data, "train", downscale=target.downscale)
        march = target.contents.march
        chosen = find_points(field, occupancy, views.intrinsics, views.cam_to_world, march, backend)
    folder = make_folder(out)
    record = {
        "target": str(target.path),
        "variant": variant,
        "view_dependence": draw_view_dependence(folder / FIGURE, field, chosen, variant),
    }
    write_json(folder / "report.json", record)
    with replacing(folder / "report.md") as temporary:
        temporary.write_text(_markdown(record))
    return record


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
    return "\n".join(lines) + "\n"
