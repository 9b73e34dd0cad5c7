"""The room of the scene forward/corner: its walls, furniture, books, plants and pictures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from geometry import Array, output_folder, write_ply
from PIL import Image
from solids import Solid, box, fragment, mesh, shape, spline, step, wedge

TURN = 33.0  # Of the room about z: what the camera sees is a corner
CORNER = (-0.32, 0.93)  # Where the two walls meet
TABLE = -0.13  # The height of the table
TUB = (-0.260, 0.581)  # Where the big plant stands
PARTS = 4  # What is turned is made of this many equal pieces
COVERS = ("rust", "navy", "cream", "sage", "mustard", "plum", "teal", "linen")


def room(at: Sequence[float], *steps: str) -> list[str]:
    """Steps from a shape around the origin to its place in the room.

    The place is how far along the back wall from the corner, how far before it, and z.
    """
    place = step("translate", x=at[0], y=-at[1], z=at[2])
    turn = step("rotate", z=1, angle=-TURN)
    return [*steps, place, turn, step("translate", x=CORNER[0], y=CORNER[1])]


def block(name: str, low: Sequence[float], high: Sequence[float], material: str) -> str:
    """A box between two places in the room."""
    size, middle = (np.array(high) - low) / 2, (np.array(low) + high) / 2
    scale = step("scale", x=size[0], y=size[1], z=size[2])
    return shape("cube", name, room(middle, scale), material)


def walls() -> list[str]:
    """The walls, one with a window, and what is fixed to them."""
    out = [
        block("wall_back", (-0.02, -0.02, -0.7), (1.54, 0, 0.97), "paint"),
        block("wall_below", (-0.02, 0, -0.7), (0, 1.18, -0.17), "white_paint"),
        block("wall_above", (-0.02, 0, 0.5), (0, 1.18, 0.97), "white_paint"),
        block("wall_corner", (-0.02, 0, -0.17), (0, 0.26, 0.5), "white_paint"),
        block("wall_front", (-0.02, 0.72, -0.17), (0, 1.18, 0.5), "white_paint"),
        block("ceiling", (0, 0, 0.95), (1.0, 0.8, 0.97), "white_paint"),
        block("floor", (0, 0, -0.7), (1.45, 0.95, -0.68), "oak"),
        block("sill", (-0.02, 0.23, -0.185), (0.06, 0.75, -0.165), "white_paint"),
    ]
    bars = [((0.255, -0.17), (0.28, 0.5)), ((0.7, -0.17), (0.725, 0.5))]
    bars += [((0.255, 0.478), (0.725, 0.503)), ((0.255, -0.17), (0.725, -0.145))]
    bars += [((0.482, -0.17), (0.498, 0.5)), ((0.255, 0.22), (0.725, 0.234))]
    for i, ((b, z), (d, top)) in enumerate(bars):
        out.append(block(f"bar_{i}", (-0.018, b, z), (0.008, d, top), "white_paint"))
    return out


def books(rng: np.random.Generator, name: str, start: float, stop: float, foot: float) -> list[str]:
    """A row of books on a shelf; here and there one leans."""
    out, a = [], start
    while True:
        thick, tall, deep = rng.uniform([0.014, 0.115, 0.085], [0.034, 0.17, 0.11])
        if a + thick > stop:
            return out
        cover = COVERS[rng.integers(len(COVERS))]
        scale = step("scale", x=thick / 2 - 0.0008, y=deep / 2, z=tall / 2)
        at = (a + thick / 2, 0.01 + deep / 2, foot + tall / 2)
        out.append(shape("cube", f"{name}_{len(out)}", room(at, scale), cover))
        if rng.uniform() < 0.45:
            band = step("scale", x=thick / 2 - 0.0004, y=0.001, z=rng.uniform(0.004, 0.014))
            low = (at[0], 0.0105 + deep, foot + tall * rng.choice([0.22, 0.78]))
            label = ("gold", "cream")[len(out) % 2]
            out.append(shape("cube", f"{name}_{len(out)}", room(low, band), label))
        a += thick


def shelves(rng: np.random.Generator) -> list[str]:
    """Two shelves on the back wall and what stands on them."""
    out = []
    for i, (low, high, z) in enumerate([(0.36, 1.2, -0.07), (0.3, 1.08, 0.2)]):
        out.append(block(f"shelf_{i}", (low, 0, z - 0.018), (high, 0.15, z), "oak"))
        for j, a in enumerate((low + 0.1, high - 0.1)):
            bracket = (a - 0.006, 0, z - 0.075), (a + 0.006, 0.012, z - 0.018)
            out.append(block(f"bracket_{i}_{j}", *bracket, "iron"))
            arm = (a - 0.006, 0, z - 0.028), (a + 0.006, 0.12, z - 0.018)
            out.append(block(f"arm_{i}_{j}", *arm, "iron"))
    out += books(rng, "low_book", 0.5, 0.82, -0.07)
    out += books(rng, "low_right", 0.99, 1.18, -0.07)
    out += books(rng, "high_book", 0.62, 0.98, 0.2)
    for i, (size, at, material) in enumerate(
        [
            (1.0, (0.43, 0.08, -0.07), "glaze"),
            (1.15, (0.9, 0.08, -0.07), "clay"),
            (1.25, (0.42, 0.08, 0.2), "white_glaze"),
            (0.8, (0.54, 0.085, 0.2), "clay"),
            (0.9, (1.03, 0.08, 0.2), "glaze"),
        ]
    ):
        for part in range(PARTS):
            turn = step("rotate", z=1, angle=part * 360 / PARTS)
            moves = room(at, turn, step("scale", value=size))
            out.append(mesh("corner_pot.ply", f"pot_{i}_{part}", moves, material))
    return out


def turned_things() -> list[str]:
    """What is turned and does not stand on the shelves: in world coordinates."""
    out = []
    for name, kind, material, size, x, y, z in [
        ("bowl", "bowl", "white_glaze", 0.95, 0.02, -0.46, TABLE),
        ("mug", "cup", "enamel", 1.0, -0.165, -0.56, TABLE),
        ("small_cup", "cup", "glaze", 0.85, -0.24, -0.36, TABLE),
        ("near_cup", "cup", "white_glaze", 0.75, -0.1, -0.71, TABLE),
        ("near_pot", "pot", "clay", 0.6, 0.2, -0.7, TABLE),
        ("jar", "pot", "white_glaze", 1.1, 0.27, -0.38, TABLE),
        ("tub", "pot", "clay", 2.0, *TUB, -0.4),
        ("lamp", "shade", "mustard", 1.0, 0.13, 0.22, 0.24),
    ]:
        for part in range(PARTS):
            moves = [step("rotate", z=1, angle=part * 360 / PARTS), step("scale", value=size)]
            moves.append(step("translate", x=x, y=y, z=z))
            out.append(mesh(f"corner_{kind}.ply", f"{name}_{part}", moves, material))
    return out


def leaves(name: str, at: Sequence[float], size: float, count: int, droop: float) -> list[str]:
    """A tuft of leaves out of a pot."""
    out = []
    for i in range(count):
        tilt = 14 + droop * ((i * 7) % count) / count
        length = size * (0.75 + 0.35 * ((i * 5) % 7) / 6)
        moves = [step("scale", value=length), step("rotate", y=1, angle=tilt)]
        moves.append(step("rotate", z=1, angle=i * 137.5))
        material = ("leaf", "leaf_light", "leaf_dark")[i % 3]
        out.append(mesh("corner_leaf.ply", f"{name}_{i}", room(at, *moves), material))
    return out


def pictures() -> list[str]:
    """Framed prints on the walls."""
    out = []
    places = [(0.62, 0.5, 0.17, 0.2), (0.87, 0.5, 0.125, 0.2), (0.15, 0.38, 0.11, 0.155)]
    for i, (a, z, wide, high) in enumerate(places):
        wide, high = wide / 2 + 0.02, high / 2 + 0.02
        frame = ("oak", "iron", "gold")[i]
        low, top = (a - wide, 0, z - high), (a + wide, 0.016, z + high)
        out.append(block(f"frame_{i}", low, top, frame))
        scale = step("scale", x=wide - 0.01, y=high - 0.01)
        stand = step("rotate", x=1, angle=90)
        at = (a, 0.0165, z)
        out.append(shape("rectangle", f"print_{i}", room(at, scale, stand), f"art_{i}"))
    return out


def pot() -> Array:
    """Profile of a pot of height 0.11."""
    outer = spline([(0.032, 0.0), (0.047, 0.03), (0.05, 0.07), (0.044, 0.11)], 2)
    return np.vstack([[[0.0, 0.0]], outer, [[0.039, 0.11], [0.04, 0.09], [0.0, 0.088]]])


def cup() -> Array:
    """Profile of a cup of height 0.085, outside and inside."""
    outer = spline([(0.028, 0.0), (0.036, 0.02), (0.039, 0.05), (0.04, 0.085)], 2)
    inner = spline([(0.0365, 0.085), (0.0355, 0.05), (0.032, 0.02), (0.0, 0.008)], 2)
    return np.vstack([[[0.0, 0.0]], outer, inner])


def bowl() -> Array:
    """Profile of a wide bowl of height 0.06, outside and inside."""
    outer = spline([(0.04, 0.006), (0.08, 0.02), (0.105, 0.06)], 3)
    inner = spline([(0.101, 0.06), (0.077, 0.026), (0.0, 0.014)], 3)
    return np.vstack([[[0.0, 0.0], [0.038, 0.0]], outer, inner])


def shade() -> Array:
    """Profile of the lamp over the table."""
    return spline([(0.13, 0.0), (0.122, 0.035), (0.075, 0.085), (0.02, 0.11)], 3)


def leaf() -> tuple[Array, Array]:
    """A leaf of length 1 that grows up along z and bends towards x."""
    t = np.linspace(0, 1, 9)
    half = 0.13 * np.sin(np.pi * (0.06 + 0.94 * t) ** 0.8) * (1 - 0.25 * t)
    line = np.stack([0.42 * t**2.2, 0 * t, t - 0.22 * t**3], 1)
    fold = np.array([-0.35, 0, 0.1])
    edges = [line + half[:, None] * (np.array([0, s, 0]) + fold) for s in (1, -1)]
    points = np.stack([edges[0], line, edges[1]], 1).reshape(-1, 3)
    i = 3 * np.arange(8)[:, None] + np.array([0, 1])
    i = i.ravel()
    faces = [np.stack([i, i + 1, i + 3], 1), np.stack([i + 3, i + 1, i + 4], 1)]
    return points, np.vstack(faces)


def grain() -> Array:
    """The grain of the table top."""
    rng = np.random.default_rng(6)
    y, x = np.mgrid[0:192, 0:192] / 192
    warp = 0.05 * np.sin(2 * np.pi * (1.3 * x + 0.4)) + 0.02 * np.sin(2 * np.pi * (3.1 * x + y))
    rings = sum(
        np.sin(2 * np.pi * f * (y + warp / 2) + rng.uniform(0, 6)) / k
        for k, f in enumerate((4, 9, 17, 31, 47), 1)
    )
    planks = np.array([0.1, -0.25, 0.3, -0.1, 0.2, -0.3])[(y * 6).astype(int)]
    value = 0.5 + 0.14 * rings + 0.5 * planks - 0.7 * ((y * 6) % 1 < 0.05)
    return (value.clip(0, 1) * 7).round().astype(np.uint8)


def art(number: int) -> Array:
    """One of the prints, as numbers of colours."""
    y, x = np.mgrid[0:160, 0:128]
    x, y = (x - 63.5) / 64, (y - 79.5) / 64
    paint = np.where((np.abs(x) > 0.82) | (np.abs(y) > 1.07), 0, 1)
    inside = paint == 1
    if number == 0:
        paint[inside & (np.hypot(x - 0.15, y + 0.42) < 0.38)] = 2
        for k, level in enumerate((0.1, 0.38, 0.7)):
            hill = level + 0.16 * np.sin(3.2 * x + 1.7 * k)
            paint[inside & (y > hill)] = 3 + k
    elif number == 1:
        for k in range(5):
            bend = x - 0.3 * np.sin(1.6 * y + k) + 0.55 - 0.28 * k
            stem = (np.abs(bend) < 0.02) & (y > -0.7 + 0.12 * k)
            pods = np.hypot(bend - 0.09, (y * 5 + k) % 1 / 5 - 0.1) < 0.075
            paint[inside & (stem | (pods & (y > -0.75) & (y < 0.75)))] = 3 + k % 3
    else:
        paint[inside & (np.abs(x) + np.abs(y) < 0.8)] = 4
        paint[inside & (np.hypot(x, y) < 0.42)] = 2
        paint[inside & (np.hypot(x, y) < 0.2)] = 5
    return paint.astype(np.uint8)


def save_picture(name: str, numbers: Array, colours: Sequence[Sequence[int]]) -> None:
    """A picture with few colours."""
    picture = Image.fromarray(numbers, "P")
    picture.putpalette([value for colour in colours for value in colour])
    picture.save(output_folder() / f"corner_{name}.png", optimize=True)


def main() -> None:
    folder = output_folder()
    turned = {"pot": pot(), "cup": cup(), "bowl": bowl(), "shade": shade()}
    solids: dict[str, Solid] = {name: wedge(p, PARTS, 7)[0] for name, p in turned.items()}
    solids["cover"] = box((0.2, 0.14, 0.004), 0.0015)
    for name, solid in solids.items():
        path = folder / f"corner_{name}.ply"
        write_ply(path, solid.vertices, solid.faces, normals=solid.normals)
    write_ply(folder / "corner_leaf.ply", *leaf())
    dark, light = np.array([118, 72, 40]), np.array([190, 134, 84])
    save_picture("grain", grain(), [tuple(dark + (light - dark) * k // 7) for k in range(8)])
    colours = [(240, 234, 220), (226, 214, 190), (214, 92, 60), (132, 158, 140), (52, 92, 104)]
    for number in range(3):
        save_picture(f"art_{number}", art(number), [*colours, (34, 42, 66)])
    rng = np.random.default_rng(14)
    lines = [*walls(), *shelves(rng), *pictures(), *turned_things()]
    lines += leaves("palm", (0.24, 0.26, -0.2), 0.42, 13, 22)
    lines += leaves("fern", (0.42, 0.08, 0.32), 0.13, 12, 70)
    lines += leaves("aloe", (0.43, 0.08, 0.02), 0.12, 9, 40)
    text = fragment(lines, "Made by corner.py: the room of forward/corner.xml.")
    (folder / "corner_room.xml").write_text(text)


if __name__ == "__main__":
    main()
