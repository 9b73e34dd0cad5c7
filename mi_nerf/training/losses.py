"""What a prediction is measured by."""

from __future__ import annotations

from typing import Any

import drjit as dr


def squared_error(predicted: list[Any], target: list[Any]) -> Any:
    """Squared error of every ray, mean over channels (NeRF Eq. 6)."""
    return sum(dr.square(p - t) for p, t in zip(predicted, target, strict=True)) / 3


def mean_squared_error(color: list[Any], alpha: Any, true: list[Any], true_alpha: Any) -> Any:
    """Squared error of every ray, mean over channels and over all backgrounds in [0, 1].

    Before a background b, a channel of premultiplied colours c and C with opacities a and A is
    off by (c − C) − b·(a − A); the mean of its square over b is (c − C)² − (c − C)·(a − A)
    + (a − A)²/3, without the noise of drawing backgrounds.

    Args:
        color, alpha: predicted, three arrays of R values and one.
    """
    da = alpha - true_alpha
    channels = [dr.square(c - t) - (c - t) * da for c, t in zip(color, true, strict=True)]
    return sum(channels) / 3 + dr.square(da) / 3


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
