"""The place of unbounded/courtyard: an armillary sphere over a basin, and a court around it.

Lengths are metres. The court is 15 wide, with arcades in the north and the west, a wall in
the east and a balustrade in the south. ``courtyard_land.py`` and ``courtyard_paint.py`` make the
land around and the textures.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from geometry import Array, grid_faces, output_folder, write_ply
from solids import Solid, arc, box, fragment, merge, mesh, moved, shape, spline, step, wedge
from surfaces import (
    block,
    leaves,
    prism,
    put_mesh,
    scale,
    slab,
    tube,
    turn,
    write_solid,
    write_turned,
)

HALF = 7.5  # Of the court's width
BAY = 3.0  # Width of a bay of the arcades
SPRING = 2.35  # Height where the arches begin
STOREY = 4.4
DEPTH = 2.8  # Of the arcades
WALL = 0.42  # Thickness of their walls
CENTRE = 2.02  # Height of the armillary sphere
TILT = 43.5  # Of its axis: the latitude


put = partial(put_mesh, "courtyard")


# ---- The object: an armillary sphere on a pedestal in a basin ----------------


def ring(radius: float, width: float, thick: float) -> Array:
    """Profile of a hoop: outer radius, its width along the axis, thickness across."""
    inner, half = radius - thick, width / 2
    corners = [(inner, -half), (radius, -half), (radius, half), (inner, half), (inner, -half)]
    return np.array(corners)


def baluster() -> Array:
    """Profile of the pedestal, from the bottom of the basin to the foot of the bronze."""
    points = [(0.30, 0.62), (0.27, 0.68), (0.15, 0.75), (0.135, 0.81), (0.21, 0.90), (0.25, 1.01)]
    points += [(0.21, 1.13), (0.13, 1.24), (0.12, 1.28)]
    foot = [(0.36, 0.0), (0.36, 0.50), (0.33, 0.54), (0.33, 0.60), (0.30, 0.62)]
    head = [(0.18, 1.295), (0.2, 1.33), (0.18, 1.36), (0.07, 1.375), (0.0, 1.375)]
    return np.vstack([foot, spline(points, 4), head])


def fluted(path: Path) -> None:
    """Writes a quarter of the pedestal, its belly fluted, with the normals of that shape."""
    profile = baluster()
    t = np.linspace(0, np.pi / 2, 25)
    flutes = np.exp(-(((profile[:, 1] - 1.01) / 0.13) ** 4))[:, None]

    def place(angle: Array) -> Array:
        radius = profile[:, :1] * (1 + 0.045 * flutes * np.abs(np.cos(6 * angle)))
        z = np.broadcast_to(profile[:, 1:], radius.shape)
        return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], -1)

    points = place(t)
    along = np.gradient(points, axis=0)
    normals = np.cross(place(t + 1e-3) - place(t - 1e-3), along)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    normals = np.where(length > 1e-9, normals / np.maximum(length, 1e-9), [0.0, 0.0, 1.0])
    faces = grid_faces(*points.shape[:2])
    uv = np.stack(np.broadcast_arrays(0.3 * t, profile[:, 1:]), -1)
    flat = [a.reshape(-1, a.shape[-1]) for a in (points, normals, uv)]
    write_ply(path, flat[0], faces, normals=flat[1], uv=flat[2])


def arrow() -> Solid:
    """The gnomon: a rod along z with a point and three feathers."""
    rod = tube(np.array([[0, 0, -0.62], [0, 0, 0.0], [0, 0, 0.58]]), 0.009, 10)
    line = np.array([[0, 0, 0.57], [0, 0, 0.575], [0, 0, 0.69]])
    tip = tube(line, np.array([0.0, 0.035, 0.0]), 10)
    feather = slab(np.array([[0.0, -0.66], [0.06, -0.70], [0.06, -0.56], [0.0, -0.5]]), 0.006, 0)
    return merge([rod, tip, *(moved(feather, (0, 0, 0), 120 * k) for k in range(3))])


def sphere_of_rings() -> list[str]:
    """The armillary sphere: hoops about the axis of the world, and what bears them."""
    tip = step("rotate", x=1, angle=-(90 - TILT))  # z becomes the axis, towards the north
    size, at = scale(1.3), step("translate", z=CENTRE)
    out = []
    for name, file, material, steps in [
        ("meridian", "hoop", "bronze", [step("rotate", y=1, angle=90)]),
        ("horizon", "horizon", "bronze", []),
        ("equator", "band", "scale_band", [tip]),
        ("colure", "fine_hoop", "brass", [step("rotate", y=1, angle=90), turn(62), tip]),
        ("ecliptic", "zodiac", "brass", [step("rotate", x=1, angle=23.4), turn(35), tip]),
        ("north_tropic", "tropic", "brass", [step("translate", z=0.169), tip]),
        ("south_tropic", "tropic", "brass", [step("translate", z=-0.169), tip]),
        ("arctic", "polar", "brass", [step("translate", z=0.386), tip]),
        ("antarctic", "polar", "brass", [step("translate", z=-0.386), tip]),
        ("gnomon", "arrow", "gilt", [tip]),
    ]:
        out.append(mesh(f"courtyard_{file}.ply", f"fountain_{name}", [*steps, size, at], material))
    for k in range(4):
        steps = [turn(90 * k + 45), size, step("translate", z=1.36)]
        out.append(mesh("courtyard_scroll.ply", f"fountain_scroll_{k}", steps, "bronze"))
        out.append(put("pedestal", f"fountain_pedestal_{k}", "stone", (0, 0, 0), turn(90 * k)))
    return out


def scroll() -> Solid:
    """One of the four arms between the pedestal and the horizon."""
    line = [(0.045, -0.02), (0.09, 0.05), (0.2, 0.09), (0.30, 0.2), (0.385, 0.36), (0.45, 0.46)]
    line += [(0.475, 0.505)]
    curl = arc(0.035, -150, 150, 12) + [0.235, 0.055]
    flat = [spline(line, 5), curl]
    rods = [tube(np.insert(p, 1, 0.0, axis=1), 0.012, 8) for p in flat]
    return merge(rods)


def basin() -> list[str]:
    """An octagonal basin with glazed tiles, on a step, with water lilies."""
    out = []
    for k in range(8):
        out.append(put("side", f"fountain_basin_{k}", "azulejo", (0, 0, 0), turn(45 * k)))
        out.append(put("coping", f"fountain_coping_{k}", "stone", (0, 0, 0), turn(45 * k)))
        out.append(put("tread", f"fountain_tread_{k}", "stone", (0, 0, 0), turn(45 * k)))
    out.append(shape("disk", "fountain_water", [scale(1.2), step("translate", z=0.5)], "water"))
    rng = np.random.default_rng(4)
    for k, (angle, radius) in enumerate(
        [(20, 0.9), (41, 0.75), (57, 0.98), (200, 0.8), (222, 0.95)]
    ):
        a = np.radians(angle)
        at = (radius * np.cos(a), radius * np.sin(a), 0.506)
        out.append(
            put(
                "pad",
                f"fountain_pad_{k}",
                "lily_pad",
                at,
                scale(rng.uniform(0.8, 1.2)),
                turn(97 * k),
            )
        )
        if k in (0, 3):
            out.append(
                put("lily", f"fountain_lily_{k}", "lily", (at[0], at[1], 0.53), scale(0.075))
            )
    return out


def pad() -> tuple[Array, Array]:
    """A round leaf on the water, with a cut."""
    rim = np.insert(arc(0.13, 12, 348, 22), 2, 0.006, axis=1)
    points = np.vstack([[[0, 0, 0]], rim])
    i = np.arange(1, len(rim))
    return points, np.stack([0 * i, i, i + 1], 1)


def lily() -> tuple[Array, ...]:
    """A flower of radius 1: petals in three rounds."""
    angle = np.arange(22) * 2.4
    rise = np.repeat([0.35, 0.8, 1.5], [9, 8, 5])
    axes = np.stack([np.cos(angle), np.sin(angle), rise], 1)
    return leaves(np.zeros((22, 3)), axes, np.full(22, 1.0), np.random.default_rng(3))


# ---- The court ---------------------------------------------------------------


def bay_wall() -> Solid:
    """The wall over one bay of an arcade, in x and z around the bay's middle, from its arch up."""
    half, radius = BAY / 2, BAY / 2 - 0.2
    hole = arc(radius, 180, 0, 25) + [0, SPRING]
    # In two halves, for a polygon that winds the same way everywhere.
    left = hole[:13]
    outline = np.vstack([[[-half, SPRING]], left, [[0, STOREY], [-half, STOREY]]])
    right = outline[::-1] * [-1, 1]
    return merge([slab(outline, WALL, 0.0), slab(right, WALL, 0.0)])


def voussoirs() -> Solid:
    """The stones of one arch, which stand out a little on both sides."""
    inner, outer = BAY / 2 - 0.2, BAY / 2 + 0.02
    stones = []
    for k in range(15):
        low, high = 180 - 12 * k - 0.4, 180 - 12 * (k + 1) + 0.4
        bow = 0.05 if k == 7 else 0.0  # the keystone
        ring_out = arc(outer + bow, high, low, 3)
        ring_in = arc(inner - bow, low, high, 3)
        plan = np.vstack([ring_out, ring_in]) + [0, SPRING]
        stones.append(slab(plan, WALL + 0.07 + bow, 0.008))
    return merge(stones)


def column() -> Array:
    """Profile of a column with base and capital, without their square plates."""
    base = [(0.22, 0.09), (0.235, 0.12), (0.22, 0.15), (0.18, 0.165), (0.175, 0.185), (0.2, 0.215)]
    shaft = [(0.168, 0.26), (0.172, 0.9), (0.15, 1.95)]
    head = [(0.165, 1.965), (0.165, 1.99), (0.15, 2.0), (0.15, 2.06), (0.175, 2.12), (0.225, 2.2)]
    return np.vstack([[[0.0, 0.09]], base, shaft, head, [[0.0, 2.2]]])


def plates() -> Solid:
    """The square plates at both ends of a column."""
    foot = box((0.52, 0.52, 0.09), 0.01)
    head = box((0.54, 0.54, 0.15), 0.012)
    return merge([moved(foot, (0, 0, 0.045)), moved(head, (0, 0, SPRING - 0.075))])


def arcade(name: str, origin: Sequence[float], angle: float, count: int) -> list[str]:
    """Bays side by side along x before the turn; their back wall is towards +y."""
    out = []

    def at(file: str, what: str, material: str, x: float, y: float, *steps: str) -> None:
        place = step("translate", x=x, y=y)
        there = step("translate", x=origin[0], y=origin[1])
        where = [*steps, place, turn(angle), there]
        out.append(mesh(f"courtyard_{file}.ply", f"{name}_{what}", where, material))

    for k in range(count):
        x = BAY * (k - (count - 1) / 2)
        at("bay", f"bay_{k}", "plaster", x, 0)
        at("voussoirs", f"arch_{k}", "stone", x, 0)
        for b in range(4):
            beam = step("translate", z=STOREY - 0.35)
            at("beam", f"beam_{k}_{b}", "timber", x - 1.1 + 0.75 * b, DEPTH / 2, beam)
        kind = ("door", "bench", "niche", "bench", "door")[k % 5]
        if kind == "door":
            at("door", f"door_{k}", "door", x, DEPTH - 0.03)
            at("doorway", f"doorway_{k}", "stone", x, DEPTH - 0.06)
        elif kind == "bench":
            at("bench", f"bench_{k}", "stone", x, DEPTH - 0.35)
        else:
            at("jar", f"jar_{k}", "glaze", x, DEPTH - 0.5, scale(1.15))
    for k in range(count + 1):
        x = BAY * (k - count / 2)
        at("column", f"column_{k}", "stone", x, 0)
        at("plates", f"plates_{k}", "stone", x, 0)
    at("back", "back", "rose", 0, DEPTH + 0.1)
    at("ceiling", "ceiling", "plaster", 0, DEPTH / 2, step("translate", z=STOREY))
    at("cornice", "cornice", "stone", 0, 0, step("translate", z=STOREY))
    return out


def doorway() -> tuple[Solid, Solid]:
    """A frame of stone, and a door of planks in it."""
    posts = [moved(box((0.16, 0.14, 2.3), 0.01), (s * 0.63, 0, 1.15)) for s in (-1, 1)]
    lintel = moved(box((1.54, 0.18, 0.2), 0.012), (0, 0, 2.4))
    sill = moved(box((1.5, 0.3, 0.1), 0.01), (0, -0.05, 0.05))
    leaf = [moved(box((0.178, 0.06, 2.2), 0.008), (0.184 * (k - 2.5), 0, 1.2)) for k in range(6)]
    return merge([*posts, lintel, sill]), merge(leaf)


def bench() -> Solid:
    """A stone bench of length 1.7."""
    seat = moved(box((1.7, 0.44, 0.09), 0.015), (0, 0, 0.45))
    feet = [moved(box((0.16, 0.36, 0.41), 0.012), (s * 0.62, 0, 0.205)) for s in (-1, 1)]
    return merge([seat, *feet])


def jar() -> Array:
    """Profile of a tall jar with an open mouth."""
    outer = spline([(0.14, 0.0), (0.2, 0.12), (0.29, 0.42), (0.25, 0.68), (0.15, 0.8)], 5)
    lip = [(0.19, 0.86), (0.2, 0.88), (0.17, 0.885), (0.13, 0.82), (0.0, 0.8)]
    return np.vstack([[[0.0, 0.0]], outer, lip])


def flowerpot() -> Array:
    """Profile of a terracotta pot of height 0.62 with earth in it."""
    outer = [(0.24, 0.0), (0.3, 0.3), (0.335, 0.47), (0.345, 0.5), (0.375, 0.51), (0.385, 0.6)]
    return np.array([(0.0, 0.0), *outer, (0.37, 0.62), (0.335, 0.62), (0.32, 0.55), (0.0, 0.57)])


def upper_storey() -> list[str]:
    """The windows over the northern arcade, and the eaves."""
    out = [block("upper", (-HALF, HALF - 0.21, STOREY), (HALF, HALF + 0.21, 7.9), "plaster")]
    for k in range(5):
        x = BAY * (k - 2)
        at = (x, HALF - 0.21, 5.35)
        out.append(put("window", f"window_{k}", "stone", at))
        out.append(
            block(f"pane_{k}", (x - 0.5, HALF - 0.215, 5.35), (x + 0.5, HALF - 0.2, 6.95), "glass")
        )
        out.append(put("bars", f"bars_{k}", "white_paint", at))
        for side in (-1, 1):
            ajar = turn(side * (8 + 23 * ((3 * k + side) % 4)))
            place = (x + side * 0.54, HALF - 0.25, 5.35)
            flip = [step("scale", x=-1, y=1, z=1)] if side < 0 else []
            out.append(put("shutter", f"shutter_{k}_{side + 1}", "shutter", place, *flip, ajar))
    out += [put("rafter", f"rafter_{k}", "timber", (0.6 * k - 7.2, HALF, 7.85)) for k in range(25)]
    return out


def window() -> tuple[Solid, Solid, Solid]:
    """The frame of a window before the wall, its bars, and a shutter hinged at x = 0."""
    sides = [moved(box((0.12, 0.12, 1.6), 0.01), (s * 0.56, -0.02, 0.8)) for s in (-1, 1)]
    sill = moved(box((1.4, 0.26, 0.1), 0.012), (0, -0.06, -0.05))
    lintel = moved(box((1.44, 0.2, 0.14), 0.012), (0, -0.04, 1.67))
    bars = [moved(box((0.04, 0.04, 1.6), 0.004), (x, -0.01, 0.8)) for x in (-0.48, 0.0, 0.48)]
    bars += [moved(box((1.0, 0.04, 0.035), 0.004), (0, -0.01, z)) for z in (0.02, 0.55, 1.07, 1.58)]
    slats = [moved(box((0.05, 0.045, 1.56), 0.004), (x, 0, 0.8)) for x in (0.03, 0.49)]
    tilted = slab(
        np.array([[-0.03, -0.006], [0.02, 0.03], [0.025, 0.025], [-0.025, -0.011]]), 0.42, 0
    )
    side_on = Solid(
        tilted.vertices[:, [1, 0, 2]] * [-1, 1, 1],
        tilted.faces,
        tilted.normals[:, [1, 0, 2]] * [-1, 1, 1],
    )
    slats += [moved(side_on, (0.26, 0, 0.06 + 0.085 * k)) for k in range(18)]
    return merge([*sides, sill, lintel]), merge(bars), merge(slats)


def tile_row() -> Solid:
    """One row of hollow tiles up a roof, seven along +y, each over the one below."""
    angle = np.radians(np.linspace(-10, 190, 9))
    tiles = []
    for k in range(7):
        low, high = 0.115, 0.092
        ends = []
        for radius, y, lift in ((low, 0.42 * k, 0.022), (high, 0.42 * k + 0.5, 0.0)):
            ends.append(
                np.stack([radius * np.cos(angle), 0 * angle + y, radius * np.sin(angle) + lift], 1)
            )
        out = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], 1)
        i = np.arange(8)
        faces = np.vstack([np.stack([i, i + 10, i + 9], 1), np.stack([i, i + 1, i + 10], 1)])
        tiles.append(Solid(np.vstack(ends), faces[:, ::-1], np.vstack([out, out])))
    return merge(tiles)


def roofs(rng: np.random.Generator) -> list[str]:
    """Hollow tiles over the western arcade, and along the eaves in the north."""
    out = []
    slope = step("rotate", x=1, angle=24)
    tints = ("tile", "tile", "tile_dark", "tile_light", "tile")
    for k in range(62):
        place = step("translate", x=-7.5 + 0.245 * k, y=-0.42, z=STOREY + 0.2)
        there = step("translate", x=-HALF)
        tint = tints[rng.integers(5)]
        steps = [slope, place, turn(90), there]
        out.append(mesh("courtyard_tiles.ply", f"west_tiles_{k}", steps, tint))
        if k % 31 == 0:
            under = [step("scale", x=7.6, y=1.6), step("translate", x=7.5, y=1.5, z=-0.02), slope]
            if k == 0:
                under += [step("translate", x=-7.5, y=-0.42, z=STOREY + 0.2), turn(90), there]
                out.append(shape("rectangle", "west_roof", under, "tile_dark"))
        steps = [slope, step("translate", x=-7.5 + 0.245 * k, y=HALF - 0.75, z=7.98)]
        out.append(mesh("courtyard_tiles.ply", f"north_tiles_{k}", steps, tints[rng.integers(5)]))
    under = [step("scale", x=7.7, y=1.6), step("translate", y=1.5, z=-0.02), slope]
    under.append(step("translate", y=HALF - 0.75, z=7.98))
    out.append(shape("rectangle", "north_roof", under, "tile_dark"))
    return out


def east_wall(rng: np.random.Generator) -> list[str]:
    """A wall with a portal, a blind window and creepers, under a row of tiles."""
    out = [block("east_wall", (HALF, -HALF - 0.4, -0.5), (HALF + 0.5, HALF, 3.6), "plaster")]
    out.append(
        block("east_cap", (HALF - 0.06, -HALF - 0.46, 3.6), (HALF + 0.56, HALF, 3.7), "stone")
    )
    face = turn(-90)
    out.append(put("doorway", "portal", "stone", (HALF - 0.02, 2.2, 0), scale(1.15), face))
    out.append(put("door", "portal_door", "door", (HALF - 0.01, 2.2, 0), scale(1.15), face))
    for k, y in enumerate((-1.6, -4.9)):
        out.append(put("window", f"east_window_{k}", "stone", (HALF, y, 1.3), scale(0.8), face))
        out.append(
            block(
                f"east_pane_{k}", (HALF - 0.01, y - 0.4, 1.3), (HALF + 0.05, y + 0.4, 2.55), "glass"
            )
        )
        for b in range(5):
            low = (HALF - 0.05, y - 0.33 + 0.165 * b - 0.008, 1.3)
            out.append(
                block(f"grille_{k}_{b}", low, (low[0] + 0.016, low[1] + 0.016, 2.55), "iron")
            )
    spots = []
    for start, reach in ((4.4, 2.6), (-3.2, 1.9)):
        for _ in range(62):
            height = rng.uniform(0.0, 1.0)
            y = start + rng.normal(0, 0.22 + 0.55 * height**1.5) * reach / 2
            spots.append((HALF - 0.02 - rng.uniform(0, 0.16), y, 0.15 + 3.55 * height))
    for k, spot in enumerate(spots):
        tint = (
            ("ivy", "ivy", "ivy_dark", "bloom")[k % 4]
            if spot[1] > 1
            else ("ivy", "ivy_dark")[k % 2]
        )
        flat = step("scale", x=0.17, y=rng.uniform(0.24, 0.36), z=rng.uniform(0.24, 0.36))
        out.append(put("tuft", f"creeper_{k}", tint, spot, turn(rng.uniform(0, 360)), flat))
    return out


def balustrade() -> list[str]:
    """Balusters, rails and piers along the south."""
    y = -HALF - 0.2
    out = [block("plinth", (-HALF - 0.4, y - 0.22, -0.6), (HALF, y + 0.22, 0.14), "stone")]
    out.append(put("rail", "rail", "stone", (0, y, 0.98)))
    for k in range(6):
        x = BAY * (k - 2.5)
        out.append(put("pier", f"pier_{k}", "stone", (x, y, 0)))
        for b in range(9):
            if k < 5:
                out.append(
                    put("baluster", f"baluster_{k}_{b}", "stone", (x + 0.46 + 0.26 * b, y, 0.14))
                )
        if k in (1, 4):
            out.append(put("pot", f"urn_{k}", "terracotta", (x, y, 1.1), scale(0.62)))
            for t in range(7):
                a = 2.4 * t
                at = (x + 0.13 * np.cos(a), y + 0.13 * np.sin(a), 1.55 + 0.05 * (t % 3))
                tint = ("geranium", "ivy")[t % 2]
                out.append(put("tuft", f"urn_{k}_{t}", tint, at, scale(0.2), turn(50 * t)))
    return out


def small_baluster() -> Array:
    """Profile of a baluster of height 0.78."""
    line = spline(
        [(0.05, 0.1), (0.045, 0.14), (0.095, 0.27), (0.07, 0.45), (0.045, 0.6), (0.06, 0.66)], 3
    )
    return np.vstack(
        [[(0.09, 0.0), (0.09, 0.08), (0.05, 0.1)], line, [(0.085, 0.69), (0.085, 0.78)]]
    )


def crown(
    name: str,
    at: Sequence[float],
    radius: float,
    count: int,
    rng: np.random.Generator,
    tints: Sequence[str],
    size: float,
    flat: float = 0.85,
) -> list[str]:
    """A crown of tufts around a place."""
    out = []
    for k in range(count):
        z = 1 - 2 * (k + 0.5) / count
        a, level = 2.4 * k, np.sqrt(1 - z * z)
        way = np.array([level * np.cos(a), level * np.sin(a), flat * z])
        spot = np.array(at) + radius * way * rng.uniform(0.62, 1.0)
        moves = [turn(rng.uniform(0, 360)), scale(size * rng.uniform(0.8, 1.2))]
        out.append(put("tuft", f"{name}_{k}", tints[rng.integers(len(tints))], spot, *moves))
    return out


def potted_trees(rng: np.random.Generator) -> list[str]:
    """Lemon trees and clipped box in pots around the court."""
    out = []
    lemons = [(-5.9, 5.6), (5.7, 5.9), (5.9, -5.9), (-5.8, -5.8), (0.0, -6.4)]
    for i, (x, y) in enumerate(lemons):
        out.append(put("pot", f"pot_{i}", "terracotta", (x, y, 0), turn(40 * i)))
        out.append(put("trunk", f"trunk_{i}", "bark", (x, y, 0.55), turn(70 * i)))
        out += crown(
            f"crown_{i}", (x, y, 1.95), 0.52, 26, rng, ("citrus", "citrus", "citrus_light"), 0.24
        )
        for k in range(9):
            a, z = rng.uniform(0, 2 * np.pi), rng.uniform(-0.4, 0.3)
            spot = (x + 0.56 * np.cos(a), y + 0.56 * np.sin(a), 1.95 + z)
            fruit = [
                step("scale", x=0.036, y=0.036, z=0.048),
                step("translate", x=spot[0], y=spot[1], z=spot[2]),
            ]
            out.append(mesh("courtyard_ball.ply", f"lemon_{i}_{k}", fruit, "lemon"))
    for i, (x, y, size) in enumerate(
        [(-2.4, 6.5, 0.75), (2.3, 6.6, 0.8), (-6.6, 1.4, 0.7), (6.6, 0.3, 0.85), (6.7, -3.1, 0.6)]
    ):
        out.append(put("pot", f"box_pot_{i}", "terracotta", (x, y, 0), scale(size), turn(30 * i)))
        out += crown(
            f"box_{i}",
            (x, y, 0.92 * size),
            0.3 * size,
            14,
            rng,
            ("ivy", "ivy_dark"),
            0.2 * size,
            1.0,
        )
    return out


def trunk() -> Solid:
    """The stem of a lemon tree with three boughs."""
    stem = [(0, 0, 0), (0.03, 0.01, 0.4), (-0.02, 0.02, 0.8), (0.0, 0.0, 1.1)]
    rods = [tube(spline(stem, 5), np.linspace(0.045, 0.03, 16), 7)]
    for k in range(3):
        a = 2.1 * k + 0.4
        way = np.array([np.cos(a), np.sin(a), 1.2])
        rods.append(tube(np.array(stem[3]) + np.linspace(0, 0.42, 4)[:, None] * way, 0.02, 6))
    return merge(rods)


def smaller_things() -> list[str]:
    """A watering can on the step, a table with bread and wine, and two chairs."""
    out = [put("can", "watering_can", "zinc", (1.33, 0.55, 0.16), turn(-35))]
    x, y = 3.9, 5.75
    out.append(put("table", "table", "iron", (x, y, 0)))
    out.append(
        shape(
            "disk", "table_top", [scale(0.42), step("translate", x=x, y=y, z=0.752)], "azulejo_top"
        )
    )
    for k, (dx, dy, angle) in enumerate([(-0.75, 0.1, 80), (0.5, -0.6, -140)]):
        out.append(put("chair", f"chair_{k}", "chair_paint", (x + dx, y + dy, 0), turn(angle)))
    out.append(put("bottle", "wine_bottle", "bottle", (x + 0.12, y + 0.1, 0.755)))
    for k, (dx, dy) in enumerate([(-0.1, 0.14), (0.18, -0.14)]):
        out.append(put("cup", f"cup_{k}", "glaze", (x + dx, y + dy, 0.755)))
    fruit = [(-0.12, -0.1), (-0.05, -0.15), (-0.04, -0.07)]
    for k, (dx, dy) in enumerate(fruit):
        at = [step("translate", x=x + dx, y=y + dy, z=0.79)]
        out.append(shape("sphere", f"orange_{k}", [scale(0.038), *at], "orange"))
    return out


def watering_can() -> Solid:
    """A can of zinc: body, spout with its rose, and handle."""
    profile = [(0.0, 0.0), (0.13, 0.0), (0.135, 0.02), (0.12, 0.25), (0.125, 0.27), (0.11, 0.27)]
    body, _ = wedge(np.array([*profile, (0.1, 0.24), (0.0, 0.235)]), 1, 24)
    spout = tube(spline([(0.11, 0, 0.06), (0.24, 0, 0.16), (0.36, 0, 0.33)], 5), 0.016, 8)
    rose = tube(
        np.array([[0.35, 0, 0.315], [0.4, 0, 0.385], [0.401, 0, 0.386]]),
        np.array([0.018, 0.05, 0.0]),
        12,
    )
    handle = tube(
        spline(
            [
                (-0.11, 0, 0.06),
                (-0.24, 0, 0.14),
                (-0.22, 0, 0.3),
                (-0.05, 0, 0.38),
                (0.09, 0, 0.27),
            ],
            5,
        ),
        0.011,
        8,
    )
    return merge([body, spout, rose, handle])


def garden_chair() -> Solid:
    """A chair of slats, facing -y."""
    legs = [
        moved(box((0.035, 0.035, 0.45), 0.004), (x, y, 0.225))
        for x in (-0.2, 0.2)
        for y in (-0.19, 0.19)
    ]
    seat = [moved(box((0.43, 0.07, 0.018), 0.004), (0, -0.17 + 0.085 * k, 0.455)) for k in range(5)]
    posts = [moved(box((0.035, 0.03, 0.48), 0.004), (x, 0.2, 0.68)) for x in (-0.2, 0.2)]
    back = [moved(box((0.42, 0.016, 0.055), 0.004), (0, 0.2, 0.62 + 0.1 * k)) for k in range(4)]
    return merge([*legs, *seat, *posts, *back])


def iron_table() -> Solid:
    """The foot of a round table, without its top."""
    rods = [tube(np.array([[0, 0, 0.1], [0, 0, 0.4], [0, 0, 0.74]]), 0.022, 8)]
    for k in range(3):
        foot = spline([(0.02, 0, 0.2), (0.16, 0, 0.12), (0.28, 0, 0.015), (0.33, 0, 0.03)], 4)
        rods.append(moved(tube(foot, 0.014, 7), (0, 0, 0), 120 * k))
    rim = np.insert(arc(0.42, 0, 360, 33), 2, 0.745, axis=1)
    rods.append(tube(rim, 0.012, 6))
    return merge(rods)


# ---- Files -------------------------------------------------------------------


def write_object(folder: Path) -> None:
    """Basin, pedestal and armillary sphere."""
    for name, profile, steps in [
        ("hoop", ring(0.455, 0.03, 0.02), 56),
        ("fine_hoop", ring(0.425, 0.018, 0.012), 56),
        ("tropic", ring(0.392, 0.014, 0.01), 48),
        ("polar", ring(0.176, 0.014, 0.01), 32),
        ("zodiac", ring(0.427, 0.05, 0.008), 56),
    ]:
        write_turned(folder / f"courtyard_{name}.ply", profile, 1, steps)
    flat = np.array(
        [(0.465, -0.011), (0.53, -0.011), (0.53, 0.011), (0.465, 0.011), (0.465, -0.011)]
    )
    write_turned(folder / "courtyard_horizon.ply", flat, 1, 56)
    band = np.array(
        [(0.436, 0.037), (0.436, -0.037), (0.44, -0.037), (0.44, 0.037), (0.436, 0.037)]
    )
    write_band(folder / "courtyard_band.ply", band)
    fluted(folder / "courtyard_pedestal.ply")
    write_solid(folder / "courtyard_arrow.ply", arrow())
    write_solid(folder / "courtyard_scroll.ply", scroll())
    tangent = np.tan(np.pi / 8)

    def sector(near: float, far: float, gap: float = 0.0) -> Array:
        return np.array(
            [
                (near, -near * tangent + gap),
                (far, -far * tangent + gap),
                (far, far * tangent - gap),
                (near, near * tangent - gap),
            ]
        )

    side = prism(sector(1.16, 1.36), 0.0, 0.56, 0.0)
    write_solid(folder / "courtyard_side.ply", side)
    write_solid(folder / "courtyard_coping.ply", prism(sector(1.1, 1.44, 0.003), 0.56, 0.64, 0.016))
    write_solid(folder / "courtyard_tread.ply", prism(sector(1.3, 1.72, 0.003), -0.05, 0.16, 0.016))
    write_ply(folder / "courtyard_pad.ply", *pad())
    write_ply(folder / "courtyard_lily.ply", *lily())


def write_band(path: Path, profile: Array) -> None:
    """The equator: u once around, v across, for the scale of hours."""
    solid, uv = wedge(profile, 1, 72)
    uv = np.stack([uv[:, 0], (solid.vertices[:, 2] + 0.037) / 0.074], 1)
    write_ply(path, solid.vertices, solid.faces, normals=solid.normals, uv=uv)


def write_court(folder: Path) -> None:
    """Buildings and what stands in the court."""
    frame, bars, shutter = window()
    posts, leaf = doorway()
    wide = 5 * BAY
    cornice = np.array(
        [(-0.21, 0), (-0.3, 0.06), (-0.3, 0.11), (-0.36, 0.17), (-0.36, 0.2), (0.1, 0.2), (0.1, 0)]
    )
    length = slab(cornice[::-1], wide, 0.004)
    along = Solid(
        length.vertices[:, [1, 0, 2]], length.faces[:, ::-1], length.normals[:, [1, 0, 2]]
    )
    solids = {
        "bay": bay_wall(),
        "voussoirs": voussoirs(),
        "plates": plates(),
        "beam": box((0.16, DEPTH, 0.2), 0.01),
        "back": moved(box((wide, 0.2, STOREY), 0.0), (0, 0, STOREY / 2)),
        "ceiling": box((wide, DEPTH + 0.4, 0.06), 0.0),
        "cornice": along,
        "doorway": posts,
        "door": leaf,
        "bench": bench(),
        "window": frame,
        "bars": bars,
        "shutter": shutter,
        "rafter": moved(box((0.12, 1.5, 0.14), 0.008), (0, 0, 0)),
        "tiles": tile_row(),
        "rail": box((wide, 0.36, 0.12), 0.02),
        "pier": merge(
            [
                moved(box((0.44, 0.44, 1.0), 0.012), (0, 0, 0.5)),
                moved(box((0.54, 0.54, 0.1), 0.015), (0, 0, 1.05)),
            ]
        ),
        "trunk": trunk(),
        "can": watering_can(),
        "chair": garden_chair(),
        "table": iron_table(),
    }
    for name, solid in solids.items():
        write_solid(folder / f"courtyard_{name}.ply", solid)
    cup = [
        (0.0, 0.0),
        (0.03, 0.0),
        (0.036, 0.03),
        (0.037, 0.075),
        (0.034, 0.075),
        (0.032, 0.02),
        (0, 0.01),
    ]
    bottle = [
        (0.0, 0.0),
        (0.036, 0.0),
        (0.038, 0.01),
        (0.038, 0.17),
        (0.03, 0.2),
        (0.014, 0.23),
        (0.013, 0.29),
        (0.016, 0.3),
        (0, 0.3),
    ]
    for name, profile, steps in [
        ("ball", arc(1.0, -90, 90, 9), 12),
        ("column", column(), 24),
        ("jar", jar(), 28),
        ("pot", flowerpot(), 28),
        ("baluster", small_baluster(), 12),
        ("cup", np.array(cup), 20),
        ("bottle", np.array(bottle), 20),
    ]:
        write_turned(folder / f"courtyard_{name}.ply", profile, 1, steps)


def main() -> None:
    """Writes the meshes, and where they stand."""
    folder = output_folder()
    write_object(folder)
    write_court(folder)
    rng = np.random.default_rng(14)
    lines = [*sphere_of_rings(), *basin(), *smaller_things()]
    lines += arcade("north", (0, HALF), 0, 5) + arcade("west", (-HALF, 0), 90, 5)
    lines += [*upper_storey(), *roofs(rng), *east_wall(rng), *balustrade(), *potted_trees(rng)]
    text = fragment(lines, "Made by courtyard.py: what stands in unbounded/courtyard.xml.")
    (folder / "courtyard_place.xml").write_text(text)


if __name__ == "__main__":
    main()
