"""What the commands share: the option --variant, checks of values, the progress bar."""

from __future__ import annotations

import math
import sys
from typing import Annotated, Any

from tqdm.auto import tqdm
from tyro.conf import arg

from ..errors import InputError

Variant = Annotated[
    str | None, arg(help="Mitsuba variant; default: CUDA where it works, LLVM otherwise.")
]


def positive(name: str, value: Any) -> Any:
    """The value of option ``--name``; InputError unless it is a finite number above 0."""
    if not 0 < value < math.inf:
        raise InputError(f"--{name} {value}: expected a number above 0")
    return value


def name_and_value(text: str, option: str = "--set") -> tuple[str, str]:
    """The two sides of ``name=value``, as ``option`` takes it; InputError if it is none."""
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise InputError(f"{option} {text}: expected name=value")
    return name, value


def valid_seed(value: int) -> int:
    """The value of ``--seed``; InputError unless it is from 0 to 2^31 - 1."""
    if not 0 <= value < 1 << 31:
        raise InputError(f"--seed {value}: expected a number from 0 to {(1 << 31) - 1}")
    return value


def progress_bar(name: str, unit: str, total: int | None = None) -> tqdm[Any]:
    """A progress bar on a terminal; nothing elsewhere."""
    return tqdm(desc=name, unit=unit, total=total, disable=not sys.stderr.isatty())
