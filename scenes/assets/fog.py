"""The island of the scene hard/fog: its pines, its cliffs and the roofs."""

from __future__ import annotations

import numpy as np
from geometry import Array, output_folder, write_ply
from solids import Solid, extrude, merge, wedge


def pine() -> Solid:
    """A pine of height 1, four skirts on a trunk."""
    skirts = [(0.1, 0.3, 0.45), (0.3, 0.25, 0.63), (0.5, 0.19, 0.81), (0.68, 0.13, 1.0)]
    parts = [wedge(np.array([[0.045, 0.0], [0.035, 0.3]]), 1, 6)[0]]
    for foot, radius, tip in skirts:
        inner = [radius * 0.5, foot + 0.03]
        profile = np.array([inner, [radius, foot], [radius * 0.45, foot * 0.55 + tip * 0.45]])
        parts.append(wedge(np.vstack([profile, [[0.0, tip]]]), 1, 8)[0])
    return merge(parts)


def rock() -> Solid:
    """A boulder of radius about 1 with flat facets."""
    rng = np.random.default_rng(11)
    angle = np.linspace(0, 2 * np.pi, 9)[:-1]
    levels = [(-1.0, 0.85), (-0.35, 1.05), (0.35, 0.9), (0.8, 0.5)]
    rings = [
        np.stack([r * np.cos(angle + 0.3 * k), r * np.sin(angle + 0.3 * k), 0 * angle + z], 1)
        for k, (z, r) in enumerate(levels)
    ]
    points = np.vstack([*rings, [[0.0, 0.0, 0.92]]])
    points[:, :2] *= rng.uniform(0.82, 1.16, (len(points), 1))
    points[:, 2] += rng.uniform(-0.09, 0.09, len(points))
    i = np.arange(8)
    j = (i + 1) % 8
    faces = [np.stack([i + 24, j + 24, 0 * i + 32], 1)]
    for k in (0, 8, 16):
        faces += [np.stack([i + k, j + k, i + k + 8], 1)]
        faces += [np.stack([i + k + 8, j + k, j + k + 8], 1)]
    corners = points[np.vstack(faces)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    count = 3 * len(corners)
    return Solid(
        corners.reshape(-1, 3), np.arange(count).reshape(-1, 3), np.repeat(normals, 3, axis=0)
    )


def tower() -> Array:
    """Profile of the lighthouse: shaft, gallery and lamp room, from its rock up."""
    points = [(0.17, -0.4), (0.15, -0.2), (0.13, 0.0), (0.115, 0.2), (0.104, 0.4), (0.1, 0.46)]
    points += [(0.15, 0.5), (0.16, 0.5), (0.16, 0.525), (0.085, 0.525)]
    return np.array(points)


def write(name: str, solid: Solid, uv: Array | None = None) -> None:
    """One mesh of the scene."""
    path = output_folder() / f"fog_{name}.ply"
    write_ply(path, solid.vertices, solid.faces, normals=solid.normals, uv=uv)


def main() -> None:
    solid, uv = wedge(tower(), 4, 6)
    write("tower", solid, uv * [1, -1] + [0, 1])
    cap = [(0.0, 0.64), (0.12, 0.64), (0.125, 0.65), (0.07, 0.71), (0.02, 0.75), (0.0, 0.755)]
    write("cap", wedge(np.array(cap), 1, 16)[0])
    write("pine", pine())
    write("rock", rock())
    gable = [[-0.13, -0.1], [0.13, -0.1], [0.13, 0.06], [0.0, 0.17], [-0.13, 0.06]]
    write("house", extrude(np.array(gable), 0.34, 0.006))
    roof = [[-0.165, 0.035], [-0.15, 0.025], [0.0, 0.152], [0.15, 0.025], [0.165, 0.035]]
    write("roof", extrude(np.array([*roof, [0.0, 0.19]]), 0.4, 0.004))


if __name__ == "__main__":
    main()
