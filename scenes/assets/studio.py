"""The room of unbounded/studio: a painter's studio under the roof, and the street outside.

Lengths are metres. The room is 6.4 by 5.2 and 3.2 high, with a window in the north (y up), a
skylight, shelves in the east, an easel, a table, a plan chest and an armchair around a rug.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from geometry import Array, output_folder, write_ply
from solids import Solid, arc, box, fragment, merge, mesh, moved, shape, spline, step
from surfaces import (
    blend,
    block,
    leaves,
    noise,
    put_mesh,
    rough,
    save,
    scale,
    slab,
    tube,
    tuft,
    turn,
    write_solid,
    write_turned,
)

X, Y, TOP = 3.2, 2.6, 3.2  # Half sizes of the room, its height
WINDOW = (-2.0, 1.4, 0.82, 2.75)  # Left, right, sill, lintel
LIGHT = (-1.2, 1.2, -0.8, 0.7)  # The skylight: x and y
COVERS = ("rust", "navy", "cream", "sage", "mustard", "plum", "teal", "linen")

put = partial(put_mesh, "studio")


# ---- The shell ---------------------------------------------------------------


def shell() -> list[str]:
    """Walls, floor, ceiling, window, skylight, beams and skirting: closed but for the window."""
    left, right, sill, lintel = WINDOW
    west, east, south, north = LIGHT
    t = 0.25
    out = [
        block("wall_south", (-X - t, -Y - t, 0), (X + t, -Y, TOP), "wall"),
        block("wall_west", (-X - t, -Y, 0), (-X, Y, TOP), "wall_blue"),
        block("wall_east", (X, -Y, 0), (X + t, Y, TOP), "wall"),
        block("wall_below", (-X - t, Y, 0), (X + t, Y + t, sill), "wall"),
        block("wall_above", (-X - t, Y, lintel), (X + t, Y + t, TOP), "wall"),
        block("wall_left", (-X - t, Y, sill), (left, Y + t, lintel), "wall"),
        block("wall_right", (right, Y, sill), (X + t, Y + t, lintel), "wall"),
        block("ceiling_west", (-X - t, -Y - t, TOP), (west, Y + t, TOP + 0.4), "white"),
        block("ceiling_east", (east, -Y - t, TOP), (X + t, Y + t, TOP + 0.4), "white"),
        block("ceiling_south", (west, -Y - t, TOP), (east, south, TOP + 0.4), "white"),
        block("ceiling_north", (west, north, TOP), (east, Y + t, TOP + 0.4), "white"),
        block("under", (-X - t, -Y - t, -0.2), (X + t, Y + t, -0.001), "oak"),
        shape("rectangle", "floor", [step("scale", x=X, y=Y)], "parquet"),
        block("sill", (left - 0.1, Y - 0.16, sill - 0.04), (right + 0.1, Y + t + 0.05, sill), "white_paint"),
    ]
    for k in range(5):
        x = left + (right - left) * k / 4
        out.append(block(f"upright_{k}", (x - 0.025, Y + 0.08, sill), (x + 0.025, Y + 0.14, lintel), "iron"))
    for k, z in enumerate((sill, 1.4, 2.1, lintel)):
        out.append(block(f"bar_{k}", (left, Y + 0.09, z - 0.018), (right, Y + 0.13, z + 0.018), "iron"))
    for k in range(4):
        x = west + (east - west) * k / 3
        out.append(block(f"sky_bar_{k}", (x - 0.02, south, TOP + 0.18), (x + 0.02, north, TOP + 0.24), "iron"))
    for k, y in enumerate((-1.9, -1.05, 0.95, 1.85)):
        out.append(put("beam", f"beam_{k}", "timber", (0, y, TOP - 0.09)))
    for name, low, high in [
        ("south", (-X, -Y, 0), (1.38, -Y + 0.018, 0.13)),
        ("west", (-X, -Y, 0), (-X + 0.018, Y, 0.13)),
        ("north", (-X, Y - 0.018, 0), (X, Y, 0.13)),
        ("east", (X - 0.018, -Y, 0), (X, Y, 0.13)),
    ]:
        out.append(block(f"skirting_{name}", low, high, "white_paint"))
    return out


def door() -> list[str]:
    """The door in the south, with panels, a frame and a knob of brass; a coat hangs beside it."""
    x, y = 1.95, -Y
    out = [block("door_leaf", (x - 0.45, y, 0), (x + 0.45, y + 0.03, 2.05), "door_paint")]
    for k, (low, high) in enumerate([((-0.36, 0.2), (-0.05, 0.95)), ((0.05, 0.2), (0.36, 0.95)), ((-0.36, 1.1), (-0.05, 1.9)), ((0.05, 1.1), (0.36, 1.9))]):
        corners = (x + low[0], y + 0.03, low[1]), (x + high[0], y + 0.042, high[1])
        out.append(block(f"door_panel_{k}", *corners, "door_paint"))
    for k, (a, b, c, d) in enumerate([(-0.56, -0.45, 0, 2.16), (0.45, 0.56, 0, 2.16), (-0.56, 0.56, 2.05, 2.16)]):
        out.append(block(f"door_frame_{k}", (x + a, y, c), (x + b, y + 0.06, d), "white_paint"))
    out.append(shape("sphere", "knob", [scale(0.03), step("translate", x=x - 0.38, y=y + 0.08, z=1.03)], "brass"))
    return out


# ---- Furniture ---------------------------------------------------------------


def shelves(rng: np.random.Generator) -> list[str]:
    """Shelves along the eastern wall, with books and things on them."""
    deep, low, high = 0.32, -1.9, 1.5
    out, levels = [], (0.1, 0.52, 0.92, 1.32, 1.72, 2.12)
    for k in range(5):
        y = low + (high - low) * k / 4
        out.append(block(f"side_{k}", (X - deep, y - 0.014, 0), (X, y + 0.014, 2.45), "oak"))
    for k, z in enumerate((*levels, 2.45)):
        out.append(block(f"shelf_{k}", (X - deep, low, z - 0.012), (X, high, z + 0.012), "oak"))
    out.append(block("shelf_back", (X - 0.012, low, 0), (X - 0.001, high, 2.45), "oak"))
    things = {(1, 0): "vase", (3, 2): "bust", (2, 1): "bowl", (3, 3): "cone", (0, 4): "jar", (2, 3): "jar", (1, 4): "globe", (0, 2): "vase_tall", (3, 5): "jar"}
    for column in range(4):
        for level, z in enumerate(levels):
            start = low + (high - low) * column / 4 + 0.03
            stop = start + (high - low) / 4 - 0.06
            thing = things.get((column, level))
            if thing is not None:
                at = (X - 0.17, (start + stop) / 2 + 0.18, z + 0.012)
                out += on_shelf(thing, f"{thing}_{column}_{level}", at)
                stop -= 0.38
            out += books(rng, f"book_{column}_{level}", start, stop, z + 0.012)
    return out


def books(rng: np.random.Generator, name: str, start: float, stop: float, foot: float) -> list[str]:
    """A row of books with their backs to the room; some lie flat, and here and there is a gap."""
    out: list[str] = []
    y = start
    while True:
        thick, tall, deep = rng.uniform([0.022, 0.2, 0.16], [0.062, 0.31, 0.24])
        if y + thick > stop:
            return out
        if rng.uniform() < 0.07 and y + 0.3 < stop:
            for k in range(3):
                low = (X - 0.3 + 0.01 * k, y + 0.01 * k, foot + 0.045 * k)
                top = (X - 0.05, y + 0.27 - 0.02 * k, foot + 0.045 * (k + 1) - 0.002)
                out.append(block(f"{name}_{len(out)}", low, top, COVERS[rng.integers(8)]))
            y += 0.32
            continue
        edge = X - 0.04 - deep
        cover = COVERS[rng.integers(8)]
        out.append(block(f"{name}_{len(out)}", (edge, y + 0.001, foot), (X - 0.04, y + thick, foot + tall), cover))
        if rng.uniform() < 0.5:
            z = foot + tall * rng.choice([0.2, 0.75])
            low, top = (edge - 0.001, y + 0.003, z), (edge + 0.01, y + thick - 0.002, z + rng.uniform(0.012, 0.05))
            out.append(block(f"{name}_{len(out)}", low, top, ("gold", "paper")[len(out) % 2]))
        y += thick


def on_shelf(kind: str, name: str, at: Sequence[float]) -> list[str]:
    """Something that stands between the books."""
    x, y, z = at
    if kind == "globe":
        ball = [scale(0.115), step("translate", x=x, y=y, z=z + 0.17)]
        return [put("stand", f"{name}_foot", "brass", at, scale(0.8)), shape("sphere", name, ball, "map")]
    if kind == "cone":
        return [put("cone", name, "gypsum", at, scale(0.8))]
    if kind == "bust":
        return [put("bust", name, "gypsum", at, scale(0.9), turn(95))]
    file = "vase" if kind.startswith("vase") else kind
    size = {"vase": 0.85, "vase_tall": 1.0, "bowl": 0.9, "jar": 1.0}[kind]
    tint = {"vase": "glaze", "vase_tall": "glaze_red", "bowl": "celadon", "jar": "glaze_white"}[kind]
    return [put(file, name, tint, at, scale(size))]


def easel() -> list[str]:
    """An easel with an unfinished picture, before the window's western half."""
    steps = [turn(38)]
    at = (-1.75, 1.25, 0)
    out = [put("easel", "easel", "oak", at, *steps)]
    lean = step("rotate", x=1, angle=-10)
    face = [step("rotate", x=1, angle=90), step("scale", x=0.42, y=1, z=0.52)]
    stand = [step("translate", y=-0.055, z=1.42), lean, *steps]
    place = step("translate", x=at[0], y=at[1])
    out.append(shape("rectangle", "picture", [*face, *stand, place], "painting"))
    back = [step("scale", x=0.42, y=0.018, z=0.52), step("translate", y=-0.034, z=1.42), lean, *steps]
    out.append(shape("cube", "stretcher", [*back, place], "linen"))
    out.append(put("stool", "stool", "timber", (-0.92, 0.62, 0), turn(20)))
    out.append(put("palette", "palette", "varnish", (-0.9, 0.6, 0.672), turn(150)))
    colours = ("rust", "navy", "mustard", "paper", "sage", "plum", "glaze_red")
    for k, colour in enumerate(colours):
        a = np.radians(35 + 32 * k)
        x, y = -0.9 + 0.115 * np.cos(a), 0.6 + 0.085 * np.sin(a)
        blob = [step("scale", x=0.017, y=0.014, z=0.008), step("translate", x=x, y=y, z=0.684)]
        out.append(mesh("studio_ball.ply", f"paint_{k}", blob, colour))
    return out


def easel_frame() -> Solid:
    """Three legs, a mast and a ledge; the picture leans on its -y side."""
    parts = [tube(np.array([(s * 0.36, -0.12, 0), (s * 0.2, 0.02, 0.9), (s * 0.05, 0.16, 1.95)]), 0.02, 6) for s in (-1, 1)]
    parts.append(tube(np.array([(0, 0.72, 0), (0, 0.45, 0.9), (0, 0.17, 1.9)]), 0.02, 6))
    parts.append(moved(box((0.055, 0.03, 1.6), 0.004), (0, 0.07, 1.3)))
    parts.append(moved(box((0.86, 0.09, 0.03), 0.004), (0, -0.09, 0.86)))
    parts.append(moved(box((0.62, 0.03, 0.045), 0.004), (0, 0.0, 0.62)))
    return merge(parts)


def work_table(rng: np.random.Generator) -> list[str]:
    """The table under the window: brushes in jars, a still life, tubes and a lamp."""
    z = 0.78
    out = [put("table", "table", "timber", (0.62, 2.12, 0))]
    for k, (x, y, file, tint, size) in enumerate(
        [
            (-0.1, 2.2, "jar", "glaze_white", 1.0),
            (0.07, 2.32, "jar", "clay", 0.85),
            (0.85, 2.2, "bowl", "celadon", 1.0),
            (1.18, 2.28, "vase", "glaze", 1.0),
            (1.32, 2.0, "jug", "copper", 1.0),
        ]
    ):
        out.append(put(file, f"pot_{k}", tint, (x, y, z), scale(size), turn(47 * k)))
    for k in range(13):
        a = 2.4 * k
        foot = np.array([-0.1 + 0.02 * np.cos(a), 2.2 + 0.02 * np.sin(a), z + 0.02])
        tip = foot + [0.075 * np.cos(a), 0.06 * np.sin(a), 0.27 + 0.05 * (k % 3)]
        out += stick(f"brush_{k}", foot, tip, 0.0045, ("oak", "rust", "navy")[k % 3])
        out += stick(f"bristle_{k}", tip, tip + 0.14 * (tip - foot), 0.0065, ("linen", "iron")[k % 2])
    for k, (dx, dy, dz) in enumerate([(-0.05, -0.03, 0.055), (0.05, -0.02, 0.055), (0, 0.05, 0.055), (0, 0, 0.115), (-0.3, -0.2, 0.038)]):
        at = [step("translate", x=0.85 + dx, y=2.2 + dy, z=z + dz)]
        tint = ("apple", "apple_green", "orange", "apple", "apple_green")[k]
        out.append(shape("sphere", f"fruit_{k}", [scale(0.04), *at], tint))
    for k in range(7):
        x, y = 0.2 + 0.055 * k, 1.9 + 0.02 * (k % 3)
        turned = turn(70 + 13 * ((5 * k) % 7))
        out.append(put("tube", f"tube_{k}", "tin", (x, y, z + 0.012), turned))
        colour = ("rust", "navy", "mustard", "sage", "plum", "teal", "glaze_red")[k]
        band = [step("scale", x=0.012, y=0.022, z=0.0125), turned, step("translate", x=x, y=y, z=z + 0.0125)]
        out.append(shape("cube", f"label_{k}", band, colour))
    for k in range(3):
        low = (0.35 + 0.01 * k, 2.16 + 0.008 * k, z + 0.028 * k)
        out.append(block(f"stack_{k}", low, (0.62 - 0.012 * k, 2.36, z + 0.028 * (k + 1) - 0.002), COVERS[2 * k + 1]))
    out.append(shape("sphere", "bulb", [scale(0.045), step("translate", x=0.7, y=1.55, z=1.99)], "glaze_white"))
    out += [put("shade", "pendant", "brass", (0.7, 1.55, 1.95)), *stick("flex", (0.7, 1.55, 2.1), (0.7, 1.55, TOP), 0.005, "iron")]
    return out


def stick(name: str, foot: Sequence[float] | Array, tip: Sequence[float] | Array, radius: float, material: str) -> list[str]:
    """A cylinder between two points."""
    ends = [", ".join(f"{v:.4g}" for v in p) for p in (foot, tip)]
    points = f'<point name="p0" value="{ends[0]}"/><point name="p1" value="{ends[1]}"/>'
    radii = f'<float name="radius" value="{radius}"/>'
    return [shape("cylinder", name, [], material, points + radii)]


def table() -> Solid:
    """A table of length 1.9 with two drawers."""
    legs = [moved(box((0.07, 0.07, 0.74), 0.006), (x, y, 0.37)) for x in (-0.86, 0.86) for y in (-0.3, 0.3)]
    top = moved(box((1.9, 0.76, 0.04), 0.006), (0, 0, 0.76))
    rails = [moved(box((1.66, 0.025, 0.11), 0.003), (0, y, 0.68)) for y in (-0.3, 0.3)]
    rails += [moved(box((0.5, 0.02, 0.085), 0.004), (x, -0.32, 0.68)) for x in (-0.45, 0.45)]
    return merge([*legs, top, *rails])


def plan_chest() -> list[str]:
    """The chest of flat drawers in the south, a lit lamp and plaster solids on it."""
    low, high = (-1.0, -2.58, 0.06), (0.6, -1.95, 0.88)
    out = [block("chest", low, high, "chest_paint")]
    out.append(block("chest_top", (-1.03, -2.59, 0.88), (0.63, -1.92, 0.915), "oak"))
    for k in range(6):
        z = 0.1 + 0.13 * k
        out.append(block(f"drawer_{k}", (-0.97, -1.95, z), (0.57, -1.932, z + 0.115), "chest_paint"))
        for side, x in enumerate((-0.65, 0.25)):
            out.append(block(f"label_{k}_{side}", (x - 0.05, -1.934, z + 0.04), (x + 0.05, -1.929, z + 0.08), "paper"))
            out.append(put("handle", f"handle_{k}_{side}", "brass", (x, -1.93, z + 0.028)))
    z = 0.915
    out.append(put("cone", "solid_cone", "gypsum", (-0.35, -2.3, z), scale(1.0)))
    ball = [scale(0.11), step("translate", x=-0.08, y=-2.14, z=z + 0.11)]
    out.append(shape("sphere", "solid_ball", ball, "gypsum"))
    cube = [scale(0.085), turn(28), step("translate", x=-0.42, y=-2.08, z=z + 0.085)]
    out.append(shape("cube", "solid_cube", cube, "gypsum"))
    out.append(put("bust", "bust", "gypsum", (0.3, -2.33, z), scale(1.25), turn(160)))
    out.append(put("stand", "lamp_foot", "brass", (-0.8, -2.3, z), scale(1.4)))
    out.append(put("vase", "chest_vase", "glass", (0.08, -2.4, z), scale(1.05)))
    for k in range(7):
        a = 2.4 * k
        foot = np.array([0.08, -2.4, z + 0.03])
        tip = foot + [0.13 * np.cos(a), 0.09 * np.sin(a), 0.42 + 0.03 * (k % 3)]
        out += stick(f"stem_{k}", foot, tip, 0.003, "leaf")
        out.append(put("bloom", f"bloom_{k}", ("petal", "petal_white")[k % 2], tip, scale(0.055), turn(80 * k)))
    return out


def armchair() -> list[str]:
    """A leather chair in the south-west, a cushion, a floor lamp, a small table with a cup."""
    at, angle = (-2.25, -1.55, 0), turn(122)
    out = [put("chair", "armchair", "leather", at, angle), put("chair_legs", "chair_legs", "oak", at, angle)]
    cushion = [step("scale", x=0.24, y=0.085, z=0.22), step("rotate", x=1, angle=-22)]
    cushion += [step("translate", y=0.16, z=0.66), angle, step("translate", x=at[0], y=at[1])]
    out.append(mesh("studio_ball.ply", "cushion", cushion, "weave"))
    out.append(put("floor_lamp", "floor_lamp", "brass", (-2.85, -2.2, 0)))
    x, y = -1.55, -2.1
    out.append(put("side_table", "side_table", "varnish", (x, y, 0)))
    out.append(put("cup", "coffee", "glaze_white", (x - 0.06, y + 0.05, 0.505)))
    out.append(block("magazine", (x - 0.02, y - 0.15, 0.505), (x + 0.16, y + 0.06, 0.513), "rust"))
    return out


def chair() -> tuple[Solid, Solid]:
    """A club chair that faces -y: its upholstery, and its feet."""
    parts = [moved(box((0.6, 0.62, 0.2), 0.06), (0, -0.04, 0.34)), moved(box((0.78, 0.74, 0.16), 0.03), (0, 0, 0.2))]
    back = slab([(-0.4, 0.15), (0.4, 0.15), (0.37, 0.7), (0.24, 0.86), (-0.24, 0.86), (-0.37, 0.7)], 0.18, 0.055)
    parts.append(moved(back, (0, 0.33, 0)))
    arm = box((0.17, 0.76, 0.44), 0.06)
    parts += [moved(arm, (s * 0.385, -0.03, 0.36)) for s in (-1, 1)]
    feet = [tube(np.array([(x, y, 0), (0.92 * x, 0.92 * y, 0.07), (0.88 * x, 0.88 * y, 0.14)]), np.array([0.016, 0.022, 0.026]), 8) for x in (-0.36, 0.36) for y in (-0.34, 0.34)]
    return merge(parts), merge(feet)


def western_wall() -> list[str]:
    """A tall mirror, pictures in frames, and a low shelf with records."""
    out = []
    for k, (y, z, wide, high, art, frame) in enumerate(
        [
            (1.55, 1.75, 0.62, 0.8, "art_0", "gold"),
            (0.72, 1.98, 0.4, 0.5, "art_1", "iron"),
            (0.68, 1.34, 0.48, 0.4, "art_2", "oak"),
            (-1.75, 1.95, 0.95, 0.62, "art_3", "oak"),
        ]
    ):
        a, b = wide / 2 + 0.05, high / 2 + 0.05
        out.append(block(f"frame_{k}", (-X, y - a, z - b), (-X + 0.03, y + a, z + b), frame))
        face = [step("scale", x=wide / 2, y=high / 2), step("rotate", x=1, angle=90), turn(90)]
        out.append(shape("rectangle", f"framed_{k}", [*face, step("translate", x=-X + 0.031, y=y, z=z)], f"art_{k}"))
    lean = step("rotate", y=1, angle=5)
    y = -0.42
    border = [step("scale", x=0.018, y=0.46, z=0.96), step("translate", z=0.96), lean]
    out.append(shape("cube", "mirror_frame", [*border, step("translate", x=-X + 0.03, y=y, z=0.01)], "gold"))
    glass = [step("scale", x=0.4, y=0.9), step("rotate", x=1, angle=90), turn(90), step("translate", x=0.0185, z=0.96), lean]
    out.append(shape("rectangle", "mirror_glass", [*glass, step("translate", x=-X + 0.03, y=y, z=0.01)], "mirror"))
    out.append(block("low_shelf", (-X, 0.35, 0.0), (-X + 0.38, 2.0, 0.46), "oak"))
    out.append(block("low_shelf_gap", (-X + 0.3, 0.39, 0.05), (-X + 0.382, 1.96, 0.41), "iron"))
    y = 0.4
    rng = np.random.default_rng(6)
    while y < 1.9:
        thick = rng.uniform(0.006, 0.022)
        low = (-X + 0.36 + rng.uniform(0, 0.02), y, 0.05)
        out.append(block(f"record_{len(out)}", low, (low[0] + 0.02, y + thick - 0.001, 0.36), COVERS[rng.integers(8)]))
        y += thick
    for k, (y, file, tint, size) in enumerate([(0.55, "jug", "glaze_red", 0.9), (0.95, "bowl", "copper", 0.85), (1.75, "vase", "glaze_white", 1.15)]):
        out.append(put(file, f"west_{k}", tint, (-X + 0.19, y, 0.46), scale(size)))
    return out


def sketches(rng: np.random.Generator) -> list[str]:
    """Drawings pinned to the southern wall, and canvases that lean against it."""
    out = []
    for k in range(9):
        x, z = -0.95 + 0.36 * (k % 5) + rng.uniform(-0.03, 0.03), 1.62 + 0.46 * (k // 5) + rng.uniform(-0.05, 0.05)
        x += 0.17 * (k // 5)
        face = [step("scale", x=rng.uniform(0.11, 0.16), y=rng.uniform(0.14, 0.2)), step("rotate", z=1, angle=rng.uniform(-5, 5))]
        face += [step("rotate", x=1, angle=90), turn(180), step("translate", x=x, y=-Y + 0.004 + 0.001 * k, z=z)]
        out.append(shape("rectangle", f"drawing_{k}", face, f"sketch_{k % 3}"))
        pin = [scale(0.008), step("translate", x=x, y=-Y + 0.012, z=z + 0.12)]
        out.append(shape("sphere", f"pin_{k}", pin, ("apple", "navy", "mustard")[k % 3]))
    for k, (x, wide, high) in enumerate([(2.78, 0.3, 0.45), (2.82, 0.26, 0.33), (2.74, 0.24, 0.25)]):
        size = step("scale", x=wide, y=0.016, z=high)
        moves = [size, step("translate", z=high), step("rotate", x=1, angle=9 + 3 * k), step("translate", x=x, y=-Y + 0.17 + 0.09 * k)]
        out.append(shape("cube", f"leaning_{k}", moves, ("linen", "paper", "canvas")[k]))
    return out


def plants(rng: np.random.Generator) -> list[str]:
    """A big plant in the north-east, one that hangs, and flowers outside the window."""
    out = [put("planter", "planter", "clay", (2.5, 2.08, 0))]
    out.append(put("palm", "palm", "leaf", (2.5, 2.08, 0.42)))
    out.append(put("palm", "palm_light", "leaf_light", (2.5, 2.08, 0.42), scale(0.86), turn(77)))
    out += [put("planter", "hanging", "glaze_white", (-2.72, 2.15, 2.0), scale(0.42))]
    for k in range(3):
        a = 2.1 * k
        out += stick(f"cord_{k}", (-2.72 + 0.1 * np.cos(a), 2.15 + 0.1 * np.sin(a), 2.18), (-2.72, 2.15, TOP), 0.003, "linen")
    for k in range(34):
        a, down = 2.4 * k, rng.uniform(0, 1)
        out_by = 0.06 + 0.12 * np.sqrt(down)
        spot = (-2.72 + out_by * np.cos(a), 2.15 + out_by * np.sin(a), 2.22 - 0.75 * down**1.6)
        out.append(put("tuft", f"trail_{k}", ("leaf_light", "leaf")[k % 2], spot, scale(0.075), turn(50 * k)))
    for k in range(3):
        low = (-1.7 + 1.05 * k, Y + 0.3, 0.62)
        out.append(block(f"box_{k}", low, (low[0] + 0.8, low[1] + 0.2, 0.8), "clay"))
        for j in range(7):
            spot = (low[0] + 0.08 + 0.105 * j, low[1] + rng.uniform(0.05, 0.15), 0.86 + rng.uniform(0, 0.06))
            tint = ("leaf", "petal", "leaf_light")[j % 3]
            out.append(put("tuft", f"flowers_{k}_{j}", tint, spot, scale(0.095), turn(40 * j)))
    return out


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


def street(rng: np.random.Generator) -> list[str]:
    """Houses on the other side of the street, roofs behind them, and a tree."""
    out = [block("street", (-60, 3.5, -9.2), (60, 60, -9.0), "pavement")]
    x, k = -34.0, 0
    while x < 34:
        wide, high = rng.uniform(5.5, 9), rng.uniform(1.2, 4.6)
        size = [step("scale", x=wide / 2, y=(high + 9) / 2), step("rotate", x=1, angle=90)]
        kind = f"facade_{k % 3}"
        face = [*size, step("translate", x=x + wide / 2, y=15.0, z=(high - 9) / 2)]
        out.append(shape("rectangle", f"house_{k}", face, kind))
        out.append(block(f"house_body_{k}", (x, 15.01, -9), (x + wide, 24, high), "wall"))
        out.append(block(f"eaves_{k}", (x, 14.7, high), (x + wide, 15.3, high + 0.22), "white"))
        roof = [turn(90), step("scale", x=wide, y=9.6, z=2.6), step("translate", x=x + wide / 2, y=19.6, z=high + 0.2)]
        out.append(mesh("studio_roof.ply", f"roof_{k}", roof, ("slate", "tile")[k % 2]))
        chimney = x + wide * rng.uniform(0.2, 0.8)
        out.append(block(f"chimney_{k}", (chimney, 17.6, high), (chimney + 0.8, 18.3, high + 2.7), "tile"))
        x, k = x + wide, k + 1
    at = np.array([2.6, 8.2, 1.1])
    out += stick("tree_stem", (2.6, 8.2, -9), (2.6, 8.2, 0.6), 0.16, "bark")
    for j in range(60):
        way = rng.normal(size=3)
        spot = at + way / np.linalg.norm(way) * rng.uniform(0.5, 1.0) * [1.7, 1.5, 1.6]
        tint = ("foliage", "foliage_light")[j % 2]
        out.append(put("tuft", f"foliage_{j}", tint, spot, scale(rng.uniform(0.45, 0.65)), turn(60 * j)))
    return out


# ---- Profiles of what is turned ----------------------------------------------


def profiles() -> dict[str, tuple[Array, int]]:
    """Radius and height from the bottom, and how many steps around."""
    vase = spline([(0.045, 0), (0.085, 0.07), (0.1, 0.15), (0.06, 0.25), (0.045, 0.3), (0.06, 0.33)], 5)
    inside = spline([(0.055, 0.33), (0.04, 0.3), (0.055, 0.25), (0.094, 0.15), (0.08, 0.07), (0, 0.02)], 4)
    jug = spline([(0.06, 0), (0.09, 0.05), (0.085, 0.14), (0.055, 0.2), (0.065, 0.25)], 5)
    bowl = spline([(0.05, 0.008), (0.11, 0.035), (0.135, 0.08)], 4)
    bowl_in = spline([(0.13, 0.08), (0.105, 0.04), (0, 0.016)], 4)
    stand = spline([(0.09, 0.012), (0.03, 0.03), (0.012, 0.06), (0.02, 0.1), (0.01, 0.14), (0.01, 0.2)], 4)
    bust = [(0.0, 0), (0.06, 0), (0.06, 0.03), (0.03, 0.045)]
    shade = spline([(0.2, 0.0), (0.185, 0.06), (0.11, 0.13), (0.03, 0.15), (0.0, 0.155)], 4)
    return {
        "vase": (np.vstack([[[0, 0]], vase, inside]), 28),
        "jug": (np.vstack([[[0, 0]], jug, [[0.06, 0.25], [0.05, 0.2], [0, 0.18]]]), 24),
        "bowl": (np.vstack([[[0, 0], [0.045, 0]], bowl, bowl_in]), 28),
        "jar": (np.array([(0, 0), (0.046, 0), (0.05, 0.01), (0.05, 0.12), (0.046, 0.13), (0.043, 0.13), (0.043, 0.02), (0, 0.015)]), 20),
        "cup": (np.array([(0, 0), (0.025, 0), (0.038, 0.03), (0.04, 0.065), (0.037, 0.065), (0.034, 0.03), (0, 0.012)]), 20),
        "ball": (arc(1.0, -90, 90, 13), 20),
        "cone": (np.array([(0, 0), (0.1, 0), (0.1, 0.012), (0, 0.27)]), 28),
        "stand": (np.vstack([[[0, 0], [0.09, 0]], stand]), 20),
        "bust_base": (np.array(bust), 16),
        "shade": (np.vstack([shade, [[0.0, 0.15]], (shade - [0.003, 0.004])[::-1][2:]]), 32),
        "lampshade": (np.array([(0.15, 0), (0.09, 0.2), (0.088, 0.2), (0.148, 0)]), 28),
        "planter": (np.array([(0, 0), (0.17, 0), (0.24, 0.36), (0.265, 0.37), (0.27, 0.44), (0.245, 0.44), (0.235, 0.4), (0, 0.41)]), 28),
        "side_table": (np.vstack([[[0, 0], [0.16, 0], [0.16, 0.015]], spline([(0.05, 0.03), (0.02, 0.12), (0.032, 0.3), (0.02, 0.47)], 4), [[0.25, 0.48], [0.25, 0.505], [0, 0.505]]]), 28),
    }


def bust() -> Solid:
    """A head of plaster on a foot, in simple planes, facing -y."""
    rows, columns = 26, 32
    v = np.linspace(0, 1, rows)[:, None]
    a = 2 * np.pi * np.arange(columns) / columns
    profile = spline([(0.055, 0.03), (0.05, 0.06), (0.043, 0.1), (0.062, 0.14), (0.078, 0.19), (0.077, 0.24), (0.05, 0.285), (0.012, 0.3)], 12)
    at = np.stack([np.interp(v[:, 0], np.linspace(0, 1, len(profile)), profile[:, k]) for k in (0, 1)], 1)
    z = at[:, 1:]
    front = np.exp(-((np.angle(np.exp(1j * (a + np.pi / 2))) / 0.32) ** 2))
    nose = 0.34 * front**2 * np.exp(-(((z - 0.175) / 0.022) ** 2))
    brow = 0.1 * front**0.5 * np.exp(-(((z - 0.215) / 0.014) ** 2))
    eyes = -0.16 * np.exp(-(((z - 0.197) / 0.011) ** 2)) * sum(np.exp(-((np.angle(np.exp(1j * (a + np.pi / 2 + s))) / 0.2) ** 2)) for s in (-0.42, 0.42))
    chin = 0.16 * front * np.exp(-(((z - 0.13) / 0.014) ** 2)) + 0.07 * front * np.exp(-(((z - 0.15) / 0.006) ** 2))
    radius = at[:, :1] * (1 + nose + brow + eyes + chin + 0.12 * np.abs(np.sin(a)) * (z > 0.1))
    points = np.stack(np.broadcast_arrays(radius * np.cos(a), radius * np.sin(a), z), -1)
    du = np.roll(points, -1, 1) - np.roll(points, 1, 1)
    dv = np.gradient(points, axis=0)
    normals = np.cross(du, dv)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    i = np.arange(rows - 1)[:, None] * columns + np.arange(columns)
    j = np.arange(rows - 1)[:, None] * columns + (np.arange(columns) + 1) % columns
    i, j = i.ravel(), j.ravel()
    faces = np.vstack([np.stack([i, j, j + columns], 1), np.stack([i, j + columns, i + columns], 1)])
    head = Solid(points.reshape(-1, 3), faces, normals.reshape(-1, 3))
    return merge([head, moved(box((0.13, 0.13, 0.035), 0.006), (0, 0, 0.0175))])


def other_solids() -> dict[str, Solid]:
    """What is neither turned nor grown."""
    upholstery, feet = chair()
    seat = moved(box((0.36, 0.36, 0.035), 0.01), (0, 0, 0.65))
    legs = [tube(np.array([(0.2 * x, 0.2 * y, 0), (0.17 * x, 0.17 * y, 0.3), (0.13 * x, 0.13 * y, 0.64)]), 0.016, 7) for x in (-1, 1) for y in (-1, 1)]
    rungs = [tube(np.array([(-0.17, y, 0.25), (0, y, 0.25), (0.17, y, 0.25)]), 0.01, 6) for y in (-0.17, 0.17)]
    lamp = [tube(np.array([(0, 0, 0.02), (0, 0, 0.9), (0, 0, 1.6)]), 0.011, 10)]
    lamp.append(tube(np.array([(0, 0, 0), (0, 0, 0.02), (0, 0, 0.024), (0, 0, 0.025)]), np.array([0.15, 0.15, 0.13, 0.0]), 28))
    bow = np.array([(-0.05, 0.0, 0.0), (-0.048, 0.018, -0.004), (0, 0.026, -0.01), (0.048, 0.018, -0.004), (0.05, 0.0, 0.0)])
    plan = np.vstack([arc(0.16, 20, 340, 26) * [1.15, 0.85], [[0.08, 0.0]]])
    outline = slab(plan, 0.008)
    flat = Solid(np.stack([outline.vertices[:, 0], outline.vertices[:, 2], -outline.vertices[:, 1]], 1), outline.faces, np.stack([outline.normals[:, 0], outline.normals[:, 2], -outline.normals[:, 1]], 1))
    body = tube(np.array([(-0.06, 0, 0), (-0.055, 0, 0), (0.04, 0, 0), (0.052, 0, 0), (0.055, 0, 0), (0.07, 0, 0), (0.071, 0, 0)]), np.array([0.004, 0.012, 0.012, 0.006, 0.006, 0.006, 0.0]), 10)
    return {
        "beam": box((2 * X, 0.16, 0.18), 0.012),
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


# ---- Textures ----------------------------------------------------------------


def parquet(size: int = 512) -> Array:
    """Herringbone of oak; repeats every 1.2 metres."""
    rng = np.random.default_rng(1)
    count = 8  # staves across; each is 4 times as long as wide
    y, x = (np.mgrid[:size, :size] + 0.5) / size * count
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    phase = (i - j) % count
    flat = phase < 4  # a stave along x, else one along y
    start = np.where(flat, i - phase, j - ((j - i - 1) % count))
    along = np.where(flat, x, y) - start
    across = np.where(flat, y, x) % 1
    number = np.where(flat, 31 * j + 7 * (start % count), 17 * i + 5 * (start % count) + 311) % 199
    tone = rng.uniform(-1, 1, 199)[number]
    shift = rng.uniform(0, 60, 199)[number]
    lines = noise(size, (64, 3), rng)
    grain = np.sin(14 * across + 1.3 * np.sin(0.8 * along + shift) + 3 * shift) * 0.5
    streak = lines[(across * 63 + shift).astype(int) % size, (along * 60 + 9 * shift).astype(int) % size]
    picture = blend((0.50, 0.34, 0.20), (0.72, 0.54, 0.35), 0.5 + 0.27 * tone + 0.09 * grain + 0.11 * streak)
    edge = np.minimum(np.minimum(across, 1 - across), np.minimum(along % 4, 4 - along % 4))
    return blend((0.22, 0.14, 0.08), picture, (edge - 0.012) / 0.022)


def rug(width: int = 480, height: int = 320) -> Array:
    """A kilim with borders and diamonds, knot by knot."""
    rng = np.random.default_rng(2)
    y, x = np.mgrid[:height, :width] // 2 * 2 + 1
    u, v = np.abs(x - width / 2) / height, np.abs(y - height / 2) / height
    ground, cream, navy = (0.56, 0.15, 0.12), (0.86, 0.78, 0.62), (0.12, 0.17, 0.30)
    ochre, teal = (0.80, 0.55, 0.20), (0.16, 0.38, 0.38)
    picture = np.broadcast_to(ground, (height, width, 3)).copy()
    for centre in (-0.42, 0.0, 0.42):
        d = np.abs((x - width / 2) / height - centre) * 1.35 + np.abs(y - height / 2) / height
        for limit, colour in ((0.29, navy), (0.265, cream), (0.235, teal), (0.15, ochre), (0.11, ground), (0.05, cream)):
            picture[d < limit] = colour
        hooks = (np.abs(d - 0.2) < 0.012) & ((x // 6 + y // 6) % 2 == 0)
        picture[hooks] = cream
    edge = np.minimum(width / 2 / height - u, 0.5 - v)
    for limit, colour in ((0.115, navy), (0.1, ochre), (0.088, navy), (0.02, cream), (0.01, ground)):
        picture[edge < limit] = colour
    band = (edge > 0.03) & (edge < 0.08)
    zigzag = np.abs(((x + y) // 2 % 16) - 8) < 3
    picture[band & zigzag] = cream
    picture[band & ((x - y) // 2 % 32 < 5)] = ground
    small = ((x // 2 % 14) - 7) ** 2 + ((y // 2 % 14) - 7) ** 2 < 5
    picture[small & (edge > 0.125) & (np.abs(picture - ground).sum(-1) < 0.01)] = ochre
    knots = rng.normal(0, 0.035, (height, width))
    fade = 0.05 * rough(512, 3, 4, rng)[:height, :width]
    return picture * (1 + (knots + fade)[..., None])


def weave(size: int = 128) -> Array:
    """Stripes of a woven cushion."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:size, :size]
    stripe = (y // 8 + (x // 16 % 2)) % 4
    colours = np.array([(0.85, 0.76, 0.55), (0.16, 0.30, 0.36), (0.72, 0.36, 0.18), (0.85, 0.76, 0.55)])
    return colours[stripe] * (1 + 0.06 * rng.normal(size=(size, size, 1)) + 0.05 * ((x + y) % 2)[..., None])


def painting(width: int = 320, height: int = 400) -> Array:
    """The unfinished picture: hills and a house in broad strokes, its margin still bare."""
    rng = np.random.default_rng(4)
    size = 400
    y, x = np.mgrid[:height, :width]
    bend = [3 * noise(size, (9, 9), rng)[:height, :width] + 2 * noise(size, (40, 14), rng)[:height, :width] for _ in range(2)]
    u, v = (x + bend[0]) / width, (y + bend[1]) / height
    picture = blend((0.90, 0.78, 0.58), (0.38, 0.60, 0.80), 1.2 - 2.6 * v)
    picture[np.hypot(u - 0.68, v - 0.22) < 0.07] = (0.97, 0.86, 0.52)
    layers = [(0.40, 0.08, (0.46, 0.52, 0.66)), (0.52, 0.06, (0.40, 0.50, 0.42)), (0.62, 0.05, (0.58, 0.56, 0.28)), (0.76, 0.04, (0.30, 0.42, 0.24)), (0.88, 0.03, (0.62, 0.36, 0.2))]
    for k, (level, swing, colour) in enumerate(layers):
        line = level + swing * np.sin(5 * u + 2.1 * k) + 0.4 * swing * np.sin(13 * u + k)
        picture[v > line] = colour
    wall = (np.abs(u - 0.34) < 0.085) & (np.abs(v - 0.61) < 0.05)
    roof = (np.abs(u - 0.34) < 0.11 - (0.58 - v) * 1.2) & (v < 0.575) & (v > 0.5)
    picture[wall], picture[roof] = (0.92, 0.88, 0.78), (0.72, 0.28, 0.18)
    for k in range(5):
        at = 0.55 + 0.08 * k
        picture[np.hypot((u - at) * 3.2, v - 0.62 - 0.02 * (k % 2)) < 0.075] = (0.16, 0.28, 0.18)
    strokes = 0.05 * noise(size, (60, 9), rng)[:height, :width] + 0.05 * noise(size, (14, 50), rng)[:height, :width]
    picture = picture * (1 + strokes[..., None])
    margin = np.minimum(np.minimum(u, 1 - u), np.minimum(v, 1 - v)) * 12 + 0.5 * noise(size, (16, 16), rng)[:height, :width]
    weft = 0.86 + 0.03 * ((x // 2 + y // 2) % 2)
    bare = np.stack([weft, 0.95 * weft, 0.84 * weft], -1)
    done = np.where(v + 0.06 * noise(size, (8, 8), rng)[:height, :width] > 0.9, -1.0, margin)
    return blend(bare, picture, (done - 0.1) * 6)


def art(number: int, size: int = 192) -> Array:
    """One of the framed pictures on the western wall."""
    rng = np.random.default_rng(20 + number)
    y, x = (np.mgrid[:size, :size] + 0.5) / size
    bend = 0.012 * noise(size, (9, 9), rng)
    if number == 0:  # a bowl of fruit
        picture = blend((0.20, 0.22, 0.20), (0.44, 0.36, 0.26), y + 3 * bend)
        picture[y + bend > 0.66] = (0.50, 0.30, 0.18)
        for cx, cy, r, colour in [(0.36, 0.55, 0.12, (0.78, 0.22, 0.12)), (0.54, 0.5, 0.13, (0.86, 0.60, 0.16)), (0.68, 0.57, 0.1, (0.52, 0.60, 0.20)), (0.47, 0.38, 0.11, (0.84, 0.42, 0.14))]:
            d = np.hypot(x - cx + bend, y - cy)
            lit = np.clip(1 - np.hypot(x - cx + 0.4 * r, y - cy + 0.45 * r) / (1.6 * r), 0, 1)
            picture = np.where((d < r)[..., None], np.array(colour) * (0.45 + 0.8 * lit[..., None]), picture)
        bowl = (y > 0.6) & (np.hypot((x - 0.5) / 1.5, y - 0.58) < 0.21)
        picture = np.where(bowl[..., None], np.array((0.36, 0.48, 0.60)) * (1.2 - x[..., None]), picture)
    elif number == 1:  # a wave in ink
        picture = np.broadcast_to((0.90, 0.86, 0.76), (size, size, 3)).copy()
        for k in range(9):
            line = 0.3 + 0.075 * k + 0.07 * np.sin(7 * x + 0.7 * k + 4 * bend) * (1 - 0.07 * k)
            picture[np.abs(y - line) < 0.009 + 0.004 * np.sin(9 * x + k)] = (0.10, 0.16, 0.28)
        picture[np.hypot(x - 0.7, y - 0.17) < 0.075] = (0.72, 0.18, 0.12)
    elif number == 2:  # blocks of colour
        colours = np.array([(0.84, 0.70, 0.30), (0.20, 0.34, 0.50), (0.74, 0.30, 0.20), (0.90, 0.86, 0.78), (0.26, 0.44, 0.38)])
        column, row = (x * 5 + 2 * bend).astype(int), (y * 4 + 2 * bend).astype(int)
        picture = colours[rng.integers(0, 5, (6, 6))[row.clip(0, 5), column.clip(0, 5)]]
        picture = picture * (1 + 0.05 * rough(size, 8, 4, rng)[..., None])
    else:  # the harbour at dusk
        picture = blend((0.92, 0.58, 0.34), (0.26, 0.30, 0.48), 1.3 - 2.4 * y + 5 * bend)
        water = y > 0.58
        glitter = noise(size, (46, 7), rng) > 0.75
        sea = blend((0.30, 0.32, 0.44), (0.16, 0.20, 0.32), 2.4 * (y - 0.58))
        picture = np.where(water[..., None], np.where(glitter[..., None], (0.90, 0.62, 0.42), sea), picture)
        for k in range(4):
            at = 0.16 + 0.22 * k
            picture[(np.abs(x - at) < 0.005) & (y > 0.24 + 0.05 * (k % 2)) & (y < 0.6)] = (0.12, 0.10, 0.12)
            sail = (x > at) & (x - at < 0.13 * (y - 0.24) / 0.3) & (y < 0.54) & (y > 0.26)
            picture[sail] = ((0.86, 0.80, 0.68), (0.62, 0.26, 0.18))[k % 2]
            picture[(np.abs(x - at - 0.02) < 0.08 - (y - 0.57) * 0.8) & (y > 0.565) & (y < 0.605)] = (0.18, 0.12, 0.10)
    return picture * (1 + 0.04 * noise(size, (48, 20), rng)[..., None])


def sketch(number: int, size: int = 128) -> Array:
    """Charcoal on paper: a head, a figure of boxes, hatched hills."""
    rng = np.random.default_rng(30 + number)
    y, x = (np.mgrid[:size, :size] + 0.5) / size
    wob = 0.006 * noise(size, (7, 7), rng)
    ink = np.zeros((size, size))

    def line(distance: Array, wide: float = 0.008) -> None:
        np.maximum(ink, np.clip(1.4 - np.abs(distance + wob) / wide, 0, 1), out=ink)

    if number == 0:
        line(np.hypot((x - 0.5) / 0.8, y - 0.42) - 0.27)
        line(np.where(np.abs(x - 0.5) < 0.16, y - 0.4, 1.0))
        line(np.where((y > 0.4) & (y < 0.55), x - 0.5 - 0.2 * (y - 0.4), 1.0))
        line(np.where(np.abs(x - 0.5) < 0.09, y - 0.6 - 0.6 * (x - 0.5) ** 2, 1.0))
        line(np.where(y > 0.66, np.abs(x - 0.5) - 0.1 - 1.4 * np.maximum(y - 0.78, 0), 1.0))
    elif number == 1:
        for cx, cy, r in ((0.35, 0.62, 0.16), (0.62, 0.56, 0.2)):
            line(np.maximum(np.abs(x - cx), np.abs(y - cy)) - r)
            line(np.maximum(np.abs(x - cx - 0.07), np.abs(y - cy + 0.09)) - r)
        line(np.hypot(x - 0.48, y - 0.25) - 0.12)
    else:
        for k in range(4):
            line(y - 0.3 - 0.15 * k - 0.06 * np.sin(8 * x + 2 * k))
        line(np.where(y > 0.45, ((x + 0.7 * y) * 22 % 1 - 0.5) / 22, 1.0), 0.006)
    shade = np.clip(0.25 * rough(size, 4, 4, rng) + 0.4 * np.clip(0.5 - np.hypot(x - 0.55, y - 0.5), 0, 1), 0, 0.35)
    paper = blend((0.90, 0.86, 0.76), (0.84, 0.78, 0.66), 0.5 + 0.3 * rough(size, 3, 4, rng))
    return blend(paper, (0.16, 0.15, 0.15), np.maximum(0.9 * ink, shade))


def world_map(width: int = 320, height: int = 160) -> Array:
    """An invented earth for a small globe, with a grid."""
    rng = np.random.default_rng(40)
    y, x = np.mgrid[:height, :width]
    field = rough(width, 3, 6, rng)[:height]
    picture = np.where((field > 0.25)[..., None], blend((0.76, 0.66, 0.42), (0.48, 0.54, 0.32), field - 0.4), (0.42, 0.58, 0.62))
    grid = (x % 20 == 0) | (y % 20 == 0)
    return np.where(grid[..., None], picture * 0.78, picture)


def facade(number: int, size: int = 224) -> Array:
    """Two storeys by two windows of a house front, which repeat."""
    rng = np.random.default_rng(50 + number)
    base = ((0.86, 0.74, 0.58), (0.72, 0.50, 0.42), (0.70, 0.72, 0.66))[number]
    picture = np.asarray(base) * (1 + 0.05 * rough(size, 4, 5, rng)[..., None])
    y, x = (np.mgrid[:size, :size] + 0.5) / size * 2
    u, v = x % 1, y % 1
    picture[(v > 0.94) | (v < 0.015)] = np.asarray(base) * 1.1
    picture[(np.abs(u - 0.5) < 0.24) & (np.abs(v - 0.47) < 0.34)] = (0.90, 0.88, 0.82)
    pane = (np.abs(u - 0.5) < 0.19) & (np.abs(v - 0.47) < 0.29)
    glass = blend((0.14, 0.18, 0.22), (0.52, 0.62, 0.70), 1 - v + 0.25 * noise(size, (4, 4), rng))
    picture = np.where(pane[..., None], glass, picture)
    bars = pane & ((np.abs(u - 0.5) < 0.014) | (np.abs(v - 0.37) < 0.012) | (np.abs(v - 0.57) < 0.012))
    picture[bars] = (0.90, 0.88, 0.82)
    shutters = (np.abs(np.abs(u - 0.5) - 0.31) < 0.07) & (np.abs(v - 0.47) < 0.33)
    colour = np.array(((0.22, 0.36, 0.32), (0.30, 0.34, 0.42), (0.44, 0.26, 0.2))[number])
    picture[shutters] = (colour * (1 + 0.25 * np.sin(2 * np.pi * v * 26))[..., None])[shutters]
    return picture


def outdoors(width: int = 768) -> Array:
    """The sky all around: bright with clouds in the north, before the window, plain elsewhere."""
    height = width // 2
    rng = np.random.default_rng(60)
    v, u = np.mgrid[:height, :width] + 0.5
    elevation, azimuth = np.pi * (0.5 - v / height), 2 * np.pi * u / width
    north, rise = np.cos(azimuth) * np.cos(elevation), np.sin(elevation)
    picture = blend((0.84, 0.90, 0.95), (0.40, 0.60, 0.86), (1.1 * np.clip(rise, 0, 1)) ** 0.7)
    field = rough(width, 7, 6, rng)[:height]
    cloud = np.clip((field - 0.1) * 1.4, 0, 1) * np.clip(rise * 8, 0, 1)
    picture = blend(picture, blend((0.99, 0.98, 0.96), (0.80, 0.83, 0.88), field - 0.8), cloud)
    picture = blend(picture, (0.48, 0.50, 0.54), 1 - np.clip(2.5 * (north + 0.25), 0, 1))
    return blend(picture, (0.30, 0.29, 0.28), -rise * 8)


# ---- Files -------------------------------------------------------------------


def write_meshes(folder: Path) -> None:
    """All meshes of the scene."""
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


def main() -> None:
    """Writes every file of the scene."""
    folder = output_folder()
    write_meshes(folder)
    pictures = {"parquet": parquet(), "rug": rug(), "weave": weave(), "painting": painting()}
    pictures |= {f"art_{k}": art(k) for k in range(4)}
    pictures |= {f"sketch_{k}": sketch(k) for k in range(3)}
    pictures |= {f"facade_{k}": facade(k) for k in range(3)}
    pictures |= {"map": world_map(), "outdoors": outdoors()}
    for name, picture in pictures.items():
        save(folder / f"studio_{name}.jpg", picture)
    rng = np.random.default_rng(15)
    lines = [*shell(), *door(), *shelves(rng), *easel(), *work_table(rng), *plan_chest()]
    lines += [*armchair(), *western_wall(), *sketches(rng), *plants(rng), *street(rng)]
    text = fragment(lines, "Made by studio.py: what stands in unbounded/studio.xml.")
    (folder / "studio_room.xml").write_text(text)


if __name__ == "__main__":
    main()
