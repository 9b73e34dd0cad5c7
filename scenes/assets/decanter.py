"""Makes the files of realistic/decanter.xml: cut glass, a lobed lacquer box, a tray, a studio."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from geometry import Array, output_folder, write_curves, write_ply
from PIL import Image

CUTS = 14  # facets around the decanter
WEDGES = 10  # of the turned shapes, and lobes of the box
BOX = (0.40, -0.30)  # where it stands

# Radius and height of the rings of facets, upwards: foot, body (cut in diamonds), neck.
FOOT = [(0.0, -0.775), (0.25, -0.775), (0.275, -0.785), (0.295, -0.775), (0.30, -0.75)]
BODY = [
    (0.295, -0.720),
    (0.308, -0.648),
    (0.315, -0.576),
    (0.319, -0.504),
    (0.319, -0.432),
    (0.315, -0.360),
    (0.308, -0.288),
    (0.296, -0.216),
]
NECK = [
    (0.290, -0.185),
    (0.270, -0.130),
    (0.200, -0.030),
    (0.130, 0.050),
    (0.098, 0.120),
    (0.088, 0.215),
    (0.098, 0.235),
    (0.126, 0.250),
    (0.126, 0.272),
    (0.098, 0.288),
    (0.090, 0.320),
    (0.100, 0.370),
    (0.138, 0.400),
    (0.140, 0.412),
    (0.124, 0.420),
]
# The hollow, downwards from the mouth; the liquid stands at the ring LEVEL.
HOLLOW = [
    (0.124, 0.420),
    (0.090, 0.395),
    (0.064, 0.340),
    (0.058, 0.220),
    (0.068, 0.110),
    (0.110, 0.030),
    (0.180, -0.050),
    (0.240, -0.130),
    (0.262, -0.200),
    (0.272, -0.300),
    (0.276, -0.340),
    (0.278, -0.500),
    (0.268, -0.640),
    (0.245, -0.685),
    (0.200, -0.705),
    (0.0, -0.710),
]
LEVEL = 10
STOPPER = [
    (0.0, 0.330),
    (0.050, 0.330),
    (0.055, 0.400),
    (0.074, 0.424),
    (0.074, 0.440),
    (0.050, 0.462),
    (0.100, 0.520),
    (0.158, 0.590),
    (0.170, 0.650),
    (0.140, 0.720),
    (0.080, 0.765),
    (0.0, 0.770),
]


def ring(radius: float, height: float, shift: float, columns: int) -> Array:
    """Corners of a regular polygon around the z axis, turned by ``shift`` sides."""
    angle = 2 * np.pi * (np.arange(columns) + shift) / columns
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(columns, height)], 1)


def band(low: Array, high: Array) -> Array:
    """Triangles between two rings of as many corners, given by their indices."""
    low_next, high_next = np.roll(low, -1), np.roll(high, -1)
    return np.concatenate(
        [np.stack([low, low_next, high_next], 1), np.stack([low, high_next, high], 1)]
    )


def without_slivers(vertices: Array, faces: Array) -> Array:
    """Leaves out triangles that have shrunk to a line on the axis."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return faces[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-9]


def cut_glass() -> tuple[Array, Array]:
    """The outside of the decanter: each diamond of the body is a low pyramid."""
    vertices, faces = [], []
    profile = [*FOOT, *NECK]
    for radius, height in profile:
        vertices.append(ring(radius, height, 0.0, CUTS))
    rings = np.arange(len(profile) * CUTS).reshape(-1, CUTS)
    count, split = rings.size, len(FOOT)
    corners, tips = [], []
    for k, (radius, height) in enumerate(BODY):
        shift = 0.5 * (k % 2)
        edge = k in (0, len(BODY) - 1)
        # The middle of a side lies nearer to the axis than its ends.
        tip = radius * np.cos(np.pi / CUTS) + (0.0 if edge else 0.022)
        vertices += [ring(radius, height, shift, CUTS), ring(tip, height, shift + 0.5, CUTS)]
        corners.append(count + np.arange(CUTS))
        tips.append(count + CUTS + np.arange(CUTS))
        count += 2 * CUTS
    for k in range(len(BODY) - 1):
        low, high = corners[k], corners[k + 1]
        # Between corners i and i + 1 of the lower ring lies one of the upper ring.
        if k % 2:
            above, left, right = np.roll(high, -1), high, np.roll(high, -1)
            base, peak = low, tips[k + 1]
        else:
            above, left, right = high, high, np.roll(high, -1)
            base, peak = np.roll(low, -1), tips[k + 1]
        following = np.roll(low, -1)
        faces += [np.stack([low, tips[k], above], 1), np.stack([tips[k], following, above], 1)]
        faces += [np.stack([base, peak, left], 1), np.stack([base, right, peak], 1)]
    for below, above in ((rings[split - 1], 0), (rings[split], -1)):
        # The last ring of diamonds is turned by half a side: start at its tips.
        twisted = above == -1 and len(BODY) % 2 == 0
        first, second = (tips, corners) if twisted else (corners, tips)
        start, middle = first[above], second[above]
        if twisted:
            start = np.roll(start, 1)
        following = np.roll(start, -1)
        fans = [
            np.stack([below, middle, start], 1),
            np.stack([below, np.roll(below, -1), middle], 1),
            np.stack([np.roll(below, -1), following, middle], 1),
        ]
        faces += [fan if above == 0 else fan[:, ::-1] for fan in fans]
    for k in range(len(profile) - 1):
        if k != split - 1:
            faces.append(band(rings[k], rings[k + 1]))
    points = np.concatenate(vertices)
    return points, without_slivers(points, np.concatenate(faces))


def hollow(rows: list[tuple[float, float]]) -> tuple[Array, Array]:
    """A part of the inner wall, facing the axis; its mouth fits the facets outside."""
    columns = 2 * CUTS
    points = np.stack([ring(radius, height, 0.0, columns) for radius, height in rows])
    if rows[0] == HOLLOW[0]:
        corner = points[0, ::2]
        points[0, 1::2] = 0.5 * (corner + np.roll(corner, -1, axis=0))
    index = np.arange(points.shape[0] * columns).reshape(-1, columns)
    faces = np.concatenate([band(index[k], index[k + 1]) for k in range(len(rows) - 1)])
    vertices = points.reshape(-1, 3)
    return vertices, without_slivers(vertices, faces)


def stopper() -> tuple[Array, Array]:
    """The stopper: rings that turn by half a side, so that its facets are triangles."""
    columns = 10
    shifts = np.array([0, 0, 0, 0, 0, 0, 0, 0.5, 1, 1.5, 2, 2])
    rings = [ring(r, z, s, columns) for (r, z), s in zip(STOPPER, shifts, strict=True)]
    vertices = np.concatenate(rings)
    index = np.arange(len(vertices)).reshape(-1, columns)
    faces = np.concatenate([band(index[k], index[k + 1]) for k in range(len(rings) - 1)])
    return vertices, without_slivers(vertices, faces)


def chaikin(points: Array) -> Array:
    """Cuts the corners of a polyline, keeping its ends."""
    low = 0.75 * points[:-1] + 0.25 * points[1:]
    high = 0.25 * points[:-1] + 0.75 * points[1:]
    middle = np.stack([low, high], 1).reshape(-1, points.shape[1])
    return np.concatenate([points[:1], middle, points[-1:]])


def write_wedge(
    path: Path, corners: list[tuple[float, float]], lobe: float = 0.0, columns: int = 6
) -> None:
    """Writes one wedge of a turned shape, which may bulge outwards in its middle."""
    profile = chaikin(np.array(corners))
    angle = np.linspace(-np.pi / WEDGES, np.pi / WEDGES, columns)
    depth = lobe * np.clip(profile[:, :1] / 0.3, 0, 1) ** 2

    def surface(rho: Array, height: Array, turn: Array) -> Array:
        swell = 1 - depth * (1 - np.abs(np.cos(turn * WEDGES / 2)) ** 0.8)
        x, y = rho * swell * np.cos(turn), rho * swell * np.sin(turn)
        return np.stack([x, y, np.broadcast_to(height, x.shape)], -1)

    radius, height = profile[:, :1], profile[:, 1:]
    vertices = surface(radius, height, angle)
    along = np.gradient(vertices, axis=0)
    # Differences inwards at either side keep the crease between two lobes.
    inset = np.clip(angle, angle[0] + 0.004, angle[-1] - 0.004)
    step = surface(radius, height, inset + 0.003) - surface(radius, height, inset - 0.003)
    normals = np.cross(step, along)
    normals = np.where(
        radius[..., None] < 1e-6, [0, 0, np.sign(height[-1, 0] - height[0, 0])], normals
    )
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    index = np.arange(vertices.shape[0] * columns).reshape(-1, columns)
    low, high = index[:-1], index[1:]
    quads = np.stack([low[:, :-1], low[:, 1:], high[:, 1:], high[:, :-1]], -1).reshape(-1, 4)
    faces = without_slivers(
        vertices.reshape(-1, 3), np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    )
    write_ply(path, vertices.reshape(-1, 3), faces, normals=normals.reshape(-1, 3))


def circle(centre: tuple[float, float, float], radius: float, thickness: float) -> Array:
    """Control points of a closed circular wire."""
    points = 24
    swell = 3 / (2 + np.cos(2 * np.pi / points))
    wire = ring(radius * swell, 0.0, 0.0, points) + centre
    return np.column_stack([np.vstack([wire, wire[:3]]), np.full(points + 3, thickness)])


def seam() -> Array:
    """Control points of the gold wire between the box and its lid."""
    angle = np.linspace(0, 2 * np.pi, 8 * WEDGES + 1)[:-1]
    swell = 1 - 0.10 * (1 - np.abs(np.cos(angle * WEDGES / 2)) ** 0.8)
    radius = 1.1 * 0.333 * swell
    x, y = BOX[0] + radius * np.cos(angle), BOX[1] + radius * np.sin(angle)
    wire = np.column_stack([x, y, np.full((len(x), 2), (1.1 * 0.205 - 0.798, 0.009))])
    return np.vstack([wire, wire[:3]])


def studio(width: int) -> Image.Image:
    """A dark studio with large soft cards, bright enough to be the only light."""
    v, u = np.mgrid[0 : width // 2, 0:width] + 0.5
    azimuth, height = u / width * 360, 90 - v / width * 360
    level = np.interp(height, [-90, -20, 0, 15, 90], [0.05, 0.05, 0.07, 0.09, 0.12])
    picture = level[..., None] * np.array([0.92, 1.0, 1.1])
    cards = [
        (65, 40, 30, 26, (1.0, 0.93, 0.82)),
        (160, 22, 10, 38, (0.50, 0.56, 0.64)),
        (255, 30, 22, 24, (0.58, 0.66, 0.78)),
        (325, 16, 9, 34, (0.55, 0.52, 0.48)),
    ]
    for where, middle, half_width, half_height, colour in cards:
        across = np.abs((azimuth - where + 180) % 360 - 180) / half_width
        card = np.exp(-(across**8) - (np.abs(height - middle) / half_height) ** 8)
        picture += card[..., None] * np.array(colour)
    picture += (0.5 / (1 + np.exp((72 - height) / 2)))[..., None]
    encoded = np.clip(picture, 0, 1) ** (1 / 2.2)
    return Image.fromarray((255 * encoded).astype(np.uint8))


def main() -> None:
    """Writes every file of the scene."""
    folder = output_folder()
    write_ply(folder / "decanter_outside.ply", *cut_glass())
    write_ply(folder / "decanter_empty.ply", *hollow(HOLLOW[: LEVEL + 1]))
    write_ply(folder / "decanter_filled.ply", *hollow(HOLLOW[LEVEL:]))
    write_ply(folder / "decanter_stopper.ply", *stopper())

    tray = [(0.0, -0.86), (0.80, -0.86), (0.86, -0.855), (0.885, -0.83), (0.90, -0.78)]
    tray += [(0.915, -0.755), (0.905, -0.745), (0.89, -0.755), (0.87, -0.79), (0.84, -0.80)]
    write_wedge(folder / "decanter_tray.ply", [*tray, (0.7, -0.80), (0.0, -0.80)], columns=7)
    box = [(0.0, 0.0), (0.22, 0.0), (0.25, 0.01), (0.31, 0.07), (0.335, 0.14), (0.33, 0.195)]
    write_wedge(folder / "decanter_box.ply", [*box, (0.32, 0.205)], 0.10, 9)
    lid = [(0.325, 0.20), (0.342, 0.215), (0.342, 0.235), (0.325, 0.275), (0.26, 0.325)]
    lid += [(0.16, 0.355), (0.05, 0.365), (0.0, 0.365)]
    write_wedge(folder / "decanter_lid.ply", lid, 0.10, 9)
    trim = [circle((0, 0, -0.747), 0.906, 0.012), circle((*BOX, -0.395), 0.05, 0.014)]
    trim.append(seam())
    write_curves(folder / "decanter_trim.txt", trim)
    studio(128).save(folder / "decanter_studio.png", optimize=True)


if __name__ == "__main__":
    main()
