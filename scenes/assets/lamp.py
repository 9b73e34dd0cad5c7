"""The turned metal of the lamp: an eighth of each profile, and the arm's curve."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from geometry import Array, output_folder, write_curves, write_ply
from PIL import Image


def arc(centre: tuple[float, float], radius: float, start: float, end: float, count: int) -> Array:
    """Points (r, z) of a circle's arc, degrees from the r axis."""
    angle = np.radians(np.linspace(start, end, count))
    return np.array(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def smooth_normals(profile: Array, crease: float = 40.0) -> tuple[Array, Array]:
    """The profile with its creases doubled, and a normal for every point of it."""
    along = np.diff(profile, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    sides = np.stack([along[:, 1], -along[:, 0]], axis=1)
    points, normals = [profile[0]], [sides[0]]
    for k in range(1, len(profile) - 1):
        if sides[k - 1] @ sides[k] > np.cos(np.radians(crease)):
            points.append(profile[k])
            normals.append((sides[k - 1] + sides[k]) / np.linalg.norm(sides[k - 1] + sides[k]))
        else:
            points += [profile[k]] * 2
            normals += [sides[k - 1], sides[k]]
    return np.array([*points, profile[-1]]), np.array([*normals, sides[-1]])


def write_turned(path: Path, profile: Array, segments: int = 8) -> None:
    """An eighth of the solid that the profile (r, z), from bottom to top, sweeps around z."""
    points, normals = smooth_normals(profile)
    angle = np.linspace(0, np.pi / 4, segments + 1)[:, None]

    def turn(p: Array) -> Array:
        r, z = p.T
        swept = [r * np.cos(angle), r * np.sin(angle), z + 0 * angle]
        return np.stack(swept, axis=-1).reshape(-1, 3)

    count = len(points)
    same = np.all(np.abs(np.diff(points, axis=0)) < 1e-9, axis=1)
    column = np.flatnonzero(~same)
    a = (column[None] + count * np.arange(segments)[:, None]).ravel()
    right = np.stack([a, a + count, a + 1], axis=1)
    left = np.stack([a + 1, a + count, a + count + 1], axis=1)
    write_ply(path, turn(points), np.concatenate([right, left]), normals=turn(normals))


def reflector() -> Array:
    """A bowl of ridged rings around the origin, each of which shows the bulb, rolled at the rim."""
    ridges, opening, thickness = 7, 0.43, 0.016
    t = np.linspace(0, 1, 4 * ridges + 1)
    r = 0.045 + (opening - 0.045) * t
    bowl = np.stack([r, 0.235 * t**1.35 - 0.12], axis=1)
    inside = bowl + np.stack([0 * t, 0.011 * np.abs(np.sin(np.pi * ridges * t))], axis=1)
    outside = bowl[::4] + [0.0, -thickness]
    lip = arc((opening + 0.004, inside[-1, 1] - 0.006), 0.017, -110, 150, 8)
    return np.concatenate([outside, lip, inside[::-1]])


def foot() -> Array:
    """The lamp's weighted foot with a stepped shoulder, and the collar of the stem."""
    shoulder = arc((0.21, 0.035), 0.035, -30, 75, 6)
    sweep_r = np.linspace(0.2, 0.05, 9)
    sweep = np.stack([sweep_r, 0.078 + 0.075 * ((0.2 - sweep_r) / 0.15) ** 2.2], axis=1)
    collar = arc((0.034, 0.172), 0.02, -50, 90, 6)
    return np.concatenate([[[0.23, 0.0], [0.24, 0.006]], shoulder, sweep, collar, [[0.02, 0.192]]])


def tray() -> Array:
    """A shallow round tray with a raised lip."""
    lip = arc((0.9, 0.052), 0.022, -40, 170, 8)
    return np.concatenate(
        [
            [[0.70, -0.045], [0.86, -0.045], [0.872, -0.04], [0.885, 0.005]],
            lip,
            [[0.868, 0.02], [0.855, 0.004], [0.84, 0.0], [0.42, 0.0], [0.0, 0.0]],
        ]
    )


def arm() -> Array:
    """The stem's B-spline from the foot to the back of the reflector: x, y, z, radius."""
    points = np.array(
        [
            (-0.34, 0.36, -0.47),
            (-0.34, 0.36, -0.42),
            (-0.345, 0.37, -0.28),
            (-0.39, 0.45, -0.05),
            (-0.39, 0.50, 0.14),
            (-0.31, 0.43, 0.27),
            (-0.19, 0.29, 0.255),
            *[(-0.097, 0.167, 0.183)] * 3,
        ]
    )
    return np.hstack([points, np.full((len(points), 1), 0.02)])


def studio() -> Array:
    """A dim room with a window, a softbox and a lit doorway: sRGB, to be scaled."""
    azimuth, elevation = np.meshgrid(
        np.arange(192) / 192 * 360, 90 - (np.arange(96) + 0.5) / 96 * 180
    )
    glow = np.exp(-(((elevation - 4) / 20) ** 2))
    room = np.array([0.012, 0.013, 0.016]) + glow[..., None] * np.array([0.050, 0.043, 0.037])
    room += np.clip(elevation / 90, 0, 1)[..., None] ** 2 * np.array([0.045, 0.05, 0.06])

    def panel(middle: float, width: float, low: float, high: float, colour: Array) -> None:
        across = np.abs((azimuth - middle + 180) % 360 - 180) < width / 2
        room[across & (elevation > low) & (elevation < high)] = colour

    for k in (-1, 0, 1):  # a window with six panes
        for low in (16, 42):
            panel(235 + 17 * k, 14, low, low + 23, np.array([0.80, 0.88, 1.0]))
    panel(50, 26, 20, 68, np.array([0.95, 0.9, 0.82]) * 0.75)
    panel(130, 9, -8, 45, np.array([0.75, 0.42, 0.2]) * 0.6)
    panel(330, 7, -4, 58, np.array([0.5, 0.62, 0.8]) * 0.7)
    return np.where(room < 0.0031308, 12.92 * room, 1.055 * room ** (1 / 2.4) - 0.055)


def main() -> None:
    folder = output_folder()
    for name, profile in (("reflector", reflector()), ("foot", foot()), ("tray", tray())):
        write_turned(folder / f"lamp_{name}.ply", profile)
    Image.fromarray((studio() * 255 + 0.5).astype(np.uint8)).save(folder / "lamp_studio.png")
    write_curves(folder / "lamp_arm.txt", [arm()])


if __name__ == "__main__":
    main()
