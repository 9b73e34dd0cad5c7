"""A carved puzzle ball: one 120th of two icosahedral shells, and the shells from it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from geometry import Array, output_folder, write_ply

FIVE_TO_FIVE = np.arctan(2.0)  # between neighbouring five-fold axes of the icosahedron
FIVE_TO_THREE = np.arctan(3.0 - np.sqrt(5.0))
Field = Callable[[Array], Array]


def on_sphere(polar: float, azimuth: float) -> Array:
    """The unit vector at two angles in radians."""
    return np.array(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]
    )


def axes() -> tuple[Array, Array, Array]:
    """The 5-fold, 3-fold and 2-fold axes near the north pole, which is a 5-fold one."""
    turns = np.radians(72 * np.arange(5))
    half = np.radians(36)
    five = [on_sphere(0, 0), *(on_sphere(FIVE_TO_FIVE, t) for t in turns)]
    three = [on_sphere(FIVE_TO_THREE, t + half) for t in turns]
    three += [on_sphere(np.radians(79.1877), t + half) for t in turns]
    two = [on_sphere(FIVE_TO_FIVE / 2, t) for t in turns]
    two += [on_sphere(np.radians(58.2825), t + half) for t in turns]
    return np.array(five), np.array(three), np.array(two)


FIVE, THREE, TWO = axes()
RINGLETS = np.array([on_sphere(np.radians(23.5), np.radians(18 * k)) for k in range(-1, 6)])


def nearest(p: Array, centres: Array) -> Array:
    """Degrees from each point to the nearest of the centres."""
    return np.degrees(np.arccos(np.clip(p @ centres.T, -1, 1).max(axis=1)))


def band(distance: Array, middle: float, half_width: float) -> Array:
    """How far inside a band, in degrees; negative outside."""
    return half_width - np.abs(distance - middle)


def union(*parts: Array) -> Array:
    """The maximum, with fillets where two parts meet."""
    sharpness = 2.5
    return np.log(sum(np.exp(sharpness * np.maximum(part, -40)) for part in parts)) / sharpness


def mirror_lines(p: Array) -> tuple[Array, Array, Array]:
    """Degrees to the three mirror planes that bound the fundamental triangle."""
    corners = (FIVE[0], TWO[0], THREE[0])
    found = []
    for start, end in ((0, 1), (0, 2), (1, 2)):
        normal = np.cross(corners[start], corners[end])
        found.append(np.degrees(np.abs(np.arcsin(p @ normal / np.linalg.norm(normal)))))
    return found[0], found[1], found[2]


def rosette(p: Array) -> tuple[Array, Array]:
    """The lace of the outer shells: (inside the ivory, relief), in degrees."""
    d5, d3, d2 = nearest(p, FIVE), nearest(p, THREE), nearest(p, TWO)
    to_two, to_three, across = mirror_lines(p)
    ringlet = nearest(p, RINGLETS)
    azimuth = np.arctan2(p[:, 1], p[:, 0])
    solid = union(
        band(d5, 17.0, 2.7),
        band(ringlet, 3.45, 0.62),
        band(d5, 27.75, 0.6),
        band(d3, 5.0, 1.5),
        band(d3, 9.5, 0.75),
        np.minimum(0.7 - np.minimum(to_three, across), band(d3, 7.4, 3.2)),
        band(d2, 2.9, 0.95),
        np.minimum(0.85 - across, np.minimum(d2 - 2.5, d3 - 9)),
    )
    beads = np.cos(20 * azimuth) ** 2
    relief = 0.5 * np.exp(-(((d5 - 19.0) / 0.5) ** 2))
    relief += 0.7 * np.exp(-(((d5 - 16.8) / 0.8) ** 2)) * beads
    relief += 0.4 * np.exp(-(((d3 - 5.0) / 0.6) ** 2)) + 0.4 * np.exp(-(((d2 - 2.9) / 0.4) ** 2))
    return solid, relief


def trellis(p: Array) -> tuple[Array, Array]:
    """The coarser openwork of the inner shells."""
    d5, d3, d2 = nearest(p, FIVE), nearest(p, THREE), nearest(p, TWO)
    to_two, to_three, across = mirror_lines(p)
    solid = union(
        band(d5, 18.0, 2.8),
        band(d3, 8.0, 1.7),
        band(d2, 4.6, 1.3),
        np.minimum(1.3 - to_three, 18 - d3),
        np.minimum(1.2 - across, d2 - 4),
    )
    return solid, 0.6 * np.exp(-(((d5 - 18.0) / 0.8) ** 2)) + 0.3 * np.exp(-((d3 - 8.0) ** 2))


def triangle_grid(steps: int) -> tuple[Array, Array]:
    """Points and faces of the fundamental triangle."""
    corners = np.array([FIVE[0], TWO[0], THREE[0]])
    points, index = [], {}
    for i in range(steps + 1):
        for j in range(steps + 1 - i):
            index[i, j] = len(points)
            points.append(np.array([steps - i - j, i, j]) / steps @ corners)
    faces = []
    for i in range(steps):
        for j in range(steps - i):
            faces.append((index[i, j], index[i + 1, j], index[i, j + 1]))
            if i + j < steps - 1:
                faces.append((index[i + 1, j], index[i + 1, j + 1], index[i, j + 1]))
    found = np.array(points)
    return found / np.linalg.norm(found, axis=1, keepdims=True), np.array(faces)


def clip(points: Array, faces: Array, solid: Field) -> tuple[Array, Array, Array]:
    """Cuts the triangles at ``solid`` = 0: points, faces and the cut's edges."""
    value = solid(points)
    kept = [*points]
    cuts: dict[tuple[int, int], int] = {}

    def cut(a: int, b: int) -> int:
        key = (min(a, b), max(a, b))
        if key not in cuts:
            low, high = (points[a], points[b]) if value[a] < value[b] else (points[b], points[a])
            for _ in range(20):  # bisection: the bands are not linear within a triangle
                middle = low + high
                middle /= np.linalg.norm(middle)
                if solid(middle[None])[0] < 0:
                    low = middle
                else:
                    high = middle
            cuts[key] = len(kept)
            kept.append(high)
        return cuts[key]

    triangles, edges = [], []
    for face in faces:
        inside = [v for v in range(3) if value[face[v]] > 0]
        if len(inside) == 3:
            triangles.append(tuple(face))
        elif len(inside) == 1:
            a, b, c = np.roll(face, -inside[0])
            ab, ac = cut(a, b), cut(a, c)
            triangles.append((a, ab, ac))
            edges.append((ab, ac))
        elif len(inside) == 2:
            c, a, b = np.roll(face, -({0, 1, 2} - set(inside)).pop())
            ac, bc = cut(a, c), cut(b, c)
            triangles += [(a, b, bc), (a, bc, ac)]
            edges.append((bc, ac))
    used, renumbered = np.unique(np.array(triangles), return_inverse=True)
    new = np.full(len(kept), -1)
    new[used] = np.arange(len(used))
    return np.array(kept)[used], renumbered.reshape(-1, 3), new[np.array(edges)]


def gradient(field: Field, p: Array) -> Array:
    """The tangential gradient of a field on the unit sphere."""
    step = 2e-4
    columns = []
    for axis in np.eye(3):
        ahead, behind = p + step * axis, p - step * axis
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        behind /= np.linalg.norm(behind, axis=1, keepdims=True)
        columns.append((field(ahead) - field(behind)) / (2 * step))
    return np.stack(columns, axis=1)


def write_piece(
    path: Path, pattern: Callable[[Array], tuple[Array, Array]], steps: int, thickness: float
) -> None:
    """One 120th of a shell of outer radius about 1."""
    rounding, slope = 0.9, np.radians(1.0)

    def solid(p: Array) -> Array:
        return pattern(p)[0]

    def radius(p: Array) -> Array:
        inside, relief = pattern(p)
        t = np.clip(inside / rounding, 0, 1)
        return 1 + slope * (relief - 0.8 * rounding * (1 - np.sqrt(1 - (1 - t) ** 2)))

    points, faces, edges = clip(*triangle_grid(steps), solid)
    rim = np.unique(edges)
    normals = points - gradient(radius, points)
    walls = -gradient(solid, points[rim])
    normals[rim] = walls
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    count = len(points)
    inner = points * (1 - thickness)
    below = np.full(count, -1)
    below[rim] = 2 * count + np.arange(len(rim))
    a, b = edges.T
    quads = np.concatenate(
        [np.stack([b, a, below[a]], axis=1), np.stack([b, below[a], below[b]], axis=1)]
    )
    write_ply(
        path,
        np.concatenate([points * radius(points)[:, None], inner, inner[rim]]),
        np.concatenate([faces, faces[:, ::-1] + count, quads]),
        normals=np.concatenate([normals, -points, normals[rim]]),
    )


SHELLS = (  # group, radius, and a turn so that the holes do not line up
    ("ivory_lace", 0.829, "", 0),
    ("cinnabar_lace", 0.69, 'x="1" y="0.4" z="0.8"', 23),
    ("ivory_trellis", 0.55, 'x="-0.5" y="1" z="0.3"', 41),
    ("cinnabar_trellis", 0.42, 'x="0.2" y="-0.6" z="1"', 67),
)


def shell_fragment() -> str:
    """XML that places each group on the twelve five-fold axes of each shell."""
    flip = '<rotate x="1" angle="180"/><rotate z="1" angle="36"/>'
    lines = ["<!-- Written by puzzleball.py. -->", '<scene version="3.0.0">']
    for group, radius, axis, angle in SHELLS:
        turn = f"<rotate {axis} angle='{angle}'/>".replace("'", '"') if axis else ""
        for side, hemisphere in (("n", ""), ("s", flip)):
            for k in range(6):
                lean = '<rotate z="1" angle="36"/><rotate y="1" angle="63.434949"/>'
                place = f'{lean}<rotate z="1" angle="{72 * k}"/>' if k < 5 else ""
                lines += [
                    f'    <shape type="instance" id="{group}_{side}{k}"><ref id="{group}"/>'
                    f'<transform name="to_world"><scale value="{radius}"/>'
                    f"{place}{hemisphere}{turn}</transform></shape>"
                ]
    return "\n".join([*lines, "</scene>", ""])


def main() -> None:
    folder = output_folder()
    write_piece(folder / "puzzleball_lace.ply", rosette, 28, 0.065)
    write_piece(folder / "puzzleball_trellis.ply", trellis, 20, 0.075)
    (folder / "puzzleball_shells.xml").write_text(shell_fragment())


if __name__ == "__main__":
    main()
