"""The notebooks: what is saved in them, and that they run, with tiny settings."""

from __future__ import annotations

import ast
import base64
import importlib
import re
import warnings
from pathlib import Path
from typing import Any

import pytest

import mi_nerf

nbformat = pytest.importorskip("nbformat", reason="a GPU machine may lack it")

ROOT = Path(__file__).parent.parent
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
SWITCH = "MI_NERF_NOTEBOOK_SCALE"
MOST_BYTES = 100_000  # of a picture

each = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def read(path: Path) -> Any:
    return nbformat.read(path, as_version=4)


def code_of(notebook: Any) -> list[str]:
    return [cell.source for cell in notebook.cells if cell.cell_type == "code"]


def outputs_of(notebook: Any) -> list[Any]:
    return [o for cell in notebook.cells if cell.cell_type == "code" for o in cell.outputs]


def pictures_of(notebook: Any) -> list[bytes]:
    """Those of all outputs, in whatever form."""
    texts = []
    for output in outputs_of(notebook):
        for kind, content in output.get("data", {}).items():
            if kind.startswith("image/"):
                texts.append(content)
            elif kind == "text/html":
                texts += re.findall(r"base64, *([A-Za-z0-9+/=]+)", content)
    return [base64.b64decode(text) for text in texts]


def test_there_are_notebooks() -> None:
    assert len(NOTEBOOKS) >= 3
    assert [path.name[:2] for path in NOTEBOOKS] == [f"{k + 1}_" for k in range(len(NOTEBOOKS))]


# --------------------------------------------------------------------------
#   As they are saved
# --------------------------------------------------------------------------


@each
def test_outputs_are_saved(path: Path) -> None:
    notebook = read(path)
    nbformat.validate(notebook)
    outputs = outputs_of(notebook)
    assert not [o for o in outputs if o.output_type == "error" or o.get("name") == "stderr"]
    assert len([o for o in outputs if o.output_type == "stream"]) >= 1
    pictures = pictures_of(notebook)
    assert len(pictures) >= 2
    assert max(map(len, pictures)) <= MOST_BYTES
    assert path.stat().st_size < 1_000_000
    numbers = [c.execution_count for c in notebook.cells if c.cell_type == "code"]
    assert numbers == list(range(1, len(numbers) + 1))  # run once, from top to bottom


@each
def test_nothing_of_the_machine_is_saved(path: Path) -> None:
    notebook = read(path)
    texts = [output.get("text", "") for output in outputs_of(notebook)]
    texts += [str(v) for o in outputs_of(notebook) for v in o.get("data", {}).values()]
    texts += [cell.source for cell in notebook.cells]
    found = [re.search(r"(?<![\w.<])/(tmp|home|root|usr|work|var|opt)\b", t) for t in texts]
    assert not any(found)
    assert "widget" not in path.read_text()
    assert all(not cell.metadata for cell in notebook.cells)
    assert set(notebook.metadata) == {"kernelspec", "language_info"}


@each
def test_only_public_names_are_used(path: Path) -> None:
    for source in code_of(read(path)):
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.Attribute):
                assert not node.attr.startswith("_"), node.attr
                if isinstance(node.value, ast.Name) and node.value.id == "mi_nerf":
                    assert node.attr in mi_nerf.__all__, node.attr
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith("mi_nerf"):
                module = importlib.import_module(str(node.module))
                for alias in node.names:
                    assert alias.name in vars(module) and not alias.name.startswith("_")
                assert not any(part.startswith("_") for part in str(node.module).split("."))


@each
def test_the_switch_is_explained_and_cells_are_short(path: Path) -> None:
    notebook = read(path)
    assert notebook.cells[0].cell_type == "markdown" and SWITCH in notebook.cells[0].source
    assert SWITCH in code_of(notebook)[0]
    for source in code_of(notebook):
        assert len(source.splitlines()) <= 45
    words = sum(len(c.source.split()) for c in notebook.cells if c.cell_type == "markdown")
    assert words > 150  # they say why, not only how


# --------------------------------------------------------------------------
#   Run
# --------------------------------------------------------------------------


@each
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of Jupyter's own libraries
def test_it_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from nbclient import NotebookClient
    monkeypatch.setenv(SWITCH, "ci")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))  # this checkout, whatever is installed
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # where notebooks put what they make
    notebook = read(path)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs, cell.execution_count = [], None
    resources = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=300, kernel_name="python3", resources=resources).execute()
    assert all(c.execution_count for c in notebook.cells if c.cell_type == "code")
    saved = read(path)
    for old, new in zip(saved.cells, notebook.cells, strict=True):
        kinds = [{o.output_type for o in c.get("outputs", ()) if o.get("name") != "stderr"}
                 for c in (old, new)]  # fmt: skip
        assert kinds[0] == kinds[1], new.source
