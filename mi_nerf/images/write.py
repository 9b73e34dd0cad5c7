"""Writing pictures: linear premultiplied RGBA to OpenEXR and PNG."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as iio
import numpy as np
import OpenEXR

from ..base.arrays import Image
from ..base.color import linear_to_srgb
from ..base.errors import InputError
from ..base.files import replacing

_CHANNELS = {1: "Y", 3: "RGB", 4: "RGBA"}


def write_picture(path: Path, image: Image) -> None:
    """Writes (H, W, 4) linear premultiplied RGBA as ``.exr``, or 8 bits straight as ``.png``.

    Raises:
        InputError: if the file cannot be written; nothing lies under its name then.
    """
    if path.suffix.lower() == ".exr":
        write_exr(path, image)
        return
    pixels = np.rint(encoded(image) * 255).astype(np.uint8)
    with replacing(path) as temporary:
        # A quarter faster than the usual level 6, for about 1 % more bytes.
        iio.imwrite(temporary, pixels, extension=".png", compress_level=3)


def write_exr(path: Path, image: Image) -> None:
    """Writes (H, W, C) numbers as 32-bit OpenEXR; C = 1 (Y), 3 (RGB) or 4 (RGBA).

    Raises:
        InputError: if the file cannot be written; nothing lies under its name then.
    """
    pixels = np.ascontiguousarray(image, np.float32)
    names = _CHANNELS[pixels.shape[-1]]
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with replacing(path) as temporary:
        try:
            channel = pixels[..., 0] if len(names) == 1 else pixels
            with OpenEXR.File(header, {names: channel}) as file:
                file.write(str(temporary))
        except RuntimeError as error:  # it knows no OSError, not even for a full disk
            raise InputError(f"{path}: cannot be written: {error}") from error


def encoded(image: Image) -> Image:
    """What a PNG holds, before rounding: (H, W, 4) straight sRGB in [0, 1].

    Args:
        image: Linear premultiplied RGBA. Colour without alpha is black.
    """
    alpha = np.clip(image[..., 3:], 0, 1)
    straight = image[..., :3] / np.where(alpha > 0, alpha, 1)
    color = np.where(alpha > 0, linear_to_srgb(straight), 0)
    return np.concatenate([np.clip(color, 0, 1), alpha], axis=-1)


def on_white(image: Image) -> Image:
    """What a viewer shows, before rounding: (..., 3) sRGB in [0, 1], composited in sRGB.

    Args:
        image: (..., 4) linear premultiplied RGBA.
    """
    straight = encoded(image)
    shown: Image = straight[..., :3] * straight[..., 3:] + (1 - straight[..., 3:])
    return shown
