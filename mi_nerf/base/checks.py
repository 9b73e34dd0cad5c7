"""Checks of values that several functions take."""

from __future__ import annotations

import math
from typing import Any

from .errors import InputError, Option


def positive(name: str, value: Any) -> Any:
    """The value of an option; InputError unless it is a finite number above 0."""
    if not 0 < value < math.inf:
        raise InputError("{}: expected a number above 0", Option(name, value))
    return value


def at_least_one(**values: int) -> None:
    """InputError unless all values, of the options called so, are at least 1."""
    for name, value in values.items():
        if value < 1:
            raise InputError("{}: expected at least 1", Option(name, value))


def valid_size(size: tuple[int, int]) -> tuple[int, int]:
    """The value of ``size``, width and height; InputError unless both are at least 1."""
    if min(size) < 1:
        raise InputError("{}: expected two numbers of at least 1", Option("size", size))
    return size


def valid_seed(value: int) -> int:
    """The value of ``seed``; InputError unless it is from 0 to 2^31 - 1."""
    if not 0 <= value < 1 << 31:
        raise InputError("{}: expected a number from 0 to {}", Option("seed", value), (1 << 31) - 1)
    return value
