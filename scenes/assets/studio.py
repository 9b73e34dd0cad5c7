"""The room of unbounded/studio: a painter's studio under the roof, and the street outside.

Lengths are metres. The room is 6.4 by 5.2 and 3.2 high, with a window in the north (y up), a
skylight, shelves in the east, an easel, a table, a plan chest and an armchair around a rug.
``studio_solids.py`` and ``studio_paint.py`` make its meshes and its textures.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from geometry import Array, output_folder
from solids import fragment, mesh, shape, step
from surfaces import (
    block,
    put_mesh,
    scale,
    turn,
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
        block(
            "sill",
            (left - 0.1, Y - 0.16, sill - 0.04),
            (right + 0.1, Y + t + 0.05, sill),
            "white_paint",
        ),
    ]
    for k in range(5):
        x = left + (right - left) * k / 4
        out.append(
            block(
                f"upright_{k}", (x - 0.025, Y + 0.08, sill), (x + 0.025, Y + 0.14, lintel), "iron"
            )
        )
    for k, z in enumerate((sill, 1.4, 2.1, lintel)):
        out.append(
            block(f"bar_{k}", (left, Y + 0.09, z - 0.018), (right, Y + 0.13, z + 0.018), "iron")
        )
    for k in range(4):
        x = west + (east - west) * k / 3
        out.append(
            block(
                f"sky_bar_{k}", (x - 0.02, south, TOP + 0.18), (x + 0.02, north, TOP + 0.24), "iron"
            )
        )
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
    for k, (low, high) in enumerate(
        [
            ((-0.36, 0.2), (-0.05, 0.95)),
            ((0.05, 0.2), (0.36, 0.95)),
            ((-0.36, 1.1), (-0.05, 1.9)),
            ((0.05, 1.1), (0.36, 1.9)),
        ]
    ):
        corners = (x + low[0], y + 0.03, low[1]), (x + high[0], y + 0.042, high[1])
        out.append(block(f"door_panel_{k}", *corners, "door_paint"))
    for k, (a, b, c, d) in enumerate(
        [(-0.56, -0.45, 0, 2.16), (0.45, 0.56, 0, 2.16), (-0.56, 0.56, 2.05, 2.16)]
    ):
        out.append(block(f"door_frame_{k}", (x + a, y, c), (x + b, y + 0.06, d), "white_paint"))
    out.append(
        shape(
            "sphere",
            "knob",
            [scale(0.03), step("translate", x=x - 0.38, y=y + 0.08, z=1.03)],
            "brass",
        )
    )
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
    things = {
        (1, 0): "vase",
        (3, 2): "bust",
        (2, 1): "bowl",
        (3, 3): "cone",
        (0, 4): "jar",
        (2, 3): "jar",
        (1, 4): "globe",
        (0, 2): "vase_tall",
        (3, 5): "jar",
    }
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
        out.append(
            block(
                f"{name}_{len(out)}",
                (edge, y + 0.001, foot),
                (X - 0.04, y + thick, foot + tall),
                cover,
            )
        )
        if rng.uniform() < 0.5:
            z = foot + tall * rng.choice([0.2, 0.75])
            low, top = (
                (edge - 0.001, y + 0.003, z),
                (edge + 0.01, y + thick - 0.002, z + rng.uniform(0.012, 0.05)),
            )
            out.append(block(f"{name}_{len(out)}", low, top, ("gold", "paper")[len(out) % 2]))
        y += thick


def on_shelf(kind: str, name: str, at: Sequence[float]) -> list[str]:
    """Something that stands between the books."""
    x, y, z = at
    if kind == "globe":
        ball = [scale(0.115), step("translate", x=x, y=y, z=z + 0.17)]
        return [
            put("stand", f"{name}_foot", "brass", at, scale(0.8)),
            shape("sphere", name, ball, "map"),
        ]
    if kind == "cone":
        return [put("cone", name, "gypsum", at, scale(0.8))]
    if kind == "bust":
        return [put("bust", name, "gypsum", at, scale(0.9), turn(95))]
    file = "vase" if kind.startswith("vase") else kind
    size = {"vase": 0.85, "vase_tall": 1.0, "bowl": 0.9, "jar": 1.0}[kind]
    tint = {"vase": "glaze", "vase_tall": "glaze_red", "bowl": "celadon", "jar": "glaze_white"}[
        kind
    ]
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
    back = [
        step("scale", x=0.42, y=0.018, z=0.52),
        step("translate", y=-0.034, z=1.42),
        lean,
        *steps,
    ]
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
        out += stick(
            f"bristle_{k}", tip, tip + 0.14 * (tip - foot), 0.0065, ("linen", "iron")[k % 2]
        )
    for k, (dx, dy, dz) in enumerate(
        [
            (-0.05, -0.03, 0.055),
            (0.05, -0.02, 0.055),
            (0, 0.05, 0.055),
            (0, 0, 0.115),
            (-0.3, -0.2, 0.038),
        ]
    ):
        at = [step("translate", x=0.85 + dx, y=2.2 + dy, z=z + dz)]
        tint = ("apple", "apple_green", "orange", "apple", "apple_green")[k]
        out.append(shape("sphere", f"fruit_{k}", [scale(0.04), *at], tint))
    for k in range(7):
        x, y = 0.2 + 0.055 * k, 1.9 + 0.02 * (k % 3)
        turned = turn(70 + 13 * ((5 * k) % 7))
        out.append(put("tube", f"tube_{k}", "tin", (x, y, z + 0.012), turned))
        colour = ("rust", "navy", "mustard", "sage", "plum", "teal", "glaze_red")[k]
        band = [
            step("scale", x=0.012, y=0.022, z=0.0125),
            turned,
            step("translate", x=x, y=y, z=z + 0.0125),
        ]
        out.append(shape("cube", f"label_{k}", band, colour))
    for k in range(3):
        low = (0.35 + 0.01 * k, 2.16 + 0.008 * k, z + 0.028 * k)
        out.append(
            block(
                f"stack_{k}",
                low,
                (0.62 - 0.012 * k, 2.36, z + 0.028 * (k + 1) - 0.002),
                COVERS[2 * k + 1],
            )
        )
    out.append(
        shape(
            "sphere",
            "bulb",
            [scale(0.045), step("translate", x=0.7, y=1.55, z=1.99)],
            "glaze_white",
        )
    )
    out += [
        put("shade", "pendant", "brass", (0.7, 1.55, 1.95)),
        *stick("flex", (0.7, 1.55, 2.1), (0.7, 1.55, TOP), 0.005, "iron"),
    ]
    return out


def stick(
    name: str,
    foot: Sequence[float] | Array,
    tip: Sequence[float] | Array,
    radius: float,
    material: str,
) -> list[str]:
    """A cylinder between two points."""
    ends = [", ".join(f"{v:.4g}" for v in p) for p in (foot, tip)]
    points = f'<point name="p0" value="{ends[0]}"/><point name="p1" value="{ends[1]}"/>'
    radii = f'<float name="radius" value="{radius}"/>'
    return [shape("cylinder", name, [], material, points + radii)]


def plan_chest() -> list[str]:
    """The chest of flat drawers in the south, a lit lamp and plaster solids on it."""
    low, high = (-1.0, -2.58, 0.06), (0.6, -1.95, 0.88)
    out = [block("chest", low, high, "chest_paint")]
    out.append(block("chest_top", (-1.03, -2.59, 0.88), (0.63, -1.92, 0.915), "oak"))
    for k in range(6):
        z = 0.1 + 0.13 * k
        out.append(
            block(f"drawer_{k}", (-0.97, -1.95, z), (0.57, -1.932, z + 0.115), "chest_paint")
        )
        for side, x in enumerate((-0.65, 0.25)):
            out.append(
                block(
                    f"label_{k}_{side}",
                    (x - 0.05, -1.934, z + 0.04),
                    (x + 0.05, -1.929, z + 0.08),
                    "paper",
                )
            )
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
        out.append(
            put(
                "bloom",
                f"bloom_{k}",
                ("petal", "petal_white")[k % 2],
                tip,
                scale(0.055),
                turn(80 * k),
            )
        )
    return out


def armchair() -> list[str]:
    """A leather chair in the south-west, a cushion, a floor lamp, a small table with a cup."""
    at, angle = (-2.25, -1.55, 0), turn(122)
    out = [
        put("chair", "armchair", "leather", at, angle),
        put("chair_legs", "chair_legs", "oak", at, angle),
    ]
    cushion = [step("scale", x=0.24, y=0.085, z=0.22), step("rotate", x=1, angle=-22)]
    cushion += [step("translate", y=0.16, z=0.66), angle, step("translate", x=at[0], y=at[1])]
    out.append(mesh("studio_ball.ply", "cushion", cushion, "weave"))
    out.append(put("floor_lamp", "floor_lamp", "brass", (-2.85, -2.2, 0)))
    x, y = -1.55, -2.1
    out.append(put("side_table", "side_table", "varnish", (x, y, 0)))
    out.append(put("cup", "coffee", "glaze_white", (x - 0.06, y + 0.05, 0.505)))
    out.append(block("magazine", (x - 0.02, y - 0.15, 0.505), (x + 0.16, y + 0.06, 0.513), "rust"))
    return out


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
        out.append(
            shape(
                "rectangle",
                f"framed_{k}",
                [*face, step("translate", x=-X + 0.031, y=y, z=z)],
                art,
            )
        )
    lean = step("rotate", y=1, angle=5)
    y = -0.42
    border = [step("scale", x=0.018, y=0.46, z=0.96), step("translate", z=0.96), lean]
    out.append(
        shape(
            "cube", "mirror_frame", [*border, step("translate", x=-X + 0.03, y=y, z=0.01)], "gold"
        )
    )
    glass = [
        step("scale", x=0.4, y=0.9),
        step("rotate", x=1, angle=90),
        turn(90),
        step("translate", x=0.0185, z=0.96),
        lean,
    ]
    out.append(
        shape(
            "rectangle",
            "mirror_glass",
            [*glass, step("translate", x=-X + 0.03, y=y, z=0.01)],
            "mirror",
        )
    )
    out.append(block("low_shelf", (-X, 0.35, 0.0), (-X + 0.38, 2.0, 0.46), "oak"))
    out.append(block("low_shelf_gap", (-X + 0.3, 0.39, 0.05), (-X + 0.382, 1.96, 0.41), "iron"))
    y = 0.4
    rng = np.random.default_rng(6)
    while y < 1.9:
        thick = rng.uniform(0.006, 0.022)
        low = (-X + 0.36 + rng.uniform(0, 0.02), y, 0.05)
        out.append(
            block(
                f"record_{len(out)}",
                low,
                (low[0] + 0.02, y + thick - 0.001, 0.36),
                COVERS[rng.integers(8)],
            )
        )
        y += thick
    for k, (y, file, tint, size) in enumerate(
        [
            (0.55, "jug", "glaze_red", 0.9),
            (0.95, "bowl", "copper", 0.85),
            (1.75, "vase", "glaze_white", 1.15),
        ]
    ):
        out.append(put(file, f"west_{k}", tint, (-X + 0.19, y, 0.46), scale(size)))
    return out


def sketches(rng: np.random.Generator) -> list[str]:
    """Drawings pinned to the southern wall, and canvases that lean against it."""
    out = []
    for k in range(9):
        x, z = (
            -0.95 + 0.36 * (k % 5) + rng.uniform(-0.03, 0.03),
            1.62 + 0.46 * (k // 5) + rng.uniform(-0.05, 0.05),
        )
        x += 0.17 * (k // 5)
        face = [
            step("scale", x=rng.uniform(0.11, 0.16), y=rng.uniform(0.14, 0.2)),
            step("rotate", z=1, angle=rng.uniform(-5, 5)),
        ]
        face += [
            step("rotate", x=1, angle=90),
            turn(180),
            step("translate", x=x, y=-Y + 0.004 + 0.001 * k, z=z),
        ]
        out.append(shape("rectangle", f"drawing_{k}", face, f"sketch_{k % 3}"))
        pin = [scale(0.008), step("translate", x=x, y=-Y + 0.012, z=z + 0.12)]
        out.append(shape("sphere", f"pin_{k}", pin, ("apple", "navy", "mustard")[k % 3]))
    for k, (x, wide, high) in enumerate(
        [(2.78, 0.3, 0.45), (2.82, 0.26, 0.33), (2.74, 0.24, 0.25)]
    ):
        size = step("scale", x=wide, y=0.016, z=high)
        moves = [
            size,
            step("translate", z=high),
            step("rotate", x=1, angle=9 + 3 * k),
            step("translate", x=x, y=-Y + 0.17 + 0.09 * k),
        ]
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
        out += stick(
            f"cord_{k}",
            (-2.72 + 0.1 * np.cos(a), 2.15 + 0.1 * np.sin(a), 2.18),
            (-2.72, 2.15, TOP),
            0.003,
            "linen",
        )
    for k in range(34):
        a, down = 2.4 * k, rng.uniform(0, 1)
        out_by = 0.06 + 0.12 * np.sqrt(down)
        spot = (-2.72 + out_by * np.cos(a), 2.15 + out_by * np.sin(a), 2.22 - 0.75 * down**1.6)
        out.append(
            put(
                "tuft",
                f"trail_{k}",
                ("leaf_light", "leaf")[k % 2],
                spot,
                scale(0.075),
                turn(50 * k),
            )
        )
    for k in range(3):
        low = (-1.7 + 1.05 * k, Y + 0.3, 0.62)
        out.append(block(f"box_{k}", low, (low[0] + 0.8, low[1] + 0.2, 0.8), "clay"))
        for j in range(7):
            spot = (
                low[0] + 0.08 + 0.105 * j,
                low[1] + rng.uniform(0.05, 0.15),
                0.86 + rng.uniform(0, 0.06),
            )
            tint = ("leaf", "petal", "leaf_light")[j % 3]
            out.append(put("tuft", f"flowers_{k}_{j}", tint, spot, scale(0.095), turn(40 * j)))
    return out


def street(rng: np.random.Generator) -> list[str]:
    """Houses on the other side of the street, roofs behind them, and a tree."""
    out: list[str] = []
    x, k = -34.0, 0
    while x < 34:
        wide, high = rng.uniform(5.5, 9), rng.uniform(1.2, 4.6)
        size = [step("scale", x=wide / 2, y=(high + 9) / 2), step("rotate", x=1, angle=90)]
        kind = f"facade_{k % 3}"
        face = [*size, step("translate", x=x + wide / 2, y=15.0, z=(high - 9) / 2)]
        out.append(shape("rectangle", f"house_{k}", face, kind))
        out.append(block(f"house_body_{k}", (x, 15.01, -9), (x + wide, 24, high), "wall"))
        out.append(block(f"eaves_{k}", (x, 14.7, high), (x + wide, 15.3, high + 0.22), "white"))
        roof = [
            turn(90),
            step("scale", x=wide, y=9.6, z=2.6),
            step("translate", x=x + wide / 2, y=19.6, z=high + 0.2),
        ]
        out.append(mesh("studio_roof.ply", f"roof_{k}", roof, ("slate", "tile")[k % 2]))
        chimney = x + wide * rng.uniform(0.2, 0.8)
        out.append(
            block(f"chimney_{k}", (chimney, 17.6, high), (chimney + 0.8, 18.3, high + 2.7), "tile")
        )
        x, k = x + wide, k + 1
    at = np.array([2.6, 8.2, 1.1])
    out += stick("tree_stem", (2.6, 8.2, -9), (2.6, 8.2, 0.6), 0.16, "bark")
    for j in range(60):
        way = rng.normal(size=3)
        spot = at + way / np.linalg.norm(way) * rng.uniform(0.5, 1.0) * [1.7, 1.5, 1.6]
        tint = ("foliage", "foliage_light")[j % 2]
        out.append(
            put("tuft", f"foliage_{j}", tint, spot, scale(rng.uniform(0.45, 0.65)), turn(60 * j))
        )
    return out


def main() -> None:
    """Writes what stands where."""
    rng = np.random.default_rng(15)
    lines = [*shell(), *door(), *shelves(rng), *easel(), *work_table(rng), *plan_chest()]
    lines += [*armchair(), *western_wall(), *sketches(rng), *plants(rng), *street(rng)]
    text = fragment(lines, "Made by studio.py: what stands in unbounded/studio.xml.")
    (output_folder() / "studio_room.xml").write_text(text)


if __name__ == "__main__":
    main()
