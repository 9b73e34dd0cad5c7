"""The three thin sheets of the scene hard/sheet, and what is printed on them."""

from __future__ import annotations

import numpy as np
from geometry import Array, output_folder, write_ply
from PIL import Image

THICKNESS = 0.002
SIZE = 256  # Pixels of a print; front and back lie side by side in one picture
PAPER, INK, CORAL, TEAL, MUSTARD, ROSE, SAGE = range(7)
COLOURS = [(243, 235, 218), (27, 36, 62), (214, 82, 56), (24, 116, 120), (233, 165, 44)]
COLOURS += [(232, 170, 156), (134, 164, 120)]


def card(t: Array) -> tuple[Array, Array]:
    """The middle line of the card in the plane y = 0.25, seen from above, and its normals."""
    line = np.stack([0.45 * (2 * t - 1), np.full_like(t, 0.25)], 1)
    return line, np.tile([0.0, -1.0], (len(t), 1))


def wave(t: Array) -> tuple[Array, Array]:
    """The same of the wave."""
    x = 0.55 * (2 * t - 1)
    line = np.stack([x, -0.28 + 0.13 * np.sin(2 * np.pi * x / 1.1)], 1)
    slope = 0.13 * 2 * np.pi / 1.1 * np.cos(2 * np.pi * x / 1.1)
    normal = np.stack([slope, -np.ones_like(x)], 1)
    return line, normal / np.linalg.norm(normal, axis=1, keepdims=True)


def helix(t: Array) -> tuple[Array, Array]:
    """The same of the ribbon."""
    angle = np.radians(-150 + 540 * t)
    normal = np.stack([np.cos(angle), np.sin(angle)], 1)
    return 0.82 * normal, normal


def sheet(line: Array, normal: Array, low: Array, high: Array) -> tuple[Array, ...]:
    """A closed sheet that stands on a curve: its vertices, faces, normals and uv.

    Its front (where the normals point) has u from 0 to 0.5, its back the rest; the cut
    edges have the colour of the paper at the very corner of the picture.
    """
    count = len(line)
    u = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    u = 0.002 + 0.496 * u / u[-1]
    half = THICKNESS / 2 * normal
    corners = []
    for side in (1, -1):
        for z in (low, high):
            corners.append(np.column_stack([line + side * half, z]))
    flat = np.column_stack([normal, np.zeros(count)])
    down = np.tile([0.0, 0.0, -1.0], (count, 1))
    vertices, normals, uv, faces = [], [], [], []

    def strip(a: Array, b: Array, way: Array, coordinates: tuple[Array, Array]) -> None:
        start = sum(len(part) for part in vertices)
        vertices.extend([a, b])
        normals.extend([way, way])
        uv.extend(coordinates)
        i = start + np.arange(len(a) - 1)
        j = i + len(a)
        quads = np.vstack([np.stack([i, i + 1, j], 1), np.stack([j, i + 1, j + 1], 1)])
        p, q, r = (np.vstack(vertices)[quads[0, k]] for k in range(3))
        inward = np.cross(q - p, r - p) @ way[0] < 0
        faces.append(quads[:, ::-1] if inward else quads)

    def edge(points: int) -> tuple[Array, Array]:
        corner = np.full((points, 2), 0.001)
        return corner, corner

    bottom, top = np.full(count, 0.999), np.full(count, 0.004)
    front, back = np.column_stack([u, bottom]), np.column_stack([1 - u, bottom])
    strip(corners[0], corners[1], flat, (front, np.column_stack([u, top])))
    strip(corners[2], corners[3], -flat, (back, np.column_stack([1 - u, top])))
    strip(corners[0], corners[2], down, edge(count))
    strip(corners[1], corners[3], -down, edge(count))
    for end, sign in ((0, -1.0), (-1, 1.0)):
        along = sign * (line[1] - line[0] if end == 0 else line[-1] - line[-2])
        way = np.tile(np.append(along / np.linalg.norm(along), 0.0), (2, 1))
        a = np.stack([corners[0][end], corners[1][end]])
        b = np.stack([corners[2][end], corners[3][end]])
        strip(a, b, way, edge(2))
    return np.vstack(vertices), np.vstack(faces), np.vstack(normals), np.vstack(uv)


def pixels() -> tuple[Array, Array]:
    """Coordinates of a print: x to the right and y down, both from 0 to 1."""
    axis = (np.arange(SIZE) + 0.5) / SIZE
    x, y = np.meshgrid(axis, axis)
    return x, y


def quilt() -> Array:
    """The front of the card: quarter circles and half discs on a grid of tiles."""
    x, y = pixels()
    columns, rows = 4, 6
    i, j = (x * columns).astype(int), (y * rows).astype(int)
    a, b = x * columns % 1, y * rows % 1
    turn = (i * 3 + j * 5 + i * j) % 4
    for quarter in (1, 2, 3):
        swap = turn >= quarter
        a, b = np.where(swap, b, a), np.where(swap, 1 - a, b)
    inks = np.array([CORAL, INK, TEAL, MUSTARD, ROSE, INK])
    grounds = np.array([PAPER, MUSTARD, PAPER, PAPER, TEAL, ROSE])
    kind = (i + 2 * j) % 3
    r = np.hypot(a, b)
    figure = np.where(kind == 0, r < 1, np.hypot(a - 0.5, b) < 0.5)
    figure = np.where(kind == 2, (r < 1) & (r > 0.66) | (r < 0.33), figure)
    paint = np.where(figure, inks[(i * 2 + j) % 6], grounds[(i + j * 3) % 6])
    border = (x < 0.035) | (x > 0.965) | (y < 0.024) | (y > 0.976)
    return np.where(border, PAPER, paint)


def moon() -> Array:
    """The back of the card: a moon over waves."""
    x, y = pixels()
    paint = np.full(x.shape, INK)
    height = (y - 0.5) * 1.38
    r = np.hypot(x - 0.5, height + 0.22)
    paint[r < 0.27] = PAPER
    paint[(r < 0.27) & (np.hypot(x - 0.58, height + 0.26) < 0.2)] = MUSTARD
    for k in range(6):
        crest = 0.55 + 0.075 * k + 0.02 * np.sin(x * 4 * np.pi + 1.9 * k)
        paint[y > crest] = (TEAL, PAPER)[k % 2]
    return paint


def stripes() -> Array:
    """The front of the wave: slanted stripes that grow wider."""
    x, y = pixels()
    s = (x * 1.2 + 0.35 * y) ** 1.3 * 9
    order = np.array([CORAL, PAPER, ROSE, PAPER, MUSTARD, PAPER, INK, PAPER])
    return order[(s * 1.2).astype(int) % 8]


def dots() -> Array:
    """The back of the wave: dots on sage."""
    x, y = pixels()
    row = (y * 10).astype(int)
    a, b = (x * 11 + 0.5 * (row % 2)) % 1 - 0.5, y * 10 % 1 - 0.5
    return np.where(np.hypot(a, b) < 0.12 + 0.26 * y, INK, SAGE)


def lines() -> Array:
    """The outside of the ribbon: long lines on teal."""
    _, y = pixels()
    thin = np.abs((y * 7) % 1 - 0.5) < 0.1
    return np.where(thin & (np.abs(y - 0.5) < 0.36), PAPER, TEAL)


def steps() -> Array:
    """The inside of the ribbon: triangles, one after the other."""
    x, y = pixels()
    a = x * 28 % 1
    return np.where(np.abs(y - 0.5) < 0.4 * (1 - a), CORAL, MUSTARD)


def main() -> None:
    folder = output_folder()
    one, many, most = (np.linspace(0, 1, count) for count in (2, 37, 73))
    sheets = {
        "card": (*card(one), -0.62 + 0 * one, 0.62 + 0 * one),
        "wave": (*wave(many), -0.58 + 0 * many, 0.5 + 0 * many),
        "helix": (*helix(most), -0.8 + 1.3 * most, -0.5 + 1.3 * most),
    }
    prints = {"card": (quilt, moon), "wave": (stripes, dots), "helix": (lines, steps)}
    for name, parts in sheets.items():
        vertices, faces, normals, uv = sheet(*parts)
        write_ply(folder / f"sheet_{name}.ply", vertices, faces, normals=normals, uv=uv)
        front, back = prints[name]
        both = np.hstack([front(), back()]).astype(np.uint8)
        both[:2, :2] = PAPER
        picture = Image.fromarray(both, "P")
        picture.putpalette([value for colour in COLOURS for value in colour])
        picture.save(folder / f"sheet_{name}.png", optimize=True)


if __name__ == "__main__":
    main()
