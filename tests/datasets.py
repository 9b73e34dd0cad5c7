"""Tiny datasets for tests."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from PIL import Image

from mi_nerf.cameras import look_at


def write_blender_dataset(
    folder: Path,
    images: np.ndarray,
    poses: np.ndarray,
    angle_x: float,
    split: str = "train",
    **extra: Any,
) -> Path:
    """Writes one split as Blender/NeRF does and returns its JSON file.

    ``images`` is (N, H, W, 4) straight RGBA, or (N, H, W, 3), of uint8; ``poses``
    is (N, 4, 4); ``extra`` are further keys of the JSON.
    """
    (folder / split).mkdir(parents=True, exist_ok=True)
    frames = []
    for i, (image, pose) in enumerate(zip(images, poses, strict=True)):
        Image.fromarray(image).save(folder / split / f"r_{i}.png")
        frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": pose.tolist()})
    file = folder / f"transforms_{split}.json"
    file.write_text(json.dumps({"camera_angle_x": angle_x, "frames": frames, **extra}))
    return file


def write_exr(path: Path, **channels: np.ndarray) -> None:
    """Writes (H, W) planes as the channels of an EXR file."""
    OpenEXR.File(
        {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels
    ).write(str(path))


def random_images(n: int, height: int, width: int, channels: int = 4, seed: int = 0) -> np.ndarray:
    """Noise, (n, height, width, channels) uint8."""
    return np.random.default_rng(seed).integers(
        0, 256, (n, height, width, channels), dtype=np.uint8
    )


def orbit_poses(n: int, radius: float = 4.0, height: float = 1.0) -> np.ndarray:
    """OpenGL poses on a circle around the z axis that look at the origin, (n, 4, 4)."""
    angles = 2 * np.pi * np.arange(n) / n
    return np.stack(
        [look_at((radius * np.cos(a), radius * np.sin(a), height), (0, 0, 0)) for a in angles]
    )
