"""Numbers for the hard cases: what the usual formula makes of each, and what mi_nerf does.

    python -m tests.hard_cases

prints the table of docs/stability.md. Every case is a function of the array types of a
backend (such as ``drjit.llvm.ad``) that returns a few :class:`Finding`; test_stability.py
asserts what they must be. Usual formulas are those of :mod:`tests.support.naive`; what is right
comes from closed forms in float64.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Finding:
    """One measured quantity, whose best value is 0 unless ``what`` says otherwise."""

    what: str
    naive: float
    ours: float


@dataclass(frozen=True)
class Case:
    """A row of the table."""

    row: int
    name: str
    naive: str  # the usual formula, in words
    measure: Callable[[Any], list[Finding]]

    @property
    def test(self) -> str:
        """The name of the test in test_stability.py."""
        return f"test_row_{self.row:02d}_{self.measure.__name__}"


def relative(found: Any, exact: Any) -> float:
    """The largest relative error; NaN if anything is not finite."""
    found, exact = np.asarray(found, float), np.asarray(exact, float)
    if not np.isfinite(found).all():
        return float("nan")
    return float(np.max(np.abs(found - exact) / np.abs(exact)))


def not_finite(*arrays: Any) -> int:
    """How many numbers of Dr.Jit arrays are infinite or NaN."""
    return sum(int(np.sum(~np.isfinite(np.array(a)))) for a in arrays)
