"""The landscape of the scene forward/valley: ground, ridges, trees, grass and flowers."""

from __future__ import annotations

import numpy as np
from geometry import Array, output_folder, waves, write_ply
from PIL import Image
from solids import Solid, extrude, fragment, merge, mesh, moved, step, wedge

EYE = -0.95  # The y of the camera
LAKE = -0.475  # The height of the water


def ground_height(x: Array, y: Array) -> Array:
    """Height of the meadow: a slope down to the lake, with rising sides."""
    far = np.clip((y - EYE) / 1.4, 0, 1)
    height = -0.3 - 0.24 * np.sin(np.pi * np.clip(far * 1.15, 0, 1) * 0.5) ** 1.2
    height = height + 0.42 * far**0.7 * np.abs(x - 0.06) ** 1.8 * np.where(x < 0, 1.15, 0.8)
    height = height + (0.004 + 0.02 * far) * waves(6 * x, 6 * y, 3)
    return height + 0.004 * waves(19 * x, 19 * y, 4)


def grid(columns: Array, rows: Array) -> Array:
    """Faces of a grid of points, row after row."""
    n = len(columns)
    i = (np.arange(n - 1)[None] + n * np.arange(len(rows) - 1)[:, None]).ravel()
    return np.vstack([np.stack([i, i + 1, i + n], 1), np.stack([i + n, i + 1, i + n + 1], 1)])


def ground() -> tuple[Array, Array]:
    """The meadow, finer where it is near."""
    u = np.linspace(-1, 1, 27)
    v = np.linspace(0, 1, 24)
    y = (EYE - 0.03 + 1.5 * v**1.6)[:, None] + 0 * u
    half = np.minimum(0.2 + 0.75 * (y - EYE), 0.99)
    x = half * u
    points = np.stack([x, y, ground_height(x, y)], -1).reshape(-1, 3)
    return points, grid(u, v)


def ridge(number: int) -> tuple[Array, Array, Array]:
    """A range of hills across the valley: its points, faces and place in the picture.

    The range of number 0 is the nearest. Its points go from its foot to its crest.
    """
    y, low, top = [(0.58, -0.5, -0.27), (0.74, -0.45, -0.09), (0.9, -0.35, 0.155)][number]
    seed, size = 20 + 7 * number, top - low
    x = np.linspace(-0.99, 0.99, 56)
    v = np.array([0.0, 0.3, 0.6, 0.82, 1.0])[:, None]
    crest = top + 0.3 * size * waves(4.2 * x, 0 * x, seed)
    crest = crest + 0.12 * size * waves(14 * x, 0 * x, seed + 1)
    crest = crest + 0.055 * size * waves(39 * x, 0 * x, seed + 2)
    crest = crest + (0.3, 0.3, 0.24)[number] * size * (np.abs(x + 0.08 * (number - 1)) - 0.45)
    gully = waves(15 * x, 3 * v, seed + 3) + 0.5 * waves(31 * x, 5 * v, seed + 5)
    z = crest * v + low * (1 - v)
    depth = y - 0.14 * (1 - v) + 0.022 * gully * np.sqrt(1 - v) * (0.3 + v)
    points = np.stack([np.broadcast_to(x, z.shape), depth, z], -1).reshape(-1, 3)
    shade = ((z - low) / size / 1.5 + 0.07 * gully).clip(0.01, 0.99)
    uv = np.stack([np.full(z.shape, (number + 0.5) / 3), 1 - shade], -1).reshape(-1, 2)
    return points, grid(x, v[:, 0]), uv


def slopes() -> Array:
    """The colours of the ridges, a column each, from their crests down."""
    stops = np.array([0.0, 0.3, 0.42, 0.55, 1.0])
    colours = [
        [(96, 122, 78), (88, 116, 70), (70, 100, 58), (78, 112, 60), (104, 132, 70)],
        [(142, 156, 158), (120, 140, 138), (98, 126, 118), (92, 124, 108), (100, 132, 108)],
        [(248, 248, 250), (232, 236, 244), (150, 166, 190), (138, 156, 184), (142, 166, 182)],
    ]
    t = (np.arange(64) + 0.5) / 64
    table = [[np.interp(t, stops, np.array(c)[:, k]) for k in range(3)] for c in colours]
    return np.array(table).transpose(2, 0, 1).round().astype(np.uint8)


def pine() -> Solid:
    """A conifer of height 1."""
    parts = [wedge(np.array([[0.03, -0.1], [0.025, 0.2]]), 1, 5)[0]]
    for foot, radius, tip in [(0.1, 0.22, 0.5), (0.34, 0.17, 0.72), (0.58, 0.12, 1.0)]:
        profile = [[radius * 0.3, foot + 0.03], [radius, foot], [radius * 0.4, (foot + tip) / 2]]
        parts.append(wedge(np.array([*profile, [0.0, tip]]), 1, 7)[0])
    return merge(parts)


def blade(rng: np.random.Generator) -> tuple[Array, Array]:
    """A bent blade of grass."""
    x, y = rng.uniform(-0.085, 0.085, 2)
    height, width = rng.uniform(0.012, 0.034), rng.uniform(0.0009, 0.0016)
    turn, bend = rng.uniform(0, 2 * np.pi), rng.uniform(0.1, 0.6) * height
    side = np.array([-np.sin(turn), np.cos(turn), 0.0]) * width
    lean = np.array([np.cos(turn), np.sin(turn), 0.0]) * bend
    up = np.array([0.0, 0.0, height])
    foot, middle = np.array([x, y, -0.004]), np.array([x, y, 0.0]) + 0.55 * up + 0.3 * lean
    points = [foot - side, foot + side, middle - 0.8 * side, middle + 0.8 * side]
    points.append(np.array([x, y, 0.0]) + up + lean)
    return np.array(points), np.array([[0, 1, 3], [0, 3, 2], [2, 3, 4]])


def grass() -> tuple[Array, Array]:
    """A patch of grass."""
    rng = np.random.default_rng(5)
    blades = [blade(rng) for _ in range(120)]
    faces = np.vstack([faces + 5 * i for i, (_, faces) in enumerate(blades)])
    return np.vstack([points for points, _ in blades]), faces


def flowers() -> Solid:
    """The heads of five poppies, open cups at different heights."""
    rng = np.random.default_rng(12)
    profile = np.array([[0.0, -0.35], [0.45, -0.3], [0.9, 0.05], [1.0, 0.3]])
    heads = []
    for _ in range(5):
        head = wedge(profile * rng.uniform(0.006, 0.0085), 1, 8)[0]
        tilt = np.radians(rng.uniform(10, 50))
        c, s = np.cos(tilt), np.sin(tilt)
        lean = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
        head = Solid(head.vertices @ lean.T, head.faces, head.normals @ lean.T)
        place = [*rng.uniform(-0.07, 0.07, 2), rng.uniform(0.026, 0.042)]
        heads.append(moved(head, place, rng.uniform(-60, 60)))
    return merge(heads)


def hut() -> tuple[Solid, Solid]:
    """The walls and the roof of a hut of length 1."""
    walls = [[-0.33, -0.3], [0.33, -0.3], [0.33, 0.35], [0.0, 0.68], [-0.33, 0.35]]
    roof = [[-0.47, 0.27], [-0.42, 0.23], [0.0, 0.64], [0.42, 0.23], [0.47, 0.27], [0.0, 0.75]]
    return extrude(np.array(walls), 1.0, 0.01), extrude(np.array(roof), 1.16, 0.01)


def boulder() -> tuple[Array, Array]:
    """A stone of radius about 1, faceted."""
    rows, columns = np.linspace(0, np.pi, 6), np.linspace(0, 2 * np.pi, 9)
    angle, fall = columns[None], rows[:, None]
    radius = 1 + 0.16 * waves(3 * np.cos(angle), 3 * np.sin(angle) + 4 * np.cos(fall), 8)
    out = [np.sin(fall) * np.cos(angle), np.sin(fall) * np.sin(angle), np.cos(fall) + 0 * angle]
    points = (np.stack(out, -1) * radius[..., None]).reshape(-1, 3)
    return points, grid(columns, rows)[:, ::-1]


def near_spots(rng: np.random.Generator, count: int, near: float, far: float) -> Array:
    """Places on the meadow, dense in front, in and around what the camera sees."""
    y = EYE + near + (far - near) * rng.uniform(0, 1, count) ** 1.7
    x = rng.uniform(-1, 1, count) * (0.14 + 0.62 * (y - EYE))
    return np.stack([x, y, ground_height(x, y)], 1)


def put(file: str, name: str, material: str, place: Array, *steps: str) -> str:
    """The XML of one plant or stone."""
    x, y, z = np.round(place, 4)
    return mesh(f"valley_{file}.ply", name, [*steps, step("translate", x=x, y=y, z=z)], material)


def spin(rng: np.random.Generator) -> str:
    """A turn about z."""
    return step("rotate", z=1, angle=round(rng.uniform(0, 360)))


def meadow(rng: np.random.Generator) -> list[str]:
    """Grass, flowers and stones."""
    out = []
    for i, place in enumerate(near_spots(rng, 90, 0.2, 0.85)):
        size = round(rng.uniform(0.75, 1.2) * (1 + 0.5 * (place[1] - EYE)), 2)
        moves = [spin(rng), step("scale", value=size)]
        tint = ("blade", "hay", "blade", "moss")[i % 4]
        out.append(put("grass", f"grass_{i}", tint, place, *moves))
    for i, place in enumerate(near_spots(rng, 30, 0.26, 0.75)):
        colour = ("poppy", "poppy", "daisy", "cornflower")[i % 4]
        out.append(put("flowers", f"flowers_{i}", colour, place, spin(rng)))
    for i, place in enumerate(near_spots(rng, 12, 0.3, 1.0)):
        size = round(rng.uniform(0.012, 0.03) * (1 + place[1] - EYE), 4)
        moves = [step("scale", x=size, y=0.8 * size, z=0.6 * size), spin(rng)]
        out.append(put("boulder", f"boulder_{i}", "rock", place, *moves))
    return out


def village() -> list[str]:
    """Huts above the shore."""
    out = []
    for i, (x, y, turn) in enumerate([(0.3, 0.0, 25), (0.4, 0.1, 70), (-0.33, 0.16, -50)]):
        place = np.array([x, y, ground_height(np.array(x), np.array(y)) + 0.022])
        moves = [step("scale", value=0.085), step("rotate", z=1, angle=turn)]
        out.append(put("hut", f"hut_{i}", "plaster", place, *moves))
        out.append(put("roof", f"roof_{i}", "shingle", place, *moves))
    return out


def forest(rng: np.random.Generator) -> list[str]:
    """Conifers on the slopes on both sides."""
    out: list[str] = []
    while len(out) < 95:
        y = EYE + rng.uniform(0.62, 1.42)
        x = rng.uniform(-1, 1) * min(0.6 * (y - EYE) + 0.06, 0.95)
        z = float(ground_height(np.array(x), np.array(y)))
        clear = abs(x - 0.02) < 0.33 + 0.1 * float(waves(np.array(5 * x), np.array(5 * y), 9))
        if clear or z < LAKE + 0.02:
            continue
        size = round(rng.uniform(0.085, 0.15), 3)
        moves = step("scale", x=size, y=size, z=size * rng.uniform(0.9, 1.3))
        kind = "needles" if rng.uniform() < 0.6 else "light_needles"
        out.append(put("pine", f"tree_{len(out)}", kind, np.array([x, y, z - 0.01]), moves))
    points = ridge(0)[0].reshape(5, -1, 3)
    for i in range(36):
        row, column = rng.uniform(0.9, 3.95), rng.integers(len(points[0]))
        below, above = points[int(row), column], points[int(row) + 1, column]
        place = below + (row % 1) * (above - below)
        if abs(place[0]) < 0.8:
            move = step("scale", value=round(rng.uniform(0.04, 0.07), 3))
            out.append(put("pine", f"far_tree_{i}", "needles", place - [0, 0, 0.005], move))
    return out


def main() -> None:
    folder = output_folder()
    meshes = {"ground": ground(), "grass": grass(), "boulder": boulder()}
    for name, (vertices, faces) in meshes.items():
        write_ply(folder / f"valley_{name}.ply", vertices, faces)
    for number in range(3):
        points, triangles, uv = ridge(number)
        write_ply(folder / f"valley_ridge_{number}.ply", points, triangles, uv=uv)
    Image.fromarray(slopes()).resize((24, 64), 0).save(folder / "valley_slopes.png")
    walls, roof = hut()
    solids = {"pine": pine(), "flowers": flowers(), "hut": walls, "roof": roof}
    for name, solid in solids.items():
        path = folder / f"valley_{name}.ply"
        write_ply(path, solid.vertices, solid.faces, normals=solid.normals)
    rng = np.random.default_rng(2)
    lines = [*meadow(rng), *village(), *forest(rng)]
    text = fragment(lines, "Made by valley.py: what stands in forward/valley.xml.")
    (folder / "valley_plants.xml").write_text(text)


if __name__ == "__main__":
    main()
