"""The meshes of unbounded/studio: what is turned, joined and grown.

Lengths are metres; things stand on z = 0 and face -y.
"""

from __future__ import annotations

import numpy as np
from geometry import Array, output_folder, write_ply
from solids import Solid, arc, box, merge, moved, spline
from surfaces import leaves, slab, tube, tuft, write_solid, write_turned


def profiles() -> dict[str, tuple[Array, int]]:
    """Radius and height from the bottom, and how many steps around."""
    vase = spline(
        [(0.045, 0), (0.085, 0.07), (0.1, 0.15), (0.06, 0.25), (0.045, 0.3), (0.06, 0.33)], 5
    )
    inside = spline(
        [(0.055, 0.33), (0.04, 0.3), (0.055, 0.25), (0.094, 0.15), (0.08, 0.07), (0, 0.02)], 4
    )
    jug = spline([(0.06, 0), (0.09, 0.05), (0.085, 0.14), (0.055, 0.2), (0.065, 0.25)], 5)
    bowl = spline([(0.05, 0.008), (0.11, 0.035), (0.135, 0.08)], 4)
    bowl_in = spline([(0.13, 0.08), (0.105, 0.04), (0, 0.016)], 4)
    stand = spline(
        [(0.09, 0.012), (0.03, 0.03), (0.012, 0.06), (0.02, 0.1), (0.01, 0.14), (0.01, 0.2)], 4
    )
    bust = [(0.0, 0), (0.06, 0), (0.06, 0.03), (0.03, 0.045)]
    shade = spline([(0.2, 0.0), (0.185, 0.06), (0.11, 0.13), (0.03, 0.15), (0.0, 0.155)], 4)
    return {
        "vase": (np.vstack([[[0, 0]], vase, inside]), 28),
        "jug": (np.vstack([[[0, 0]], jug, [[0.06, 0.25], [0.05, 0.2], [0, 0.18]]]), 24),
        "bowl": (np.vstack([[[0, 0], [0.045, 0]], bowl, bowl_in]), 28),
        "jar": (
            np.array(
                [
                    (0, 0),
                    (0.046, 0),
                    (0.05, 0.01),
                    (0.05, 0.12),
                    (0.046, 0.13),
                    (0.043, 0.13),
                    (0.043, 0.02),
                    (0, 0.015),
                ]
            ),
            20,
        ),
        "cup": (
            np.array(
                [
                    (0, 0),
                    (0.025, 0),
                    (0.038, 0.03),
                    (0.04, 0.065),
                    (0.037, 0.065),
                    (0.034, 0.03),
                    (0, 0.012),
                ]
            ),
            20,
        ),
        "ball": (arc(1.0, -90, 90, 13), 20),
        "cone": (np.array([(0, 0), (0.1, 0), (0.1, 0.012), (0, 0.27)]), 28),
        "stand": (np.vstack([[[0, 0], [0.09, 0]], stand]), 20),
        "bust_base": (np.array(bust), 16),
        "shade": (np.vstack([shade, [[0.0, 0.15]], (shade - [0.003, 0.004])[::-1][2:]]), 32),
        "lampshade": (np.array([(0.15, 0), (0.09, 0.2), (0.088, 0.2), (0.148, 0)]), 28),
        "planter": (
            np.array(
                [
                    (0, 0),
                    (0.17, 0),
                    (0.24, 0.36),
                    (0.265, 0.37),
                    (0.27, 0.44),
                    (0.245, 0.44),
                    (0.235, 0.4),
                    (0, 0.41),
                ]
            ),
            28,
        ),
        "side_table": (
            np.vstack(
                [
                    [[0, 0], [0.16, 0], [0.16, 0.015]],
                    spline([(0.05, 0.03), (0.02, 0.12), (0.032, 0.3), (0.02, 0.47)], 4),
                    [[0.25, 0.48], [0.25, 0.505], [0, 0.505]],
                ]
            ),
            28,
        ),
    }


def bust() -> Solid:
    """A head of plaster on a foot, in simple planes, facing -y."""
    rows, columns = 26, 32
    v = np.linspace(0, 1, rows)[:, None]
    a = 2 * np.pi * np.arange(columns) / columns
    profile = spline(
        [
            (0.055, 0.03),
            (0.05, 0.06),
            (0.043, 0.1),
            (0.062, 0.14),
            (0.078, 0.19),
            (0.077, 0.24),
            (0.05, 0.285),
            (0.012, 0.3),
        ],
        12,
    )
    at = np.stack(
        [np.interp(v[:, 0], np.linspace(0, 1, len(profile)), profile[:, k]) for k in (0, 1)], 1
    )
    z = at[:, 1:]
    front = np.exp(-((np.angle(np.exp(1j * (a + np.pi / 2))) / 0.32) ** 2))
    nose = 0.34 * front**2 * np.exp(-(((z - 0.175) / 0.022) ** 2))
    brow = 0.1 * front**0.5 * np.exp(-(((z - 0.215) / 0.014) ** 2))
    eyes = (
        -0.16
        * np.exp(-(((z - 0.197) / 0.011) ** 2))
        * sum(
            np.exp(-((np.angle(np.exp(1j * (a + np.pi / 2 + s))) / 0.2) ** 2))
            for s in (-0.42, 0.42)
        )
    )
    chin = 0.16 * front * np.exp(-(((z - 0.13) / 0.014) ** 2)) + 0.07 * front * np.exp(
        -(((z - 0.15) / 0.006) ** 2)
    )
    radius = at[:, :1] * (1 + nose + brow + eyes + chin + 0.12 * np.abs(np.sin(a)) * (z > 0.1))
    points = np.stack(np.broadcast_arrays(radius * np.cos(a), radius * np.sin(a), z), -1)
    du = np.roll(points, -1, 1) - np.roll(points, 1, 1)
    dv = np.gradient(points, axis=0)
    normals = np.cross(du, dv)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    i = np.arange(rows - 1)[:, None] * columns + np.arange(columns)
    j = np.arange(rows - 1)[:, None] * columns + (np.arange(columns) + 1) % columns
    i, j = i.ravel(), j.ravel()
    faces = np.vstack(
        [np.stack([i, j, j + columns], 1), np.stack([i, j + columns, i + columns], 1)]
    )
    head = Solid(points.reshape(-1, 3), faces, normals.reshape(-1, 3))
    return merge([head, moved(box((0.13, 0.13, 0.035), 0.006), (0, 0, 0.0175))])


def easel_frame() -> Solid:
    """Three legs, a mast and a ledge; the picture leans on its -y side."""
    parts = [
        tube(
            np.array([(s * 0.36, -0.12, 0), (s * 0.2, 0.02, 0.9), (s * 0.05, 0.16, 1.95)]), 0.02, 6
        )
        for s in (-1, 1)
    ]
    parts.append(tube(np.array([(0, 0.72, 0), (0, 0.45, 0.9), (0, 0.17, 1.9)]), 0.02, 6))
    parts.append(moved(box((0.055, 0.03, 1.6), 0.004), (0, 0.07, 1.3)))
    parts.append(moved(box((0.86, 0.09, 0.03), 0.004), (0, -0.09, 0.86)))
    parts.append(moved(box((0.62, 0.03, 0.045), 0.004), (0, 0.0, 0.62)))
    return merge(parts)


def table() -> Solid:
    """A table of length 1.9 with two drawers."""
    legs = [
        moved(box((0.07, 0.07, 0.74), 0.006), (x, y, 0.37))
        for x in (-0.86, 0.86)
        for y in (-0.3, 0.3)
    ]
    top = moved(box((1.9, 0.76, 0.04), 0.006), (0, 0, 0.76))
    rails = [moved(box((1.66, 0.025, 0.11), 0.003), (0, y, 0.68)) for y in (-0.3, 0.3)]
    rails += [moved(box((0.5, 0.02, 0.085), 0.004), (x, -0.32, 0.68)) for x in (-0.45, 0.45)]
    return merge([*legs, top, *rails])


def chair() -> tuple[Solid, Solid]:
    """A club chair that faces -y: its upholstery, and its feet."""
    parts = [
        moved(box((0.6, 0.62, 0.2), 0.06), (0, -0.04, 0.34)),
        moved(box((0.78, 0.74, 0.16), 0.03), (0, 0, 0.2)),
    ]
    back = slab(
        [(-0.4, 0.15), (0.4, 0.15), (0.37, 0.7), (0.24, 0.86), (-0.24, 0.86), (-0.37, 0.7)],
        0.18,
        0.055,
    )
    parts.append(moved(back, (0, 0.33, 0)))
    arm = box((0.17, 0.76, 0.44), 0.06)
    parts += [moved(arm, (s * 0.385, -0.03, 0.36)) for s in (-1, 1)]
    feet = [
        tube(
            np.array([(x, y, 0), (0.92 * x, 0.92 * y, 0.07), (0.88 * x, 0.88 * y, 0.14)]),
            np.array([0.016, 0.022, 0.026]),
            8,
        )
        for x in (-0.36, 0.36)
        for y in (-0.34, 0.34)
    ]
    return merge(parts), merge(feet)


def palm(rng: np.random.Generator) -> tuple[Array, Array]:
    """Long arching stalks, each with rows of leaflets and a leaf at its end."""
    vertices, faces, count = [], [], 0

    def add(points: Array, triangles: Array) -> None:
        nonlocal count
        vertices.append(points)
        faces.append(triangles + count)
        count += len(points)

    for k in range(11):
        angle = 2.4 * k
        way = np.array([np.cos(angle), np.sin(angle), 0.0])
        reach, rise = rng.uniform(0.35, 0.62), rng.uniform(0.75, 1.25) * (0.7 if k % 3 == 0 else 1)
        t = np.linspace(0, 1, 13)[:, None]
        line = way * reach * t**1.6 + np.array([0, 0, 1.0]) * rise * (t - 0.38 * t**3)
        add(*tube(line, np.linspace(0.011, 0.003, 13), 5)[:2])
        across = np.cross(way, [0, 0, 1.0])
        spots, axes, sizes = [], [], []
        for i in range(4, 13):
            ahead = line[i] - line[i - 1]
            ahead = ahead / np.linalg.norm(ahead)
            for side in (-1, 1):
                spots.append(line[i])
                axes.append(0.75 * ahead + side * across + [0, 0, -0.2])
                sizes.append(0.3 - 0.012 * abs(i - 7))
        add(*leaves(np.array(spots), np.array(axes), np.array(sizes), rng))
    return np.concatenate(vertices), np.concatenate(faces)


def other_solids() -> dict[str, Solid]:
    """What is neither turned nor grown."""
    upholstery, feet = chair()
    seat = moved(box((0.36, 0.36, 0.035), 0.01), (0, 0, 0.65))
    legs = [
        tube(
            np.array(
                [(0.2 * x, 0.2 * y, 0), (0.17 * x, 0.17 * y, 0.3), (0.13 * x, 0.13 * y, 0.64)]
            ),
            0.016,
            7,
        )
        for x in (-1, 1)
        for y in (-1, 1)
    ]
    rungs = [
        tube(np.array([(-0.17, y, 0.25), (0, y, 0.25), (0.17, y, 0.25)]), 0.01, 6)
        for y in (-0.17, 0.17)
    ]
    lamp = [tube(np.array([(0, 0, 0.02), (0, 0, 0.9), (0, 0, 1.6)]), 0.011, 10)]
    lamp.append(
        tube(
            np.array([(0, 0, 0), (0, 0, 0.02), (0, 0, 0.024), (0, 0, 0.025)]),
            np.array([0.15, 0.15, 0.13, 0.0]),
            28,
        )
    )
    bow = np.array(
        [
            (-0.05, 0.0, 0.0),
            (-0.048, 0.018, -0.004),
            (0, 0.026, -0.01),
            (0.048, 0.018, -0.004),
            (0.05, 0.0, 0.0),
        ]
    )
    plan = np.vstack([arc(0.16, 20, 340, 26) * [1.15, 0.85], [[0.08, 0.0]]])
    outline = slab(plan, 0.008)
    flat = Solid(
        np.stack([outline.vertices[:, 0], outline.vertices[:, 2], -outline.vertices[:, 1]], 1),
        outline.faces,
        np.stack([outline.normals[:, 0], outline.normals[:, 2], -outline.normals[:, 1]], 1),
    )
    body = tube(
        np.array(
            [
                (-0.06, 0, 0),
                (-0.055, 0, 0),
                (0.04, 0, 0),
                (0.052, 0, 0),
                (0.055, 0, 0),
                (0.07, 0, 0),
                (0.071, 0, 0),
            ]
        ),
        np.array([0.004, 0.012, 0.012, 0.006, 0.006, 0.006, 0.0]),
        10,
    )
    return {
        "beam": box((6.4, 0.16, 0.18), 0.012),
        "easel": easel_frame(),
        "table": table(),
        "chair": upholstery,
        "chair_legs": feet,
        "stool": merge([seat, *legs, *rungs]),
        "floor_lamp": merge(lamp),
        "handle": tube(bow, 0.004, 6),
        "palette": flat,
        "tube": body,
        "bust": bust(),
        "roof": slab([(-0.5, 0.0), (0.5, 0.0), (0.0, 1.0)], 1.0),
    }


def main() -> None:
    """Writes all meshes of the scene."""
    folder = output_folder()
    rng = np.random.default_rng(5)
    for name, (profile, steps) in profiles().items():
        if name != "bust_base":
            write_turned(folder / f"studio_{name}.ply", profile, 1, steps)
    for name, solid in other_solids().items():
        write_solid(folder / f"studio_{name}.ply", solid)
    write_ply(folder / "studio_tuft.ply", *tuft(60, 0.4, rng))
    write_ply(folder / "studio_palm.ply", *palm(rng))
    angle = np.arange(26) * 2.4
    axes = np.stack([np.cos(angle), np.sin(angle), np.repeat([0.1, 0.7, 1.8], [11, 9, 6])], 1)
    flower = leaves(np.zeros((26, 3)), axes, np.full(26, 1.0), rng)
    write_ply(folder / "studio_bloom.ply", *flower)


if __name__ == "__main__":
    main()
