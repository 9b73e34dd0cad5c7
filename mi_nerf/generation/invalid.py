"""Samples that are no numbers: dropped one by one, and counted.

A NaN or an infinity in one sample would take the whole pixel with it. Mitsuba's films warn of such
samples in scalar variants only, and add them up in all. Here a picture that has none is taken as it
is. One that has any is rendered again with the same seed by an integrator around the scene's own
(wrapped.py), which gives zero for these samples and counts them, in the same kernel; or, where
paths do not belong to camera rays, sample by sample.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..base.arrays import Image
from .wrapped import LARGEST

SHARE = 0.01  # of a view's samples that may be dropped


def without_invalid(image: Image, samples: int) -> tuple[Image, Image]:
    """What a guarded integrator has rendered, as if the samples it dropped had not been taken.

    Args:
        image: (H, W, 5): RGBA and the share of samples that are no numbers.
        samples: Samples a pixel.

    Returns:
        The mean of the others, (H, W, 4), 0 where there are none, and how many they are,
        (H, W, 1).
    """
    good = samples - np.rint(image[..., 4:] * samples)
    mean: Image = image[..., :4] * np.float32(samples) / np.maximum(good, 1)
    return mean.astype(np.float32), good.astype(np.float32)


def one_by_one(render: Callable[[int], Image], samples: int) -> tuple[Image, Image]:
    """The same from pictures of one sample a pixel each, of which values that are numbers count.

    Args:
        render: Renders the picture of one sample, by its number, (H, W, 4) or with more channels.
    """
    total: Any = 0.0
    good: Any = 0
    for i in range(samples):
        image = render(i)[..., :4]
        known = (np.abs(image) < LARGEST).all(axis=-1, keepdims=True)  # not if NaN
        total = total + np.where(known, image, 0)
        good = good + known
    mean: Image = total / np.maximum(good, 1)
    return mean.astype(np.float32), good.astype(np.float32)
