"""The docstrings of the plugins: in Mitsuba's format, complete, with examples that load."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import textwrap
from pathlib import Path
from typing import Any

import mitsuba as mi
import pytest

import mi_nerf
from tests.support.datasets import write_blob_dataset
from tests.support.fields import small_file

PLUGINS = Path(mi_nerf.__file__).parent / "plugins"


def registered() -> dict[str, tuple[str, str, str]]:
    """Kind, module and class of every plugin, by name, as the source registers them."""
    found = {}
    for path in sorted(PLUGINS.glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            function = getattr(getattr(node, "func", None), "attr", "")
            if isinstance(node, ast.Call) and function in (
                "register_integrator",
                "register_medium",
                "register_sensor",
            ):
                name, made = node.args
                kind = function.removeprefix("register_")
                if isinstance(name, ast.Constant) and isinstance(made, ast.Name):
                    found[str(name.value)] = (kind, f"mi_nerf.plugins.{path.stem}", made.id)
    return found


NAMES = registered()
each = pytest.mark.parametrize("name", NAMES)


@pytest.fixture(autouse=True)
def variant() -> None:
    mi.set_variant(mi_nerf.choose_variant())


def plugin(name: str) -> Any:
    _, module, made = NAMES[name]
    return getattr(importlib.import_module(module), made)


def documented(name: str) -> dict[str, list[str]]:
    """Types and texts of the documented parameters."""
    rows: dict[str, list[str]] = {}
    for row in re.split(r"^ *\* - ", inspect.getdoc(plugin(name)) or "", flags=re.MULTILINE)[1:]:
        title, *cells = re.split(r"^ +- (?=\||[A-Z(:])", row.split("\n\n")[0], flags=re.MULTILINE)
        for parameter in title.strip().split(", "):
            rows[parameter] = [" ".join(cell.split()) for cell in cells]
    return rows


def test_the_plugins_are_found() -> None:
    assert {"nerf", "nerf_tracking", "nerfmedium", "nerfviews"} <= set(NAMES)


@each
def test_form(name: str) -> None:
    text = inspect.getdoc(plugin(name)) or ""
    label, title, line = (part for part in text.splitlines()[:5] if part)
    assert label == f".. _{NAMES[name][0]}-{name}:"
    assert title.endswith(f"(:monosp:`{name}`)") and re.fullmatch("-+", line)
    assert len(line) >= len(title)
    assert ".. pluginparameters::" in text and ".. tabs::" in text
    for parameter, cells in documented(name).items():
        assert re.fullmatch(r"\|[a-z ]+\|", cells[0]), parameter
        assert cells[1][0].isupper() or cells[1].startswith(":"), parameter
        for extra in cells[2:]:
            assert re.fullmatch(r"\|exposed\|(, \|differentiable\|)?", extra), parameter


@each
def test_every_property_is_documented(name: str) -> None:
    known = documented(name)
    read = set()
    for cls in plugin(name).__mro__:
        if cls.__module__.startswith("mi_nerf"):
            source = textwrap.dedent(inspect.getsource(cls))
            read |= set(re.findall(r'props(?:\.get\(|\[)"(\w+)"(?!\] = )', source))
    assert read and read <= set(known), read - set(known)


@each
def test_every_exposed_parameter_is_documented(name: str, tmp_path: Path) -> None:
    exposed = {p for p, cells in documented(name).items() if any("exposed" in c for c in cells[2:])}
    made = load(example(name, "xml", tmp_path))
    found = {key.rpartition(".")[2] for key in mi.traverse(made).keys()}  # noqa: SIM118
    if name == "nerfmedium":
        assert {"to_world", "(weights)"} <= exposed and "trunk_0_weight" in found
    for parameter in exposed - {"(weights)", "(Nested plugin)"}:
        assert parameter in found


def example(name: str, language: str, folder: Path) -> str:
    """The example in a language, with a field that is there."""
    text = inspect.getdoc(plugin(name)) or ""
    found = re.search(rf"\.\. code-tab:: {language}\n\n((?: +.*\n?|\n)+)", text)
    assert found is not None
    text = textwrap.dedent(found[1].split("\n    .. code-tab")[0])
    if name == "nerfviews":
        data = folder if (folder / "train").exists() else write_blob_dataset(folder)
        return re.sub("""(["'])lego["']""", rf"\1{data}\1", text)
    return text.replace("lego.safetensors", str(small_file(folder)))


def load(xml: str) -> Any:
    scene = mi.load_string(f'<scene version="3.0.0">{xml}</scene>')
    if scene.shapes():
        return scene.shapes()[0]
    return scene.integrator() or scene.sensors()[0]


@each
def test_examples_load(name: str, tmp_path: Path) -> None:
    from_xml = load(example(name, "xml", tmp_path))
    values = ast.literal_eval(f"{{{example(name, 'python', tmp_path)}}}")
    from_dict = mi.load_dict(values)
    assert type(from_dict) is type(from_xml)
    assert str(from_dict).count("\n") == str(from_xml).count("\n")
