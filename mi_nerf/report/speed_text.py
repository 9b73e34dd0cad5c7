"""What a sweep says, in words and tables."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from ..base.errors import InputError
from ..base.machine import machine_line
from ..tasks.tables import markdown_table

Record = dict[str, Any]
Point = dict[str, Any]

_NOTHING = 0.05  # dB that nobody sees
_BUDGET = 0.1  # dB, and for formulas a share of the largest radiance: what may be given up
WORDS = {"color": "colour", "depth": "depth"}
_FINE = 1e-3  # a quarter of an 8-bit step


def choose(
    record: Record, *, milliseconds: float | None = None, error: float | None = None
) -> Point:
    """The most exact point within a time, or the fastest one within an error.

    Args:
        record: of :func:`mi_nerf.report.sweep`.
        milliseconds: for all ``record["rays"]`` rays.
        error: root mean square quadrature error, of what ``record["by"]`` says.

    Raises:
        ValueError: unless just one of both limits is given.
        InputError: if no point keeps within it; the message says what the least is.
    """
    points = record["points"]
    if milliseconds is not None and error is None:
        within = [p for p in points if p["milliseconds"] <= milliseconds]
        if not within:
            least = min(p["milliseconds"] for p in points)
            raise InputError(f"{milliseconds:g} ms: expected at least {least:.3g} ms")
        return min(within, key=lambda p: (_error(record, p), p["milliseconds"]))
    if error is None or milliseconds is not None:
        raise ValueError("expected either milliseconds or error")
    within = [p for p in points if _error(record, p) <= error]
    if not within:
        least = min(_error(record, p) for p in points)
        raise InputError(f"error {error:g}: expected at least {least:.2g}")
    return min(within, key=lambda p: p["milliseconds"])


def describe(point: Point) -> str:
    """The settings of a point in words."""
    fine = f" + {point['fine']}" if point["fine"] else ""
    parts = [f"{point['samples']}{fine} samples", f"`{point['rule']}`", f"stop {point['stop']:g}"]
    if point["grid"] is not None:
        resolution, threshold = (point["grid"][k] for k in ("resolution", "threshold"))
        parts.append(f"grid of {resolution}, threshold {threshold:g}")
    return ", ".join(parts)


def conclusions(record: Record) -> list[str]:
    """What follows, a sentence or two each, computed from the record alone."""
    own = record["points"][0]
    start = (
        f"At its own settings ({describe(own)}) {record['rays']:,} rays take "
        f"{own['milliseconds']:.3g} ms and {own['queries_per_ray']:.1f} queries a ray; "
        f"the quadrature error is {_color(own):.1e} ({record['unit']}, root mean square)"
    )
    if record["reference"]["psnr"] is None or own["psnr"] is None:
        result = [start + _depth(own) + "."]
    else:
        best, there = record["reference"]["psnr"], own["psnr"]
        result = [
            start + ".",
            f"Against the images that is {there:.2f} dB. With perfect quadrature the same field "
            f"has {best:.2f} dB, the model error alone: quadrature "
            + (
                f"costs {best - there:.2f} dB."
                if best - there >= 0.01
                else "costs nothing (less than 0.01 dB)."
            ),
        ]
    return [*result, *_more_and_fewer(record), *_fastest(record), *_rules(record)]


def _error(record: Record, point: Point) -> float:
    """The error that counts."""
    return float(point["error"][record["by"]])


def _color(point: Point) -> float:
    return float(point["error"]["color"])


def _depth(point: Point) -> str:
    depth = point["error"]["depth"]
    return "" if depth is None else f", that of the depth {depth:.1e} scene units"


def _of_samples(record: Record, rule: str) -> list[Point]:
    """The sweep over samples with a rule, ascending."""
    points = [p for p in record["points"] if "samples" in p["knobs"] and p["rule"] == rule]
    return sorted(points, key=lambda p: p["samples"])


def _more_and_fewer(record: Record) -> list[str]:
    """What the most samples are worth, and how error goes with time."""
    own = record["points"][0]
    line = _of_samples(record, own["rule"])
    if len(line) < 2:
        return []
    result = []
    most = line[-1]
    if most is not own and own["psnr"] is not None and most["psnr"] is not None:
        gain = most["psnr"] - own["psnr"]
        verdict = "buy nothing" if abs(gain) < _NOTHING else f"change it by {gain:+.2f} dB"
        result.append(
            f"More samples {verdict}: {most['samples']} a ray take "
            f"{most['milliseconds'] / own['milliseconds']:.1f} times as long for "
            f"{most['psnr']:.2f} dB."
        )
    known = [p for p in line if _error(record, p) > record["reference"]["error"][record["by"]]]
    if len(known) > 1:
        first, last = known[0], known[-1]
        before, after = (_error(record, p) for p in (first, last))
        order = math.log(before / after) / math.log(last["samples"] / first["samples"])
        result.append(
            f"From {first['samples']} to {last['samples']} samples the error of the "
            f"{WORDS[record['by']]} falls from {before:.1e} to {after:.1e}, as samples to the "
            f"power of {-order:.1f}; the time grows from "
            f"{first['milliseconds']:.3g} to {last['milliseconds']:.3g} ms."
        )
    return result


def _fastest(record: Record) -> list[str]:
    """The fastest point that gives up next to nothing."""
    best, word = record["reference"]["psnr"], WORDS[record["by"]]
    if best is None:
        try:
            point = choose(record, error=_FINE)
        except InputError:
            return [f"No setting has an error of the {word} below {_FINE:g}."]
        what = f"with an error of the {word} below {_FINE:g}"
    else:
        good = [p for p in record["points"] if (p["psnr"] or 0) >= best - _BUDGET]
        if not good:
            return [f"No setting comes within {_BUDGET} dB of perfect quadrature."]
        point = min(good, key=lambda p: p["milliseconds"])
        what = f"within {_BUDGET} dB of perfect quadrature"
    return [f"The fastest {what}: {describe(point)}, {point['milliseconds']:.3g} ms."]


def _rules(record: Record) -> list[str]:
    """Other rules against the own one, at equal samples."""
    own, word = record["points"][0]["rule"], WORDS[record["by"]]
    line = {p["samples"]: p for p in _of_samples(record, own)}
    names = {p["rule"] for p in record["points"]} - {own}
    result = []
    for rule in sorted(names):
        pairs = [
            (_error(record, p), _error(record, line[p["samples"]]))
            for p in _of_samples(record, rule)
            if p["samples"] in line
        ]
        ratios = [a / b for a, b in pairs if a and b]
        if not ratios:
            continue
        if max(abs(r - 1) for r in ratios) < 0.02:
            result.append(
                f"At equal samples `{rule}` and `{own}` err alike (by the {word}, within 2 %)."
            )
        else:
            result.append(
                f"At equal samples `{rule}` has {min(ratios):.2f} to {max(ratios):.2f} times the "
                f"error of `{own}` (by the {word})."
            )
    return result


# ---- report.md -------------------------------------------------------------------

_TITLES = {
    "front": "What time buys: the Pareto front, and the own settings",
    "samples": "Samples a ray, by rule",
    "rule": "Rule",
    "split": "Coarse and fine samples, at equal queries",
    "stop": "Early termination: transmittance at which a ray ends",
    "resolution": "Resolution of the occupancy grid",
    "threshold": "Threshold of the occupancy grid: optical thickness of an empty cell",
}


def markdown(record: Record, figure: str) -> list[str]:
    """The section of ``report.md`` about a record of :func:`mi_nerf.report.sweep`."""
    lines = [
        f"![Error against time]({figure})",
        "",
        f"{record['rays']:,} rays {_origin(record)}, seed {record['views']['seed']}; "
        f"{machine_line(record['machine'])}. Times are of all these rays, the median of "
        f"{record['repeats']} renderings after a first one that compiled, with the fastest and "
        f"slowest in brackets. **Bold**: on the Pareto front, no other setting is as fast and as "
        f"exact, by the error of the {WORDS[record['by']]}.",
    ]
    for knob, title in _TITLES.items():
        points = _sorted_points(record, knob)
        if points:
            lines += ["", f"### {title}", "", *_table(record, points)]
    return [*lines, "", *_how_to_read(record)]


def _origin(record: Record) -> str:
    views = record["views"]
    size = f"{views['views']} views of {views['size'][0]}x{views['size'][1]} pixels"
    if views["data"] is None:
        return f"of {size} on a circle around the box"
    return f"of {size} (split {views['split']} of {views['data']})"


def _sorted_points(record: Record, knob: str) -> list[Point]:
    """The points of one table, in the order of what it is about."""
    points, rules = record["points"], [p["rule"] for p in record["points"]]
    if knob == "front":
        front = [p for p in points if p["pareto"] or "own" in p["knobs"]]
        return sorted(front, key=lambda p: p["milliseconds"])
    keys: dict[str, Callable[[Point], Any]] = {
        "samples": lambda p: (rules.index(p["rule"]), p["samples"]),
        "rule": lambda p: rules.index(p["rule"]),
        "split": lambda p: p["samples"],
        "stop": lambda p: p["stop"],
        "resolution": lambda p: p["grid"]["resolution"],
        "threshold": lambda p: p["grid"]["threshold"],
    }
    return sorted((p for p in points if knob in p["knobs"]), key=keys[knob])


def _table(record: Record, points: list[Point]) -> list[str]:
    images = record["reference"]["psnr"] is not None
    depth = record["reference"]["error"]["depth"] is not None
    head = ["setting", "ms", "queries/ray", "colour error"]
    head += ["depth error"] * depth + ["PSNR (dB)"] * images
    rows = []
    for point in points:
        cells = [
            describe(point) + (" (own)" if "own" in point["knobs"] else ""),
            f"{point['milliseconds']:.3g} ({point['fastest']:.3g} – {point['slowest']:.3g})",
            f"{point['queries_per_ray']:.1f}",
            f"{_color(point):.1e}",
        ]
        if depth:
            cells.append(f"{point['error']['depth']:.1e}")
        if images:
            cells.append("∞" if point["psnr"] is None else f"{point['psnr']:.2f}")
        if point["pareto"]:
            cells[:2] = [f"**{cell}**" for cell in cells[:2]]
        rows.append(cells)
    return markdown_table(head, rows)


def _how_to_read(record: Record) -> list[str]:
    reference, own = record["reference"], record["own_grid"]
    stated = reference["error"]["color"]
    behind = (
        f"behind its own grid of {'x'.join(map(str, own))} cells"
        if own is not None
        else "everywhere in its box"
    )
    lines = [
        "Errors are root mean squares over rays (and channels) of the difference to a reference: "
        f"the same field, {behind}, marched in double precision with up to "
        f"{reference['max_intervals']} intervals a ray. The reference states an error of its own "
        f"of at most {stated:.1e}; smaller differences say little. Colours are {record['unit']}"
        + (
            "."
            if record["formula"]
            else ", on white. PSNR is of all pixels together, in 8 bits, not the mean over images."
        )
        + " Depths count where the reference is more than half opaque, in scene units.",
    ]
    if all(p["rule"] != "cells" for p in record["points"]):
        lines += [
            "",
            "Without jitter the rule `cells` is `constant`: a sample's cell is its stratum.",
        ]
    if any(p["grid"] for p in record["points"]):
        lines += [
            "",
            "Grids of other resolutions and thresholds are made by looking at random points of "
            "every cell"
            + (
                " that the own grid keeps, as outside of it the field was never trained. Their "
                "error is against the field behind the own grid: a stricter threshold takes "
                "something away; a coarser grid lets in what lies beside."
                if own is not None
                else ". Their error is against the whole field: what they miss is missing."
            ),
        ]
    return lines
