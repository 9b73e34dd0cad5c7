"""Figures are files: tables are those of docs/results, and say which ones are out of date."""

from __future__ import annotations

import argparse
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.fields.hash_grid import HashGridConfig
from tests.benchmarks import all as everything
from tests.benchmarks import note, resolution, steps
from tests.benchmarks import results as figures
from tests.benchmarks.results import RESULTS, ROOT, Figure, Protocol, Record, Row, load
from tests.benchmarks.tables import BLOCK, PAGES, files_of, spread_text, text, written

FILES = sorted(RESULTS.glob("*.json"))
NOISE = "0.15 dB"  # of seeds, below which nothing is told apart
ROW = Row(
    {"what": "a step"},
    {"psnr": Figure(30.123, "dB", (29.5, 31.0)), "error": Figure(float("nan"))},
    Protocol("lego_200", "val", 25, (100, 100)),
    (0, 1),
)


# ---- The documents -----------------------------------------------------------------------


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_tables_are_those_of_the_files(page: Path) -> None:
    same = page.read_text() == written(page.read_text())
    assert same, "run python -m tests.benchmarks.tables"


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_files_are_complete_and_name_nothing_private(file: Path) -> None:
    for record in load(file):
        assert record.origin.date >= "2026-11-01"
        assert record.origin.parts
        assert "data" not in record.row.labels or record.row.protocol is not None
    paths = [word for word in file.read_text().split() if re.match(r'"?/(?!deg)\w', word)]
    assert not paths, paths


def test_every_file_is_shown_somewhere() -> None:
    shown = {name for page in PAGES for name in files_of(page.read_text())}
    assert {file.stem for file in FILES} <= shown


def test_measured_numbers_stand_in_tables_alone() -> None:
    """Two decimals of a decibel, or milliseconds, rates and memory, in the pages on figures."""
    pages = ("README", "figures", "training", "quadrature", "stability")
    for page in (page for page in PAGES if page.stem in pages):
        rest = BLOCK.sub("", page.read_text())
        found = re.findall(r"\d\.\d\d dB|\d ?ms\b|\d GFLOP/s|\d MB\b", rest)
        found = [number for number in found if number != NOISE]
        assert not found, f"{page.name}: {found}"
    assert "figures: quality" in (ROOT / "README.md").read_text()


# ---- Files -------------------------------------------------------------------------------


def options(folder: Path) -> argparse.Namespace:
    return argparse.Namespace(no_write=False, results=folder)


def saved(folder: Path, *rows: Row, **more: object) -> list[Record]:
    figures.save("some", rows, options(folder), "llvm_ad_rgb", ("march",), **more)  # type: ignore
    return load(folder / "some.json")


def test_rows_survive_the_file(tmp_path: Path) -> None:
    (record,) = saved(tmp_path, ROW)
    assert str(record.row.figures.pop("error").value) == "nan"
    assert record.row == replace(ROW, figures={"psnr": ROW.figures["psnr"]})
    assert record.origin.current()
    assert {"processor", "cores", "versions"} <= set(record.origin.machine)
    content = (tmp_path / "some.json").read_text()
    assert "NaN" not in content, "which is no JSON"


def test_rows_replace_those_with_the_same_labels(tmp_path: Path) -> None:
    other = Row({"what": "another"}, {"ms": Figure(3, "ms")})
    saved(tmp_path, ROW, other)
    better = replace(ROW, figures={"psnr": Figure(33.0, "dB")})
    first, second = saved(tmp_path, better)
    assert first.row == better and second.row == other
    assert len(saved(tmp_path, other, whole=True)) == 1


def test_nothing_is_written_if_not_wanted(tmp_path: Path) -> None:
    no = argparse.Namespace(no_write=True, results=tmp_path)
    figures.save("some", [ROW], no, "llvm_ad_rgb", ("march",))
    assert not list(tmp_path.iterdir())


def test_parts_must_exist(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="marching: expected a file or folder of mi_nerf"):
        figures.save("some", [ROW], options(tmp_path), "llvm_ad_rgb", ("marching",))


def incomplete(folder: Path, part: str, field: str) -> Path:
    """A file whose first origin or row lacks something."""
    saved(folder, ROW)
    file = folder / "some.json"
    content = json.loads(file.read_text())
    del content[part][0][field]
    file.write_text(json.dumps(content))
    return file


@pytest.mark.parametrize("field", ["command", "date", "machine", "engine", "commit", "parts"])
def test_incomplete_origins_are_refused(field: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"some\.json: expected a complete file of figures"):
        load(incomplete(tmp_path, "origins", field))


@pytest.mark.parametrize("field", ["labels", "figures", "protocol", "seeds", "origin"])
def test_incomplete_rows_are_refused(field: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"some\.json"):
        load(incomplete(tmp_path, "rows", field))


# ---- Engines -----------------------------------------------------------------------------

CODE = '"""What it is."""\ndef f(x):\n    """Says."""\n    return [x + 1, "a"]  # why\n'


def engine(folder: Path, code: str) -> str:
    (folder / "march").mkdir(exist_ok=True)
    (folder / "march" / "a.py").write_text(code)
    return figures.digest(("march",), folder)


@pytest.mark.parametrize(
    "code",
    [
        "def f(x):\n    return [x + 1, 'a']\n",
        CODE.replace("Says", "Tells"),
        '# New.\n\n\ndef f(\n    x,\n):\n    return [\n        (x + 1),\n        "a",\n    ]\n',
    ],
)
def test_an_engine_is_its_code_without_words_and_layout(code: str, tmp_path: Path) -> None:
    assert engine(tmp_path, code) == engine(tmp_path, CODE)


@pytest.mark.parametrize("change", ["x + 2", "x - 1", "1 + x", "x + 1.0"])
def test_another_engine_is_told(change: str, tmp_path: Path) -> None:
    assert engine(tmp_path, CODE.replace("x + 1", change)) != engine(tmp_path, CODE)


def test_an_engine_is_its_parts(tmp_path: Path) -> None:
    before = engine(tmp_path, CODE)
    (tmp_path / "fields").mkdir()
    (tmp_path / "fields" / "b.py").write_text("x = 1\n")
    assert figures.digest(("march",), tmp_path) == before
    assert figures.digest(("march", "fields"), tmp_path) != before
    assert figures.digest(("march", "fields/b.py"), tmp_path) != before
    shutil.move(tmp_path / "march" / "a.py", tmp_path / "march" / "c.py")
    assert figures.digest(("march",), tmp_path) != before


def test_the_digest_is_the_same_in_every_version_of_python(tmp_path: Path) -> None:
    code = CODE + "class A(list): y = f'{f(1)!r:>{3}} of' rf'{2}'\n"
    assert engine(tmp_path, code) == "b8c1b65ad4a044a2"


# ---- Tables ------------------------------------------------------------------------------

TABLE = "<!-- figures: some\nwhat = {what}\nPSNR = {psnr} ({psnr.range})\n-->\n<!-- end -->\n"


def test_older_engines_are_marked(tmp_path: Path) -> None:
    saved(tmp_path, ROW, replace(ROW, labels={"what": "another"}))
    page = f"Before.\n{TABLE}After.\n"
    fresh = written(page, tmp_path)
    assert "\n| a step | 30.12 dB (29.50 – 31.00 dB) |\n" in fresh and "older" not in fresh
    assert written(fresh, tmp_path) == fresh
    first, second = load(tmp_path / "some.json")
    stale = replace(second, origin=replace(second.origin, engine=None))
    figures.write(tmp_path / "some.json", [first, stale])
    mixed = written(fresh, tmp_path)
    assert "\n| a step | 30" in mixed and "\n| another † | 30" in mixed
    assert "†: by an older engine</sub>" in mixed
    figures.write(tmp_path / "some.json", [stale])
    assert "All by an older engine</sub>" in written(mixed, tmp_path)


def test_tables_without_figures_say_so(tmp_path: Path) -> None:
    assert "Not measured yet" in written(TABLE, tmp_path)


def test_rows_can_be_left_out(tmp_path: Path) -> None:
    saved(tmp_path, ROW, replace(ROW, labels={"what": "another"}))
    page = written(TABLE.replace("PSNR", "only what = another\nPSNR"), tmp_path)
    assert "| another |" in page and "a step" not in page


@pytest.mark.parametrize(
    ("figure", "shown"),
    [
        (Figure(30.126, "dB"), "30.13 dB"),
        (Figure(-0.1, "dB"), "−0.10 dB"),
        (Figure(0.04567, "s"), "0.0457 s"),
        (Figure(1571588), "1,571,588"),
        (Figure(float("inf")), "∞"),
        (Figure(0.0), "0"),
    ],
)
def test_numbers_as_they_are_shown(figure: Figure, shown: str) -> None:
    assert text(figure) == shown


def test_digits_can_be_chosen() -> None:
    assert text(Figure(0.97712), ".3f") == "0.977"
    assert spread_text(Figure(1.0, "s", (0.5, 2.0))) == "0.5 – 2 s"
    assert spread_text(Figure(1.0, "s")) == "–"


# ---- The benchmarks' own arithmetic ------------------------------------------------------


def test_when_a_curve_passes_a_level() -> None:
    curve = [(10.0, 20.0), (40.0, 22.0), (80.0, 25.0)]
    assert resolution.passed(curve, 21.0) == pytest.approx(20.0)  # halfway in the logarithm
    assert resolution.passed(curve, 25.0) == pytest.approx(80.0)
    assert resolution.passed(curve, 19.0) == 10.0
    assert resolution.passed(curve, 26.0) == float("inf")


def test_commands_are_due_until_they_have_measured(tmp_path: Path) -> None:
    def commands() -> list[str]:
        return [" ".join(words) for _, words in everything.due(None, tmp_path)]

    assert len(commands()) == len(everything.PLAN)
    command = "python -m tests.benchmarks.gradient"
    saved(tmp_path, ROW, command=command)
    assert "tests.benchmarks.gradient" not in commands()
    (record,) = load(tmp_path / "some.json")
    figures.write(
        tmp_path / "some.json", [replace(record, origin=replace(record.origin, engine="0"))]
    )
    assert "tests.benchmarks.gradient" in commands()


def test_vertices_around_points() -> None:
    """In a dense level those of the cell; in a hashed one within its part of the table."""
    grid = HashGridConfig(levels=2, features=2, log2_entries=10, coarsest=4, finest=32)
    found = steps.vertices(grid, np.array([[0.0, 0.0, 0.0], [0.999, 0.0, 0.0]]))
    assert found.shape == (2, 2, 8)
    assert sorted(found[0, 0]) == [0, 1, 4, 5, 16, 17, 20, 21]
    assert sorted(found[1, 0]) == [1, 2, 5, 6, 17, 18, 21, 22]
    assert found[:, 1].min() >= 64 and found[:, 1].max() < grid.entries()


def test_figures_by_hand() -> None:
    assert note.figure("30.5 dB") == Figure(30.5, "dB")
    assert note.figure("3e-4") == Figure(3e-4)
    with pytest.raises(InputError, match="expected a number"):
        note.figure("many dB")
