"""Results for people: tables in Markdown, and the files of figures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from ..base.files import replacing


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """The lines of a table, each row as many cells as the head has."""
    first, *others = (f"| {' | '.join(cells)} |" for cells in (head, *rows))
    return [first, "|" + "---|" * len(head), *others]


def number(value: float | None, form: str) -> str:
    """A cell with a number in a format, or with ``n/a``."""
    return "n/a" if value is None else format(value, form)


def spread(values: Sequence[float], form: str = ".2f") -> str:
    """From the least of several values to the greatest; empty of a single one."""
    return f"{min(values):{form}} to {max(values):{form}}" if len(values) > 1 else ""


def save_figure(path: Path, figure: Any) -> None:
    """Writes a matplotlib figure as PNG."""
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=150)


def time_axis(axes: Any, label: str) -> None:
    """Makes x an axis of times, logarithmic with plain numbers, on a grid of grey lines."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel(label)
    axes.grid(which="major", color="#dddddd", lw=0.6)
    axes.set_axisbelow(True)
