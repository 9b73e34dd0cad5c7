"""Checks of values that options of commands and functions share."""

from __future__ import annotations

import math
from typing import Any

from .errors import InputError


def positive(name: str, value: Any) -> Any:
    """The value of option ``--name``; InputError unless it is a finite number above 0."""
    if not 0 < value < math.inf:
        raise InputError(f"--{name} {value}: expected a number above 0")
    return value


def valid_seed(value: int) -> int:
    """The value of ``--seed``; InputError unless it is from 0 to 2^31 - 1."""
    if not 0 <= value < 1 << 31:
        raise InputError(f"--seed {value}: expected a number from 0 to {(1 << 31) - 1}")
    return value
