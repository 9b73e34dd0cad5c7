"""Says in one line what tyro, which parses the command line, explains in a box of many."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable

_KINDS = {"INT": "whole number", "FLOAT": "number"}


def unknown_command(name: str, commands: Iterable[str]) -> str:
    """The message for a first argument that is no command."""
    close = difflib.get_close_matches(name, list(commands), n=1)
    expected = f"did you mean {close[0]}?" if close else f"expected one of {', '.join(commands)}"
    return f"{name}: unknown command, {expected}"


def usage_error(box: str, arguments: list[str], options: list[str]) -> str:
    """The message for arguments that tyro refuses.

    Args:
        box: what tyro printed.
        arguments: what it refused; the first one is the command.
        options: those of the command.
    """
    rows = _rows(box)
    text = " ".join(" ".join(rows).split())
    command = "mi-nerf" if arguments[0].startswith("-") else f"mi-nerf {arguments[0]}"
    hint = f"see {command} --help"
    if missing := re.search(r"Missing from ", text):
        names = _indented(rows) or [text[missing.end() :]]
        return f"{arguments[0]}: missing {' and '.join(names)}, {hint}"
    if found := re.search(r"Unrecognized (?:or misplaced )?options: (\S+?),?(?: |$)", text):
        # Long words are broken to fit in the box: find the whole one.
        word = next((a for a in arguments if a.startswith(found[1])), found[1])
        close = difflib.get_close_matches(word.partition("=")[0], options, n=1, cutoff=0.7)
        hint = f"did you mean {close[0]}?" if close else hint
        kind = "option" if word.startswith("-") else "argument"
        return f"{word}: unknown {kind} of {command}, {hint}"
    if found := re.search(r"Error parsing (\S+): no type matching (.+?) could be .* from \[", text):
        kinds = found[2].strip("{}").split()
        kind = _KINDS.get(kinds[0], kinds[0])
        expected = f"a {kind}" if len(kinds) == 1 else f"{len(kinds)} {kind}s"
        if "," in kinds[0]:
            expected = f"one of {kinds[0].replace(',', ', ')}"
        return f"{found[1]} {_values(arguments, found[1])}: expected {expected}"
    if found := re.search(r"invalid choice (\S+) for argument '(\S+?)'. .*one of \((.*?)\)", text):
        choices = [c for c in re.findall(r"'(.+?)'", found[3]) if c != "None"]
        return f"{found[2]} {found[1].strip(chr(39))}: expected one of {', '.join(sorted(choices))}"
    if found := re.search(r"Missing value for argument \W*?(--[\w-]+)", text):
        return f"{found[1]}: expected a value, {hint}"
    return f"{text}, {hint}"


def _rows(box: str) -> list[str]:
    """The text in the box, down to where it repeats the help, without frame and colours."""
    rows = []
    for line in re.sub(r"\x1b\[[0-9;]*m", "", box).splitlines():
        row = re.sub(r"[│|]", " ", line).rstrip()
        if re.search(r"Argument helptext|For full helptext", row):
            break
        if re.search(r"\w", row) and not re.search(r"[╭╰┌└]", row):
            rows.append(row)
    return rows


def _indented(rows: list[str]) -> list[str]:
    """The names in a list in which each is followed by a longer explanation, further in."""
    inner = [row for row in rows if row.startswith(" " * 5)]
    margin = min((len(row) - len(row.lstrip()) for row in inner), default=0)
    names = [row.strip() for row in inner if len(row) - len(row.lstrip()) == margin]
    return [name.split(", ")[-1] for name in names]


def _values(arguments: list[str], option: str) -> str:
    """What was written after an option, up to the next one."""
    names = option.split("/")
    for i, argument in enumerate(arguments):
        name, equals, value = argument.partition("=")
        if name in names:
            rest = arguments[i + 1 :]
            stop = next((j for j, a in enumerate(rest) if a.startswith("--")), len(rest))
            return value if equals else " ".join(rest[:stop])
    return ""
