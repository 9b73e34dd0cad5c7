"""Figures as files: what a benchmark found, and where, when and with which engine.

A benchmark ends with :func:`save`, which writes ``docs/results/NAME.json``; a row that it has
measured again takes the place of the older one with the same labels. ``tests.benchmarks.tables``
writes the tables of the documents from these files.

The *engine* of a row is a digest of the sources that its figures depend on, without comments,
docstrings and layout. It needs no history of versions; a row whose digest is not that of the
present sources is out of date. Figures older than this scheme have none.
"""

from __future__ import annotations

import argparse
import ast
import functools
import hashlib
import json
import math
import platform
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerf.base.errors import InputError
from mi_nerf.base.files import make_folder, read_json, write_text
from mi_nerf.base.machine import available_memory, machine

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results"
FORMAT = "mi_nerf.result"

# What figures depend on: files and folders below mi_nerf.
TRAINING = ("cameras", "data", "fields", "march", "training")
RENDERING = ("cameras", "fields", "march", "plugins")
QUADRATURE = ("fields", "march")
GENERATION = ("cameras", "generation", "images", "scene_xml")
REPORT = (*TRAINING, "estimators", "report")


@dataclass(frozen=True)
class Figure:
    """A number with its unit, and the least and greatest of the measurements behind it."""

    value: float
    unit: str = ""
    spread: tuple[float, float] | None = None


def mean_of(values: Sequence[float], unit: str = "") -> Figure:
    """The mean, with its range where there are several."""
    return Figure(float(np.mean(values)), unit, _range(values))


def median_of(values: Sequence[float], unit: str = "") -> Figure:
    """The median, with its range where there are several."""
    return Figure(float(np.median(values)), unit, _range(values))


def _range(values: Sequence[float]) -> tuple[float, float] | None:
    return (float(min(values)), float(max(values))) if len(values) > 1 else None


@dataclass(frozen=True)
class Protocol:
    """Which images a quality is measured on, and how."""

    dataset: str
    split: str
    views: int
    resolution: tuple[int, int]  # pixels, width and height
    background: str = "white"
    metric: str = "nerf2020"


@dataclass(frozen=True)
class Row:
    """What one measurement found; the labels, words for the tables, tell it from others."""

    labels: Mapping[str, str]
    figures: Mapping[str, Figure]
    protocol: Protocol | None = None
    seeds: tuple[int, ...] = ()


@dataclass(frozen=True)
class Origin:
    """Where the figures of a row come from."""

    command: str
    date: str  # year-month-day
    machine: Mapping[str, Any]
    commit: str | None  # of the checkout; none where there is no history
    parts: tuple[str, ...]  # of the engine, below mi_nerf
    engine: str | None  # their digest; none for figures older than digests

    def current(self) -> bool:
        """Whether the sources that the figures depend on are those measured."""
        return self.engine is not None and self.engine == _present(self.parts)


@dataclass(frozen=True)
class Record:
    """A row of a file."""

    row: Row
    origin: Origin


# ---- Engines ------------------------------------------------------------------


@functools.cache
def _present(parts: tuple[str, ...]) -> str:
    """The digest of this checkout, whose sources do not change while a program runs."""
    return digest(parts)


def digest(parts: Iterable[str], package: Path = ROOT / "mi_nerf") -> str:
    """Of the code of files and folders; comments, docstrings and layout do not count."""
    found = hashlib.sha256()
    for file in _sources(parts, package):
        found.update(file.relative_to(package).as_posix().encode())
        for token in _tokens(ast.parse(file.read_text())):
            found.update(f"{token}\n".encode())
    return found.hexdigest()[:16]


def _sources(parts: Iterable[str], package: Path) -> list[Path]:
    files: set[Path] = set()
    for part in parts:
        path = package / part
        files.update([path] if path.suffix == ".py" and path.exists() else path.rglob("*.py"))
    return sorted(files)


def _tokens(node: Any) -> Iterator[str]:
    """A syntax tree as a sequence of words that is the same in every version of Python."""
    if isinstance(node, ast.AST):
        yield type(node).__name__
        for name, value in ast.iter_fields(node):
            if name == "body" and isinstance(value, list) and _documented(value):
                value = value[1:]
            # Newer versions have more fields, which are empty for the code of older ones.
            if value is not None and value != [] and name not in ("kind", "type_comment"):
                yield name
                yield from _tokens(value)
    elif isinstance(node, list):
        yield str(len(node))
        for item in node:
            yield from _tokens(item)
    else:
        yield repr(node)


def _documented(body: list[Any]) -> bool:
    first = body[0] if body else None
    text = first.value if isinstance(first, ast.Expr) else None
    return isinstance(text, ast.Constant) and isinstance(text.value, str)


# ---- Files --------------------------------------------------------------------


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of every benchmark."""
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the figures")
    parser.add_argument("--no-write", action="store_true", help="print the figures only")


def save(
    name: str,
    rows: Sequence[Row],
    options: argparse.Namespace,
    variant: str,
    parts: tuple[str, ...],
    *,
    whole: bool = False,
    command: str | None = None,
    checkout: Path = ROOT,
) -> None:
    """Writes rows to ``NAME.json``, unless the options say not to.

    Args:
        parts: what the figures depend on, such as :data:`TRAINING`.
        whole: these are all rows of the file: older ones with other labels go.
        command: that has measured them; default: the one that was typed.
        checkout: whose engine was measured.

    Raises:
        InputError: if there is no such part, or the file cannot be read or written.
    """
    for part in parts:
        if not (ROOT / "mi_nerf" / part).exists():
            raise InputError("{}: expected a file or folder of mi_nerf", part)
    if options.no_write:
        return
    file = make_folder(options.results) / f"{name}.json"
    origin = Origin(
        command or typed(),
        _today(),
        _machine(variant),
        commit(checkout),
        parts,
        digest(parts, checkout / "mi_nerf"),
    )
    kept = load(file) if file.exists() and not whole else []
    records = {_key(record.row): record for record in kept}
    records.update({_key(row): Record(row, origin) for row in rows})
    write(file, list(records.values()))
    print(f"written: {file.name}; python -m tests.benchmarks.tables takes it to the documents")


def write(file: Path, records: Sequence[Record]) -> None:
    """Writes a whole file, atomically: a row a line; rows of one origin share it."""
    origins: list[Origin] = []
    for record in records:
        if record.origin not in origins:
            origins.append(record.origin)
    rows = [{**_rounded(asdict(r.row)), "origin": origins.index(r.origin)} for r in records]
    sections = {"origins": [asdict(o) for o in origins], "rows": rows}
    lines = ["{", f'"format": {json.dumps(FORMAT)},']
    for name, section in sections.items():
        lines += [
            f'"{name}": [',
            ",\n".join(json.dumps(item, ensure_ascii=False) for item in section),
        ]
        lines += ["]," if name == "origins" else "]"]
    write_text(file, [*lines, "}"])


def load(file: Path) -> list[Record]:
    """The rows of a file.

    Raises:
        InputError: if a field is missing, unknown or of the wrong kind.
    """
    content = read_json(file, "figures")
    try:
        if content["format"] != FORMAT:
            raise ValueError(f"format {content['format']}")
        origins = [_origin(values) for values in content["origins"]]
        records = [Record(_row(dict(v)), origins[v["origin"]]) for v in content["rows"]]
        if not records or len({_key(record.row) for record in records}) < len(records):
            raise ValueError("no rows, or two with the same labels")
    except (AttributeError, KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError("{}: expected a complete file of figures: {}", file, error) from error
    return records


def _origin(values: dict[str, Any]) -> Origin:
    origin = Origin(**{**values, "parts": tuple(values["parts"])})
    datetime.strptime(origin.date, "%Y-%m-%d")
    if not origin.command or not {"processor", "cores", "variant"} <= set(origin.machine):
        raise ValueError("an origin needs a command and a machine")
    return origin


def _row(values: dict[str, Any]) -> Row:
    del values["origin"]
    figures = {name: _figure(figure) for name, figure in values.pop("figures").items()}
    protocol, seeds = values.pop("protocol"), tuple(values.pop("seeds"))
    if protocol is not None:
        width, height = protocol["resolution"]
        protocol = Protocol(**{**protocol, "resolution": (width, height)})
    row = Row(figures=figures, protocol=protocol, seeds=seeds, **values)
    if not figures or not row.labels:
        raise ValueError("a row needs labels and figures")
    return row


def _figure(values: dict[str, Any]) -> Figure:
    figure = Figure(**values)
    spread = None if figure.spread is None else (figure.spread[0], figure.spread[1])
    return Figure(float(figure.value), str(figure.unit), spread)


def _key(row: Row) -> tuple[str, ...]:
    return tuple(row.labels.values())


def _rounded(value: Any) -> Any:
    """Six digits of every number with a fraction; JSON has no words for NaN and infinity."""
    if isinstance(value, dict):
        return {key: _rounded(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(v) for v in value]
    if not isinstance(value, float):
        return value
    return float(f"{value:.6g}") if math.isfinite(value) else str(value)


# ---- Origins ------------------------------------------------------------------


def typed() -> str:
    """What was typed, absolute paths without the folders that only this machine has."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    name = "" if spec is None else spec.name.removesuffix(".__main__")
    parser = argparse.ArgumentParser(allow_abbrev=False)
    add_options(parser)
    _, words = parser.parse_known_args(sys.argv[1:])  # without where the figures go
    words = [Path(w).name if Path(w).is_absolute() else w for w in words]
    return " ".join(["python -m", name or Path(sys.argv[0]).stem, *words])


def _today() -> str:
    return datetime.now(timezone.utc).strftime("%Y-%m-%d")


def _machine(variant: str) -> dict[str, Any]:
    system = f"{platform.system()} {platform.machine()}"
    memory = round(available_memory() / 2**30, 1)
    return {**machine(variant), "memory_gib": memory, "system": system}


def commit(root: Path = ROOT) -> str | None:
    """The commit of the checkout, with a plus where files differ from it."""
    try:
        command = ["git", "-C", str(root), "describe", "--always", "--dirty=+", "--abbrev=10"]
        found = subprocess.run(command, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return found.stdout.strip()
