"""The ring of the scene composed/interlocked."""

from __future__ import annotations

import numpy as np
from geometry import Array, grid_faces, output_folder, write_ply

AROUND, ACROSS = 64, 12


def ring(radius: float, thickness: float) -> tuple[Array, Array, Array]:
    """Vertices, faces and normals of a torus about z."""
    u, v = np.meshgrid(
        2 * np.pi * np.arange(AROUND + 1) / AROUND,
        2 * np.pi * np.arange(ACROSS + 1) / ACROSS,
        indexing="ij",
    )
    out = np.stack([np.cos(u), np.sin(u), 0 * u], -1)
    normals = np.cos(v)[..., None] * out + np.sin(v)[..., None] * np.array([0.0, 0.0, 1.0])
    vertices = radius * out + thickness * normals
    # Rows run along the ring: the order of the corners has to be turned round.
    faces = grid_faces(AROUND + 1, ACROSS + 1)[:, ::-1]
    return vertices.reshape(-1, 3), faces, normals.reshape(-1, 3)


def main() -> None:
    """Writes the mesh."""
    vertices, faces, normals = ring(0.92, 0.04)
    write_ply(output_folder() / "interlocked_ring.ply", vertices, faces, normals=normals)


if __name__ == "__main__":
    main()
