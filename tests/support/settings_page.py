"""Writes the tables of docs/settings.md: ``python -m tests.support.settings_page``."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import io
import tokenize
import typing
from pathlib import Path
from typing import Any, Literal

from mi_nerf.training.config import TrainConfig, to_json
from mi_nerf.training.plain import as_text, leaves
from mi_nerf.training.presets import PRESETS

PAGE = Path(__file__).parents[2] / "docs" / "settings.md"
MARK = "<!-- From here on written by tests/support/settings_page.py -->\n"


def main() -> None:
    """Rewrites what follows the mark."""
    text, mark, _ = PAGE.read_text().partition(MARK)
    PAGE.write_text(text + mark + tables())


def tables() -> str:
    """All settings in Markdown: a table for each group, then those of the presets."""
    return "\n".join([*_group(TrainConfig(), ""), *_presets()])


def _group(settings: Any, prefix: str) -> list[str]:
    cls = type(settings)
    title = f"## `{prefix}*`" if prefix else "## The run"
    summary = (inspect.getdoc(cls) or "").split("\n\n")[0].replace("\n", " ")
    lines = ["", title, "", summary.replace("``", "`").rstrip(".") + ".", ""]
    lines += ["| setting | values | default | meaning |", "|---|---|---|---|"]
    nested, comments, hints = [], _comments(cls), typing.get_type_hints(cls)
    for field in dataclasses.fields(cls):
        inner, default = _dataclass(hints[field.name]), getattr(settings, field.name)
        if inner is not None:
            nested.append((default or inner(), f"{prefix}{field.name}."))
            if default is not None:
                continue
        default = as_text(default, "g")
        row = (f"`{prefix}{field.name}`", _values(hints[field.name]), f"`{default}`")
        lines.append(f"| {' | '.join(row)} | {comments[field.name]} |")
    for inner, name in nested:
        lines += _group(inner, name)
    return lines


def _presets() -> list[str]:
    """What presets set otherwise than the defaults."""
    usual = dict(leaves(to_json(TrainConfig())))
    found = {name: dict(leaves(to_json(make()))) for name, make in PRESETS.items()}
    names = [n for preset in found.values() for n, v in preset.items() if v != usual.get(n, None)]
    names = [n for n in dict.fromkeys(names) if n != "preset"]
    lines = ["", "## Presets", "", "Settings in which a preset differs from the defaults.", ""]
    lines += [f"| setting | default | {' | '.join(f'`{p}`' for p in found)} |"]
    lines += ["|---|---|" + "---|" * len(found)]
    for name in sorted(names):
        values = [preset.get(name, "–") for preset in (usual, *found.values())]
        lines.append(f"| `{name}` | {' | '.join(_cell(value) for value in values)} |")
    return [*lines, ""]


def _cell(value: Any) -> str:
    return as_text(value, "g") if value != "–" else value


def _comments(cls: Any) -> dict[str, str]:
    """The comment behind each field of a dataclass."""
    source = inspect.getsource(cls)
    behind = {
        token.start[0]: token.string.lstrip("# ").strip()
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    body = typing.cast(ast.ClassDef, ast.parse(source).body[0]).body
    return {
        node.target.id: behind.get(node.lineno, "")
        for node in body
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
    }


def _dataclass(hint: Any) -> Any:
    options = (hint, *typing.get_args(hint))
    return next((o for o in options if dataclasses.is_dataclass(o)), None)


def _values(hint: Any) -> str:
    """What a setting may be, in words."""
    words = {int: "whole number", float: "number", bool: "true, false", str: "text"}
    parts: list[str] = []
    for option in typing.get_args(hint) if typing.get_args(hint) else (hint,):
        if typing.get_origin(hint) is Literal:
            parts.append(str(option))
        elif typing.get_origin(option) is Literal:
            parts += [str(value) for value in typing.get_args(option)]
        elif typing.get_origin(option) is tuple:
            parts.append(f"{len(typing.get_args(option))} numbers with commas")
        elif option is type(None) or dataclasses.is_dataclass(option):
            parts.append("none" if option is type(None) else "its settings, below")
        else:
            parts.append(words[option])
    return ", ".join(parts)


if __name__ == "__main__":
    main()
