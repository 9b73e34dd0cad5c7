"""What a prediction is measured by."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr

from ..base.color import linear_to_srgb
from ..march.quadrature import over_background
from .config import TrainConfig

if TYPE_CHECKING:
    from .batches import RayBatch

RELATIVE_FLOOR = TrainConfig.loss_floor  # where a caller has no other
# Of opacity beside relative errors. With 1, silhouettes are blurred, with 100, colours suffer:
# docs/datasets.md has the figures.
ALPHA_WEIGHT = 10.0


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


def relative_error(predicted: list[Any], target: list[Any], floor: float = RELATIVE_FLOOR) -> Any:
    """Squared error of every ray relative to the prediction, mean over channels, for radiance.

    ((c − C) / (c + floor))², the first c of which alone has a derivative (RawNeRF, Eq. 4): the
    error of log(c) to first order, whose minimum is the mean of noisy targets nevertheless. Where
    a target is more than about twice the prediction, the square goes on as its tangent: c near 0
    below a lamp of 1e4 would outweigh all other rays of a step by 1e8 and more.

    Args:
        floor: radiance below which errors are absolute.
    """
    pairs = zip(predicted, target, strict=True)
    return sum(_limited_square((c - t) / (dr.abs(dr.detach(c)) + floor)) for c, t in pairs) / 3


def relative_error_and_alpha(
    color: list[Any], alpha: Any, true: list[Any], true_alpha: Any, floor: float = RELATIVE_FLOOR
) -> Any:
    """:func:`relative_error` of premultiplied radiance, plus 10 times the squared error of opacity.

    This takes the place of random backgrounds where targets have alpha: before them, a dark
    surface would be dark only as far as it is opaque to the last per mille.
    """
    return relative_error(color, true, floor) + ALPHA_WEIGHT * dr.square(alpha - true_alpha)


def tone_mapped_error(predicted: list[Any], target: list[Any]) -> Any:
    """Squared error of every ray after tone mapping, x/(1 + x) as sRGB; mean over channels."""

    def mapped(x: Any) -> Any:
        x = dr.maximum(x, 0)
        return linear_to_srgb(x / (1 + x))

    pairs = zip(predicted, target, strict=True)
    return sum(dr.square(mapped(p) - mapped(t)) for p, t in pairs) / 3


def _limited_square(x: Any) -> Any:
    """x² up to |x| = 1, its tangent 2|x| − 1 beyond."""
    size = dr.abs(x)
    return dr.select(size > 1, 2 * size - 1, dr.square(x))


class RayLoss:
    """The loss of every ray, and the error whose decibels are reported.

    That is the squared error or, with the relative loss, the one after tone mapping. Where
    backgrounds are random, neither depends on those that were drawn.
    """

    def __init__(self, kind: str, background: str, floor: float = RELATIVE_FLOOR) -> None:
        """
        Args:
            kind: ``mse`` or ``relative``.
            background: ``white``, ``black`` or ``random``.
            floor: of the relative loss.
        """
        self.kind, self._floor = kind, floor
        self._over_all = background == "random"

    def __call__(self, color: list[Any], alpha: Any, batch: RayBatch) -> tuple[Any, Any]:
        """Of rays that see these premultiplied colours where they ought to see a batch."""
        if not self._over_all:
            return self.before(color, alpha, batch)
        if self.kind == "relative":
            loss = relative_error_and_alpha(color, alpha, batch.color, batch.alpha, self._floor)
            return loss, tone_mapped_error(color, batch.color)
        error = mean_squared_error(color, alpha, batch.color, batch.alpha)
        return error, error

    def before(self, color: list[Any], alpha: Any, batch: RayBatch) -> tuple[Any, Any]:
        """The same before the backgrounds of the batch, be they random."""
        predicted = over_background(color, alpha, batch.background)
        target = over_background(batch.color, batch.alpha, batch.background)
        if self.kind == "relative":
            loss = relative_error(predicted, target, self._floor)
            return loss, tone_mapped_error(predicted, target)
        error = squared_error(predicted, target)
        return error, error
