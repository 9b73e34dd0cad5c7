"""The textures of unbounded/courtyard: paving, plaster, stone, tiles, fields and the sky."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from geometry import Array, output_folder
from surfaces import blend, cells, noise, rough, save


def paving(size: int = 512) -> Array:
    """Cobbles in frames of slabs; the picture repeats every 2.4 metres."""
    rng = np.random.default_rng(1)
    count = 25
    column, row = np.meshgrid(np.arange(count), np.arange(count))
    points = np.stack([(column + 0.5 * (row % 2)) / count, (row + 0.5) / count], -1).reshape(-1, 2)
    points = (points + rng.normal(0, 0.0065, points.shape)) % 1
    number, edge = cells(size, points)
    tones = np.array(
        [(0.56, 0.50, 0.44), (0.47, 0.43, 0.40), (0.63, 0.57, 0.49), (0.55, 0.45, 0.40)]
    )
    stone = tones[rng.integers(0, 4, len(points))] + rng.normal(0, 0.03, (len(points), 1))
    stone = stone[number] + 0.025 * rough(size, 30, 3, rng)[..., None]
    picture = blend((0.30, 0.27, 0.22), stone, (edge - 0.004) / 0.006)
    y, x = (np.mgrid[:size, :size] + 0.5) / size * 2.4
    slab = (0.66, 0.61, 0.53) + 0.02 * rough(size, 6, 5, rng)[..., None]
    for along, across in ((x, y), (y, x)):
        part = np.floor(along / 0.8).astype(int)
        shade = np.array([0.0, 0.035, -0.03])[part % 3][..., None]
        joint = np.minimum((along % 0.8), 0.8 - along % 0.8)
        joint = np.minimum(joint, np.minimum(across, np.abs(across - 0.36)))
        inside = across < 0.36
        framed = blend((0.33, 0.29, 0.24), slab + shade, (joint - 0.004) / 0.006)
        picture = np.where(inside[..., None], framed, picture)
    return picture


def plaster(base: Sequence[float], seed: int, size: int = 320) -> Array:
    """Old plaster with stains, patches and hair cracks; repeats every 3 metres."""
    rng = np.random.default_rng(seed)
    picture = np.asarray(base) * (1 + 0.045 * rough(size, 3, 6, rng)[..., None])
    pale = np.clip(rough(size, 4, 4, rng) - 0.9, 0, 1)
    picture = blend(picture, np.minimum(np.asarray(base) * 1.22, 0.93), 0.8 * pale)
    streaks = np.clip(
        noise(size, (2.0, 26), rng) * 0.5 + 0.5 * noise(size, (1.5, 9), rng) - 0.55, 0, 1
    )
    picture = blend(picture, np.asarray(base) * 0.72, 0.55 * streaks)
    line = np.abs(noise(size, (6, 6), rng) + 0.35 * noise(size, (24, 24), rng))
    crack = (line < 0.035) & (noise(size, (4, 4), rng) > 1.1)
    return np.where(crack[..., None], picture * 0.74, picture)


def stone(size: int = 256) -> Array:
    """Travertine: bands, clouds and pits; repeats every metre."""
    rng = np.random.default_rng(8)
    bands = noise(size, (14, 1.2), rng) + 0.7 * noise(size, (38, 3), rng)
    picture = blend((0.73, 0.68, 0.58), (0.84, 0.80, 0.72), 0.5 + 0.3 * bands)
    picture = picture * (1 + 0.03 * rough(size, 4, 5, rng)[..., None])
    pits = np.clip(noise(size, (42, 16), rng) + 0.5 * bands - 1.9, 0, 1)
    return blend(picture, (0.42, 0.37, 0.29), 1.2 * pits)


def azulejo(size: int = 288) -> Array:
    """Four painted tiles with a star, leaves and a frame, and the glaze's small faults."""
    rng = np.random.default_rng(9)
    y, x = (np.mgrid[:size, :size] + 0.5) / size * 2
    u, v = np.abs(x % 1 - 0.5), np.abs(y % 1 - 0.5)
    r, a = np.hypot(u, v), np.arctan2(v, u)
    white, blue, pale, yellow = (
        (0.88, 0.88, 0.84),
        (0.09, 0.20, 0.50),
        (0.45, 0.62, 0.80),
        (0.89, 0.66, 0.18),
    )
    picture = np.broadcast_to(white, (size, size, 3)).copy()

    def paint(where: Array, colour: Sequence[float]) -> None:
        picture[where] = colour

    paint(r < 0.30 + 0.075 * np.cos(8 * a), blue)
    paint(r < 0.25 + 0.07 * np.cos(8 * a), pale)
    paint(r < 0.13 + 0.03 * np.cos(8 * a + np.pi), yellow)
    paint(r < 0.05, blue)
    corner = np.hypot(0.5 - u, 0.5 - v)
    paint((corner < 0.24) & (corner > 0.2), blue)
    paint(corner < 0.15, yellow)
    paint(corner < 0.085, blue)
    stem = np.abs(u - v) < 0.018
    paint(stem & (r > 0.3) & (corner > 0.24), blue)
    leaf = np.hypot((u - v) * 3.2, u + v - 0.62) < 0.09
    paint(leaf, blue)
    edge = np.maximum(u, v)
    paint((edge > 0.46) & (edge < 0.472), blue)
    tint = np.array([0.0, 0.02, -0.025, 0.01])[(2 * (y.astype(int) % 2) + x.astype(int) % 2)]
    picture = picture + tint[..., None] + 0.012 * rough(size, 20, 3, rng)[..., None]
    return np.where((edge > 0.49)[..., None], (0.45, 0.42, 0.38), picture)


def planks(size: int = 192) -> Array:
    """Weathered boards, grain along v; repeats every metre."""
    rng = np.random.default_rng(10)
    grain = (
        noise(size, (2, 34), rng) + 0.6 * noise(size, (5, 70), rng) + 0.4 * rough(size, 4, 4, rng)
    )
    return blend((0.28, 0.19, 0.12), (0.52, 0.38, 0.25), 0.5 + 0.2 * grain)


def hours(width: int = 768, height: int = 32) -> Array:
    """The scale on the equator: hours, quarters and a line."""
    picture = np.broadcast_to((0.73, 0.58, 0.30), (height, width, 3)).copy()
    x = (np.arange(width) + 0.5) / width * 24
    y = (np.arange(height) + 0.5)[:, None] / height
    quarter, hour = np.abs((4 * x) % 1 - 0.5) > 0.42, np.abs(x % 1 - 0.5) > 0.455
    ink = (
        (quarter & (y < 0.3)) | (hour & (y < 0.55)) | (np.abs(y - 0.58) < 0.03) + 0 * x.astype(bool)
    )
    numeral = np.zeros((height, width), bool)
    for k in range(24):  # as many strokes as the hour has fives and ones, after a fashion
        strokes = "".join(["X" * (k % 12 // 10), "V" * (k % 12 % 10 // 5), "I" * (k % 5)]) or "O"
        for s, letter in enumerate(strokes):
            at = k + 0.5 + 0.11 * (s - (len(strokes) - 1) / 2)
            lean = {
                "X": np.abs(np.abs(x - at) - np.abs(y - 0.78) * 0.3),
                "I": np.abs(x - at) + 0 * y,
            }
            lean["V"] = np.abs(np.abs(x - at) - (0.92 - y) * 0.16)
            lean["O"] = np.abs(np.hypot((x - at) * 2, (y - 0.78) * 0.9) - 0.1)
            numeral |= (lean[letter] < 0.018) & (np.abs(y - 0.78) < 0.14)
    return np.where((ink | numeral)[..., None], (0.13, 0.09, 0.05), picture)


def fields(size: int = 640) -> Array:
    """The colours of the land from above, 1200 metres wide: fields, vines, woods, lanes."""
    rng = np.random.default_rng(11)
    number, edge = cells(size, rng.uniform(size=(520, 2)), 0.7)
    crops = np.array(
        [
            (0.55, 0.56, 0.28),
            (0.70, 0.62, 0.36),
            (0.42, 0.50, 0.22),
            (0.62, 0.52, 0.34),
            (0.50, 0.56, 0.30),
        ]
    )
    kind = rng.integers(0, 5, 520)[number]
    picture = crops[kind] + rng.normal(0, 0.02, (520, 1))[number]
    y, x = np.mgrid[:size, :size] + 0.5
    angle = rng.uniform(0, np.pi, 520)[number]
    rows = np.sin(2 * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / 3.1)
    picture = np.where(
        ((kind == 2) | (kind == 0))[..., None], picture * (1 + 0.16 * rows[..., None]), picture
    )
    wood = np.clip(2.5 * (rough(size, 7, 5, rng) - 0.75), 0, 1)
    picture = blend(
        picture, (0.20, 0.27, 0.13) + 0.03 * noise(size, (150, 150), rng)[..., None], wood
    )
    picture = blend((0.22, 0.29, 0.14), picture, (edge - 0.0008) / 0.0012)
    haze = np.clip(np.hypot(x - size / 2, y - size / 2) / size * 1200 / 560, 0, 1)
    return blend(
        picture * (1 + 0.04 * rough(size, 40, 3, rng)[..., None]), (0.60, 0.68, 0.72), 0.62 * haze
    )


def slopes(number: int, size: int = 192) -> Array:
    """A range of mountains, 0 the nearer: woods and gullies, in the haze at its foot."""
    rng = np.random.default_rng(12 + number)
    low, high, haze = [
        ((0.36, 0.48, 0.40), (0.56, 0.64, 0.56), (0.68, 0.75, 0.76)),
        ((0.50, 0.60, 0.68), (0.68, 0.75, 0.82), (0.76, 0.83, 0.88)),
    ][number]
    v = 1 - (np.arange(size)[:, None] + 0.5) / size
    gully = noise(size, (3, 20), rng) + 0.7 * noise(size, (12, 50), rng)
    picture = blend(low, high, v - 0.1 + 0.3 * gully)
    return blend(picture, haze, 0.85 - 1.1 * v + 0 * gully)


def sky(width: int = 1024) -> Array:
    """A summer sky with cumulus, all directions; brightest around the sun in the south-west."""
    height = width // 2
    rng = np.random.default_rng(13)
    v, u = np.mgrid[:height, :width] + 0.5
    elevation, azimuth = np.pi * (0.5 - v / height), 2 * np.pi * u / width
    way = np.stack(
        [
            np.sin(azimuth) * np.cos(elevation),
            np.cos(azimuth) * np.cos(elevation),
            np.sin(elevation),
        ],
        -1,
    )
    a, e = np.radians(215), np.radians(50)
    sun = np.clip(way @ [np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), np.sin(e)], -1, 1)
    rise = np.clip(way[..., 2], 0, 1)
    picture = blend((0.80, 0.87, 0.93), (0.30, 0.51, 0.80), (1.15 * rise) ** 0.55)
    picture = blend(picture, (0.97, 0.96, 0.92), 0.75 * np.exp(-(1 - sun) / 0.05))
    # Clouds lie in a plane far up: they crowd towards the horizon.
    x, y = (way[..., k] / (rise + 0.16) for k in (0, 1))
    size = 1024
    field = rough(size, 9, 7, rng)
    puffs = field[(x * 90).astype(int) % size, (y * 90).astype(int) % size]
    light = field[((x - 0.06) * 90).astype(int) % size, ((y - 0.05) * 90).astype(int) % size]
    amount = np.clip((puffs - 0.35) * 1.5, 0, 1) * np.clip(rise * 9, 0, 1)
    shade = np.clip(0.5 + 0.6 * (puffs - light), 0, 1)
    cloud = blend(
        (0.98, 0.97, 0.95), (0.74, 0.78, 0.84), np.clip(amount * 0.9 - 0.4 + 0.3 * shade, 0, 1)
    )
    picture = blend(picture, cloud, amount)
    return blend(picture, (0.42, 0.40, 0.30), -way[..., 2] * 8)


def main() -> None:
    """Writes every picture."""
    folder = output_folder()
    rng = np.random.default_rng(14)
    pictures = {"paving": paving(), "stone": stone(), "azulejo": azulejo(), "planks": planks()}
    pictures |= {"plaster": plaster((0.86, 0.72, 0.50), 2), "rose": plaster((0.74, 0.47, 0.36), 3)}
    pictures |= {"hours": hours(), "fields": fields(), "sky": sky()}
    pictures |= {f"slopes_{k}": slopes(k) for k in range(2)}
    pictures["stains"] = 0.5 + 0.2 * rough(160, 5, 4, rng)
    pictures["ripples"] = 0.5 + 0.17 * (noise(160, (9, 9), rng) + 0.4 * noise(160, (24, 24), rng))
    for name, picture in pictures.items():
        save(folder / f"courtyard_{name}.jpg", picture)


if __name__ == "__main__":
    main()
