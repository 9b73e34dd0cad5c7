"""Errors name arguments as Python does; the command line writes them its own way."""

from __future__ import annotations

import ast
import pickle
import re
from pathlib import Path

import pytest

import mi_nerf
from mi_nerf.base.errors import InputError, Option
from mi_nerf.commands.shared import flag

PACKAGE = Path(mi_nerf.__file__).parent


@pytest.mark.parametrize(
    ("option", "python", "command"),
    [
        (Option("size", (0, 5)), "size=(0, 5)", "--size 0 5"),
        (Option("max_seconds", -1.0), "max_seconds=-1.0", "--max-seconds -1"),
        (Option("radius", 0.0), "radius=0.0", "--radius 0"),
        (Option("path", "orbit"), "path='orbit'", "--path orbit"),
        (Option("resume", True), "resume=True", "--resume"),
        (Option("data"), "data", "--data"),
        (Option("settings", "a=1"), "settings='a=1'", "--set a=1"),
        (Option("points", (1.5, 2.0, 3.0)), "points=(1.5, 2.0, 3.0)", "--point 1.5 2 3"),
    ],
)
def test_options_in_both_languages(option: Option, python: str, command: str) -> None:
    error = InputError("{}: {}, expected more", Path("a{b}"), option)
    assert str(error) == f"a{{b}}: {python}, expected more"
    assert error.told(flag) == f"a{{b}}: {command}, expected more"
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_a_message_is_no_template_without_values() -> None:
    error = InputError("runs/{0}: not found")
    assert str(error) == error.told(flag) == "runs/{0}: not found"


def test_library_errors_have_no_words_of_the_command_line() -> None:
    raised = 0
    for path in sorted(PACKAGE.rglob("*.py")):
        if path.relative_to(PACKAGE).parts[0] in ("commands", "cli.py"):
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Raise):
                continue
            raised += 1
            texts = [n.value for n in ast.walk(node) if isinstance(n, ast.Constant)]
            found = [t for t in texts if isinstance(t, str) and re.search(r"--[a-z]|--$", t)]
            assert not found, f"{path}:{node.lineno}"
    assert raised > 100
