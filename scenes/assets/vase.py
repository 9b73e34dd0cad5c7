"""The thrown ceramics of the scene diffuse/vase, and the painting of the vase."""

from __future__ import annotations

import numpy as np
from geometry import Array, output_folder, write_curves, write_ply
from PIL import Image
from solids import arc, spline, wedge

PARTS = 8  # The painting repeats this often around the vase
WIDTH, HEIGHT = 160, 896
BELLY = 2 * np.pi * 0.44 / PARTS  # The width of one repeat where the vase is widest
CLAY, CREAM, BLACK, COBALT, OCHRE = range(5)
COLOURS = [(196, 104, 62), (236, 219, 186), (46, 36, 34), (42, 78, 132), (222, 158, 66)]


def vase() -> Array:
    """Profile of the outside, from the middle of the foot to the lip."""
    foot = [(0.0, -0.66), (0.2, -0.66), (0.215, -0.645), (0.21, -0.61)]
    points = [(0.165, -0.575), (0.27, -0.44), (0.4, -0.2), (0.44, 0.02), (0.39, 0.24)]
    points += [(0.25, 0.42), (0.145, 0.54), (0.13, 0.66), (0.165, 0.76), (0.225, 0.805)]
    return np.vstack([foot, spline(points, 3), [[0.237, 0.817], [0.232, 0.83]]])


def inside() -> Array:
    """Profile of the inside of the vase, from the lip down."""
    points = [(0.232, 0.83), (0.215, 0.828), (0.15, 0.765), (0.11, 0.66), (0.125, 0.54)]
    points += [(0.23, 0.41), (0.36, 0.22), (0.4, 0.02), (0.3, -0.3), (0.0, -0.42)]
    return np.array(points)


def bowl() -> Array:
    """Profile of the bowl, outside and inside."""
    outer = spline([(0.13, -0.6), (0.22, -0.56), (0.29, -0.47), (0.315, -0.37)], 3)
    inner = spline([(0.295, -0.37), (0.265, -0.47), (0.19, -0.55), (0.0, -0.575)], 3)
    foot = [(0.0, -0.66), (0.125, -0.66), (0.13, -0.65)]
    return np.vstack([foot, outer, [[0.308, -0.362]], inner])


def cup() -> Array:
    """Profile of the beaker, outside and inside."""
    outer = spline([(0.11, -0.65), (0.14, -0.55), (0.135, -0.44), (0.12, -0.34)], 3)
    inner = spline([(0.104, -0.34), (0.118, -0.44), (0.12, -0.55), (0.0, -0.6)], 3)
    return np.vstack([[[0.0, -0.66], [0.1, -0.66]], outer, [[0.112, -0.334]], inner])


def plinth() -> Array:
    """Profile of the round board under everything."""
    rim = arc(0.03, -90, 90, 7) + [0.83, -0.69]
    return np.vstack([[[0.0, -0.72]], rim, [[0.0, -0.66]]])


def handle() -> Array:
    """Control points of a handle: its place and thickness."""
    points = [(0.1, 0, 0.63), (0.125, 0, 0.64), (0.22, 0, 0.685), (0.335, 0, 0.64)]
    points += [(0.385, 0, 0.52), (0.375, 0, 0.38), (0.34, 0, 0.3), (0.29, 0, 0.24)]
    radius = np.array([0.03, 0.03, 0.026, 0.026, 0.026, 0.027, 0.033, 0.033])
    return np.hstack([np.array(points), radius[:, None]])


def lemon() -> Array:
    """Control points along a lemon, from tip to tip: place and thickness."""
    x = np.array([-1.5, -1.45, -1.38, -1.25, -0.95, -0.5, 0, 0.5, 0.95, 1.22, 1.32, 1.38, 1.4])
    r = np.array([0.0, 0.06, 0.2, 0.24, 0.62, 1.0, 1.15, 1.0, 0.62, 0.26, 0.16, 0.08, 0.0])
    return 0.1 * np.stack([x, 0 * x, 0 * x, r], 1)


def meander(x: Array, y: Array) -> Array:
    """A running key in a band with y from 0 to 1 and x from 0 to 2 (two keys)."""
    key = ["#######", "......#", ".####.#", ".#..#.#", ".#.##.#", ".#....#", "##....#"]
    grid = np.array([[letter == "#" for letter in row] for row in key])[::-1]
    column = (x % 1 * 7).astype(int).clip(0, 6)
    return grid[(y * 7).astype(int).clip(0, 6), column]


def leaf(x: Array, y: Array) -> Array:
    """A pointed leaf that stands on y = 0 and ends at y = 1, |x| at most 0.5."""
    return np.abs(x) < 0.42 * np.sin(np.pi * y.clip(0, 1) ** 0.75) * (1 - 0.35 * y)


def frieze(x: Array, y: Array) -> Array:
    """The main band: a palmette over a spiral wave; x from -0.5 to 0.5, y from 0 to 1.4."""
    paint = np.full(x.shape, CREAM)
    foot = y - 0.34
    for turn in (-78, -52, -26, 0, 26, 52, 78):
        c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        along, across = c * foot + s * x, c * x - s * foot
        size = 0.44 + 0.56 * c * c
        petal = leaf(across / size * 2.6, (along - 0.1) / (size - 0.1))
        vein = np.abs(across) < 0.012
        paint[petal] = COBALT if turn % 52 == 0 else CLAY
        paint[petal & vein & (along < size * 0.72)] = CREAM
    heart = np.hypot(x, foot)
    paint[heart < 0.13] = BLACK
    paint[heart < 0.085] = OCHRE
    for side in (-0.5, 0.5):
        dx, dy = x - side, y - 0.3
        r, angle = np.hypot(dx, dy), np.arctan2(dy, dx * np.sign(side)) / (2 * np.pi)
        coil = ((r / 0.085 - angle) % 1 < 0.45) & (r < 0.22)
        paint[coil] = BLACK
        bud = leaf(dx * 3.4, (y - 0.62) / 0.6)
        paint[bud] = OCHRE
        paint[bud & (np.abs(dx) < 0.014)] = CLAY
        for up in (0.56, 1.3):
            paint[np.hypot(dx, y - up) < 0.035] = BLACK
    paint[y < 0.035] = BLACK
    return paint


def painting(length: float) -> Array:
    """The colours of one repeat; ``length`` is that of the profile."""
    x = (np.arange(WIDTH) + 0.5)[None] / WIDTH + np.zeros((HEIGHT, 1))
    s = (HEIGHT - np.arange(HEIGHT) - 0.5)[:, None] / HEIGHT * length + np.zeros((1, WIDTH))
    paint = np.full(x.shape, CLAY)

    def band(start: float, stop: float) -> tuple[Array, Array]:
        return (s >= start) & (s < stop), (s - start) / (stop - start)

    def fill(start: float, stop: float, colour: int) -> None:
        paint[band(start, stop)[0]] = colour

    fill(0.255, 0.275, BLACK)
    where, y = band(0.33, 0.6)
    rays = np.abs((x * 2) % 1 - 0.5) < 0.4 * (1 - y)
    paint[where & rays] = BLACK
    fill(0.6, 0.612, BLACK)
    fill(0.622, 0.64, CREAM)
    where, y = band(0.64, 0.7)
    paint[where] = np.where((x * 4 + y) % 1 < 0.5, COBALT, CREAM)[where]
    fill(0.7, 0.718, CREAM)
    fill(0.718, 0.735, BLACK)
    where, _ = band(0.735, 1.235)
    paint[where] = frieze(x - 0.5, (s - 0.735) / BELLY)[where]
    fill(1.235, 1.252, BLACK)
    where, y = band(1.262, 1.345)
    paint[where] = np.where(meander(x * 2, y), BLACK, CREAM)[where]
    fill(1.355, 1.367, BLACK)
    where, y = band(1.4, 1.55)
    paint[where & leaf((x * 2) % 1 - 0.5, y)] = BLACK
    paint[where & leaf(((x * 2) % 1 - 0.5) * 1.9, y * 1.25)] = OCHRE
    fill(1.575, 1.59, CREAM)
    fill(1.6, 1.606, BLACK)
    fill(1.82, 3.0, BLACK)
    return paint.astype(np.uint8)


def main() -> None:
    folder = output_folder()
    profiles = {"body": vase(), "inside": inside(), "bowl": bowl(), "cup": cup()}
    for name, profile in {**profiles, "board": plinth()}.items():
        steps = {"body": 5, "board": 8}.get(name, 3)
        solid, uv = wedge(profile, PARTS, steps)
        path = folder / f"vase_{name}.ply"
        uv = uv * [1, -1] + [0, 1]  # Pictures begin at the top
        write_ply(path, solid.vertices, solid.faces, normals=solid.normals, uv=uv)
    length = float(np.linalg.norm(np.diff(profiles["body"], axis=0), axis=1).sum())
    picture = Image.fromarray(painting(length), "P")
    picture.putpalette([value for colour in COLOURS for value in colour])
    picture.save(folder / "vase_painting.png", optimize=True)
    write_curves(folder / "vase_handle.txt", [handle()])
    write_curves(folder / "vase_lemon.txt", [lemon()])


if __name__ == "__main__":
    main()
