"""What the scripts of this folder share: meshes as arrays, and files for Mitsuba.

Every other script here makes the files of one scene. Run it again after a change:

    python scenes/assets/bonsai.py            # beside the script
    python scenes/assets/bonsai.py elsewhere/ # in another folder
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]


def waves(x: Array, y: Array, seed: int) -> Array:
    """Smooth noise, mostly from -1 to 1, over a plane that does not repeat: waves of all ways."""
    rng = np.random.default_rng(seed)
    total = np.zeros(np.broadcast(x, y).shape)
    for _ in range(7):
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        total += np.sin(np.cos(angle) * x + np.sin(angle) * y + phase)
    return total / 4


def output_folder() -> Path:
    """Where the script writes: its first argument, or beside itself."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def write_ply(
    path: Path,
    vertices: Array,
    faces: Array,
    *,
    normals: Array | None = None,
    uv: Array | None = None,
) -> None:
    """Writes a triangle mesh as binary PLY, the same bytes for the same arrays.

    Args:
        vertices: (V, 3) positions.
        faces: (F, 3) vertex indices, counter-clockwise from outside.
        normals: (V, 3) shading normals; without them Mitsuba computes smooth ones,
            unless the shape says ``face_normals``.
        uv: (V, 2) texture coordinates.
    """
    vertices, faces = np.asarray(vertices), np.asarray(faces)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"{path}: a face names a vertex that does not exist")
    names, columns = ["x", "y", "z"], [vertices]
    if normals is not None:
        names += ["nx", "ny", "nz"]
        columns.append(normals)
    if uv is not None:
        names += ["u", "v"]
        columns.append(uv)
    table = np.hstack(columns).astype("<f4")
    if not np.isfinite(table).all():
        raise ValueError(f"{path}: a vertex is not finite")
    short = len(table) <= 1 << 16  # two bytes an index do
    triangles = np.empty(len(faces), [("count", "u1"), ("index", "<u2" if short else "<i4", 3)])
    triangles["count"], triangles["index"] = 3, faces
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property float {name}" for name in names]
    kind = "ushort" if short else "int"
    header += [f"element face {len(faces)}", f"property list uchar {kind} vertex_indices"]
    header += ["end_header", ""]
    path.write_bytes("\n".join(header).encode() + table.tobytes() + triangles.tobytes())


def chaikin(points: Array, rounds: int) -> Array:
    """Cuts the corners of a polyline, keeping its ends."""
    for _ in range(rounds):
        low = 0.75 * points[:-1] + 0.25 * points[1:]
        high = 0.25 * points[:-1] + 0.75 * points[1:]
        middle = np.stack([low, high], 1).reshape(-1, points.shape[1])
        points = np.concatenate([points[:1], middle, points[-1:]])
    return points


def grid_faces(rows: int, columns: int) -> Array:
    """Triangles of a grid of vertices, row by row."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    right, up = corner + 1, corner + columns
    return np.concatenate([np.stack([corner, right, up + 1], 1), np.stack([corner, up + 1, up], 1)])


def refine(points: Array, count: int) -> Array:
    """Points in between (Catmull-Rom)."""
    t = np.linspace(0, len(points) - 1, count)
    i = np.minimum(t.astype(int), len(points) - 2)
    f = (t - i)[:, None]
    p0, p1 = points[np.maximum(i - 1, 0)], points[i]
    p2, p3 = points[i + 1], points[np.minimum(i + 2, len(points) - 1)]
    curve = 2 * p1 + (p2 - p0) * f + (2 * p0 - 5 * p1 + 4 * p2 - p3) * f**2
    return (curve + (3 * p1 - p0 - 3 * p2 + p3) * f**3) / 2


def write_curves(path: Path, curves: Sequence[Array], digits: int = 4) -> None:
    """Writes B-spline curves, (N, 4) control points with radii each, for Mitsuba.

    Mitsuba 3.9.1 reads beyond the last control point, and may crash, where a ray meets the
    very end of the last curve of a file. So that none can, a tiny one hides in the last.
    """
    blocks = [_rows(curve, digits) for curve in curves]
    blocks.append(_rows(_hidden_in(curves[-1]), 6))
    path.write_text("\n\n".join(blocks) + "\n")


def _rows(points: Array, digits: int) -> str:
    numbers = [[f"{x:.{digits}f}".rstrip("0").rstrip(".") for x in row] for row in points]
    return "\n".join(" ".join(row) for row in numbers)


def _hidden_in(curve: Array) -> Array:
    """Control points of a short thin curve on the middle of another."""
    i = len(curve) // 2 - 1
    middle = (curve[i - 1] + 4 * curve[i] + curve[i + 1]) / 6  # a knot of the B-spline
    along = curve[i + 1, :3] - curve[i - 1, :3]
    steps = 0.01 * middle[3] * np.arange(-1.5, 2)[:, None] * along / np.linalg.norm(along)
    return np.column_stack([middle[:3] + steps, np.full(4, 0.05 * middle[3])])
