"""The textures of unbounded/studio: parquet, rug, pictures, house fronts and the sky."""

from __future__ import annotations

import numpy as np
from geometry import Array, output_folder
from surfaces import blend, noise, rough, save


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
    streak = lines[
        (across * 63 + shift).astype(int) % size, (along * 60 + 9 * shift).astype(int) % size
    ]
    picture = blend(
        (0.50, 0.34, 0.20), (0.72, 0.54, 0.35), 0.5 + 0.27 * tone + 0.09 * grain + 0.11 * streak
    )
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
        for limit, colour in (
            (0.29, navy),
            (0.265, cream),
            (0.235, teal),
            (0.15, ochre),
            (0.11, ground),
            (0.05, cream),
        ):
            picture[d < limit] = colour
        hooks = (np.abs(d - 0.2) < 0.012) & ((x // 6 + y // 6) % 2 == 0)
        picture[hooks] = cream
    edge = np.minimum(width / 2 / height - u, 0.5 - v)
    for limit, colour in (
        (0.115, navy),
        (0.1, ochre),
        (0.088, navy),
        (0.02, cream),
        (0.01, ground),
    ):
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
    colours = np.array(
        [(0.85, 0.76, 0.55), (0.16, 0.30, 0.36), (0.72, 0.36, 0.18), (0.85, 0.76, 0.55)]
    )
    return colours[stripe] * (
        1 + 0.06 * rng.normal(size=(size, size, 1)) + 0.05 * ((x + y) % 2)[..., None]
    )


def painting(width: int = 320, height: int = 400) -> Array:
    """The unfinished picture: hills and a house in broad strokes, its margin still bare."""
    rng = np.random.default_rng(4)
    size = 400
    y, x = np.mgrid[:height, :width]
    bend = [
        3 * noise(size, (9, 9), rng)[:height, :width]
        + 2 * noise(size, (40, 14), rng)[:height, :width]
        for _ in range(2)
    ]
    u, v = (x + bend[0]) / width, (y + bend[1]) / height
    picture = blend((0.90, 0.78, 0.58), (0.38, 0.60, 0.80), 1.2 - 2.6 * v)
    picture[np.hypot(u - 0.68, v - 0.22) < 0.07] = (0.97, 0.86, 0.52)
    layers = [
        (0.40, 0.08, (0.46, 0.52, 0.66)),
        (0.52, 0.06, (0.40, 0.50, 0.42)),
        (0.62, 0.05, (0.58, 0.56, 0.28)),
        (0.76, 0.04, (0.30, 0.42, 0.24)),
        (0.88, 0.03, (0.62, 0.36, 0.2)),
    ]
    for k, (level, swing, colour) in enumerate(layers):
        line = level + swing * np.sin(5 * u + 2.1 * k) + 0.4 * swing * np.sin(13 * u + k)
        picture[v > line] = colour
    wall = (np.abs(u - 0.34) < 0.085) & (np.abs(v - 0.61) < 0.05)
    roof = (np.abs(u - 0.34) < 0.11 - (0.58 - v) * 1.2) & (v < 0.575) & (v > 0.5)
    picture[wall], picture[roof] = (0.92, 0.88, 0.78), (0.72, 0.28, 0.18)
    for k in range(5):
        at = 0.55 + 0.08 * k
        picture[np.hypot((u - at) * 3.2, v - 0.62 - 0.02 * (k % 2)) < 0.075] = (0.16, 0.28, 0.18)
    strokes = (
        0.05 * noise(size, (60, 9), rng)[:height, :width]
        + 0.05 * noise(size, (14, 50), rng)[:height, :width]
    )
    picture = picture * (1 + strokes[..., None])
    margin = (
        np.minimum(np.minimum(u, 1 - u), np.minimum(v, 1 - v)) * 12
        + 0.5 * noise(size, (16, 16), rng)[:height, :width]
    )
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
        for cx, cy, r, colour in [
            (0.36, 0.55, 0.12, (0.78, 0.22, 0.12)),
            (0.54, 0.5, 0.13, (0.86, 0.60, 0.16)),
            (0.68, 0.57, 0.1, (0.52, 0.60, 0.20)),
            (0.47, 0.38, 0.11, (0.84, 0.42, 0.14)),
        ]:
            d = np.hypot(x - cx + bend, y - cy)
            lit = np.clip(1 - np.hypot(x - cx + 0.4 * r, y - cy + 0.45 * r) / (1.6 * r), 0, 1)
            picture = np.where(
                (d < r)[..., None], np.array(colour) * (0.45 + 0.8 * lit[..., None]), picture
            )
        bowl = (y > 0.6) & (np.hypot((x - 0.5) / 1.5, y - 0.58) < 0.21)
        picture = np.where(
            bowl[..., None], np.array((0.36, 0.48, 0.60)) * (1.2 - x[..., None]), picture
        )
    elif number == 1:  # a wave in ink
        picture = np.broadcast_to((0.90, 0.86, 0.76), (size, size, 3)).copy()
        for k in range(9):
            line = 0.3 + 0.075 * k + 0.07 * np.sin(7 * x + 0.7 * k + 4 * bend) * (1 - 0.07 * k)
            picture[np.abs(y - line) < 0.009 + 0.004 * np.sin(9 * x + k)] = (0.10, 0.16, 0.28)
        picture[np.hypot(x - 0.7, y - 0.17) < 0.075] = (0.72, 0.18, 0.12)
    elif number == 2:  # blocks of colour
        colours = np.array(
            [
                (0.84, 0.70, 0.30),
                (0.20, 0.34, 0.50),
                (0.74, 0.30, 0.20),
                (0.90, 0.86, 0.78),
                (0.26, 0.44, 0.38),
            ]
        )
        column, row = (x * 5 + 2 * bend).astype(int), (y * 4 + 2 * bend).astype(int)
        picture = colours[rng.integers(0, 5, (6, 6))[row.clip(0, 5), column.clip(0, 5)]]
        picture = picture * (1 + 0.05 * rough(size, 8, 4, rng)[..., None])
    else:  # the harbour at dusk
        picture = blend((0.92, 0.58, 0.34), (0.26, 0.30, 0.48), 1.3 - 2.4 * y + 5 * bend)
        water = y > 0.58
        glitter = noise(size, (46, 7), rng) > 0.75
        sea = blend((0.30, 0.32, 0.44), (0.16, 0.20, 0.32), 2.4 * (y - 0.58))
        picture = np.where(
            water[..., None], np.where(glitter[..., None], (0.90, 0.62, 0.42), sea), picture
        )
        for k in range(4):
            at = 0.16 + 0.22 * k
            picture[(np.abs(x - at) < 0.005) & (y > 0.24 + 0.05 * (k % 2)) & (y < 0.6)] = (
                0.12,
                0.10,
                0.12,
            )
            sail = (x > at) & (x - at < 0.13 * (y - 0.24) / 0.3) & (y < 0.54) & (y > 0.26)
            picture[sail] = ((0.86, 0.80, 0.68), (0.62, 0.26, 0.18))[k % 2]
            picture[
                (np.abs(x - at - 0.02) < 0.08 - (y - 0.57) * 0.8) & (y > 0.565) & (y < 0.605)
            ] = (0.18, 0.12, 0.10)
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
    shade = np.clip(
        0.25 * rough(size, 4, 4, rng) + 0.4 * np.clip(0.5 - np.hypot(x - 0.55, y - 0.5), 0, 1),
        0,
        0.35,
    )
    paper = blend((0.90, 0.86, 0.76), (0.84, 0.78, 0.66), 0.5 + 0.3 * rough(size, 3, 4, rng))
    return blend(paper, (0.16, 0.15, 0.15), np.maximum(0.9 * ink, shade))


def world_map(width: int = 320, height: int = 160) -> Array:
    """An invented earth for a small globe, with a grid."""
    rng = np.random.default_rng(40)
    y, x = np.mgrid[:height, :width]
    field = rough(width, 3, 6, rng)[:height]
    picture = np.where(
        (field > 0.25)[..., None],
        blend((0.76, 0.66, 0.42), (0.48, 0.54, 0.32), field - 0.4),
        (0.42, 0.58, 0.62),
    )
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
    bars = pane & (
        (np.abs(u - 0.5) < 0.014) | (np.abs(v - 0.37) < 0.012) | (np.abs(v - 0.57) < 0.012)
    )
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


def main() -> None:
    """Writes every picture."""
    folder = output_folder()
    pictures = {"parquet": parquet(), "rug": rug(), "weave": weave(), "painting": painting()}
    pictures |= {f"art_{k}": art(k) for k in range(4)}
    pictures |= {f"sketch_{k}": sketch(k) for k in range(3)}
    pictures |= {f"facade_{k}": facade(k) for k in range(3)}
    pictures |= {"map": world_map(), "outdoors": outdoors()}
    for name, picture in pictures.items():
        save(folder / f"studio_{name}.jpg", picture)


if __name__ == "__main__":
    main()
