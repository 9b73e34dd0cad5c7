"""Tiny datasets for tests."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from PIL import Image

from mi_nerf.cameras.pinhole import Intrinsics
from mi_nerf.cameras.poses import look_at
from mi_nerf.images.write import encoded


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


def exact_rays(camera: Intrinsics, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origin, (3,), and unit directions, (H, W, 3), through the centres of pixels, in float64."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    local = [(x - camera.cx) / camera.fx, (camera.cy - y) / camera.fy, -np.ones_like(x)]
    d = np.stack(local, axis=-1) @ pose[:3, :3].T
    return pose[:3, 3], d / np.linalg.norm(d, axis=-1, keepdims=True)


def blob_images(
    poses: np.ndarray, size: int, angle_x: float, *, mirror: bool = False
) -> np.ndarray:
    """A ball of radius 0.8 with a soft edge, coloured by its normal, straight RGBA uint8.

    With ``mirror`` it is coloured by the direction in which it reflects the ray instead.
    """
    camera = Intrinsics.from_angle_x(size, size, angle_x)
    y, x = np.mgrid[:size, :size] + 0.5
    local = np.stack(
        [(x - camera.cx) / camera.fx, (camera.cy - y) / camera.fy, -np.ones_like(x)], axis=-1
    )
    images = []
    for pose in poses:
        d = local @ pose[:3, :3].T
        d /= np.linalg.norm(d, axis=-1, keepdims=True)
        o = pose[:3, 3]
        b = d @ o
        depth = 0.64 - (o @ o - b * b)  # below 0 where the ray misses
        normal = (o - d * (b + np.sqrt(np.maximum(depth, 0)))[..., None]) / 0.8
        alpha = np.clip(depth / 0.1, 0, 1)[..., None]
        if mirror:
            normal = d - 2 * (d * normal).sum(axis=-1, keepdims=True) * normal
        images.append(np.concatenate([np.clip(0.5 + 0.5 * normal, 0, 1), alpha], axis=-1))
    return np.rint(255 * np.array(images)).astype(np.uint8)


def write_blob_dataset(folder: Path, *, train: int = 8, test: int = 5, size: int = 24) -> Path:
    """A dataset of the blob in two splits, with cameras at two heights; returns ``folder``."""
    for split, count, height in (("train", train, 1.0), ("test", test, 1.5)):
        poses = orbit_poses(count, height=height)
        write_blender_dataset(folder, blob_images(poses, size, 0.6), poses, 0.6, split)
    return folder


def radiant_images(poses: np.ndarray, size: int, angle_x: float) -> np.ndarray:
    """A dark ball with a lamp of radiance 50 on top: linear premultiplied RGBA, (N, H, W, 4).

    It is matt: 0.01 below, 0.4 near the lamp, and a little redder than green and blue.
    """
    camera = Intrinsics.from_angle_x(size, size, angle_x)
    images = []
    for pose in poses:
        o, d = exact_rays(camera, pose)
        b = d @ o
        depth = 0.64 - (o @ o - b * b)  # below 0 where the ray misses
        height = (o - d * (b + np.sqrt(np.maximum(depth, 0)))[..., None])[..., 2] / 0.8
        light = np.where(height > 0.7, 50, 0.01 + 0.4 * np.clip(height, 0, 1) ** 2)
        alpha = np.clip(depth / 0.1, 0, 1)
        color = light[..., None] * np.array([1, 0.9, 0.8]) * alpha[..., None]
        images.append(np.concatenate([color, alpha[..., None]], axis=-1))
    return np.array(images, np.float32)


def write_radiant_dataset(folder: Path, *, size: int = 24) -> Path:
    """:func:`radiant_images` as ``generate`` writes them, EXR and PNG; returns ``folder``."""
    for split, count, height in (("train", 10, 2.0), ("test", 3, 2.5)):
        poses = orbit_poses(count, height=height)
        images = radiant_images(poses, size, 0.6)
        pictures = np.rint(255 * np.array([encoded(image) for image in images]))
        write_blender_dataset(folder, pictures.astype(np.uint8), poses, 0.6, split)
        for i, image in enumerate(images):
            planes = np.ascontiguousarray(np.moveaxis(image, -1, 0))
            file = folder / split / f"r_{i}.exr"
            write_exr(file, **dict(zip("RGBA", planes, strict=True)))
    return folder


def forward_poses(n: int, spread: float = 0.3, seed: int = 0) -> np.ndarray:
    """OpenGL poses around the origin, (n, 4, 4), that look roughly along -y; z is up."""
    rng = np.random.default_rng(seed)
    origins = rng.uniform(-spread, spread, (n, 3))
    targets = rng.uniform(-spread, spread, (n, 3)) + (0, -5, 0)
    return np.stack([look_at(o, t) for o, t in zip(origins, targets, strict=True)])


def write_llff_dataset(
    folder: Path,
    images: np.ndarray,
    poses: np.ndarray,
    focal: float,
    *,
    bounds: tuple[float, float] = (2.0, 20.0),
    reduced: int = 1,
    subfolder: str = "images",
) -> Path:
    """Writes a capture as LLFF does; returns ``folder``.

    ``images`` is (N, H, W, 3) of uint8, ``reduced`` times smaller than the film, of which
    ``focal`` is the focal length in pixels; ``poses`` is (N, 4, 4), OpenGL.
    """
    (folder / subfolder).mkdir(parents=True, exist_ok=True)
    rows = []
    for i, (image, pose) in enumerate(zip(images, poses, strict=True)):
        Image.fromarray(image).save(folder / subfolder / f"IMG_{i:04d}.png")
        height, width = image.shape[0] * reduced, image.shape[1] * reduced
        matrix = np.zeros((3, 5))
        matrix[:, 0], matrix[:, 1], matrix[:, 2] = -pose[:3, 1], pose[:3, 0], pose[:3, 2]
        matrix[:, 3], matrix[:, 4] = pose[:3, 3], (height, width, focal)
        rows.append([*matrix.ravel(), *bounds])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder
