"""Makes the files of realistic/kettle.xml: turned and swept parts, and three textures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from geometry import Array, chaikin, grid_faces, output_folder, refine, write_curves, write_ply
from PIL import Image

WEDGES = 10
COLUMNS = 6  # of vertices across one wedge

# Radius and height along the outside, upwards, before the corners are rounded.
PROFILES = {
    "sole": [(0.0, -0.71), (0.5, -0.71), (0.575, -0.71), (0.6, -0.70), (0.612, -0.68)],
    "copper": [
        (0.606, -0.685),
        (0.636, -0.62),
        (0.672, -0.50),
        (0.690, -0.38),
        (0.692, -0.27),
        (0.680, -0.19),
    ],
    "belt": [
        (0.672, -0.20),
        (0.694, -0.20),
        (0.703, -0.19),
        (0.703, -0.17),
        (0.694, -0.16),
        (0.668, -0.16),
    ],
    "shoulder": [
        (0.680, -0.165),
        (0.678, -0.12),
        (0.660, -0.02),
        (0.610, 0.09),
        (0.520, 0.18),
        (0.420, 0.235),
        (0.350, 0.255),
        (0.335, 0.262),
        (0.330, 0.285),
        (0.315, 0.285),
    ],
    "lid": [
        (0.322, 0.272),
        (0.336, 0.288),
        (0.336, 0.302),
        (0.322, 0.310),
        (0.300, 0.306),
        (0.285, 0.316),
        (0.200, 0.352),
        (0.100, 0.374),
        (0.050, 0.378),
    ],
    "stem": [(0.085, 0.372), (0.085, 0.384), (0.06, 0.39), (0.036, 0.40), (0.036, 0.43)],
    "knob": [
        (0.030, 0.418),
        (0.070, 0.420),
        (0.100, 0.448),
        (0.104, 0.482),
        (0.082, 0.512),
        (0.040, 0.522),
        (0.0, 0.524),
    ],
    "board": [
        (0.0, -0.90),
        (0.78, -0.90),
        (0.83, -0.885),
        (0.84, -0.85),
        (0.83, -0.81),
        (0.79, -0.80),
        (0.72, -0.80),
        (0.0, -0.80),
    ],
}
# How often the corners of a profile are cut, where it is not once.
ROUNDING = {"shoulder": 2, "knob": 2}


def write_wedge(path: Path, profile: Array) -> None:
    """Writes one wedge of a turned shape; u runs around it, v along its profile."""
    along = np.gradient(profile, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    angle = np.linspace(-np.pi / WEDGES, np.pi / WEDGES, COLUMNS)
    cosine, sine = np.cos(angle), np.sin(angle)

    def turned(radius: Array, height: Array) -> Array:
        flat = np.broadcast_to(height[:, None], (len(height), COLUMNS))
        return np.stack([radius[:, None] * cosine, radius[:, None] * sine, flat], -1).reshape(-1, 3)

    steps = np.linalg.norm(np.diff(profile, axis=0), axis=1)
    length = np.concatenate([[0], np.cumsum(steps)]) / steps.sum()
    v, u = np.meshgrid(length, np.linspace(0, 1, COLUMNS), indexing="ij")
    write_ply(
        path,
        turned(*profile.T),
        grid_faces(len(profile), COLUMNS),
        normals=turned(along[:, 1], -along[:, 0]),
        uv=np.stack([u, v], -1).reshape(-1, 2),
    )


def sweep(sections: Array, columns: int) -> tuple[Array, Array]:
    """A tube in the xz plane; sections are (x, z, half height in the plane, half width)."""
    along = np.gradient(sections[:, :2], axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    angle = 2 * np.pi * np.arange(columns) / columns
    rise, side = sections[:, 2:3] * np.cos(angle), sections[:, 3:] * np.sin(angle)
    x = sections[:, :1] - along[:, 1:] * rise
    z = sections[:, 1:2] + along[:, :1] * rise
    row, column = np.divmod(grid_faces(len(sections), columns + 1), columns + 1)
    faces = (row * columns + column % columns)[:, ::-1]
    return np.stack([x, side, z], -1).reshape(-1, 3), faces


def spout() -> Array:
    """Sections of the spout: from inside the body to the lip, and back down inside it."""
    middle = np.array(
        [
            (0.50, -0.33, 0.185, 0.165),
            (0.62, -0.29, 0.165, 0.145),
            (0.73, -0.20, 0.135, 0.120),
            (0.80, -0.07, 0.105, 0.098),
            (0.845, 0.07, 0.082, 0.080),
            (0.89, 0.17, 0.070, 0.070),
            (0.945, 0.235, 0.068, 0.068),
        ]
    )
    outside = refine(middle, 18)
    end = outside[-1]
    direction = np.array([0.76, 0.65, 0, 0])
    lip = [end + 0.012 * direction + (0, 0, 0.008, 0.008), end + 0.022 * direction]
    inside = [end + 0.014 * direction, *outside[[-2, -4, -7]]]
    return np.array([*outside, *lip, *[s - (0, 0, 0.012, 0.012) for s in inside]])


def bail(start: float, stop: float, count: int) -> Array:
    """Points of the arch of the handle, by angle in degrees from the spout's side."""
    angle = np.radians(np.linspace(start, stop, count))
    power = 2 / 2.6
    x = 0.585 * np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** power
    return np.column_stack([x, 0.12 + 0.70 * np.abs(np.sin(angle)) ** power])


def strap() -> Array:
    """Sections of the steel strap."""
    path = bail(2, 178, 27)
    width = np.interp(np.linspace(0, 1, 27), [0, 0.04, 0.1, 0.9, 0.96, 1], [0.3, 1, 1, 1, 1, 0.3])
    return np.column_stack([path, np.full(27, 0.011), 0.042 * width])


def grip() -> Array:
    """Sections of the wooden grip, swelling in four places for the fingers."""
    path = bail(50, 130, 27)
    t = np.linspace(0, 1, 27)
    swell = 0.052 + 0.0045 * np.cos(2 * np.pi * 4 * t)
    closing = np.sqrt(np.clip(1 - np.abs(2 * t - 1) ** 14, 0.0004, 1))
    return np.column_stack([path, swell * closing * 0.92, swell * closing])


def write_trivet(path: Path) -> None:
    """Writes the curves of an iron trivet: two hoops and scrolls between them."""
    curves = []
    for radius, thickness in ((0.60, 0.026), (0.26, 0.02)):
        angle = 2 * np.pi * np.arange(27) / 24
        swell = 3 / (2 + np.cos(2 * np.pi / 24))
        hoop = [radius * swell * np.cos(angle), radius * swell * np.sin(angle), 0 * angle]
        curves.append(np.column_stack([*hoop, np.full(27, thickness)]))
    t = np.linspace(0, 1, 9)
    for i in range(8):
        angle = np.pi / 4 * i + 0.9 * np.sin(np.pi * t) * (0.5 - t)
        radius = 0.25 + 0.36 * t
        bar = [radius * np.cos(angle), radius * np.sin(angle), 0 * t]
        curves.append(np.column_stack([*bar, np.full(9, 0.018)]))
    write_curves(path, curves)


def hammer_marks(size: int, marks: int) -> Image.Image:
    """A tile of shallow dimples that meet in ridges, as heights."""
    stream = np.random.default_rng(3)
    grid = np.stack(np.mgrid[0:marks, 0:marks], -1).reshape(-1, 2)
    spots = (grid + 0.5 + stream.uniform(-0.36, 0.36, grid.shape)) / marks
    spots[:, 0] += 0.5 / marks * (grid[:, 1] % 2)
    depth = stream.uniform(-0.25, 0.25, len(spots))
    place = (np.stack(np.mgrid[0:size, 0:size], -1) + 0.5) / size
    offset = place[:, :, None] - spots
    offset -= np.round(offset)
    bowls = (offset**2).sum(-1) * marks**2 + depth
    # A soft minimum rounds the ridges.
    height = -np.log(np.exp(-14 * bowls).sum(-1)) / 14
    height = (height - height.min()) / np.ptp(height)
    return Image.fromarray((255 * height).astype(np.uint8))


def lathe_marks(size: int) -> Image.Image:
    """Brightness along the profile of brushed parts: fine grooves."""
    stream = np.random.default_rng(5)
    fine = stream.normal(size=size)
    coarse = np.convolve(stream.normal(size=size + 6), np.ones(7) / 7, mode="valid")
    line = np.clip(0.88 + 0.045 * fine + 0.06 * coarse, 0, 1)
    return Image.fromarray((255 * line).astype(np.uint8)[:, None].repeat(4, 1))


def wood(size: int) -> Image.Image:
    """Straight grain of oak, seen from above."""
    stream = np.random.default_rng(11)
    y, x = np.mgrid[0:size, 0:size] / size
    bend = 0.05 * np.sin(2 * np.pi * (x * 0.8 + 0.1)) + 0.02 * np.sin(2 * np.pi * (2.3 * x + y))
    rings = (y + bend) * 9
    grain = 0.5 + 0.5 * np.cos(2 * np.pi * (rings + 0.35 * np.sin(2 * np.pi * rings * 0.37)))
    fibres = stream.normal(size=(size, size // 16 + 2))
    stretched = np.stack(
        [np.interp(np.arange(size), 16 * np.arange(row.size), row) for row in fibres]
    )
    tone = np.clip(0.55 * grain**1.5 + 0.16 * stretched + 0.2, 0, 1)[..., None]
    light, dark = np.array([0.74, 0.55, 0.35]), np.array([0.46, 0.29, 0.15])
    picture = light * (1 - tone) + dark * tone
    image = Image.fromarray((255 * np.clip(picture, 0, 1)).astype(np.uint8))
    return image.quantize(48, dither=Image.Dither.NONE)


def studio(width: int) -> Image.Image:
    """A dim studio: dark floor, pale ceiling, and soft cards on the walls."""
    v, u = np.mgrid[0 : width // 2, 0:width] + 0.5
    azimuth, height = u / width * 360, 90 - v / width * 360
    level = np.interp(height, [-90, -15, 0, 12, 90], [0.10, 0.13, 0.2, 0.28, 0.42])
    picture = level[..., None] * np.array([0.97, 1.0, 1.05])
    cards = [(60, 34, 24, 26, 0.45), (200, 15, 12, 40, 0.5), (300, 25, 30, 14, 0.35)]
    for where, middle, half_width, half_height, strength in cards:
        across = np.abs((azimuth - where + 180) % 360 - 180) / half_width
        card = np.exp(-(across**6) - (np.abs(height - middle) / half_height) ** 6)
        picture += strength * card[..., None]
    encoded = np.clip(picture, 0, 1) ** (1 / 2.2)
    return Image.fromarray((255 * encoded).astype(np.uint8))


def main() -> None:
    """Writes every file of the scene."""
    folder = output_folder()
    for name, profile in PROFILES.items():
        points = chaikin(np.array(profile), ROUNDING.get(name, 1))
        write_wedge(folder / f"kettle_{name}.ply", points)
    write_ply(folder / "kettle_spout.ply", *sweep(spout(), 20))
    write_ply(folder / "kettle_strap.ply", *sweep(strap(), 8))
    write_ply(folder / "kettle_grip.ply", *sweep(grip(), 12))
    write_trivet(folder / "kettle_trivet.txt")
    hammer_marks(112, 7).save(folder / "kettle_hammered.png", optimize=True)
    lathe_marks(256).save(folder / "kettle_brushed.png", optimize=True)
    wood(128).save(folder / "kettle_wood.png", optimize=True)
    studio(96).save(folder / "kettle_studio.png", optimize=True)


if __name__ == "__main__":
    main()
