"""Imports lead down: the floors of ``docs/how-it-works.md`` against the imports of the code."""

from __future__ import annotations

import ast
import re
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "mi_nerf"

ROW = re.compile(r"^\| (\d+) \| `(\w+)(?:/|\.py)` \| (.+) \|$", re.MULTILINE)


def floors() -> dict[str, int]:
    """The floor of each folder, and of each module beside them."""
    section = (ROOT / "docs/how-it-works.md").read_text().partition("\n## The floors\n")[2]
    return {name: int(floor) for floor, name, _ in ROW.findall(section.partition("\n## ")[0])}


def module_name(path: Path, package: Path) -> str:
    parts = path.relative_to(package.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports(package: Path) -> dict[str, set[str]]:
    """What each module of a package imports of it, wherever in its text, by full names.

    ``from . import x`` is an import of the module ``x`` if there is one, else of its package.
    """
    paths = {module_name(path, package): path for path in sorted(package.rglob("*.py"))}
    found: dict[str, set[str]] = {}
    for name, path in paths.items():
        within = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
        found[name] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom):
                start = within[: len(within) - node.level + 1] if node.level else []
                module = ".".join([*start, *([node.module] if node.module else [])])
                inside = (f"{module}.{alias.name}" for alias in node.names)
                targets = [target if target in paths else module for target in inside]
            elif isinstance(node, ast.Import):
                targets = [alias.name for alias in node.names]
            else:
                continue
            found[name] |= {target for target in targets if target.split(".")[0] == package.name}
    return found


def violations(graph: dict[str, set[str]], floor: dict[str, int]) -> list[str]:
    """The imports that do not lead down, and those of the package itself from within."""
    found = []
    for name, targets in graph.items():
        if "." not in name:  # the package itself stands above all
            continue
        here = name.split(".")[1]
        for target in targets:
            there = target.split(".")[1] if "." in target else None
            if there is None or (there != here and floor[there] >= floor[here]):
                found.append(f"{name} imports {target}")
    return found


def cycle(graph: dict[str, set[str]]) -> list[str]:
    """Modules that import each other in a circle, if there are any."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def test_every_folder_has_a_floor() -> None:
    folders = {path.name for path in PACKAGE.iterdir() if any(path.glob("*.py"))}
    modules = {path.stem for path in PACKAGE.glob("*.py")} - {"__init__"}
    assert set(floors()) == folders | modules


def test_imports_lead_down() -> None:
    graph = imports(PACKAGE)
    assert sum(map(len, graph.values())) > 300
    assert violations(graph, floors()) == []


def test_no_modules_import_each_other() -> None:
    assert cycle(imports(PACKAGE)) == []


# ---- The check itself --------------------------------------------------------

FILES = {
    "__init__.py": "from .high.a import x",
    "low/__init__.py": "",
    "low/b.py": "import os",
    "high/__init__.py": "",
    "high/a.py": "from ..low import b\nfrom . import c\nfrom ..low.b import x",
    "high/c.py": "import numpy",
    "side/__init__.py": "",
}


@pytest.mark.parametrize(
    ("file", "text", "wrong"),
    [
        ("high/c.py", "from ..low.b import x", None),
        ("low/b.py", "from ..high import a", "house.low.b imports house.high.a"),
        ("low/b.py", "def f():\n    from ..high.c import x", "house.low.b imports house.high.c"),
        ("low/b.py", "import house.high.c", "house.low.b imports house.high.c"),
        ("low/__init__.py", "from ..high import x", "house.low imports house.high"),
        ("high/c.py", "from ..side import x", "house.high.c imports house.side"),
        ("low/b.py", "from .. import __version__", "house.low.b imports house"),
        ("low/b.py", "import house", "house.low.b imports house"),
    ],
)
def test_the_check_finds(tmp_path: Path, file: str, text: str, wrong: str | None) -> None:
    found = violations(imports(written(tmp_path, {file: text})), {"low": 0, "high": 1, "side": 1})
    assert found == ([] if wrong is None else [wrong])


def test_the_check_finds_circles(tmp_path: Path) -> None:
    assert cycle(imports(written(tmp_path, {}))) == []
    graph = imports(written(tmp_path, {"high/c.py": "def f():\n    from .a import x"}))
    assert set(cycle(graph)) == {"house.high.a", "house.high.c"}


def written(folder: Path, files: dict[str, str]) -> Path:
    """A package of ``FILES``, some of them changed."""
    for name, content in {**FILES, **files}.items():
        path = folder / "house" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
    return folder / "house"
