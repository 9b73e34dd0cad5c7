"""Forward-facing captures in the layout of LLFF (Mildenhall et al. 2019)."""

from __future__ import annotations

import io
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from ..base.files import make_folder, replacing
from ..cameras.pinhole import Intrinsics

Array = np.ndarray[Any, Any]


def poses_bounds(poses: Array, intrinsics: Intrinsics, bounds: Array) -> Array:
    """The rows of ``poses_bounds.npy``, (N, 17).

    A row is the 3×5 matrix [R | t | (height, width, focal)] row by row, then the near and
    far z-depth. The columns of R are the camera's down, right and backward axes.

    Args:
        poses: OpenGL camera-to-world matrices, (N, 4, 4).
        bounds: Near and far z-depth of each view, (N, 2).
    """
    right, up, back, origin = (poses[:, :3, i] for i in range(4))
    film = np.array([intrinsics.height, intrinsics.width, intrinsics.fx])
    film = np.broadcast_to(film, origin.shape)
    matrix = np.stack([-up, right, back, origin, film], axis=-1)
    return np.concatenate([matrix.reshape(-1, 15), bounds], axis=1)


def write_llff(folder: Path, images: list[Path], rows: Array) -> None:
    """Writes ``poses_bounds.npy``, and copies the pictures in its order to ``images/``."""
    make_folder(folder / "images")
    for i, image in enumerate(images):
        with replacing(folder / "images" / f"view_{i:03d}{image.suffix}") as temporary:
            shutil.copyfile(image, temporary)
    buffer = io.BytesIO()
    np.save(buffer, rows)
    with replacing(folder / "poses_bounds.npy") as temporary:
        temporary.write_bytes(buffer.getvalue())
