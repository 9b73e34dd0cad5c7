"""What a prediction is measured by."""

from __future__ import annotations

from typing import Any

import drjit as dr


def squared_error(predicted: list[Any], target: list[Any]) -> Any:
    """Squared error of every ray, mean over channels (NeRF Eq. 6)."""
    return sum(dr.square(p - t) for p, t in zip(predicted, target, strict=True)) / 3


def relative_error(predicted: list[Any], target: list[Any]) -> Any:
    """Squared error relative to the prediction, for HDR targets (RawNeRF, Eq. 4)."""
    return (
        sum(
            dr.square((p - t) / (dr.detach(p) + 1e-3))
            for p, t in zip(predicted, target, strict=True)
        )
        / 3
    )


LOSSES = {"mse": squared_error, "relative": relative_error}
