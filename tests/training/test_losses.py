"""Losses of rays against sums in NumPy."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mi_nerf.training.losses import mean_squared_error

NUMBER = st.floats(-1, 2, width=32)


@given(
    st.lists(NUMBER, min_size=3, max_size=3),
    st.lists(NUMBER, min_size=3, max_size=3),
    NUMBER,
    NUMBER,
)
@settings(
    max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_error_over_all_backgrounds_is_the_mean_over_many(
    variant: str, color: list[float], true: list[float], alpha: float, true_alpha: float
) -> None:
    found = mean_squared_error(
        [mi.Float(c) for c in color], mi.Float(alpha), [mi.Float(c) for c in true],
        mi.Float(true_alpha),
    )  # fmt: skip
    node, weight = np.polynomial.legendre.leggauss(3)  # exact for squares
    errors = []
    for b, w in zip((node + 1) / 2, weight / 2, strict=True):
        off = np.asarray(color) + (1 - alpha) * b - np.asarray(true) - (1 - true_alpha) * b
        errors.append(w * np.mean(off**2))
    assert found[0] == pytest.approx(sum(errors), abs=1e-5)
