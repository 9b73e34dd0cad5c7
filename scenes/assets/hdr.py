"""The turned parts of the scene hard/hdr: the lantern, the hat, a bell and a cup."""

from __future__ import annotations

import numpy as np
from geometry import Array, output_folder, write_curves, write_ply
from solids import arc, box, spline, wedge

PARTS = 4


def profiles() -> dict[str, Array]:
    """Radius and height of everything turned, from the bottom up."""
    b = 0.012
    rim = arc(0.03, -90, 90, 7) + [0.87, -0.67]
    foot = [(0.0, 0.0), (0.25 - b, 0.0), (0.25, b), (0.25, 0.05), (0.22, 0.07), (0.2, 0.11)]
    collar = spline([(0.215, 0.0), (0.27, 0.015), (0.25, 0.05), (0.16, 0.12), (0.1, 0.22)], 3)
    chimney = [(0.075, 0.23), (0.075, 0.29), (0.1, 0.3), (0.1, 0.315), (0.05, 0.35), (0.0, 0.355)]
    brim = [(0.0, 0.008), (0.2, 0.0), (0.32, 0.012), (0.345, 0.03), (0.34, 0.038), (0.31, 0.022)]
    crown = spline([(0.205, 0.022), (0.19, 0.06), (0.18, 0.2), (0.2, 0.38)], 3)
    bell = spline([(0.135, 0.0), (0.14, 0.012), (0.115, 0.06), (0.09, 0.15), (0.06, 0.2)], 3)
    outer = spline([(0.06, 0.02), (0.11, 0.06), (0.125, 0.13), (0.13, 0.19)], 3)
    inner = spline([(0.119, 0.19), (0.113, 0.13), (0.095, 0.07), (0.0, 0.04)], 3)
    return {
        "board": np.vstack([[[0.0, -0.7]], rim, [[0.0, -0.64]]]),
        "foot": np.array([*foot, (0.17, 0.12), (0.0, 0.12)]),
        "hood": np.vstack([[[0.0, 0.01]], collar, chimney]),
        "hat": np.vstack([brim, crown, [[0.198, 0.392], [0.185, 0.4], [0.0, 0.395]]]),
        "bell": np.vstack([[[0.12, 0.0]], bell, [[0.02, 0.225], [0.0, 0.228]]]),
        "cup": np.vstack([[[0.0, 0.0], [0.06, 0.0]], outer, [[0.125, 0.195]], inner]),
    }


def main() -> None:
    folder = output_folder()
    for name, profile in profiles().items():
        solid, _ = wedge(profile, PARTS, 12 if name == "board" else 6)
        path = folder / f"hdr_{name}.ply"
        write_ply(path, solid.vertices, solid.faces, normals=solid.normals)
    angle = np.radians(np.arange(27) * 15.0)
    ring = np.stack([0.11 * np.cos(angle), 0 * angle, 0.11 * np.sin(angle), 0 * angle + 0.012], 1)
    write_curves(folder / "hdr_ring.txt", [ring])
    board = box((0.03, 0.44, 0.4), 0.006)
    write_ply(folder / "hdr_plank.ply", board.vertices, board.faces, normals=board.normals)


if __name__ == "__main__":
    main()
