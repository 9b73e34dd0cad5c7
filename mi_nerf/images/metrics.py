"""Image metrics of the ``nerf2020`` protocol, and those of linear radiance.

PSNR and SSIM of opaque images in [0, 1], PSNR of radiance, all in double precision. A figure for a
set of images is the **mean of the figures of its images**. Never derive it from
their mean squared error: the logarithm is concave, so that the PSNR of the mean
error is the smaller of the two, and the difference grows with the spread of the
images.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.color import linear_to_srgb

# Taps of the Gaussian window: sigma 1.5 cut off at 3.5 sigma (Wang et al. 2004).
SSIM_WINDOW = 11


def to_8bit(image: ArrayLike) -> NDArray[np.float64]:
    """Clips to [0, 1] and rounds to the nearest k/255: what an 8-bit file would hold.

    Args:
        image: Any shape. NaN stays NaN.
    """
    clipped = np.clip(np.asarray(image, np.float64), 0.0, 1.0)
    return np.floor(clipped * 255.0 + 0.5) / 255.0


def psnr(a: ArrayLike, b: ArrayLike) -> float:
    """Peak signal-to-noise ratio ``-10 log10(mean((a - b)^2))`` in dB, peak 1.

    Args:
        a, b: Images of the same shape, any.

    Returns:
        The ratio, infinite for identical images.

    Raises:
        ValueError: The shapes differ.
    """
    x, y = _pair(a, b)
    mean_squared_error = float(np.mean((x - y) ** 2))
    return math.inf if mean_squared_error == 0 else -10.0 * math.log10(mean_squared_error)


def ssim(a: ArrayLike, b: ArrayLike) -> float:
    """Structural similarity (Wang et al. 2004), averaged over pixels and channels.

    With the settings of the original paper: Gaussian windows of 11×11 pixels and
    sigma 1.5, population covariance, K1 = 0.01, K2 = 0.03, data range 1. Only
    windows that lie wholly in the image count.

    Args:
        a, b: Images of the same shape, (H, W, C).

    Returns:
        The similarity, 1 for identical images. NaN where it is undefined, in
        images lower or narrower than the window.

    Raises:
        ValueError: The shapes differ or are not (H, W, C).
    """
    x, y = _pair(a, b)
    if x.ndim != 3:
        raise ValueError(f"expected images of shape (H, W, C), got {x.shape}")
    if min(x.shape[:2]) < SSIM_WINDOW:
        return math.nan
    # Here, because it takes half a second to import.
    from skimage.metrics import structural_similarity

    return float(
        structural_similarity(  # type: ignore[no-untyped-call]
            x,
            y,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
            data_range=1.0,
            channel_axis=-1,
        )
    )


def _pair(a: ArrayLike, b: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x, y = np.asarray(a, np.float64), np.asarray(b, np.float64)
    # Broadcasting would turn a forgotten axis into a wrong figure.
    if x.shape != y.shape:
        raise ValueError(f"images must agree in shape, got {x.shape} and {y.shape}")
    return x, y


# ---- Radiance ----------------------------------------------------------------

# Radiance up to about here counts as black, in the unit of the images.
BLACK = 1e-3


def tone_mapped(radiance: ArrayLike) -> NDArray[np.float64]:
    """Linear radiance brought into [0, 1): ``x/(1 + x)`` (Reinhard et al. 2002), as sRGB.

    Args:
        radiance: Any shape. Negative values count as 0; NaN stays NaN.
    """
    x = np.maximum(np.asarray(radiance, np.float64), 0)
    return linear_to_srgb(x / (1 + x))


def psnr_tone_mapped(a: ArrayLike, b: ArrayLike) -> float:
    """PSNR in dB of linear radiance after :func:`tone_mapped`, not rounded.

    Args:
        a, b: Images of the same shape, any.
    """
    x, y = _pair(a, b)
    return psnr(tone_mapped(x), tone_mapped(y))


def psnr_log(a: ArrayLike, b: ArrayLike, black: float = BLACK) -> float:
    """PSNR in dB of ``log10(x + black)`` of linear radiance, with one decade as the peak.

    20 dB is a root mean square of a tenth of a decade: off by 26 %, at any brightness.

    Args:
        a, b: Images of the same shape, any. Negative values count as 0.
        black: Added to both.
    """
    x, y = (np.log10(np.maximum(image, 0) + black) for image in _pair(a, b))
    return psnr(x, y)
