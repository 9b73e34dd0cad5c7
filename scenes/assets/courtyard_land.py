"""The land around unbounded/courtyard: plants, a village, fields and hills, mountains.

Lengths are metres. The court, which ``courtyard.py`` makes, is 15 wide around the origin.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from geometry import Array, grid_faces, output_folder, waves, write_ply
from solids import Solid, arc, box, fragment, merge, moved, step, wedge
from surfaces import leaves, put_mesh, scale, slab, tuft, turn, write_solid

put = partial(put_mesh, "courtyard")


HILLS = [  # azimuth from the north, distance, height, width
    (158, 175, 40, 48), (205, 260, 52, 75), (120, 310, 60, 90), (240, 420, 85, 110),
    (175, 480, 78, 110), (90, 420, 85, 120), (40, 350, 70, 110), (320, 380, 80, 120),
    (275, 330, 66, 100),
]  # fmt: skip


def ground_height(x: Array, y: Array) -> Array:
    """Height of the land: the court's hill, a valley around it, and hills."""
    away = np.hypot(x, y)
    height = -0.7 - 27 * (1 - np.exp(-((np.maximum(away - 10, 0) / 42) ** 1.5)))
    for azimuth, distance, top, width in HILLS:
        a = np.radians(azimuth)
        gap = np.hypot(x - distance * np.sin(a), y - distance * np.cos(a))
        height = height + top * np.exp(-((gap / width) ** 2))
    fade = np.clip((away - 14) / 60, 0, 1)
    return height + fade * (3.2 * waves(x / 28, y / 28, 2) + 0.9 * waves(x / 9, y / 9, 5))


def land() -> tuple[Array, Array, Array]:
    """The ground from the court to the hills, as a fan of rings; uv covers 1200 metres."""
    columns, rows = 112, 30
    angle = 2 * np.pi * np.arange(columns) / columns
    away = 10.8 * (560 / 10.8) ** (np.linspace(0, 1, rows)[:, None] ** 0.9)
    x, y = away * np.sin(angle), away * np.cos(angle)
    points = np.stack([x, y, ground_height(x, y)], -1).reshape(-1, 3)
    i = np.arange(rows - 1)[:, None] * columns + np.arange(columns)
    j = np.arange(rows - 1)[:, None] * columns + (np.arange(columns) + 1) % columns
    i, j = i.ravel(), j.ravel()
    faces = np.vstack(
        [np.stack([i, j + columns, j], 1), np.stack([i, i + columns, j + columns], 1)]
    )
    return points, faces, points[:, :2] / 1200 + 0.5


def mountains(number: int) -> tuple[Array, Array, Array, Array]:
    """A range all around, 0 the nearer: points, faces, normals and uv, v from foot to crest.

    Normals point up more than the surface does: haze shines from within.
    """
    distance, top, seed = ((760.0, 46.0, 11), (1150.0, 125.0, 17))[number]
    columns = 200
    angle = np.linspace(0, 2 * np.pi, columns + 1)
    x, y = np.sin(angle), np.cos(angle)
    crest = 1 + 0.45 * waves(2.3 * x, 2.3 * y, seed) + 0.25 * waves(7 * x, 7 * y, seed + 1)
    crest = top * np.maximum(crest + 0.09 * waves(19 * x, 19 * y, seed + 2), 0.2)
    v = np.array([0.0, 0.35, 0.7, 1.0])[:, None]
    away = distance * (1 + 0.1 * v + 0.02 * waves(25 * x, 25 * y + 3 * v, seed + 4) * (1 - v))
    z = -60 + (crest + 60) * v
    points = np.stack(np.broadcast_arrays(away * x, away * y, z), -1).reshape(-1, 3)
    turned = 0.35 * waves(31 * x, 31 * y + 2 * v, seed + 5)
    normals = np.stack(np.broadcast_arrays(-x - turned * y, -y + turned * x, 2.6 + 0 * v), -1)
    uv = np.stack(np.broadcast_arrays(6 * angle / np.pi, v), -1).reshape(-1, 2)
    return points, grid_faces(4, columns + 1), normals.reshape(-1, 3), uv


def cypress(rng: np.random.Generator) -> tuple[Array, ...]:
    """A cypress of height 1: leaves over a spindle."""
    count = 420
    t = rng.uniform(0.03, 1.0, count) ** 1.15
    radius = 0.105 * np.sin(np.pi * t**0.62) ** 0.8 * rng.uniform(0.75, 1.08, count)
    angle = rng.uniform(0, 2 * np.pi, count)
    spots = np.stack([radius * np.cos(angle), radius * np.sin(angle), t], 1)
    axes = np.stack([0.35 * np.cos(angle), 0.35 * np.sin(angle), np.ones(count)], 1)
    return leaves(spots, axes + rng.normal(0, 0.12, (count, 3)), np.full(count, 0.1), rng)


def at_ground(azimuth: float, distance: float) -> Array:
    """A place on the land."""
    a = np.radians(azimuth)
    x, y = np.array(distance * np.sin(a)), np.array(distance * np.cos(a))
    return np.array([x, y, ground_height(x, y)])


def landscape(rng: np.random.Generator) -> list[str]:
    """A village on the hill in the south, farms, rows of cypresses, and trees near by."""
    out = []
    near = [(9.6, 3.4, 6.5), (9.4, -0.6, 7.6), (9.9, -3.2, 6.8), (9.5, -6.4, 7.4), (12.6, 1.6, 8.5)]
    for k, (x, y, size) in enumerate(near):
        out.append(
            put("cypress", f"cypress_{k}", "cypress", (x, y, -0.8), scale(size), turn(60 * k))
        )
    for k in range(58):
        azimuth = 196 + 20 * np.sin(k / 9) + rng.normal(0, 0.4)
        at = at_ground(azimuth, 48 + 3.6 * k)
        out.append(put("cypress", f"avenue_{k}", "cypress", at, scale(rng.uniform(4.5, 7.5))))
    for k in range(34):
        at = at_ground(rng.normal(158, 7.5), rng.normal(170, 16))
        size = rng.uniform(5.5, 9.0)
        moves = [
            step("scale", x=size, y=size, z=size * rng.uniform(0.8, 1.4)),
            turn(rng.uniform(0, 180)),
        ]
        at[2] += 0.3 * size
        out.append(put("house", f"house_{k}", ("plaster_far", "plaster_far_2")[k % 2], at, *moves))
        out.append(put("roof", f"roof_{k}", ("tile", "tile_light")[k % 2], at, *moves))
    top = at_ground(158, 176)
    out.append(put("tower", "campanile", "stone", top, scale(1.0), turn(20)))
    out.append(put("spire", "campanile_roof", "tile", top, scale(1.0), turn(20)))
    for k in range(26):
        at = at_ground(rng.uniform(95, 265), rng.uniform(60, 330))
        if k % 3 == 0:
            size = rng.uniform(6, 9)
            at[2] += 0.25 * size
            moves = [scale(size), turn(rng.uniform(0, 180))]
            out.append(put("house", f"farm_{k}", "plaster_far", at, *moves))
            out.append(put("roof", f"farm_roof_{k}", "tile", at, *moves))
    for k in range(120):
        near_by = k < 30
        distance = rng.uniform(16, 40) if near_by else rng.uniform(45, 330)
        at = at_ground(rng.uniform(100, 260), distance)
        size = rng.uniform(1.3, 2.6) * (1 if near_by else 1.5)
        at[2] += 0.55 * size
        tint = ("olive", "olive_dark", "grove")[rng.integers(3)]
        out.append(put("tuft", f"grove_{k}", tint, at, scale(size), turn(rng.uniform(0, 360))))
    tall = (-14.5, 15.5, 0)
    out.append(put("tower", "tower", "plaster", tall, scale(0.86)))
    out.append(put("spire", "tower_roof", "tile", tall, scale(0.86)))
    return out


def house() -> tuple[Solid, Solid]:
    """The walls and the roof of a house of length 1."""
    walls = [[-0.36, -0.5], [0.36, -0.5], [0.36, 0.3], [0.0, 0.5], [-0.36, 0.3]]
    roof = [[-0.44, 0.255], [0.0, 0.49], [0.44, 0.255], [0.44, 0.3], [0.0, 0.545], [-0.44, 0.3]]
    return slab(np.array(walls), 1.0, 0.0), slab(np.array(roof), 1.12, 0.0)


def tower() -> tuple[Solid, Solid]:
    """A bell tower of height 22 with four openings at its top, and its roof."""
    parts = [moved(box((4.4, 4.4, 15.5), 0.05), (0, 0, 7.25))]
    parts += [moved(box((4.9, 4.9, 0.4), 0.06), (0, 0, z)) for z in (8.2, 15.2, 20.4)]
    parts += [
        moved(box((1.1, 1.1, 5.0), 0.04), (x, y, 17.8)) for x in (-1.6, 1.6) for y in (-1.6, 1.6)
    ]
    hole = arc(1.05, 180, 0, 13) + [0, 18.4]
    side = np.vstack([[[-1.6, 18.4]], hole, [[1.6, 18.4], [1.6, 20.3], [-1.6, 20.3]]])
    face = slab(side, 0.5, 0.0)
    parts += [moved(moved(face, (0, -1.9, 0)), (0, 0, 0), 90 * k) for k in range(4)]
    pyramid, _ = wedge(np.array([(3.4, 20.6), (3.5, 20.75), (0.0, 23.6)]), 1, 4)
    return merge(parts), moved(pyramid, (0, 0, 0), 45)


def write_meshes(folder: Path) -> None:
    """Plants, the land and what stands on it."""
    rng = np.random.default_rng(5)
    write_ply(folder / "courtyard_tuft.ply", *tuft(90, 0.36, rng))
    write_ply(folder / "courtyard_cypress.ply", *cypress(rng))
    points, faces, uv = land()
    write_ply(folder / "courtyard_land.ply", points, faces, uv=uv)
    for number in range(2):
        points, faces, normals, uv = mountains(number)
        path = folder / f"courtyard_mountains_{number}.ply"
        write_ply(path, points, faces, normals=normals, uv=uv)
    for name, solid in zip(("house", "roof", "tower", "spire"), (*house(), *tower()), strict=True):
        write_solid(folder / f"courtyard_{name}.ply", solid)


def main() -> None:
    """Writes the meshes, and where they stand."""
    folder = output_folder()
    write_meshes(folder)
    lines = landscape(np.random.default_rng(21))
    text = fragment(lines, "Made by courtyard_land.py: the land of unbounded/courtyard.xml.")
    (folder / "courtyard_land.xml").write_text(text)


if __name__ == "__main__":
    main()
