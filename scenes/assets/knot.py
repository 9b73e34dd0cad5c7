"""The rope and the plinth of the scene diffuse/knot."""

from __future__ import annotations

import numpy as np
from geometry import Array, output_folder, write_curves, write_ply
from solids import wedge

STRANDS, TWISTS, POINTS = 6, 10, 130
MAJOR, MINOR = 0.5, 0.205  # The torus that the trefoil winds around
LAY, THICKNESS = 0.094, 0.053  # Radius of the rope's core, and of a strand
CENTRE = 0.07


def strand(number: int) -> Array:
    """Control points of one closed strand: its place and radius."""
    t = np.arange(POINTS + 3) / POINTS * 2 * np.pi  # A closed B-spline repeats three
    ring = np.stack([np.cos(2 * t), 0 * t, np.sin(2 * t)], 1)
    up = np.array([0.0, 1.0, 0.0])
    core = MAJOR * ring + MINOR * (np.cos(3 * t)[:, None] * ring + np.sin(3 * t)[:, None] * up)
    tangent = np.gradient(core, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    out = np.cos(3 * t)[:, None] * ring + np.sin(3 * t)[:, None] * up
    out -= (out * tangent).sum(1, keepdims=True) * tangent
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    side = np.cross(tangent, out)
    angle = TWISTS * t + 2 * np.pi * number / STRANDS
    place = core + LAY * (np.cos(angle)[:, None] * out + np.sin(angle)[:, None] * side)
    # A quarter turn about y stands the trefoil on two of its three lobes.
    place = np.stack([place[:, 2], place[:, 1], place[:, 0] + CENTRE], 1)
    return np.hstack([place, np.full((len(t), 1), THICKNESS)])


def plinth(top: float) -> Array:
    """Profile of the drum under the knot."""
    b, low, foot = 0.014, top - 0.24, top - 0.16
    points = [(0, low), (0.68 - b, low), (0.68, low + b), (0.68, foot - b), (0.68 - b, foot)]
    points += [(0.57 + b, foot), (0.57, foot + b), (0.57, top - b), (0.57 - b, top), (0, top)]
    return np.array(points)


def main() -> None:
    folder = output_folder()
    strands = [strand(number) for number in range(STRANDS)]
    for number, points in enumerate(strands):
        write_curves(folder / f"knot_strand_{number}.txt", [points])
    top = min(points[:, 2].min() for points in strands) - THICKNESS + 0.004
    solid, _ = wedge(plinth(top), 4, 16)
    path = folder / "knot_plinth.ply"
    write_ply(path, solid.vertices, solid.faces, normals=solid.normals)


if __name__ == "__main__":
    main()
