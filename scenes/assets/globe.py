"""An engraved globe of an invented world: its map, its scales and the rings around it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from geometry import Array, output_folder, write_curves, write_ply
from PIL import Image, ImageDraw

WIDTH, HEIGHT, FINE = 1280, 640, 2  # lines are drawn FINE times finer, then averaged
# Letters as strokes on a grid of 4 by 6: points x, y, with y down.
STROKES = {
    "A": "06 20 46|14 34",
    "B": "00 30 42 33 03|33 45 36 06 00",
    "C": "41 30 10 01 05 16 36 45",
    "D": "00 20 42 44 26 06 00",
    "E": "40 00 06 46|03 33",
    "F": "40 00 06|03 33",
    "G": "41 30 10 01 05 16 36 45 43 23",
    "H": "00 06|40 46|03 43",
    "I": "20 26",
    "L": "00 06 46",
    "M": "06 00 23 40 46",
    "N": "06 00 46 40",
    "O": "10 30 41 45 36 16 05 01 10",
    "P": "06 00 30 41 42 33 03",
    "Q": "10 30 41 45 36 16 05 01 10|24 46",
    "R": "06 00 30 41 42 33 03|23 46",
    "S": "41 30 10 01 02 13 33 44 45 36 16 05",
    "T": "00 40|20 26",
    "U": "00 05 16 36 45 40",
    "V": "00 26 40",
    "X": "00 46|40 06",
    "Z": "00 40 06 46",
    "0": "10 30 41 45 36 16 05 01 10",
    "1": "11 20 26",
    "2": "01 10 30 41 42 06 46",
    "3": "00 40 22 33 44 45 36 16 05",
    "4": "36 30 04 44",
    "5": "40 00 02 32 43 45 36 06",
    "6": "40 10 03 05 16 36 45 44 33 03",
    "7": "00 40 16",
    "8": "10 30 41 32 12 01 10|12 03 05 16 36 45 43 32",
    "9": "43 13 02 01 10 30 41 43 36 06",
}


class Sheet:
    """A mask of lines over the map, in degrees of longitude and latitude."""

    def __init__(self, width: int = WIDTH, height: int = HEIGHT) -> None:
        self.size = width, height
        self.image = Image.new("L", (width * FINE, height * FINE))
        self.pen = ImageDraw.Draw(self.image)

    def line(self, lon: Array, lat: Array, width: int = 2) -> None:
        """A polyline that may cross the date line."""
        x = (np.unwrap(np.radians(lon)) / (2 * np.pi)) * self.size[0] * FINE
        y = (90 - np.asarray(lat)) / 180 * self.size[1] * FINE
        for shift in (-1, 0, 1):
            points = zip(x + shift * self.size[0] * FINE, y, strict=True)
            self.pen.line([(float(a), float(b)) for a, b in points], 255, width, joint="curve")

    def fill(self, lon: Array, lat: Array) -> None:
        """A small polygon, which may cross the date line."""
        x = np.unwrap(np.radians(lon)) / (2 * np.pi) * self.size[0] * FINE
        y = (90 - np.asarray(lat)) / 180 * self.size[1] * FINE
        for shift in (-1, 0, 1):
            points = zip(x + shift * self.size[0] * FINE, y, strict=True)
            self.pen.polygon([(float(a), float(b)) for a, b in points], fill=255)

    def text(self, words: str, lon: float, lat: float, height: float, **style: float) -> None:
        """Capitals centred at a place; ``gap`` between letters, ``tilt`` in degrees."""
        gap, tilt = style.get("gap", 0.5), np.radians(style.get("tilt", 0.0))
        width = int(style.get("width", 2))
        scale = height / 6
        step = scale * (4 + 6 * gap)
        start = -step * (len(words) - 1) / 2 - 2 * scale
        stretch = 1 / np.cos(np.radians(lat))
        for k, letter in enumerate(words):
            for stroke in STROKES.get(letter, "").split("|"):
                points = np.array([[int(c) for c in point] for point in stroke.split()], float)
                if len(points) == 0:
                    continue
                x = start + k * step + points[:, 0] * scale
                y = (3 - points[:, 1]) * scale
                across, up = (
                    np.cos(tilt) * x - np.sin(tilt) * y,
                    np.sin(tilt) * x + np.cos(tilt) * y,
                )
                self.line(lon + across * stretch, lat + up, width)

    def coverage(self) -> Array:
        """Between 0 and 1 at the map's resolution."""
        fine = np.asarray(self.image, float) / 255
        width, height = self.size
        return fine.reshape(height, FINE, width, FINE).mean(axis=(1, 3))


def directions() -> Array:
    """The unit vector of every texel."""
    lon = (np.arange(WIDTH) + 0.5) / WIDTH * 2 * np.pi
    lat = (0.5 - (np.arange(HEIGHT) + 0.5) / HEIGHT) * np.pi
    lon, lat = np.meshgrid(lon, lat)
    return np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)


def on_sphere(lon: float, lat: float) -> Array:
    """The unit vector of a place given in degrees."""
    a, b = np.radians([lon, lat])
    return np.array([np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)])


def noise(p: Array, rng: np.random.Generator) -> Array:
    """Smooth noise in space, about -1 to 1, with unit cells."""
    table = rng.uniform(-1, 1, (32, 32, 32))
    cell = np.floor(p).astype(int)
    t = p - cell
    t = t**3 * (t * (6 * t - 15) + 10)
    total = np.zeros(p.shape[:-1])
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, t, 1 - t), axis=-1)
        i, j, k = np.moveaxis((cell + corner) % 32, -1, 0)
        total += weight * table[i, j, k]
    return total


def fractal(p: Array, rng: np.random.Generator, octaves: int) -> Array:
    """Noise summed over octaves."""
    return sum(0.53**k * noise(p * 2.03**k + 11.7 * k, rng) for k in range(octaves))


def elevation(p: Array, rng: np.random.Generator) -> Array:
    """Above sea level where positive."""
    bend = np.stack([fractal(2.2 * p + 5 * k, rng, 3) for k in range(3)], axis=-1)
    height = fractal(1.75 * p + 0.22 * bend + 3.1, rng, 6)
    return height - 0.09 - 0.25 * p[..., 2] ** 2


def edges(classes: Array) -> Array:
    """Where a label differs from the one to the right or below."""
    found = classes != np.roll(classes, -1, axis=1)
    found[:-1] |= classes[:-1] != classes[1:]
    return found


def realms(p: Array, rng: np.random.Generator) -> Array:
    """A label for each texel: the nearest of some capitals, along a crooked way."""
    capitals = rng.normal(size=(44, 3))
    capitals /= np.linalg.norm(capitals, axis=1, keepdims=True)
    crooked = p + 0.09 * np.stack([fractal(5 * p + 9 * k, rng, 4) for k in range(3)], axis=-1)
    return np.argmax(crooked @ capitals.T, axis=-1)


def ring(lon: float, lat: float, radius: float | Array, bearing: Array) -> tuple[Array, Array]:
    """Points at some distance from a place, degrees."""
    r, b, phi = np.radians(radius), np.radians(bearing), np.radians(lat)
    up = np.arcsin(np.clip(np.sin(phi) * np.cos(r) + np.cos(phi) * np.sin(r) * np.cos(b), -1, 1))
    along = np.arctan2(np.sin(b) * np.sin(r) * np.cos(phi), np.cos(r) - np.sin(phi) * np.sin(up))
    return lon + np.degrees(along), np.degrees(up)


def graticule(sheet: Sheet) -> None:
    """Parallels and meridians, and the divided scales of the equator and the first meridian."""
    lon, lat = np.linspace(0, 360, 361), np.linspace(-80, 80, 161)
    for phi in range(-80, 81, 10):
        sheet.line(lon, np.full_like(lon, phi), 1)
    for meridian in range(0, 360, 10):
        sheet.line(np.full_like(lat, meridian), lat, 1)
    for offset in (-0.8, 0.8):
        sheet.line(lon, np.full_like(lon, offset), 2)
        for meridian in (0, 180):
            sheet.line(np.full_like(lat, meridian + offset), lat, 2)
    for k in range(0, 360, 2):
        sheet.fill(np.array([k, k + 1, k + 1, k]), np.array([-0.8, -0.8, 0.8, 0.8]))
        if k < 160:
            sheet.fill(np.array([-0.8, 0.8, 0.8, -0.8]), np.array([0, 0, 1, 1]) + k - 80)
            sheet.fill(np.array([-0.8, 0.8, 0.8, -0.8]) + 180, np.array([0, 0, 1, 1]) + k - 80)
    for tropic in (-66.5, -23.5, 23.5, 66.5):
        for start in range(0, 360, 4):
            part = np.linspace(start, start + 2.6, 4)
            sheet.line(part, np.full(4, tropic), 3)


def guilloche(sheet: Sheet, lon: float, lat: float, size: float) -> None:
    """An engine-turned rosette."""
    t = np.linspace(0, 360, 721)
    for phase in range(0, 360, 30):
        wave = np.cos(np.radians(12 * t + phase))
        sheet.line(*ring(lon, lat, size * (0.72 + 0.26 * wave), t), 1)
        sheet.line(*ring(lon, lat, size * (0.3 + 0.13 * np.cos(np.radians(7 * t + phase))), t), 1)
    for radius in (1.0, 1.05):
        sheet.line(*ring(lon, lat, size * radius, t), 2)


def compass(rays: Sheet, star: Sheet, lon: float, lat: float, size: float) -> None:
    """A compass star, and the rhumb lines that leave it."""
    for k in range(32):
        bearing = 11.25 * k
        reach = np.linspace(size, size * (6 if k % 2 == 0 else 2.5), 40)
        rays.line(*ring(lon, lat, reach, np.full(40, bearing)), 1)
    circle = np.linspace(0, 360, 181)
    for radius in (0.62, 0.68, 1.0):
        star.line(*ring(lon, lat, size * radius, circle), 2)
    for k in range(16):
        tip = size * (1.25, 0.55, 0.85, 0.55)[k % 4]
        radii = np.array([tip, 0.16 * size, 0.0])
        star.fill(*ring(lon, lat, radii, np.array([22.5 * k, 22.5 * k + 11.25, 0])))


def mountains(sheet: Sheet, height: Array, rng: np.random.Generator) -> None:
    """Molehills with a shaded side, where the land is high."""
    taken = np.zeros((1, 3))
    for _ in range(5200):
        lon, z = rng.uniform(0, 360), rng.uniform(-0.97, 0.97)
        lat = np.degrees(np.arcsin(z))
        here = height[int((90 - lat) / 180 * HEIGHT), int(lon / 360 * WIDTH)]
        if here < 0.22 + 0.12 * rng.uniform():
            continue
        place = on_sphere(lon, lat)
        if (taken @ place).max() > np.cos(np.radians(3.0)):
            continue
        taken = np.vstack([taken, place])
        size = 0.5 + 1.1 * min(here, 0.6)
        stretch = size / np.cos(np.radians(lat))
        sheet.line(lon + stretch * np.array([-1, 0, 1.1]), lat + size * np.array([0, 1.3, 0]), 2)
        sheet.line(lon + stretch * np.array([0, 0.25]), lat + size * np.array([1.3, 0.2]), 3)


def rivers(sheet: Sheet, height: Array, rng: np.random.Generator) -> None:
    """Ways downhill to the sea."""
    for _ in range(500):
        x, y = rng.uniform(0, WIDTH), rng.uniform(0.12, 0.88) * HEIGHT
        if height[int(y), int(x)] < 0.2:
            continue
        path = [(x, y)]
        heading = 0.0
        for _ in range(260):
            angles = heading + np.linspace(-1.2, 1.2, 9) if len(path) > 1 else np.arange(9) * 0.7
            ahead = np.stack([x + 4 * np.cos(angles), y + 4 * np.sin(angles)])
            values = height[
                np.clip(ahead[1], 0, HEIGHT - 1).astype(int), ahead[0].astype(int) % WIDTH
            ]
            best = int(np.argmin(values))
            heading, (x, y) = angles[best], ahead[:, best]
            path.append((x, y))
            if values[best] < 0:
                lon, y_path = np.array(path).T
                sheet.line(lon / WIDTH * 360, 90 - y_path / HEIGHT * 180, 2)
                break


COMPASSES = ((92, -45), (250, 42), (120, 3), (266, -22), (5, 25), (140, 62), (215, -50))
SEAS = (("MARE SERENUM", 3.2), ("OCEANUS", 4.6), ("SINUS RORIS", 2.6), ("MARE NOVUM", 3.0))
LANDS = ("TERRA ALTA", "NORVALIA", "ESTRELA", "ARGONIA", "CALIDRIS", "BOREALIA", "ZEPHIRA")
TOWNS = ("LIRIS", "ORBEN", "SALTA", "TIRNE", "VOLO", "ANSE", "MIRA", "PORTO", "ULM", "CERES")


def lettering(land: Sheet, sea: Sheet, height: Array, rng: np.random.Generator) -> None:
    """Names of seas, lands and towns where there is room for them."""
    taken = [(lon, lat + dy, 9.0) for lon, lat in COMPASSES for dy in (-5.0, 0.0, 5.0)]

    def settle(words: str, size: float, on_land: bool, tries: int) -> None:
        for _ in range(tries):
            lon, lat = rng.uniform(0, 360), rng.uniform(-58, 58)
            half = size * 0.6 * len(words) / np.cos(np.radians(lat))
            columns = (np.linspace(lon - half, lon + half, 9) / 360 * WIDTH).astype(int) % WIDTH
            values = height[int((90 - lat) / 180 * HEIGHT), columns]
            clear = values.min() > 0.02 if on_land else values.max() < -0.03
            if (
                clear
                and abs(lat) > size + 2
                and all(
                    abs((lon - a + 180) % 360 - 180) > half + c or abs(lat - b) > 1.6 * size + 1.5
                    for a, b, c in taken
                )
            ):
                taken.append((lon, lat, half))
                sheet = land if on_land else sea
                width = 3 if size > 1.8 else 2
                sheet.text(words, lon, lat, size, gap=0.45, tilt=rng.uniform(-7, 7), width=width)
                return

    for k in range(10):
        settle(*SEAS[k % 4], False, 200)
    for k in range(13):
        settle(LANDS[k % 7], 2.2, True, 300)
    for k in range(60):
        settle(TOWNS[k % 10], 1.15, True, 60)


def paint(base: Array, colour: tuple[float, float, float], weight: Array) -> None:
    """Lays a colour over the picture."""
    base += weight[..., None] * (np.array(colour) - base)


def save(path: Path, picture: Array, colours: list[Colour]) -> None:
    """A small PNG with a palette."""
    flat = [round(255 * value) for colour in colours for value in colour]
    palette = Image.new("P", (1, 1))
    palette.putpalette(flat + flat[:3] * (256 - len(colours)))
    image = Image.fromarray((np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8))
    small = np.asarray(image.quantize(palette=palette, dither=Image.Dither.NONE)) % len(colours)
    image = Image.fromarray(small, "P")
    image.putpalette(flat)
    image.save(path, optimize=True, bits=4)


Colour = tuple[float, float, float]
SEA, SHALLOWS, CREAM, INK = (
    (0.11, 0.33, 0.43),
    (0.18, 0.44, 0.50),
    (0.95, 0.92, 0.78),
    (0.2, 0.11, 0.06),
)
RED, GOLD, HILL = (0.64, 0.17, 0.11), (0.90, 0.70, 0.32), (0.68, 0.46, 0.27)
WASHES = [(0.94, 0.82, 0.57), (0.75, 0.79, 0.55), (0.93, 0.69, 0.54), (0.96, 0.91, 0.76)]
HIGHLANDS = [tuple(0.55 * w + 0.45 * h for w, h in zip(wash, HILL, strict=True)) for wash in WASHES]
PALETTE = [SEA, SHALLOWS, CREAM, INK, RED, GOLD, *WASHES, *HIGHLANDS]
PALETTE += [(0.40, 0.57, 0.59), (0.50, 0.36, 0.22)]  # half-covered lines at sea and on land


def world_map() -> Array:
    """The printed gores, joined, as sRGB."""
    rng = np.random.default_rng(20)
    p = directions()
    height = elevation(p, rng)
    land = height > 0
    label = realms(p, rng)
    ground = np.where(
        (height > 0.30)[..., None], np.array(HIGHLANDS)[label % 4], np.array(WASHES)[label % 4]
    )
    picture = np.where(land[..., None], ground, np.array(SEA))
    paint(picture, SHALLOWS, ((height > -0.07) & ~land) * 1.0)
    lines, rhumbs, stars, ink, streams, names = (Sheet() for _ in range(6))
    graticule(lines)
    for lon, lat in COMPASSES:
        compass(rhumbs, stars, lon, lat, 6)
    guilloche(ink, 0, 89.99, 10.4)
    guilloche(ink, 0, -89.99, 10.4)
    mountains(ink, height, rng)
    rivers(streams, height, rng)
    lettering(ink, names, height, rng)
    depth = np.digitize(height, (-0.085, -0.05, -0.022))
    paint(picture, (0.62, 0.74, 0.70), (edges(depth) & ~land) * 0.55)
    paint(picture, (0.72, 0.80, 0.74), rhumbs.coverage() * ~land * 0.6)
    paint(picture, (0.86, 0.84, 0.70), lines.coverage() * ~land)
    paint(picture, (0.36, 0.22, 0.12), lines.coverage() * land * 0.8)
    paint(picture, RED, (edges(label) & land) * 0.85)
    paint(picture, SEA, streams.coverage() * land)
    paint(picture, INK, edges(land.astype(int)) * 1.0)
    paint(picture, GOLD, stars.coverage())
    paint(picture, CREAM, names.coverage())
    polar = np.abs(p[..., 2]) > np.sin(np.radians(79))
    paint(picture, WASHES[3], polar * (1 - ink.coverage()))
    paint(picture, INK, ink.coverage())
    return picture


MONTHS = (
    "IANUARIUS FEBRUARIUS MARTIUS APRILIS MAIUS IUNIUS IULIUS AUGUSTUS "
    "SEPTEMBER OCTOBER NOVEMBER DECEMBER"
)


def calendar_strip() -> Array:
    """The print of the horizon ring: degrees inside, months outside; 1 where there is ink."""
    sheet = Sheet(2048, 64)
    whole = np.linspace(0, 360, 181)
    unit = 180 / 64  # of what the sheet takes for latitude, a texel
    rows = {name: 90 - row * unit for name, row in (("a", 3), ("b", 11), ("c", 30), ("d", 60))}
    for lat in rows.values():
        sheet.line(whole, np.full_like(whole, lat), 3)
    for k in range(360):
        reach = rows["b"] - unit * (8 if k % 10 == 0 else 5 if k % 5 == 0 else 0)
        sheet.line(np.array([k, k]), np.array([rows["a"], reach]), 2 if k % 5 else 3)
        if k % 2:
            box = np.array([rows["a"], rows["a"], rows["a"] - 3 * unit, rows["a"] - 3 * unit])
            sheet.fill(np.array([k, k + 1, k + 1, k]), box)
    for k, month in enumerate(MONTHS.split()):
        draw_word(sheet, month, 30 * k + 15, 45, 17)
        sheet.line(np.array([30 * k, 30 * k]), np.array([rows["c"], rows["d"]]), 4)
    for k in range(0, 360, 10):
        draw_word(sheet, str(k % 90), k + 2.5, 23, 8)
    return sheet.coverage()


def draw_word(sheet: Sheet, word: str, lon: float, row: float, height: float) -> None:
    """Capitals on a strip, whose texels are square on the ring; heights in texels."""
    unit = 180 / sheet.size[1]
    across = 360 / sheet.size[0]
    for k, letter in enumerate(word):
        left = (k - len(word) / 2) * height * 0.95
        for stroke in STROKES.get(letter, "").split("|"):
            if stroke:
                points = np.array([[int(c) for c in point] for point in stroke.split()], float)
                x = lon + (left + points[:, 0] / 6 * height) * across
                sheet.line(x, 90 - (row + (points[:, 1] / 6 - 0.5) * height) * unit, 3)


def write_annulus(path: Path, inner: float, segments: int) -> None:
    """A flat ring of outer radius 1 with u along it and v from inside to outside."""
    turn = np.linspace(0, 1, segments + 1)
    circle = np.stack([np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn), 0 * turn], axis=1)
    uv = np.stack([np.tile(turn, 2), np.repeat([1.0, 0.0], segments + 1)], axis=1)
    k = np.arange(segments)
    low = k + segments + 1
    faces = np.concatenate([np.stack([k, k + 1, low], 1), np.stack([k + 1, low + 1, low], 1)])
    write_ply(path, np.concatenate([circle, inner * circle]), faces, uv=uv)


def write_cradle(path: Path, radius: float) -> None:
    """Four arcs from the horizon ring to the bottom, as B-splines."""
    arcs = []
    for azimuth in np.radians((45, 135, 225, 315)):
        down = np.radians(np.linspace(-8, 93, 16))
        flat = radius * np.cos(down)
        arc = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), -radius * np.sin(down)], 1)
        thick = 0.013 + 0.009 * np.sin(np.clip(down, 0, np.pi / 2) * 2) ** 2
        arcs.append(np.column_stack([arc, thick]))
    write_curves(path, arcs)


def write_ring_sector(path: Path, inner: float, outer: float, segments: int) -> None:
    """An eighth of a bevelled ring; its height is 1, its bevel a little of its width."""
    edge = 0.006
    profile = np.array(
        [
            [inner + edge, -0.5, 0, -1],
            [outer - edge, -0.5, 0, -1],
            [outer, -0.36, 1, 0],
            [outer, 0.36, 1, 0],
            [outer - edge, 0.5, 0, 1],
            [inner + edge, 0.5, 0, 1],
            [inner, 0.36, -1, 0],
            [inner, -0.36, -1, 0],
        ]
    )
    angle = np.linspace(0, np.pi / 4, segments + 1)[:, None]
    r, z, nr, nz = profile.T
    vertices = np.stack([r * np.cos(angle), r * np.sin(angle), z + 0 * angle], axis=-1)
    normals = np.stack([nr * np.cos(angle), nr * np.sin(angle), nz + 0 * angle], axis=-1)
    quad = np.array([(k, (k + 1) % 8) for k in range(8)])
    a = (quad[None] + 8 * np.arange(segments)[:, None, None]).reshape(-1, 2)
    faces = np.concatenate(
        [
            np.stack([a[:, 0], a[:, 0] + 8, a[:, 1]], 1),
            np.stack([a[:, 1], a[:, 0] + 8, a[:, 1] + 8], 1),
        ]
    )
    write_ply(path, vertices.reshape(-1, 3), faces[:, ::-1], normals=normals.reshape(-1, 3))


PAPER = (0.90, 0.82, 0.64)


def shades(ground: Colour) -> list[Colour]:
    """Four steps from ink to the ground."""
    steps = np.linspace(INK, ground, 4)
    return [(float(r), float(g), float(b)) for r, g, b in steps]


def main() -> None:
    folder = output_folder()
    save(folder / "globe_map.png", world_map(), PALETTE)
    strip = calendar_strip()
    paper = np.ones((*strip.shape, 3)) * PAPER
    paint(paper, INK, strip)
    save(folder / "globe_calendar.png", paper, shades(PAPER))
    write_cradle(folder / "globe_cradle.txt", 0.9)
    write_annulus(folder / "globe_annulus.ply", 0.88, 96)
    write_ring_sector(folder / "globe_ring.ply", 0.87, 1.01, 12)


if __name__ == "__main__":
    main()
