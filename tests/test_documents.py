"""The documents: links lead somewhere, commands are accepted, examples run, settings exist."""

from __future__ import annotations

import argparse
import ast
import importlib
import importlib.util
import re
import shlex
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import mi_nerf
from mi_nerf import cli
from mi_nerf.base.errors import InputError
from mi_nerf.cli import main
from mi_nerf.commands import COMMANDS
from mi_nerf.fields import closed_form
from mi_nerf.training.config import setting_names, with_settings
from mi_nerf.training.presets import PRESETS, preset
from tests.support import settings_page
from tests.support.fields import small_file

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
PAGES = [
    README,
    ROOT / "CHANGELOG.md",
    ROOT / "scenes" / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
]

_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of a language; '' for those without."""
    return [text for kind, text in _FENCE.findall(page.read_text()) if kind == language]


def prose(page: Path) -> str:
    """A page without its blocks, comments and line ends."""
    text = re.sub(r"<!--.*?-->", "", _FENCE.sub("", page.read_text()), flags=re.DOTALL)
    return re.sub(r"\s+", " ", text)


def spans(page: Path) -> list[str]:
    """Code within the text."""
    return re.findall(r"`([^`]+)`", prose(page))


def lines_of_code(page: Path) -> list[str]:
    """What a reader may type: lines of blocks without a language, and code within the text."""
    lines = [line for text in blocks(page, "") for line in text.splitlines()]
    return [*lines, *spans(page)]


# --------------------------------------------------------------------------
#   Links
# --------------------------------------------------------------------------


def anchors(page: Path) -> set[str]:
    """The anchors that GitHub gives to the headings of a page."""
    found = set()
    for title in re.findall(r"^#+ +(.*)$", _FENCE.sub("", page.read_text()), re.MULTILINE):
        text = re.sub(r"[`*]|\[(.*?)\]\(.*?\)", r"\1", title).strip().lower()
        found.add(re.sub(r"[^\w\- ]", "", text).replace(" ", "-"))
    return found


LINKS = [
    pytest.param(page, target, id=f"{page.name}:{target}")
    for page in PAGES
    for target in re.findall(r"\[[^\]]*\]\(([^)\s]+)\)", _FENCE.sub("", page.read_text()))
]


@pytest.mark.parametrize(("page", "target"), LINKS)
def test_links(page: Path, target: str) -> None:
    if target.startswith(("http:", "https:")):
        assert re.fullmatch(r"https://[\w.-]+(/[^\s]*)?", target)
        return
    name, _, anchor = target.partition("#")
    file = (page.parent / name).resolve() if name else page
    assert file.exists() and file.is_relative_to(ROOT)
    if anchor:
        assert anchor in anchors(file), sorted(anchors(file))


def test_files_named_in_the_text_exist() -> None:
    for page in PAGES:
        for span in spans(page):
            if re.fullmatch(r"(mi_nerf|tests|scenes|docs|notebooks)/[\w/.-]+", span):
                assert (ROOT / span).exists(), f"{page.name}: {span}"


def test_every_document_is_reached_from_the_readme() -> None:
    linked = {
        (README.parent / t).resolve() for p, t in (link.values for link in LINKS) if p == README
    }
    for page in (ROOT / "docs").glob("*.md"):
        assert page in linked, page.name
    for notebook in (ROOT / "notebooks").glob("*.ipynb"):
        assert notebook in linked, notebook.name


# --------------------------------------------------------------------------
#   Commands
# --------------------------------------------------------------------------


def commands() -> Iterator[Any]:
    """Every use of ``mi-nerf`` with arguments, in blocks and in the text."""
    for page in PAGES:
        for line in lines_of_code(page):
            _, found, rest = line.partition("mi-nerf ")
            if found and not line.startswith("pip ") and " " in rest.strip():
                yield pytest.param(rest.strip(), id=f"{page.name}:{rest.strip()[:60]}")


def is_placeholder(text: str) -> bool:
    return bool(re.fullmatch(r"[A-Z]+|…|value|key", text))


@pytest.mark.slow
@pytest.mark.parametrize("line", list(commands()))
def test_commands_are_accepted(line: str) -> None:
    words = shlex.split(line)
    if "…" in words:  # something is left out: options must exist all the same
        command = COMMANDS[words[0]]
        options = {"--" + name.replace("_", "-") for name in command.__dataclass_fields__}
        assert {word for word in words if word.startswith("--")} <= options
        return
    parsed = cli._parse(["1" if word in ("N", "S", "K") else word for word in words])
    for assignment in getattr(parsed, "set", ()):
        key, _, value = assignment.partition("=")
        if words[0] in ("train", "ablate") and not is_placeholder(key):
            if is_placeholder(value):
                assert key in setting_names()
            else:
                with_settings(preset("nerf"), [assignment])
    name = getattr(parsed, "preset", "nerf")
    assert is_placeholder(name) or name in PRESETS


def test_named_commands_exist() -> None:
    for page in PAGES:
        for word in re.findall(r"`mi-nerf ([\w-]+)[ `]", prose(page)):
            assert word in COMMANDS or word.startswith("--"), f"{page.name}: mi-nerf {word}"


class AcceptedError(Exception):
    """Raised instead of doing the work."""


def python_commands() -> Iterator[Any]:
    for page in PAGES:
        for line in lines_of_code(page):
            _, found, rest = line.partition("python ")
            if found and not line.startswith("pip "):
                yield pytest.param(rest.strip(), id=f"{page.name}:{rest.strip()[:60]}")


@pytest.mark.parametrize("line", list(python_commands()))
def test_python_commands(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    words = shlex.split(line)
    if words[0] != "-m":
        assert (ROOT / words[0]).is_file()
        return
    name, options = words[1], words[2:]
    if importlib.util.find_spec(name).submodule_search_locations:  # type: ignore[union-attr]
        name += ".__main__"
    assert importlib.util.find_spec(name) is not None
    if not name.startswith("tests.benchmarks"):
        return
    module = importlib.import_module(name)
    parse = argparse.ArgumentParser.parse_args

    def parse_only(self: argparse.ArgumentParser, *_: Any) -> None:
        parse(self, options)
        raise AcceptedError

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_only)
    if options:
        with pytest.raises(AcceptedError):
            module.main()
    else:
        assert callable(module.main)


def test_the_two_lines_that_users_copy() -> None:
    lines = README.read_text().splitlines()
    assert "pip install . && mi-nerf demo" in lines
    assert 'pip install ".[test]" && pytest' in lines


# ---- Executed: those of the README, with tiny numbers ----

TINY = {
    "generate": "--train 1 --val 0 --test 1 --size 8 8 --spp 2",
    "train": "--max-seconds 0.2 --set network.width=8 network.view_width=8 occupancy.resolution=8",
    "eval": "--views 1",
    "render": "--size 16 12",
}
LEFT_OUT = ("demo", "ablate", "import", "report")  # tested elsewhere, or in need of other data
SCENE = """<scene version="3.0.0"><integrator type="nerf"/><sensor type="perspective">
<transform name="to_world"><lookat origin="0,-4,0" target="0,0,0" up="0,0,1"/></transform>
<film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="12"/></film>
</sensor><emitter type="constant"/><shape type="cube" id="box"><bsdf type="null"/>
<medium type="nerfmedium" name="interior"><string name="filename" value="field_0.safetensors"/>
</medium></shape></scene>"""
OWN_SCENE = """<scene version="3.0.0"><emitter type="constant"/><shape type="sphere"/></scene>"""


@pytest.fixture
def workplace(blob: Path, blob_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with what the examples speak of."""
    shutil.copytree(blob, tmp_path / "lego")
    shutil.copytree(blob_run, tmp_path / "runs/lego")
    small_file(tmp_path)
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "my_scene.xml").write_text(OWN_SCENE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_commands_of_the_readme_work(workplace: Path) -> None:
    shutil.rmtree(workplace / "runs")
    done: list[str] = []
    for line in (line for text in blocks(README, "") for line in text.splitlines()):
        words = shlex.split(line)
        if words[:1] != ["mi-nerf"] or words[1] in LEFT_OUT or "fern" in line:
            continue
        extra = shlex.split(TINY.get(words[1], ""))
        if "--frames" in words:
            extra += ["--frames", "2"]
        assert main([*words[1:], *extra]) == 0, line
        done.append(words[1])
    assert {"generate", "train", "eval", "render"} <= set(done)


# --------------------------------------------------------------------------
#   Examples
# --------------------------------------------------------------------------

PYTHON = [
    pytest.param(text, id=f"{page.stem}-{k}")
    for page in PAGES
    for k, text in enumerate(blocks(page, "python"))
]
XML = [
    pytest.param(text, id=f"{page.stem}-{k}")
    for page in PAGES
    for k, text in enumerate(blocks(page, "xml"))
]


@pytest.mark.slow
@pytest.mark.parametrize("text", PYTHON)
def test_python_examples_run(text: str, workplace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if "llvm_ad_rgb" not in mi_nerf.available_variants():
        pytest.skip("the examples are written for LLVM")
    monkeypatch.setattr(closed_form, "CLOSED_FORMS", dict(closed_form.CLOSED_FORMS))
    if '"report/"' in text:
        command = "report runs/lego --out report/ --no-profile --repeats 1 --samples 8 --rays 64"
        assert main(command.split()) == 0
        text = text.replace("rays=4096", "rays=64")
    text = text.replace("((1024, 400), (2048, 600), (4096, 2000))", "((16, 2), (32, 2))")
    # A slow machine may take its time.
    text = text.replace("milliseconds=20", "milliseconds=1e6").replace("rays=4096", "rays=64")
    variant = mi.variant()
    try:
        exec(compile(text, "example", "exec"), {"__name__": "__main__"})
    finally:
        if variant is not None:
            mi.set_variant(variant)


@pytest.mark.parametrize("text", XML)
def test_xml_examples_load(text: str, workplace: Path) -> None:
    mi.set_variant(mi_nerf.choose_variant())
    field = workplace / "field_0.safetensors"
    text = re.sub(r'(name="filename" value=")[^"]*\.safetensors"', rf'\1{field}"', text)
    if "<scene" not in text:
        text = f'<scene version="3.0.0">{text}</scene>'
    scene = mi.load_string(text)
    if "<sensor" in text:
        film = mi.traverse(scene.sensors()[0])
        film["film.size"] = [16, 12]
        film.update()
        image = np.array(mi.render(scene, spp=1))
        assert np.isfinite(image).all() and image.any()


def test_xml_in_the_text_is_well_formed() -> None:
    for page in PAGES:
        for span in spans(page):
            if span.startswith("<") and span.endswith(">") and len(span) > 20:
                ElementTree.fromstring(f"<scene>{span}</scene>")


# --------------------------------------------------------------------------
#   Settings and messages
# --------------------------------------------------------------------------


def test_the_settings_page_is_complete_and_current() -> None:
    text = settings_page.PAGE.read_text()
    written = text.partition(settings_page.MARK)[2]
    assert written == settings_page.tables(), "run python -m tests.support.settings_page"
    for name in setting_names():
        row = rf"^\| `{re.escape(name)}` \| [^|]+ \| `[^|]+` \| ([^|]+) \|$"
        assert len(re.findall(row, written, re.MULTILINE)) == 1, name
    assert all(f"\n| `{name}`" in text for name in PRESETS)


def accepts(name: str, setting: str) -> bool:
    try:
        with_settings(preset(name), [setting])
    except InputError:
        return False
    return True


def test_settings_named_in_the_text_exist() -> None:
    groups = {name.partition(".")[0] for name in setting_names() if "." in name}
    known, seen = set(setting_names()), 0
    for page in PAGES:
        for span in spans(page):
            for part in span.replace("--set ", "").split():
                key, _, value = part.partition("=")
                if re.fullmatch(rf"({'|'.join(groups)})\.(?!py$)[a-z_0-9]+", key):
                    seen += 1
                    assert key in known, f"{page.name}: {key}"
                    if value and not is_placeholder(value) and value != "…":
                        assert any(accepts(name, part) for name in ("nerf", "paper")), part
    assert seen > 20


def test_public_functions_named_in_the_text_exist() -> None:
    for page in PAGES:
        for span in spans(page):
            name = re.match(r"mi_nerf\.([\w.]+)", span)
            formats = ("mi_nerf.field", "mi_nerf.checkpoint", "mi_nerf.run")  # of files
            if name is None or span in (*formats, "mi_nerf.pth"):
                continue
            value: Any = mi_nerf
            for part in name[1].rstrip(".").split("."):
                if not hasattr(value, part):
                    importlib.import_module(f"{value.__name__}.{part}")
                value = getattr(value, part)


def literal_texts() -> list[str]:
    """The texts of the package, those of formatted ones without their values."""
    found = []
    for path in (ROOT / "mi_nerf").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.JoinedStr):
                parts = [v.value if isinstance(v, ast.Constant) else "\0" for v in node.values]
                found.append("".join(str(part) for part in parts))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return found


def test_messages_of_the_error_page_are_those_of_the_code() -> None:
    texts = [" ".join(text.split()) for text in literal_texts()]
    others = ("Plugin ", "RuntimeWarning: mi_nerf.pth")  # of Mitsuba, of the start-up file
    checked = 0
    for row in re.findall(r"^\| (`.*?) \| ", (ROOT / "docs/errors.md").read_text(), re.MULTILINE):
        for message in re.findall(r"`([^`]+)`", row):
            if message.startswith(others):
                continue
            pieces = re.split(r"…|'[^']*'|--[\w-]+|\d+|\w+\.json|^nerf\w*:|\.", message)
            pieces = [piece.strip(" :,") for piece in pieces if len(piece.strip(" :,")) > 8]
            assert pieces, message
            for piece in pieces:
                assert any(piece in text for text in texts), piece
                checked += 1
    assert checked > 15
