"""A gothic cathedral: a few carved pieces, and the XML that builds it from them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from geometry import Array, output_folder, write_ply

Mesh = tuple[Array, Array]

# ------------------------------ Pieces -------------------------------


def join(*meshes: Mesh) -> Mesh:
    """One mesh of several."""
    vertices, faces, count = [], [], 0
    for v, f in meshes:
        vertices.append(v)
        faces.append(f + count)
        count += len(v)
    return np.concatenate(vertices), np.concatenate(faces)


def strip(first: Array, second: Array) -> Mesh:
    """The surface between two polylines of as many points."""
    n = len(first)
    k = np.arange(n - 1)
    faces = [np.stack([k, k + 1, k + n], 1), np.stack([k + 1, k + n + 1, k + n], 1)]
    return np.concatenate([first, second]), np.concatenate(faces)


def lift(path: Array, y: float) -> Array:
    """Points (x, z) of an elevation as points in space."""
    return np.stack([path[:, 0], np.full(len(path), y), path[:, 1]], axis=1)


def rib(path: Array, half: float, y: float, height: float) -> Mesh:
    """A moulding with a ridge along a path of an elevation (x, z), facing +y."""
    tangent = np.gradient(path, axis=0)
    if np.allclose(path[0], path[-1]):
        tangent[0] = tangent[-1] = path[1] - path[-2]
    side = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    side *= half / np.linalg.norm(side, axis=1, keepdims=True)
    ridge = lift(path, y + height)
    left, right = lift(path + side, y), lift(path - side, y)
    n = len(path)
    k = np.arange(n - 1)
    faces = [
        np.stack([k + a, k + b, k + a + 1], 1)
        if turn
        else np.stack([k + b, k + b + 1, k + a + 1], 1)
        for a, b in ((0, n), (n, 2 * n))
        for turn in (True, False)
    ]
    return np.concatenate([left, ridge, right]), np.concatenate(faces)


def circle(x: float, z: float, radius: float, count: int) -> Array:
    """A closed polyline."""
    angle = np.linspace(0, 2 * np.pi, count + 1)
    return np.stack([x + radius * np.cos(angle), z + radius * np.sin(angle)], axis=1)


def arch(x: float, half: float, sill: float, spring: float, count: int) -> Array:
    """A pointed opening from the left of the sill over the apex to the right."""
    angle = np.linspace(np.pi, np.pi * 2 / 3, count)
    left = np.stack([half + 2 * half * np.cos(angle), spring + 2 * half * np.sin(angle)], axis=1)
    right = left[-2::-1] * [-1, 1]
    outline = np.concatenate([[[-half, sill]], left, right, [[half, sill]]])
    return outline + [x, 0]


def window() -> Mesh:
    """A wall, 1.5 wide and 2.7 high, with a traceried window of four lights."""
    outer, inner = arch(0, 0.58, 0.22, 1.35, 6), arch(0, 0.5, 0.3, 1.35, 6)
    x = np.concatenate([[-0.75, -0.75], np.linspace(-0.75, 0.75, len(outer) - 4), [0.75, 0.75]])
    z = np.concatenate([[0.0, 1.3], np.full(len(outer) - 4, 2.7), [1.3, 0.0]])
    frame = strip(lift(outer, 0.0), lift(np.stack([x, z], axis=1), 0.0))
    below = strip(
        lift(np.array([[-0.75, 0.0], [0.75, 0.0]]), 0.0),
        lift(np.array([[-0.58, 0.22], [0.58, 0.22]]), 0.0),
    )
    reveal = strip(lift(inner, -0.14), lift(outer, 0.0))
    sill = strip(lift(outer[[0, -1]], 0.0), lift(inner[[0, -1]], -0.14))
    bars = [rib(outer, 0.035, 0.0, 0.06)]
    for side in (-1, 1):
        bars.append(rib(arch(0.25 * side, 0.25, 1.0, 1.1, 4)[1:-1], 0.035, -0.13, 0.08))
        bars.append(rib(circle(0.25 * side, 1.28, 0.105, 8), 0.02, -0.13, 0.05))
        bars.append(rib(np.array([[0.25 * side, 0.3], [0.25 * side, 1.0]]), 0.02, -0.13, 0.05))
        for light in (-0.125, 0.125):
            x_light = 0.25 * side + light
            bars.append(rib(arch(x_light, 0.125, 0.8, 0.95, 3)[1:-1], 0.02, -0.13, 0.05))
    bars.append(rib(np.array([[0, 0.3], [0, 1.3]]), 0.035, -0.13, 0.08))
    bars.append(rib(circle(0, 1.76, 0.22, 12), 0.03, -0.13, 0.08))
    for k in range(4):
        a = np.pi / 4 + k * np.pi / 2
        bars.append(
            rib(circle(0.1 * np.cos(a), 1.76 + 0.1 * np.sin(a), 0.085, 7), 0.014, -0.13, 0.05)
        )
    return join(frame, below, reveal, sill, *bars)


def rose_petal() -> Mesh:
    """A twelfth of a rose window of radius 1, around the +z direction."""
    spoke = np.array([[0.0, 0.2], [0.0, 0.62]])
    half = np.radians(15)
    rim = circle(0, 0, 1.0, 48)[10:15]
    hub = circle(0, 0, 0.2, 24)[5:8]
    turned = spoke @ np.array([[np.cos(half), np.sin(half)], [-np.sin(half), np.cos(half)]]).T
    leaf = np.array([turned[1], [-0.085, 0.74], [0, 0.8], [0.085, 0.74], turned[1] * [-1, 1]])
    parts = [rib(spoke, 0.014, 0, 0.05), rib(turned, 0.022, 0, 0.07), rib(leaf, 0.018, 0, 0.06)]
    parts += [rib(rim, 0.06, 0, 0.1), rib(rim * 0.86, 0.015, 0, 0.05), rib(hub, 0.03, 0, 0.08)]
    parts += [rib(circle(0, 0.62, 0.075, 7), 0.014, 0, 0.05)]
    parts += [rib(circle(0.2, 0.87, 0.06, 6), 0.014, 0, 0.05)]
    return join(*parts)


def balustrade() -> Mesh:
    """A pierced parapet, 1 wide and 0.3 high."""
    parts = [
        rib(np.array([[-0.5, z], [0.5, z]]), half, 0, 0.07)
        for z, half in ((0.03, 0.03), (0.28, 0.035))
    ]
    for k in range(5):
        parts.append(rib(circle(-0.4 + 0.2 * k, 0.155, 0.08, 6), 0.02, 0, 0.05))
    return join(*parts)


def bud(centre: Array, size: float) -> Mesh:
    """A little octahedron: a crocket at this scale."""
    v = centre + size * np.array(
        [[1.2, 0, 0.5], [-1, 0, 0], [0, 0.7, 0], [0, -0.7, 0], [0, 0, 1], [0, 0, -1]]
    )
    f = [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)]
    return v, np.array(f)


def crockets() -> Mesh:
    """Buds that grow along +z from 0 to 1, outwards to +x."""
    return join(*(bud(np.array([0.0, 0, z]), 0.026) for z in np.linspace(0.04, 0.95, 12)))


def pyramid(radius: float, low: float, high: float, sides: int) -> Mesh:
    """A pyramid without its base."""
    a = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    base = np.stack([radius * np.cos(a), radius * np.sin(a), np.full(sides, low)], axis=1)
    k = np.arange(sides)
    faces = np.stack([k, (k + 1) % sides, np.full(sides, sides)], 1)
    return np.concatenate([base, [[0, 0, high]]]), faces


def prism(radius: float, low: float, high: float, sides: int, top: float = 1.0) -> Mesh:
    """An upright prism without its ends, perhaps tapering."""
    a = 2 * np.pi * (np.arange(sides + 1) + 0.5) / sides
    ring = np.stack([radius * np.cos(a), radius * np.sin(a), 0 * a], axis=1)
    return strip(ring + [0, 0, low], ring * [top, top, 1] + [0, 0, high])


def pinnacle() -> Mesh:
    """A pinnacle of height 1: shaft, four gablets and a crocketed spirelet."""
    parts = [prism(0.14, 0, 0.38, 4), pyramid(0.15, 0.36, 1.0, 4), prism(0.17, 0.0, 0.05, 4, 0.85)]
    for k in range(4):
        c, s = np.cos(k * np.pi / 2), np.sin(k * np.pi / 2)
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        gable = np.array([[0.12, -0.11, 0.3], [0.12, 0.11, 0.3], [0.12, 0, 0.56], [0, 0, 0.56]])
        parts.append((gable @ turn, np.array([(0, 1, 2), (1, 3, 2), (0, 2, 3)])))
        diagonal = np.array([[c - s, s + c, 0], [-s - c, c - s, 0], [0, 0, np.sqrt(2)]]) / np.sqrt(
            2
        )
        for z in (0.48, 0.6, 0.72, 0.84):
            v, f = bud(np.array([0.15 * (1 - z) / 0.64 + 0.01, 0, z]), 0.034)
            parts.append((v @ diagonal, f))
    parts.append(bud(np.array([0, 0, 0.99]), 0.05))
    return join(*parts)


def flyer() -> Mesh:
    """A flying buttress from the pier (y 0.29, z 0.33) up to the wall (y 0.12, z 0.47)."""
    t = np.linspace(0, 1, 9)
    top = np.stack([0.29 - 0.17 * t, 0.345 + 0.125 * t], axis=1)
    angle = np.radians(180 - 90 * t)
    under = np.stack([0.12 - 0.15 * np.cos(angle), 0.285 + 0.135 * np.sin(angle)], axis=1)
    parts = []
    for x in (-0.008, 0.008):
        parts.append(strip(*(np.insert(line, 0, x, axis=1) for line in (top, under))))
    for line in (top, under):
        parts.append(strip(*(np.insert(line, 0, x, axis=1) for x in (-0.008, 0.008))))
    return join(*parts)


def gable() -> Mesh:
    """An openwork gable, 1 wide and 1 high, crocketed, with a finial."""
    slope = np.array([[-0.5, 0], [0, 1.0], [0.5, 0]])
    sides = [rib(slope[:2], 0.045, 0, 0.07), rib(slope[1:], 0.045, 0, 0.07)]
    sides.append(rib(circle(0, 0.42, 0.16, 8), 0.03, 0, 0.06))
    sides.append(rib(circle(0, 0.42, 0.08, 6), 0.02, 0, 0.04))
    sides.append((lift(slope, 0.0), np.array([(0, 1, 2)])))
    for k in range(1, 6):
        for side in (-1, 1):
            v, f = bud(np.zeros(3), 0.06)
            place = [side * (0.5 - k / 12 + 0.05), 0.03, k / 6]
            sides.append((v * [side, 1, 1] + place, f))
    sides.append(bud(np.array([0, 0.03, 1.1]), 0.1))
    return join(*sides)


def tiles(rows: int, columns: int, taper: bool, rng: np.random.Generator) -> Mesh:
    """A slope of overlapping tiles, each a little askew: x across, z up the slope, facing +y."""
    peak = 0.0 if taper else 0.5
    corners = [np.array([[-0.5, 0, 0], [0.5, 0, 0], [peak, 0, 1], [-peak, 0, 1]])]  # boards
    for row in range(rows):
        share = 1 - (row + 0.5) / rows if taper else 1.0
        seams = np.linspace(-share / 2, share / 2, max(1, round(columns * share)) + 1)
        if row % 2 and len(seams) > 2:
            seams = np.array([seams[0], *(seams[1:] + seams[:-1]) / 2, seams[-1]])
        for left, right in pairwise(seams):
            low, high = (row - 0.12) / rows, (row + 1.05) / rows
            tilt = rng.uniform(0.0, 0.05, 2)
            y = [0.055 + tilt[0], 0.055 + tilt[1], tilt[1], tilt[0]]
            x = [left, right - 0.006, right - 0.006, left]
            corners.append(np.stack([x, y, [low, low, high, high]], 1))
    first = 4 * np.arange(len(corners))[:, None]
    faces = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]])
    return np.concatenate(corners), faces


def statue() -> Mesh:
    """A robed figure of height 1."""
    rings = [(0.17, 0), (0.14, 0.3), (0.15, 0.6), (0.19, 0.74), (0.07, 0.82), (0.1, 0.9), (0.02, 1)]
    parts = [prism(r, z, top_z, 6, top / r) for (r, z), (top, top_z) in pairwise(rings)]
    return join(*parts)


# ------------------------------ Building -----------------------------


def place(
    at: tuple[float, float, float],
    size: tuple[float, float, float] = (1, 1, 1),
    turn: float = 0.0,
    lean: float = 0.0,
    first: float = 0.0,
) -> Array:
    """Scale, turn about z by ``first``, lean about x, turn about z, move; in degrees."""

    def about_z(angle: float) -> Array:
        c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])

    c, s = np.cos(np.radians(lean)), np.sin(np.radians(lean))
    leaning = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    matrix = np.eye(4)
    matrix[:3, :3] = about_z(turn) @ leaning @ about_z(first) @ np.diag(size)
    matrix[:3, 3] = at
    return matrix


GROUND = place((-0.075, 0, -0.68), (1.05, 1.05, 1.05))


class Builder:
    """Collects the XML of shapes, shape groups and instances."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.count = 0
        self.indent = "    "

    def shape(self, kind: str, body: str, matrix: Array) -> None:
        self.count += 1
        if self.indent == "    ":  # not within a group
            matrix = GROUND @ matrix
        values = " ".join(f"{v:.4f}".rstrip("0").rstrip(".") or "0" for v in matrix.ravel())
        values = values.replace("-0 ", "0 ")
        self.lines.append(
            f'{self.indent}<shape type="{kind}" id="s{self.count}">{body}'
            f'<transform name="to_world"><matrix value="{values}"/></transform></shape>'
        )

    def piece(self, name: str, material: str, matrix: Array) -> None:
        """One of the meshes."""
        file = f'<string name="filename" value="../assets/cathedral_{name}.ply"/>'
        flat = '<boolean name="face_normals" value="true"/>'
        self.shape("ply", f'{file}{flat}<ref id="{material}"/>', matrix)

    def box(self, low: tuple[float, ...], high: tuple[float, ...], material: str = "stone") -> None:
        """A block between two corners."""
        a, b = np.array(low), np.array(high)
        self.shape("cube", f'<ref id="{material}"/>', place(tuple((a + b) / 2), tuple((b - a) / 2)))

    def glass(self, matrix: Array, width: float, height: float) -> None:
        """A pane behind the plane of an elevation, from its lower middle."""
        pane = place((0, -0.01, height / 2), (width / 2, 0.01, height / 2))
        self.shape("cube", '<ref id="glass"/>', matrix @ pane)

    def window(
        self, at: tuple[float, float, float], width: float, height: float, turn: float
    ) -> None:
        """A wall with a window, facing +y before the turn."""
        matrix = place(at, (width / 1.5, 0.08, height / 2.7), turn)
        self.piece("window", "stone", matrix)
        self.glass(matrix @ place((0, -0.14, 0.25)), 1.05, 2.0)

    def roof(self, kind: str, eave: Array, ridge: Array, width: float, turn: float) -> None:
        """Tiles from the eave (y, z) to the ridge, before the turn about z."""
        run, rise = ridge - eave
        length = float(np.hypot(run, rise))
        lean = float(np.degrees(np.arctan2(-run, rise)))
        matrix = place((0, 0, 0), turn=turn) @ place(
            (0, float(eave[0]), float(eave[1])), (width, 0.09, length), lean=lean
        )
        self.piece(kind, "copper", matrix)

    def group(self, name: str) -> None:
        self.lines.append(f'    <shape type="shapegroup" id="{name}">')
        self.indent = "        "

    def end(self) -> None:
        self.lines.append("    </shape>")
        self.indent = "    "

    def instance(self, name: str, matrix: Array) -> None:
        self.shape("instance", f'<ref id="{name}"/>', matrix)


NAVE, AISLE, BAY = 0.12, 0.24, 0.12  # half widths of nave and aisles, the width of a bay
AISLE_EAVE, NAVE_EAVE, RIDGE = 0.24, 0.52, 0.74
EAVE = np.array([NAVE + 0.012, NAVE_EAVE])
TOP = np.array([0.0, RIDGE])


def bay(b: Builder, inner: float, outer: float) -> None:
    """One bay of nave and aisle, facing +y, with a buttress at its -x side."""
    b.window((0, AISLE + 0.012, 0), outer, AISLE_EAVE, 0)
    b.window((0, NAVE + 0.012, 0.27), inner, NAVE_EAVE - 0.27, 0)
    b.piece("balustrade", "stone", place((0, AISLE + 0.012, AISLE_EAVE), (outer, 0.1, 0.1)))
    b.piece("gable", "stone", place((0, NAVE + 0.014, 0.475), (0.8 * inner, 0.1, 0.13)))
    b.piece("balustrade", "stone", place((0, NAVE + 0.012, NAVE_EAVE), (inner, 0.1, 0.1)))


def buttress(b: Builder, x: float, turn: float) -> None:
    """A stepped pier with a pinnacle, and the flyer to the nave."""
    around = place((0, 0, 0), turn=turn)
    for low, high in (
        ((-0.016, 0.24, 0), (0.016, 0.32, 0.16)),
        ((-0.013, 0.24, 0), (0.013, 0.3, 0.345)),
    ):
        a, c = np.array(low), np.array(high)
        middle = (a + c) / 2 + [x, 0, 0]
        matrix = around @ place(tuple(middle), tuple((c - a) / 2))
        b.shape("cube", '<ref id="stone"/>', matrix)
    b.piece("flyer", "stone", around @ place((x, 0, 0)))
    b.piece("pinnacle", "stone", around @ place((x, 0.275, 0.34), (0.16, 0.16, 0.2)))
    b.piece("pinnacle", "stone", around @ place((x, NAVE + 0.01, 0.5), (0.1, 0.1, 0.13)))


def groups(b: Builder) -> None:
    """What is repeated."""
    b.group("bay")
    bay(b, BAY, BAY)
    buttress(b, -BAY / 2, 0)
    b.roof("tiles", np.array([AISLE, AISLE_EAVE]), np.array([NAVE, 0.31]), BAY, 0)
    b.roof("tiles", EAVE, TOP, BAY, 0)
    for k in range(4):
        b.piece("finial", "gold", place((-0.045 + 0.03 * k, 0, RIDGE - 0.005), (0.05, 0.05, 0.05)))
    b.end()
    narrow = 2 * np.tan(np.radians(18))
    b.group("apse_bay")
    bay(b, narrow * NAVE, narrow * AISLE)
    buttress(b, 0, 18)
    b.roof("tiles_taper", np.array([AISLE, AISLE_EAVE]), np.array([0, 0.36]), narrow * AISLE, 0)
    b.roof("tiles_taper", EAVE, TOP, narrow * EAVE[0], 0)
    b.end()
    b.group("rose")
    for k in range(12):
        turn = np.eye(4)
        c, s = np.cos(np.radians(30 * k)), np.sin(np.radians(30 * k))
        turn[0, 0], turn[0, 2], turn[2, 0], turn[2, 2] = c, s, -s, c
        b.piece("rose", "stone", turn)
    b.glass(place((0, 0.002, -0.98)), 1.96, 1.96)
    b.end()
    b.group("spire")
    b.piece("spire", "copper", np.eye(4))
    slope = float(np.degrees(np.arctan2(0.16, 1.0)))
    for k in range(8):
        lean = place((0, 0, 0), turn=45 * k + 22.5) @ place((0.165, 0, 0), turn=-90)
        lean = lean @ place((0, 0, 0), (1, 1, 0.99), lean=slope, first=90)
        b.piece("crockets", "gold", lean)
    b.piece("finial", "gold", place((0, 0, 0.97), (0.16, 0.16, 0.16)))
    b.end()
    b.group("tower")
    tower(b)
    b.end()


def tower(b: Builder) -> None:
    """A west tower around the origin, below its spire."""
    half = 0.1
    b.box((-half + 0.012, -half + 0.012, 0), (half - 0.012, half - 0.012, 0.9))
    for z in (0.3, 0.575, 0.885):
        b.box((-half - 0.008, -half - 0.008, z - 0.008), (half + 0.008, half + 0.008, z + 0.004))
    for k in range(4):
        turn = 90.0 * k
        around = place((0, 0, 0), turn=turn)

        def at(x: float, y: float, z: float, around: Array = around) -> tuple[float, ...]:
            return tuple(float(v) for v in (around @ np.array([x, y, z, 1]))[:3])

        b.window(at(0, half, 0.0), 0.18, 0.295, turn)
        for x in (-0.045, 0.045):
            b.window(at(x, half, 0.305), 0.09, 0.265, turn)
            b.window(at(x, half, 0.58), 0.09, 0.295, turn)
            b.piece("gable", "stone", around @ place((x, half + 0.004, 0.83), (0.075, 0.1, 0.11)))
        b.piece("balustrade", "stone", around @ place((0, half + 0.004, 0.89), (0.2, 0.1, 0.13)))
        corner = around @ place((half, half, 0.45), (0.02, 0.02, 0.45))
        b.shape("cube", '<ref id="stone"/>', corner)
        b.shape("cube", '<ref id="stone"/>', around @ place((half, half, 0.2), (0.027, 0.027, 0.2)))
        b.piece("pinnacle", "stone", around @ place((half, half, 0.9), (0.17, 0.17, 0.24)))


def front(b: Builder, reach: float, width: float, turn: float, move: tuple[float, float]) -> None:
    """A facade with a portal, a gallery of statues, a rose and a gable, at ``reach`` along +y."""
    around = place((*move, 0), turn=turn)
    b.instance("rose", around @ place((0, reach + 0.008, 0.42), (0.095, 0.1, 0.095)))
    matrix = around @ place((0, reach + 0.022, 0), (0.1, 0.3, 0.085))
    b.piece("window", "stone", matrix)
    b.shape("cube", '<ref id="door"/>', matrix @ place((0, -0.1, 0.8), (0.5, 0.05, 1.0)))
    b.piece("gable", "stone", around @ place((0, reach + 0.03, 0.17), (0.15, 0.2, 0.13)))
    for k in range(9):
        x = (k - 4) * width / 9.5
        b.instance("statue", around @ place((x, reach + 0.016, 0.262), (0.05, 0.05, 0.052)))
    b.piece("balustrade", "stone", around @ place((0, reach + 0.012, 0.525), (width, 0.1, 0.12)))
    roof = around @ place((0, reach - 0.01, 0.52), (width + 0.01, 0.2, RIDGE - 0.5))
    b.piece("gable", "stone", roof)
    for low, high in (
        ((-1, 0.24), (1, 0.255)),
        ((-1, 0.318), (1, 0.326)),
        ((-1, 0.515), (1, 0.525)),
    ):
        size = (width / 2, 0.012, (high[1] - low[1]) / 2)
        middle = (0, reach + 0.01, (high[1] + low[1]) / 2)
        b.shape("cube", '<ref id="stone"/>', around @ place(middle, size))


CROSSING, END = 0.06, -0.42  # of the transept's axis and of the apse's centre along x


def church(b: Builder) -> None:
    """All of it, on z = 0."""
    for k, wide in enumerate((0.0, 0.02, 0.04)):
        low = (-0.71 - wide, -0.43 - wide, -0.02 * (k + 1))
        b.box(low, (0.855 + wide, 0.43 + wide, -0.02 * k), "slate" if k == 2 else "stone")
    square = place((0.0725, 0, 0.001), (0.7775, 0.425, 1))
    b.shape("rectangle", '<ref id="paving"/>', square)
    b.group("statue")
    b.piece("statue", "stone", np.eye(4))
    b.end()
    groups(b)
    for x in (-0.36, -0.24, -0.12, 0.24, 0.36, 0.48, 0.6):
        for turn in (0, 180):
            mirror = -1 if turn else 1
            b.instance("bay", place((x, 0, 0), (mirror, 1, 1), turn))
    for k in range(-2, 3):
        b.instance("apse_bay", place((END, 0, 0), turn=90 - 36.0 * k))
    b.box((END, -NAVE, 0), (0.8, NAVE, NAVE_EAVE))
    b.box((END, -AISLE, 0), (0.66, AISLE, AISLE_EAVE))
    for radius, high in ((NAVE, NAVE_EAVE), (AISLE, AISLE_EAVE)):
        wide = radius / np.cos(np.radians(18))
        b.piece("drum", "stone", place((END, 0, 0), (wide, wide, high)))
    half, reach = 0.12, 0.4
    b.box((CROSSING - half + 0.016, -reach, 0), (CROSSING + half - 0.016, reach, NAVE_EAVE))
    for side in (-1, 1):
        turn = 0.0 if side > 0 else 180.0
        front(b, reach, 0.24, turn, (CROSSING, 0.0))
        for x in (CROSSING - half, CROSSING + half):
            facing = 90.0 if x < CROSSING else -90.0
            b.window((x, side * 0.325, 0.0), 0.12, NAVE_EAVE, facing)
            rail = place((x, side * 0.27, NAVE_EAVE), (0.25, 0.1, 0.1), facing)
            b.piece("balustrade", "stone", rail)
            b.box((x - 0.02, side * reach - 0.02, 0), (x + 0.02, side * reach + 0.02, 0.54))
            b.piece("pinnacle", "stone", place((x, side * reach, 0.54), (0.2, 0.2, 0.25)))
            for k in range(3):
                b.instance("slope", place((CROSSING, side * (0.067 + 0.133 * k), 0), turn=facing))
        for x in (CROSSING - 0.067, CROSSING + 0.067, 0.73):  # where no bay has its roof
            b.instance("slope", place((x, 0, 0), turn=turn))
        tower_place = place((0.74, side * 0.21, 0))
        b.instance("tower", tower_place)
        b.instance("spire", tower_place @ place((0, 0, 0.9), (0.6, 0.6, 0.58)))
    front(b, 0.8, 0.22, -90.0, (0.0, 0.0))
    b.instance("spire", place((CROSSING, 0, 0.72), (0.42, 0.42, 0.8)))
    b.box((CROSSING - 0.055, -0.055, 0.6), (CROSSING + 0.055, 0.055, 0.76), "copper")
    for k in range(4):
        around = place((CROSSING, 0, 0), turn=90.0 * k)
        b.piece("gable", "gold", around @ place((0, 0.058, 0.74), (0.1, 0.1, 0.12)))
        b.piece("pinnacle", "gold", around @ place((0.055, 0.055, 0.72), (0.13, 0.13, 0.2)))


def main() -> None:
    folder = output_folder()
    rng = np.random.default_rng(7)
    pieces = {
        "window": window(),
        "rose": rose_petal(),
        "balustrade": balustrade(),
        "crockets": crockets(),
        "pinnacle": pinnacle(),
        "flyer": flyer(),
        "gable": gable(),
        "tiles": tiles(12, 8, False, rng),
        "tiles_taper": tiles(12, 8, True, rng),
        "statue": statue(),
        "spire": join(pyramid(0.165, 0, 1.0, 8), prism(0.185, -0.05, 0.02, 8, 0.8)),
        "drum": prism(1.0, 0, 1, 10),
        "finial": join(pyramid(0.1, 0, 0.7, 4), bud(np.array([0, 0, 0.5]), 0.2)),
    }
    for name, (vertices, faces) in pieces.items():
        write_ply(folder / f"cathedral_{name}.ply", vertices, faces)
    b = Builder()
    b.group("slope")
    b.roof("tiles", EAVE, TOP, 0.134, 0)
    b.end()
    church(b)
    text = [
        "<!-- Written by cathedral.py. -->",
        '<scene version="3.0.0">',
        *b.lines,
        "</scene>",
        "",
    ]
    (folder / "cathedral_parts.xml").write_text("\n".join(text))


if __name__ == "__main__":
    main()
