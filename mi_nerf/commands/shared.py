"""What the commands share: the option --variant, checks of values, the progress bar."""

from __future__ import annotations

from typing import Annotated

from tyro.conf import arg

from ..base.checks import positive, valid_seed
from ..base.errors import InputError
from ..base.progress_bar import progress_bar

__all__ = ["Variant", "name_and_value", "positive", "progress_bar", "valid_seed"]

Variant = Annotated[
    str | None, arg(help="Mitsuba variant; default: CUDA where it works, LLVM otherwise.")
]


def name_and_value(text: str, option: str = "--set") -> tuple[str, str]:
    """The two sides of ``name=value``, as ``option`` takes it; InputError if it is none."""
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise InputError(f"{option} {text}: expected name=value")
    return name, value
