"""How many views a dataset has, how large they are, and where cameras stand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

# On a (hemi)sphere around the object, beside the scene's sensor, within a room, or the
# scene's own sensors.
Cameras = Literal["hemisphere", "sphere", "forward", "room", "scene"]

SPLITS = ("train", "val", "test")
CAMERA_ANGLE_X = 0.6911  # the horizontal field of view of nerf_synthetic, radians
RADIUS = 4.0  # distance of its cameras from the centre of the scene
HOLD_OUT = 8  # of forward-facing captures and a scene's sensors every so many-th is for testing


@dataclass(frozen=True)
class Protocol:
    """The numbers of a kind of dataset (NeRF Sec. 6.1)."""

    train: int
    val: int
    test: int
    size: tuple[int, int]  # width, height


PROTOCOLS = {
    # Ten validation views, where the paper's set has 100: readers insist on the split.
    "realistic360": Protocol(100, 10, 200, (800, 800)),
    "diffuse360": Protocol(479, 10, 1000, (512, 512)),  # as DeepVoxels
    "forward": Protocol(28, 0, 4, (1008, 756)),
    "room": Protocol(100, 10, 50, (800, 600)),  # ours: the paper has no rooms seen from inside
}


@dataclass(frozen=True)
class Options:
    """What a user may say about a dataset; ``None`` leaves it to protocol and scene."""

    # A key of PROTOCOLS; the scene's own, or realistic360, or room where that sees nothing.
    protocol: str | None = None
    train: int | None = None  # views
    val: int | None = None
    test: int | None = None
    size: tuple[int, int] | None = None  # width, height in pixels
    spp: int | None = None  # samples a pixel; those of the scene's sampler
    seed: int = 0  # of camera positions and noise
    # Of the 360-degree protocols; "scene" takes the scene's own sensors instead.
    cameras: Literal["hemisphere", "sphere", "scene"] | None = None
    # Vertical: "x", "-y", … or a direction; that of the scene's sensor or base, or z.
    up: str | tuple[float, float, float] | None = None
    center: tuple[float, float, float] | None = None  # what the cameras look at
    radius: float | None = None  # their distance from it; forward: how far they move sideways
    elevation: tuple[float, float] | None = None  # of 360-degree cameras over its horizon, degrees
    object: tuple[str, ...] | None = None  # the shapes that cameras look at; found by size
    keep_emitters: tuple[str, ...] = ()  # IDs of light sources that are seen, or "all"
