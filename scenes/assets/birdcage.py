"""Makes the files of realistic/birdcage.xml: wires, filigree, tray, birds and seeds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from geometry import Array, chaikin, grid_faces, output_folder, refine, write_curves, write_ply
from PIL import Image

WIRES = 40
RADIUS = 0.6
FLOOR = -0.79
SHOULDER = 0.16
WEDGES = 10
REPEATS = 10  # of the filigree around the cage
DOOR_HALF_WIDTH = 2.5 * 2 * np.pi / WIRES
DOOR_BOTTOM, DOOR_TOP = -0.47, -0.02

# Radius and height of the wires of the dome, an ogee.
DOME = np.array(
    [
        (0.600, 0.100),
        (0.602, 0.160),
        (0.624, 0.220),
        (0.642, 0.290),
        (0.618, 0.370),
        (0.528, 0.455),
        (0.384, 0.515),
        (0.246, 0.560),
        (0.150, 0.620),
        (0.079, 0.690),
        (0.047, 0.760),
    ]
)


def around(angle: Array | float, radius: Array | float, height: Array | float) -> Array:
    """Points from cylindrical coordinates."""
    angle, radius, height = np.broadcast_arrays(angle, radius, height)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], -1)


def dome_radius(height: Array) -> Array:
    """Radius of the cage at a height."""
    return np.where(
        height < DOME[0, 1], RADIUS, np.interp(height, DOME[:, 1], DOME[:, 0], right=0.04)
    )


def with_radius(curves: list[Array], radius: float) -> list[Array]:
    """The same curves, of one radius."""
    return [np.column_stack([curve, np.full(len(curve), radius)]) for curve in curves]


def clamped(points: Array) -> Array:
    """Adds points near and beyond either end, so that the B-spline begins and ends there.

    Repeated end points would do so too, but the tangent vanishes there.
    """
    points = np.asarray(points, float)
    first, last = 0.1 * (points[1] - points[0]), 0.1 * (points[-2] - points[-1])
    before = [points[0] - first, points[0], points[0] + first]
    return np.array([*before, *points[1:-1], points[-1] + last, points[-1], points[-1] - last])


def ring(radius: float, height: float, points: int = 20) -> Array:
    """Control points of a closed circle around the z axis."""
    swell = 3 / (2 + np.cos(2 * np.pi / points))
    angle = 2 * np.pi * np.arange(points + 3) / points
    return around(angle, radius * swell, height)


def wires() -> list[Array]:
    """The bars of the cage; those in front leave room for the door."""
    curves = []
    for i in range(WIRES):
        angle = 2 * np.pi * (i + 0.5) / WIRES
        bottom = FLOOR
        offset = (angle + np.pi) % (2 * np.pi) - np.pi
        if abs(offset) < DOOR_HALF_WIDTH - 0.01:
            low = np.linspace(FLOOR, DOOR_BOTTOM, 4)
            curves.append(clamped(around(angle, RADIUS, low)))
            bottom = DOOR_TOP + 0.09 * np.sqrt(1 - (offset / DOOR_HALF_WIDTH) ** 2)
        straight = around(angle, RADIUS, np.linspace(bottom, 0.04, 3))
        dome = DOME if i % 2 else DOME[:-2]
        curves.append(clamped(np.concatenate([straight, around(angle, *dome.T)])))
    return curves


def rings() -> list[Array]:
    """Hoops of the cage and the frame of the doorway."""
    heights = [FLOOR + 0.02, -0.655, SHOULDER - 0.1, SHOULDER]
    hoops = [ring(float(dome_radius(np.array(z))), z) for z in heights]
    hoops += [ring(0.39, 0.513, 16), ring(0.152, 0.618, 12)]
    across = np.linspace(-1, 1, 9) * DOOR_HALF_WIDTH
    arch = around(across, RADIUS, DOOR_TOP + 0.09 * np.sqrt(1 - np.linspace(-1, 1, 9) ** 2))
    side = np.linspace(DOOR_BOTTOM, DOOR_TOP, 4)
    left, right = (around(s * DOOR_HALF_WIDTH, RADIUS, side) for s in (-1, 1))
    sill = around(across, RADIUS, DOOR_BOTTOM)
    return [*hoops, clamped(np.concatenate([left, arch, right[::-1]])), clamped(sill)]


def on_cage(angle: Array, height: Array) -> Array:
    """Points just outside the wires."""
    return around(angle, dome_radius(height) + 0.008, height)


def volute(turns: float, points: int) -> Array:
    """A spiral from its rim at (1, 0) inwards, in the plane."""
    t = np.linspace(0, 1, points)
    radius = 1 - 0.82 * t
    return np.column_stack(
        [radius * np.cos(2 * np.pi * turns * t), radius * np.sin(2 * np.pi * turns * t)]
    )


def filigree() -> list[Array]:
    """One tenth of the arches at the foot and the shoulder and the hearts on the dome."""
    curves = []
    step = 2 * np.pi / WIRES
    t = np.linspace(0, np.pi, 7)
    loop = 2 * np.pi * np.arange(12) / 9
    for i in range(WIRES // REPEATS):
        angle = (i + 0.5 + 2 * t / np.pi) * step
        curves.append(clamped(on_cage(angle, FLOOR + 0.03 + 0.1 * np.sin(t))))
        curves.append(clamped(on_cage(angle, SHOULDER - 0.1 - 0.085 * np.sin(t))))
        ring_angle = (i + 1) * step + 0.075 * np.cos(loop)
        curves.append(on_cage(ring_angle, SHOULDER - 0.05 + 0.045 * np.sin(loop)))
    for side in (-1, 1):
        low, high = 0.055 * volute(1.6, 15), 0.034 * volute(1.4, 12)
        angle = np.concatenate([(0.12 - low[::-1, 0]), [0.17], 0.075 + high[:, 0] * 1.2])
        height = np.concatenate([0.24 + low[::-1, 1], [0.29], 0.385 + high[:, 1]])
        curves.append(clamped(on_cage(0.5 * step + side * 1.3 * angle, height)))
    return curves


def beads() -> list[Array]:
    """One tenth of the drops below the shoulder."""
    step = 2 * np.pi / WIRES
    profile = np.array([0.0, 0.0, 0.011, 0.013, 0.008, 0.0, 0.0])
    rise = np.array([-0.02, -0.016, -0.009, 0.0, 0.009, 0.018, 0.02])
    drops = []
    for i in range(WIRES // REPEATS):
        spot = on_cage(np.full(7, (i + 1.5) * step), SHOULDER - 0.2 + rise)
        drops.append(np.column_stack([spot, profile]))
    return drops


def door() -> list[Array]:
    """The door, open, hinged at its left edge: local x from the hinge, local z up."""
    width = 2 * RADIUS * np.sin(DOOR_HALF_WIDTH)
    across = np.linspace(0, width, 9)
    arch = DOOR_TOP + 0.09 * np.sqrt(np.clip(1 - (2 * across / width - 1) ** 2, 0, 1))
    height = np.linspace(DOOR_BOTTOM, DOOR_TOP, 4)
    outline = [(0, z) for z in height] + list(zip(across, arch, strict=True))
    outline += [(width, z) for z in height[::-1]]
    lines = [clamped(outline), clamped([(x, DOOR_BOTTOM) for x in (0, width / 2, width)])]
    for x in np.linspace(0, width, 6)[1:-1]:
        top = np.interp(x, across, arch)
        lines.append(clamped([(x, z) for z in np.linspace(DOOR_BOTTOM, top, 4)]))
    for x in (0.25 * width, 0.75 * width):
        lines.append(np.array([x, -0.25]) + 0.055 * clamped(volute(1.7, 16)))
    angle = np.radians(-82)
    hinge = around(-DOOR_HALF_WIDTH, RADIUS, 0.0)
    facing = np.array([np.cos(angle), np.sin(angle), 0])
    return [hinge + line[:, :1] * facing + line[:, 1:] * np.array([0, 0, 1]) for line in lines]


def write_wedge(path: Path, profile: list[tuple[float, float]], rounds: int = 1) -> None:
    """Writes one wedge of a turned shape; ``profile`` runs upwards on its outside."""
    points = chaikin(np.array(profile), rounds)
    along = np.gradient(points, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    angle = np.linspace(0, 2 * np.pi / WEDGES, 7)
    vertices = around(angle, points[:, :1], points[:, 1:])
    normals = around(angle, along[:, 1:], -along[:, :1])
    faces = grid_faces(len(points), len(angle))
    write_ply(path, vertices.reshape(-1, 3), faces, normals=normals.reshape(-1, 3))


def loft(sections: Array, columns: int) -> tuple[Array, Array, Array]:
    """A tube of elliptic sections (x, z, half width, half height), closed around.

    Its first texture coordinate goes from the belly to the back on both sides alike,
    and so needs no seam.
    """
    spine = sections[:, :2]
    along = np.gradient(spine, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    angle = 2 * np.pi * np.arange(columns) / columns
    up = np.column_stack([-along[:, 1], along[:, 0]])
    height = sections[:, 3:] * -np.cos(angle)
    x, z = (spine[:, i : i + 1] + up[:, i : i + 1] * height for i in (0, 1))
    vertices = np.stack([x, sections[:, 2:3] * np.sin(angle), z], -1)
    u = np.broadcast_to((1 - np.cos(angle)) / 2, x.shape)
    v = np.broadcast_to(np.linspace(0, 1, len(sections))[:, None], x.shape)
    faces = grid_faces(len(sections), columns + 1)
    row, column = np.divmod(faces, columns + 1)
    return vertices, np.stack([u, v], -1), row * columns + column % columns


def bird() -> tuple[Array, Array, Array]:
    """A songbird that looks along x: the body and two wings in one mesh."""
    body = [
        (-0.245, -0.105, 0.002, 0.001),
        (-0.235, -0.100, 0.030, 0.006),
        (-0.170, -0.066, 0.028, 0.010),
        (-0.115, -0.036, 0.034, 0.022),
        (-0.080, -0.018, 0.054, 0.047),
        (-0.040, -0.002, 0.074, 0.073),
        (0.000, 0.012, 0.083, 0.085),
        (0.040, 0.030, 0.079, 0.082),
        (0.072, 0.054, 0.066, 0.068),
        (0.094, 0.082, 0.058, 0.058),
        (0.116, 0.103, 0.055, 0.053),
        (0.142, 0.110, 0.047, 0.045),
        (0.162, 0.109, 0.029, 0.030),
        (0.170, 0.107, 0.001, 0.001),
    ]
    wing = [
        (-0.185, -0.062, 0.001, 0.002),
        (-0.175, -0.060, 0.006, 0.008),
        (-0.110, -0.028, 0.011, 0.027),
        (-0.050, 0.004, 0.016, 0.046),
        (0.010, 0.026, 0.018, 0.050),
        (0.045, 0.040, 0.014, 0.036),
        (0.060, 0.046, 0.001, 0.002),
    ]
    vertices, uv, faces = loft(refine(np.array(body), 21), 16)
    parts, coordinates = [vertices.reshape(-1, 3)], [uv.reshape(-1, 2) * (0.5, 1)]
    triangles, count = [faces], vertices.shape[0] * vertices.shape[1]
    vertices, uv, faces = loft(refine(np.array(wing), 11), 10)
    lean = np.interp(vertices[..., 0], [-0.185, -0.08, 0.03, 0.06], [0.024, 0.058, 0.075, 0.062])
    for side in (-1, 1):
        # The trailing edge lies closer to the body than the leading one.
        tilt = 0.35 * (0.03 - vertices[..., 2])
        y = side * (np.clip(side * vertices[..., 1], -0.01, 1) + lean - np.abs(tilt) * 0.3)
        moved = np.stack([vertices[..., 0], y, vertices[..., 2]], -1)
        parts.append(moved.reshape(-1, 3))
        coordinates.append(uv.reshape(-1, 2) * (0.5, 1) + (0.5, 0))
        triangles.append(faces + count)
        count += len(parts[-1])
    return np.concatenate(parts), np.concatenate(coordinates), np.concatenate(triangles)


def plumage(back: Array, belly: Array, wing: Array, bar: Array) -> Image.Image:
    """Enamel colours of a bird: body on the left half, wings on the right."""
    size = 96
    v, u = np.mgrid[0:size, 0:size] / (size - 1)
    v = 1 - v
    edge = np.interp(v, [0, 0.4, 0.62, 0.72, 0.8, 1], [0.1, 0.55, 0.62, 0.5, 0.42, 0.62])
    mix = np.clip((2 * u - edge) / 0.05 + 0.5, 0, 1)[..., None]
    picture = belly * (1 - mix) + back * mix
    mask = np.exp(-(((v - 0.84) / 0.045) ** 2 + ((2 * u - 0.56) / 0.16) ** 2) * 2)
    picture = np.where((mask > 0.4)[..., None], wing * 0.6, picture)
    feather = 0.5 + 0.5 * np.cos(2 * np.pi * (7 * (2 * u - 1) + 3 * v))
    feathers = wing * (0.75 + 0.35 * feather[..., None] * (v < 0.55)[..., None])
    bars = (np.abs(v - 0.58) < 0.028) | (np.abs(v - 0.72) < 0.02)
    feathers = np.where(bars[..., None], bar, feathers)
    picture = np.where((u > 0.5)[..., None], feathers, picture)
    return Image.fromarray((255 * np.clip(picture, 0, 1)).astype(np.uint8))


def seeds(count: int, stream: np.random.Generator) -> list[Array]:
    """A third of the grains on the tray: short, thick curves that taper at both ends."""
    grains = []
    profile = np.array([0.0, 0.0, 0.011, 0.014, 0.010, 0.0, 0.0])
    t = np.linspace(-1, 1, 7)[:, None] * 0.026
    for _ in range(count):
        spot = around(stream.uniform(0, 2 * np.pi), 0.54 * np.sqrt(stream.uniform(0.14, 1)), 0)
        heading = stream.uniform(0, 2 * np.pi)
        slope = stream.uniform(-0.25, 0.25)
        along = np.array([np.cos(heading), np.sin(heading), slope])
        size = stream.uniform(0.7, 1.05)
        spot = spot + np.array([0, 0, FLOOR + 0.005 + 0.011 * size])
        grains.append(np.column_stack([spot + t * size * along, profile * size]))
    return grains


def main() -> None:
    """Writes every file of the scene."""
    folder = output_folder()
    stream = np.random.default_rng(7)
    write_curves(folder / "birdcage_wires.txt", with_radius(wires(), 0.006))
    write_curves(folder / "birdcage_rings.txt", with_radius(rings(), 0.0095))
    write_curves(folder / "birdcage_filigree.txt", with_radius(filigree(), 0.0042))
    write_curves(folder / "birdcage_door.txt", with_radius(door(), 0.0065))
    write_curves(folder / "birdcage_beads.txt", beads())
    write_curves(folder / "birdcage_seeds_light.txt", seeds(38, stream))
    write_curves(folder / "birdcage_seeds_dark.txt", seeds(22, stream))
    hook = around(np.linspace(-1.2, 4.3, 11), 0.05, 0)[:, [0, 2, 1]] + np.array([0, 0, 0.895])
    hook[0] = hook[0] * (0, 0, 1)
    write_curves(folder / "birdcage_hook.txt", with_radius([clamped(hook)], 0.011))

    skirt = [(0.55, -0.885), (0.73, -0.885), (0.745, -0.9), (0.77, -0.9), (0.782, -0.885)]
    skirt += [(0.77, -0.868), (0.735, -0.86), (0.70, -0.835), (0.698, -0.81), (0.715, -0.79)]
    skirt += [(0.728, -0.775), (0.725, -0.76), (0.705, -0.754), (0.688, -0.766), (0.678, -0.782)]
    write_wedge(folder / "birdcage_skirt.ply", skirt)
    floor = [(0.684, -0.772), (0.655, -0.787), (0.59, FLOOR), (0.2, FLOOR), (0.0, FLOOR)]
    write_wedge(folder / "birdcage_floor.ply", floor)
    dish = [(0.07, FLOOR), (0.075, FLOOR), (0.078, FLOOR + 0.012), (0.11, FLOOR + 0.035)]
    dish += [(0.128, FLOOR + 0.065), (0.136, FLOOR + 0.072), (0.132, FLOOR + 0.078)]
    dish += [(0.122, FLOOR + 0.068), (0.10, FLOOR + 0.035), (0.06, FLOOR + 0.02), (0, FLOOR + 0.02)]
    write_wedge(folder / "birdcage_dish.ply", dish)

    vertices, uv, faces = bird()
    write_ply(folder / "birdcage_bird.ply", vertices, faces, uv=uv)
    legs = []
    for side in (-1, 1):
        hip, foot = np.array([-0.01, 0.035 * side, -0.05]), np.array([0.005, 0.03 * side, -0.118])
        legs.append(clamped([hip, foot]))
        for spread in (-0.25, 0.25):
            toe = foot + [0.028, spread * 0.05, 0.004]
            legs.append(clamped([foot, toe, toe + [0.012, 0, -0.022]]))
        legs.append(clamped([foot, foot + [-0.022, 0, 0.0], foot + [-0.03, 0, -0.016]]))
    write_curves(folder / "birdcage_legs.txt", with_radius(legs, 0.0065))
    beak = clamped([(0.15, 0, 0.106), (0.175, 0, 0.104), (0.195, 0, 0.098), (0.212, 0, 0.092)])
    taper = [0.02, 0.02, 0.02, 0.0175, 0.010, 0.002, 0.0015, 0.001]
    write_curves(folder / "birdcage_beak.txt", [np.column_stack([beak, taper])])
    cobalt, cream = np.array([0.10, 0.36, 0.66]), np.array([0.96, 0.90, 0.78])
    coral, night = np.array([0.88, 0.26, 0.16]), np.array([0.10, 0.17, 0.30])
    plumage(cobalt, np.array([0.97, 0.72, 0.28]), night * 1.2, cream).save(
        folder / "birdcage_blue.png", optimize=True
    )
    plumage(coral, cream, np.array([0.42, 0.10, 0.12]), cream).save(
        folder / "birdcage_red.png", optimize=True
    )


if __name__ == "__main__":
    main()
