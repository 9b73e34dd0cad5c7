"""Error against milliseconds, one curve a rule."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..base.machine import machine_line
from ..tasks.tables import time_axis
from .speed_text import WORDS

Record = dict[str, Any]
Value = Callable[[dict[str, Any]], float | None]

_RULES = {  # colour, line, width: wider below narrower, where they coincide
    "constant": ("#1b6ca8", "-", 2.6),
    "cells": ("#f4a259", "--", 1.3),
    "linear": ("#4c9f50", "-", 1.3),
}
_KNOBS = {  # marker, colour, what it is
    "split": ("P", "#7b3294", "other splits into coarse and fine"),
    "stop": ("v", "#b2182b", "other early termination"),
    "resolution": ("s", "#8c6d31", "grid of another resolution"),
    "threshold": ("D", "#c05fa8", "grid of another threshold"),
}
_NOTE: dict[str, Any] = {"textcoords": "offset points", "fontsize": 8}


def plot_speed(record: Record) -> Any:
    """A matplotlib figure of a record of :func:`mi_nerf.report.sweep`.

    Left, the quadrature error of the colour against time; right, the PSNR if there are images,
    else the error of the depth. Curves run over samples a ray.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.5, 5.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    reference = record["reference"]
    _panel(left, record, lambda p: p["error"]["color"])
    _known(left, reference["error"]["color"])
    left.set_ylabel(f"quadrature error of the colour\nroot mean square, {record['unit']}")
    if reference["psnr"] is not None:
        _panel(right, record, lambda p: p["psnr"], named=False)
        _model(right, reference["psnr"])
        right.set_ylabel("PSNR against the images (dB)")
    else:
        _panel(right, record, lambda p: p["error"]["depth"])
        _known(right, reference["error"]["depth"])
        right.set_ylabel("quadrature error of the depth\nroot mean square, scene units")
    for axes in (left, right):
        time_axis(axes, f"milliseconds for {record['rays']:,} rays")
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=9)
    figure.suptitle(
        f"{record['field']}: error against time of rendering. Numbers along the curves: samples "
        f"a ray.\n{machine_line(record['machine'])}; median of {record['repeats']}",
        fontsize=10,
    )
    return figure


def _panel(axes: Any, record: Record, value: Value, *, named: bool = True) -> None:
    """Curves of the rules, marks of the other knobs, rings around the Pareto front."""
    points = [p for p in record["points"] if value(p) is not None]
    own = [p for p in points if "own" in p["knobs"]]
    for rule, (color, line, width) in _RULES.items():
        curve = [p for p in points if p["rule"] == rule and "samples" in p["knobs"]]
        curve.sort(key=lambda p: p["samples"])
        style: dict[str, Any] = {"color": color, "lw": width, "marker": "o", "ms": 4}
        if curve:
            axes.plot(*_places(curve, value), line, label=f"rule {rule}", **style)
        if named and rule == record["points"][0]["rule"]:
            for point in curve:
                fine = f"+{point['fine']}" if point["fine"] else ""
                text, place = f"{point['samples']}{fine}", (point["milliseconds"], value(point))
                axes.annotate(text, place, (-4, -11), color=color, ha="right", **_NOTE)
    for knob, (marker, color, label) in _KNOBS.items():
        some = [p for p in points if knob in p["knobs"] and "own" not in p["knobs"]]
        if some:
            style = {"color": color, "ms": 6, "alpha": 0.8, "ls": ""}
            axes.plot(*_places(some, value), marker, label=label, **style)
    axes.plot(*_places(own, value), "*", color="k", ms=13, zorder=5, ls="", label="own settings")
    front = [p for p in points if p["pareto"]]
    rings: dict[str, Any] = {"mfc": "none", "mec": "k", "ms": 12, "ls": ""}
    label = f"Pareto front by {WORDS[record['by']]}: no other as fast and exact"
    axes.plot(*_places(front, value), "o", label=label, **rings)


def _places(points: list[dict[str, Any]], value: Value) -> tuple[list[float], list[Any]]:
    return [p["milliseconds"] for p in points], [value(p) for p in points]


def _known(axes: Any, floor: float | None) -> None:
    """Makes an axis of errors, and shades what the reference cannot tell."""
    axes.set_yscale("log")
    bottom, top = axes.get_ylim()
    if floor is None or floor <= bottom:
        return
    axes.axhspan(bottom, floor, color="#eeeeee", zorder=0)
    if floor > 2 * bottom:  # else there is no room for words
        text, axis = "below what the reference states as its own error", ("axes fraction", "data")
        axes.annotate(text, (0.01, floor), (0, -11), xycoords=axis, color="#666666", **_NOTE)
    axes.set_ylim(bottom, top)


def _model(axes: Any, psnr: float) -> None:
    """Marks what the field would reach with perfect quadrature."""
    label = f"perfect quadrature: {psnr:.2f} dB, the model error alone"
    line = axes.axhline(psnr, color="k", lw=0.9, ls=(0, (6, 3)), zorder=1)
    axes.legend([line], [label], loc="lower right", fontsize=9)
