"""The ``mi-nerf`` command."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import os
import sys
import time
from collections.abc import Sequence
from typing import Any

import tyro

from .base.errors import InputError
from .commands import COMMANDS, all_commands, examples
from .commands.shared import flag
from .commands.usage import unknown_command, usage_error
from .jobs import JobError
from .training.run import TrainingError

_LISTS = ("--set", "--vary", "--object")  # options that may be followed by several values


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit status.

    0: success. 1: the work itself failed. 2: bad usage or bad input. 130: interrupted.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        command = _parse(arguments)
        command.run(_process_start())
    except InputError as error:
        return _fail(error.told(flag), 2)
    except (TrainingError, JobError) as error:
        return _fail(str(error), 1)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _fail(f"{where}{error.strerror or error}", 1)
    except KeyboardInterrupt:
        return _fail("interrupted", 130)
    return 0


def _parse(arguments: list[str]) -> Any:
    """Parses arguments; usage errors become an InputError of one line."""
    if not arguments:
        arguments = ["--help"]
    if arguments[0] not in COMMANDS and not arguments[0].startswith("-"):
        raise InputError(unknown_command(arguments[0], COMMANDS))
    name = arguments[0] if arguments[0] in COMMANDS else None
    message = io.StringIO()
    try:
        with contextlib.redirect_stderr(message):
            return tyro.cli(
                all_commands() if name is None else COMMANDS[name],
                prog="mi-nerf" if name is None else f"mi-nerf {name}",
                description="Neural radiance fields in Mitsuba 3."
                if name is None
                else examples(name),
                args=_spread_lists(arguments[name is not None :]),
                config=(tyro.conf.DisallowNone,),
            )
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        fields = () if name is None else dataclasses.fields(COMMANDS[name])
        options = ["--" + field.name.replace("_", "-") for field in fields]
        raise InputError(usage_error(message.getvalue(), arguments, options)) from None


def _spread_lists(arguments: list[str]) -> list[str]:
    """Turns ``--set a=1 b=2`` into ``--set a=1 --set b=2``; both may be written."""
    result: list[str] = []
    inside = None
    for argument in arguments:
        if argument.startswith("-"):
            inside = argument if argument in _LISTS else None
        elif inside is not None and result[-1] != inside:
            result.append(inside)
        result.append(argument)
    return result


def _fail(message: str, status: int) -> int:
    print("mi-nerf: " + " ".join(message.split()), file=sys.stderr)
    return status


def _process_start() -> float:
    """When this process began, on the clock of ``time.monotonic()``."""
    now = time.monotonic()
    try:
        with open("/proc/self/stat") as file:
            ticks = int(file.read().rpartition(")")[2].split()[19])
        age = time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
        return now - age
    except (OSError, ValueError, AttributeError):  # not Linux
        return now


if __name__ == "__main__":
    sys.exit(main())
