"""Takes the noise of light paths out of pictures, by Intel's Open Image Denoise."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import closing
from typing import Any

import numpy as np

from ..base.arrays import Image
from ..base.errors import InputError, Option


def denoiser() -> Any:
    """The library; on a machine with an NVIDIA GPU it runs there.

    Raises:
        InputError: if it is not installed.
    """
    try:
        import mitsuba_oidn
    except ImportError as error:
        raise InputError(
            "{}: the package 'mitsuba-oidn' is not installed, expected after "
            "pip install 'mi_nerf[denoise]'",
            Option("denoise"),
        ) from error
    return mitsuba_oidn


def denoised(image: Image, albedo: Image | None = None, normal: Image | None = None) -> Image:
    """A picture without noise, or so it looks: the mean of its pixels changes a little.

    Args:
        image: (H, W, 4) linear premultiplied RGBA; alpha stays as it is.
        albedo: (H, W, 3) colours of what is seen, in [0, 1]; keeps textures sharp.
        normal: (H, W, 3) unit normals, or 0; keeps edges sharp.

    Raises:
        InputError: if the library is not installed.
    """
    features = {"albedo": albedo, "normal": normal}
    given = {k: np.ascontiguousarray(v, np.float32) for k, v in features.items() if v is not None}
    color = np.ascontiguousarray(image[..., :3], np.float32)
    result = np.array(image, np.float32)
    result[..., :3] = np.maximum(denoiser().denoise(color, hdr=True, **given), 0)
    return result


def denoised_frames(
    frames: Generator[tuple[str, Image], None, None],
) -> Generator[tuple[str, Image], None, None]:
    """The same frames, each on its own, without noise."""
    with closing(frames):
        for name, image in frames:
            yield name, denoised(image)
