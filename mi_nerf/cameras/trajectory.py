"""Camera paths around what a dataset or a scene shows."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .poses import average_pose, look_at

Poses = NDArray[np.float64]


def orbit(
    center: NDArray[np.float64], up: NDArray[np.float64], radius: float, height: float, frames: int
) -> Poses:
    """(frames, 4, 4) OpenGL poses on a circle that looks at ``center``.

    Args:
        up: unit vector, the axis of the circle.
        radius: distance of the cameras from ``center``.
        height: sine of the cameras' elevation above the plane through ``center``.
    """
    side = np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.9 else [0, 1.0, 0])
    side /= np.linalg.norm(side)
    front = np.cross(up, side)
    level = math.sqrt(max(0.0, 1 - height * height))
    poses = []
    for i in range(frames):
        angle = 2 * math.pi * i / frames
        out = level * (math.cos(angle) * side + math.sin(angle) * front) + height * up
        poses.append(look_at(center + radius * out, center, up))
    return np.array(poses)


def orbit_like(cam_to_world: Poses, frames: int) -> Poses:
    """A circle at the typical distance and height of given cameras, around what they look at."""
    center, up, radius, heights = _ring(cam_to_world)
    return orbit(center, up, radius, float(np.clip(np.median(heights), -0.9, 0.9)), frames)


def look_center(cam_to_world: Poses) -> NDArray[np.float64]:
    """The point nearest to all optical axes, in the least-squares sense."""
    origin, axis = cam_to_world[:, :3, 3], -cam_to_world[:, :3, 2]
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    # A little of the cameras' mean keeps the system regular when all axes are parallel.
    weight = 1e-6 * len(origin)
    system = across.sum(0) + weight * np.eye(3)
    right = (across @ origin[:, :, None]).sum(0)[:, 0] + weight * origin.mean(0)
    center: NDArray[np.float64] = np.linalg.solve(system, right)
    return center


def spiral_like(cam_to_world: Poses, frames: int) -> Poses:
    """Two turns around the centre of given cameras that rise from the lowest to the highest."""
    center, up, radius, heights = _ring(cam_to_world)
    low, high = np.clip(np.quantile(heights, [0.1, 0.9]), -0.95, 0.95)
    rising = np.linspace(low, high, frames)
    turns = [orbit(center, up, radius, float(h), frames) for h in rising]
    return np.array([turn[(2 * i) % frames] for i, turn in enumerate(turns)])


def forward_spiral(cam_to_world: Poses, near: float, far: float, frames: int) -> Poses:
    """Two turns around the average of cameras that face forward, as in the original code.

    At angle θ the camera is off by (cos θ, −sin θ, −sin ½θ) times the radii, in the axes of
    the average camera; a radius is what 90 % of the given cameras keep within. All frames
    look at one point on the average optical axis, whose disparity mixes that of the nearest
    and of the farthest content 1 : 3.

    Args:
        near, far: z-depths between which the content lies.

    Returns:
        OpenGL poses, (frames, 4, 4).
    """
    middle = average_pose(cam_to_world)
    offsets = (cam_to_world[:, :3, 3] - middle[:3, 3]) @ middle[:3, :3]
    radii = np.percentile(np.abs(offsets), 90, axis=0)
    focus = 1 / (0.25 / (0.9 * near) + 0.75 / (5 * far))
    target = middle[:3, 3] - focus * middle[:3, 2]
    poses = []
    for angle in 4 * math.pi * np.arange(frames) / frames:
        offset = radii * (math.cos(angle), -math.sin(angle), -math.sin(angle / 2))
        poses.append(look_at(middle[:3, 3] + middle[:3, :3] @ offset, target, middle[:3, 1]))
    return np.array(poses)


def _ring(
    cam_to_world: Poses,
) -> tuple[NDArray[np.float64], NDArray[np.float64], float, NDArray[np.float64]]:
    """Centre, up axis, distance and (sine of) elevations of cameras that look inwards."""
    center = look_center(cam_to_world)
    mean_up = cam_to_world[:, :3, 1].mean(axis=0)
    # The coordinate axis that the cameras agree on: their mean is rarely exactly upright.
    strongest = int(np.argmax(np.abs(mean_up)))
    up = np.zeros(3)
    up[strongest] = math.copysign(1.0, mean_up[strongest])
    offset = cam_to_world[:, :3, 3] - center
    distances = np.maximum(np.linalg.norm(offset, axis=1), 1e-12)
    return center, up, float(np.median(distances)), (offset @ up) / distances
