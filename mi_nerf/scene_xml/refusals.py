"""What Mitsuba refuses, and what is no scene at all, in one line."""

from __future__ import annotations

import os
import re
from pathlib import Path

from ..base.errors import InputError


def check_file(path: Path) -> None:
    """Refuses what is no file that can be read, before Mitsuba says so in its own way."""
    try:
        os.fsencode(path).decode()
        if path.is_dir():
            raise InputError(f"{path}: is a folder, expected a Mitsuba XML scene")
        with path.open("rb"):
            pass
    except FileNotFoundError:
        raise InputError(f"{path}: not found, expected a Mitsuba XML scene") from None
    except UnicodeError:
        raise InputError(f"{os.fsencode(path)!r}: expected a name in UTF-8") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot be read: {reason}") from error


def refusal(message: str) -> str | None:
    """What Mitsuba says, in one line; None if a Python plugin failed by a fault of its own.

    An exception of a plugin comes as the text of its traceback. Plugins of mi_nerf refuse by
    InputError, those of Mitsuba and others by a plain Exception.
    """
    before, found, traceback = message.partition("Traceback (most recent call last):")
    if found:
        said = re.search(r"^(?:[\w.]+\.)?(\w+): (.*)", traceback, re.MULTILINE | re.DOTALL)
        if said is None or said[1] not in ("InputError", "Exception", "RuntimeError"):
            return None
        message = before + said[2]
    # Of files that include each other, the innermost complaint; places in Mitsuba's own sources go.
    message = message.rpartition("while processing <include>:")[2]
    return " ".join(re.sub(r"\[\w+\.(?:cpp|h):\d+\] ", "", message).split())


def refused_rendering(error: RuntimeError) -> str | None:
    """What Mitsuba says, in one line, if one of its own plugins cannot do what a picture takes.

    Dr.Jit wraps what happens inside a custom operation. ``None`` for faults of programs.
    """
    cause = error.__cause__ or error
    if type(cause) is not RuntimeError or not re.match(r"\[\w+\] ", str(cause)):
        return None
    return f"Mitsuba cannot render this scene: {' '.join(str(cause).split())}"
