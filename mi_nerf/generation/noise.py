"""How far a path-traced image is from the one that it converges to.

An image of n samples a pixel is rendered as two independent ones A and B of n₁ + n₂ = n
samples, and their weighted mean M is kept. A pixel's variance being σ²/samples,
E[(A − B)²] = σ²(1/n₁ + 1/n₂), and the variance of M, which is its mean squared error
because path tracing is unbiased, is σ²/n. So

    D = (A − B)·√(n₁n₂)/n

has mean zero and the variance of M's error: mean(D²) is an unbiased estimate of its mean
squared error against the converged image.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, TypeAlias

import numpy as np

from ..base.arrays import Image
from ..images.write import on_white

# How many samples a pixel has: as many as any other, or (H, W, 1) numbers where some were dropped.
Samples: TypeAlias = int | Image


@dataclass(frozen=True)
class Noise:
    """Estimated mean squared errors of one view against its converged image."""

    mse_linear: float  # of linear premultiplied RGB, unbiased
    mse_srgb: float  # of sRGB on white in [0, 1]; unbiased to first order in the noise
    mse_8bit: float  # the same after both images are rounded to 8 bits, as nerf2020 measures

    @property
    def psnr_ceiling(self) -> float | None:
        """The PSNR in dB that the converged image itself would get; ``None``: infinite."""
        return -10 * math.log10(self.mse_8bit) if self.mse_8bit > 0 else None

    def record(self) -> dict[str, float | None]:
        """What ``dataset.json`` holds."""
        return {**asdict(self), "psnr_ceiling": self.psnr_ceiling}


def estimate(a: Image, b: Image, samples: tuple[Samples, Samples]) -> Noise:
    """The noise of the weighted mean of two renderings.

    Args:
        a, b: Linear premultiplied RGBA of the same view, (H, W, 4), independent.
        samples: Samples a pixel of each. Pixels of which one has none tell nothing of noise,
            and do not count.
    """
    noisy = (a != b).any(axis=-1)  # empty background has no error
    scale: Any
    if isinstance(samples[0], int) and isinstance(samples[1], int):
        scale, count = math.sqrt(samples[0] * samples[1]) / sum(samples), a[..., :3].size
    else:
        counts = (np.broadcast_to(np.float64(n), (*noisy.shape, 1)) for n in samples)
        scale = _error_scale(*counts)
        count = max(1, 3 * int((scale > 0).sum()))
        scale = scale[noisy]
    a, b = a[noisy], b[noisy]
    linear = (a[..., :3] - b[..., :3]) * scale
    display = (on_white(a) - on_white(b)) * scale
    return Noise(
        mse_linear=_sum(np.square(linear, dtype=np.float64)) / count,
        mse_srgb=_sum(np.square(display)) / count,
        mse_8bit=_sum(_rounded_squares(display)) / count,
    )


def mean_image(a: Image, b: Image, samples: tuple[Samples, Samples]) -> Image:
    """The mean of two renderings, weighted by their samples a pixel."""
    total: Any = samples[0] + samples[1]
    share: Any = samples[0] / (total if isinstance(total, int) else np.maximum(total, 1))
    return (a * share + b * (1 - share)).astype(np.float32)


def _error_scale(a: Image, b: Image) -> Image:
    """√(ab)/(a + b), or 0: how far the mean of so many samples is off, by their difference."""
    scale: Image = np.sqrt(a * b) / np.maximum(a + b, 1)
    return scale


def _sum(values: Image) -> float:
    return float(np.sum(values, dtype=np.float64))


def _rounded_squares(errors: Image) -> Image:
    """E[(round(u + e) − round(u))²] over u uniform within a step of 1/255.

    With |e| = (k + f)/255, k whole and 0 ≤ f < 1, the rounded values differ by k + 1 steps
    with probability f, and by k otherwise.
    """
    steps = np.abs(errors) * 255
    whole = np.floor(steps)
    squares: Image = (whole**2 + (steps - whole) * (2 * whole + 1)) / 255**2
    return squares
