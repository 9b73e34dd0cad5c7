"""Writes the tables of README.md and docs from the figures in docs/results.

    python -m tests.benchmarks.tables
    python -m tests.benchmarks.tables --check

A table stands between two comments. The first names its files and has a line for each column,
a heading and what its cells say::

    <!-- figures: quality
    preset = `{preset}`
    PSNR = {psnr} ({psnr.range})
    -->
    …
    <!-- end -->

In braces stands a label of the row, ``command``, ``date``, or a figure, which brings its unit
along; ``{psnr.range}`` is its least and greatest measurement, ``{psnr:.1f}`` sets its digits,
and ``{all}`` lists all figures by their names. A line ``only preset = fast`` leaves other rows out.
Rows measured with another engine than the present sources are marked, or the whole table is.
"""

from __future__ import annotations

import argparse
import difflib
import math
import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from mi_nerf.base.errors import InputError
from mi_nerf.base.files import write_text
from tests.benchmarks.results import RESULTS, ROOT, Figure, Record, load

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"<!-- figures: (?P<head>.*?)-->\n(?P<body>.*?)<!-- end -->", re.DOTALL)
OLDER = "†"

_FIELD = re.compile(r"\{(\w+)(?:\.(\w+))?(?::([^}]+))?\}")


def main() -> None:
    """Rewrites the tables, or says which are out of date."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="write nothing, fail if they differ")
    options = parser.parse_args()
    different = False
    for page in PAGES:
        before, after = page.read_text(), written(page.read_text())
        if before == after:
            continue
        different = True
        if options.check:
            lines = (before.splitlines(), after.splitlines())
            print("\n".join(difflib.unified_diff(*lines, page.name, "figures", lineterm="")))
        else:
            write_text(page, after.splitlines())
            print(f"{page.name} written")
    if different and options.check:
        sys.exit(1)


def written(text: str, results: Path = RESULTS) -> str:
    """A page with its tables as the files say."""
    return BLOCK.sub(lambda block: _block(block["head"], results), text)


def files_of(text: str) -> list[str]:
    """The names of the files that the tables of a page are made from."""
    return [name for block in BLOCK.finditer(text) for name in _layout(block["head"]).files]


@dataclass(frozen=True)
class Layout:
    """What a table shows."""

    files: list[str]
    columns: list[tuple[str, str]]  # heading, and template of the cells
    only: list[tuple[str, str]]  # labels that rows must have


def _layout(head: str) -> Layout:
    names, *lines = head.strip().splitlines()
    columns, only = [], []
    for line in lines:
        name, equals, value = (part.strip() for part in line.partition(" = "))
        if not equals:
            raise InputError("figures: {!r}: expected lines such as 'heading = cell'", line)
        if name.startswith("only "):
            only.append((name.removeprefix("only "), value))
        else:
            columns.append((name, value))
    return Layout([name.strip() for name in names.split(",")], columns, only)


def _records(file: Path) -> list[Record]:
    """The rows of a file; none if nobody has measured them yet."""
    return load(file) if file.exists() else []


def _block(head: str, results: Path) -> str:
    layout = _layout(head)
    records = [
        record
        for name in layout.files
        for record in _records(results / f"{name}.json")
        if all(record.row.labels.get(key) == value for key, value in layout.only)
    ]
    lines = [f"| {' | '.join(heading for heading, _ in layout.columns)} |"]
    lines.append("|" + "---|" * len(layout.columns))
    mixed = len({record.origin.current() for record in records}) > 1
    for record in records:
        first, *rest = (cell(record, template) for _, template in layout.columns)
        mark = f" {OLDER}" if mixed and not record.origin.current() else ""
        lines.append(f"| {' | '.join([first + mark, *rest])} |")
    table = "\n".join([*lines, "", caption(records)])
    return f"<!-- figures: {head}-->\n{table}\n<!-- end -->"


def cell(record: Record, template: str) -> str:
    """A template with a row's words and figures; a dash for what the row does not have."""

    def replaced(field: re.Match[str]) -> str:
        name, part, digits = field.groups()
        figure = record.row.figures.get(name)
        if figure is not None:
            return spread_text(figure, digits) if part == "range" else text(figure, digits)
        if name == "all":
            return ", ".join(f"{key}: {text(f)}" for key, f in record.row.figures.items())
        words = {**record.row.labels, "command": record.origin.command, "date": record.origin.date}
        return words.get(name, "–")

    return _FIELD.sub(replaced, template)


def caption(records: Sequence[Record]) -> str:
    """When and on what the rows were measured."""
    if not records:
        return "<sub>Not measured yet</sub>"
    dates = sorted({record.origin.date for record in records})
    when = " to ".join(dict.fromkeys([dates[0], dates[-1]]))
    where = "; ".join(dict.fromkeys(_machine(record) for record in records))
    current = [record.origin.current() for record in records]
    note = f". {OLDER}: by an older engine" if any(current) else ". All by an older engine"
    return f"<sub>{when}, {where}{'' if all(current) else note}</sub>"


def _machine(record: Record) -> str:
    machine = record.origin.machine
    device = machine.get("gpu") or f"{machine['cores']} cores of {machine['processor']}"
    return f"{device}, {machine['variant']}"


def text(figure: Figure, digits: str | None = None) -> str:
    """A figure with its unit."""
    return _with_unit([figure.value], figure.unit, digits)


def spread_text(figure: Figure, digits: str | None = None) -> str:
    """The range of a figure with its unit; a dash if there was one measurement."""
    return "–" if figure.spread is None else _with_unit(figure.spread, figure.unit, digits)


def _with_unit(values: Iterable[float], unit: str, digits: str | None) -> str:
    number = " – ".join(_number(value, unit, digits) for value in values)
    return f"{number} {unit}" if unit else number


def _number(value: float, unit: str, digits: str | None) -> str:
    if not math.isfinite(value):
        return "NaN" if math.isnan(value) else "∞" if value > 0 else "−∞"
    if digits is not None:
        shown = f"{value:{digits}}"
    elif unit == "dB":
        shown = f"{value:.2f}"
    elif abs(value) >= 100 or value == int(value):
        shown = f"{value:,.0f}"
    else:
        shown = f"{value:.3g}"
    return shown.replace("-", "−") if shown.startswith("-") else shown


if __name__ == "__main__":
    main()
