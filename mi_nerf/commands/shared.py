"""What the commands share: the option --variant, checks of values, the progress bar."""

from __future__ import annotations

from typing import Annotated, Any

from tyro.conf import arg

from ..base.checks import positive, valid_seed
from ..base.errors import InputError, Option
from ..base.progress_bar import progress_bar

__all__ = [
    "ExecutorName",
    "Variant",
    "Workers",
    "budget",
    "flag",
    "name_and_value",
    "positive",
    "progress_bar",
    "valid_seed",
]

Variant = Annotated[
    str | None, arg(help="Mitsuba variant; default: CUDA where it works, LLVM otherwise.")
]

Workers = Annotated[
    int, arg(help="Processes of this machine that share the work; default: this one alone.")
]
ExecutorName = Annotated[
    str | None,
    arg(help="A cluster that does it: dask://HOST:PORT, slurm or slurm:partition=NAME,…"),
]


# Options that are not called as the arguments of functions that they become.
_NAMES = {"parameters": "set", "points": "point", "settings": "set", "values": "set"}


def flag(option: Option) -> str:
    """An argument of a function as the command line writes it: ``--size 0 5``."""
    name = "--" + _NAMES.get(option.name, option.name).replace("_", "-")
    if option.value is None or option.value is True:
        return name
    values = option.value if isinstance(option.value, tuple) else (option.value,)
    return " ".join([name, *(f"{v:g}" if isinstance(v, float) else str(v) for v in values)])


def budget(max_seconds: float | None, steps: int | None, usual: float) -> dict[str, Any]:
    """The settings of a training's end: ``steps``, or else seconds, ``usual`` by default."""
    if steps is not None:
        return {"steps": positive("steps", steps)}
    return {"max_seconds": positive("max_seconds", usual if max_seconds is None else max_seconds)}


def name_and_value(text: str, option: str = "--set") -> tuple[str, str]:
    """The two sides of ``name=value``, as ``option`` takes it; InputError if it is none."""
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise InputError(f"{option} {text}: expected name=value")
    return name, value
