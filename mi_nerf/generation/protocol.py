"""How many views a dataset has, how large they are, and where cameras stand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Cameras = Literal["hemisphere", "sphere", "forward"]

SPLITS = ("train", "val", "test")
CAMERA_ANGLE_X = 0.6911  # the horizontal field of view of nerf_synthetic, radians
RADIUS = 4.0  # distance of its cameras from the centre of the scene
HOLD_OUT = 8  # forward-facing captures: every so many-th view is for testing


@dataclass(frozen=True)
class Protocol:
    """The numbers of one of the paper's kinds of dataset (NeRF Sec. 6.1)."""

    train: int
    val: int
    test: int
    size: tuple[int, int]  # width, height


PROTOCOLS = {
    # Ten validation views, where the paper's set has 100: readers insist on the split.
    "realistic360": Protocol(100, 10, 200, (800, 800)),
    "diffuse360": Protocol(479, 10, 1000, (512, 512)),  # as DeepVoxels
    "forward": Protocol(28, 0, 4, (1008, 756)),
}


@dataclass(frozen=True)
class Options:
    """What a user may say about a dataset; ``None`` leaves it to protocol and scene."""

    protocol: str | None = None  # a key of PROTOCOLS; the scene's own, or realistic360
    train: int | None = None  # views
    val: int | None = None
    test: int | None = None
    size: tuple[int, int] | None = None  # width, height in pixels
    spp: int | None = None  # samples a pixel; those of the scene's sampler
    seed: int = 0  # of camera positions and noise
    cameras: Literal["hemisphere", "sphere"] | None = None  # of the 360-degree protocols
    up: Literal["x", "y", "z"] | None = None  # vertical axis; that of the scene's sensor, or z
    center: tuple[float, float, float] | None = None  # what the cameras look at
    radius: float | None = None  # their distance from it; forward: how far they move sideways
    keep_emitters: tuple[str, ...] = ()  # IDs of light sources that are seen, or "all"
