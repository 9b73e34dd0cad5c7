"""Makes the files of realistic/bonsai.xml: trunk, branches, sprays of leaves, pot and stand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from geometry import Array, output_folder, refine, write_curves, write_ply
from PIL import Image

WEDGES = 10
SPRAYS = 2  # meshes of leaves
TINTS = 6  # groups of them that differ in colour

# Middle line of the trunk and its radius: x, y, z, radius.
TRUNK = np.array(
    [
        (0.10, 0.00, -0.580, 0.150),
        (0.08, 0.00, -0.500, 0.125),
        (0.00, 0.02, -0.380, 0.112),
        (-0.10, 0.03, -0.240, 0.104),
        (-0.12, 0.02, -0.100, 0.094),
        (-0.02, -0.02, 0.010, 0.082),
        (0.08, -0.03, 0.120, 0.066),
        (0.07, -0.01, 0.250, 0.050),
        (-0.01, 0.01, 0.370, 0.036),
        (-0.04, 0.01, 0.480, 0.024),
        (-0.02, 0.00, 0.580, 0.012),
    ]
)
# Cushions of foliage: centre, radius, height, sprays, and where the branch leaves the trunk.
PADS = [
    ((-0.58, -0.06, -0.10), 0.27, 0.13, 33, 0.36),
    ((0.55, 0.08, 0.02), 0.27, 0.13, 32, 0.48),
    ((0.10, 0.50, 0.06), 0.25, 0.12, 26, 0.52),
    ((0.18, -0.47, 0.00), 0.20, 0.11, 19, 0.54),
    ((-0.40, 0.16, 0.24), 0.23, 0.12, 25, 0.62),
    ((0.42, -0.10, 0.34), 0.21, 0.11, 21, 0.70),
    ((-0.20, -0.34, 0.30), 0.16, 0.10, 13, 0.70),
    ((-0.03, 0.00, 0.58), 0.29, 0.24, 44, 0.90),
]


def grid_faces(rows: int, columns: int) -> Array:
    """Triangles of a grid of vertices, row by row."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    right, up = corner + 1, corner + columns
    return np.concatenate([np.stack([corner, right, up + 1], 1), np.stack([corner, up + 1, up], 1)])


def closed_faces(rows: int, columns: int) -> Array:
    """Triangles of a grid whose last column joins its first one."""
    row, column = np.divmod(grid_faces(rows, columns + 1), columns + 1)
    return row * columns + column % columns


def write_trunk(path: Path) -> None:
    """Writes the trunk, with roots at its foot and furrows that wind upwards.

    Its first texture coordinate runs to the far side and back, and so needs no seam.
    """
    stream = np.random.default_rng(2)
    rows, columns = 32, 15
    line = refine(TRUNK, rows)
    angle = 2 * np.pi * np.arange(columns) / columns
    t = np.linspace(0, 1, rows)[:, None]
    wind = angle + 3.0 * t
    relief = 0.10 * np.cos(3 * wind + 1) + 0.06 * np.cos(7 * wind - 5 * t)
    relief += 0.05 * stream.normal(size=(rows, columns))
    roots = np.exp(-(line[:, 2:3] + 0.53) / 0.06) * (0.4 + 0.6 * np.cos(5 * angle + 0.4))
    radius = line[:, 3:] * (1 + relief + np.clip(roots, -0.1, 0.9))
    vertices = np.stack(
        [
            line[:, :1] + radius * np.cos(angle),
            line[:, 1:2] + radius * np.sin(angle),
            np.broadcast_to(line[:, 2:3], radius.shape),
        ],
        -1,
    )
    u = np.broadcast_to(1 - np.abs(angle / np.pi - 1), radius.shape)
    uv = np.stack([2 * u, np.broadcast_to(5 * t, radius.shape)], -1)
    write_ply(path, vertices.reshape(-1, 3), closed_faces(rows, columns), uv=uv.reshape(-1, 2))


def on_trunk(t: float) -> Array:
    """A point of the middle line and its radius."""
    return refine(TRUNK, 201)[round(200 * t)]


def spread(count: int, stream: np.random.Generator) -> Array:
    """Points in the unit disc that keep their distance from one another."""
    points = np.zeros((1, 2))
    while len(points) < count:
        angle, radius = stream.uniform(0, 2 * np.pi, 24), np.sqrt(stream.uniform(0, 1, 24))
        tries = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
        gaps = np.linalg.norm(tries[:, None] - points, axis=2).min(1)
        points = np.vstack([points, tries[gaps.argmax()]])
    return points


def cushion(
    centre: Array, radius: float, height: float, count: int, stream: np.random.Generator
) -> tuple[Array, Array]:
    """Where the sprays of one cushion sit, and which way they point."""
    disc = spread(count, stream)
    distance = np.linalg.norm(disc, axis=1)
    dome = np.sqrt(np.clip(1.06 - distance**2, 0, 1))
    wobble = stream.uniform(-0.25, 0.12, count)
    spots = centre + np.column_stack([disc * radius, height * (dome + wobble - 0.3)])
    lean = np.column_stack([1.15 * disc, 0.55 + dome]) + stream.normal(0, 0.16, (count, 3))
    return spots, lean / np.linalg.norm(lean, axis=1, keepdims=True)


def frame(axis: Array, spin: float) -> Array:
    """A rotation that takes z to ``axis``."""
    side = np.cross([0.3, 0.9, 0.2], axis)
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    first = np.cos(spin) * side + np.sin(spin) * other
    return np.stack([first, np.cross(axis, first), axis], 1)


def foliage(stream: np.random.Generator) -> tuple[list[str], list[Array]]:
    """Instances of the sprays as XML, and the curves of branches and twigs."""
    lines, curves = [], []
    for centre, radius, height, count, t in PADS:
        middle = np.array(centre)
        spots, axes = cushion(middle, radius, height, count, stream)
        start = on_trunk(t)
        end = middle - [0, 0, 0.28 * height]
        reach = end - start[:3]
        sag = np.array([0, 0, -0.10 * np.linalg.norm(reach[:2])])
        steps = np.array([-0.08, 0.04, 0.25, 0.5, 0.75, 1.0, 1.15])[:, None]
        wiggle = stream.normal(0, 0.018, (7, 3)) * (steps > 0.1)
        branch = start[:3] + steps * reach + 4 * sag * steps * (1 - steps) + wiggle
        thick = start[3] * np.array([0.75, 0.62, 0.5, 0.42, 0.33, 0.22, 0.14])
        curves.append(np.column_stack([branch, np.maximum(thick, 0.006)]))
        for spot in spots[:: 2 if t < 0.8 else 3]:
            nearest = branch[stream.integers(4, 6)]
            bend = 0.5 * (nearest + spot) - [0, 0, 0.02]
            points = np.array([2 * nearest - bend, nearest, bend, spot, 2 * spot - bend])
            curves.append(np.column_stack([points, [0.011, 0.009, 0.007, 0.004, 0.003]]))
        for spot, axis in zip(spots, axes, strict=True):
            matrix = np.eye(4)
            spin = stream.uniform(0, 2 * np.pi)
            matrix[:3, :3] = frame(axis, spin) * stream.uniform(0.82, 1.15)
            matrix[:3, 3] = spot
            turn = [*matrix[:3, :3].T.round(2), matrix[:3, 3].round(3)]
            rows = [*np.array(turn).T.reshape(-1), 0, 0, 0, 1]
            numbers = " ".join(f"{x:.3f}".rstrip("0").rstrip(".") for x in rows)
            # Fresh growth, which is paler, lies on top.
            fresh = spot[2] - middle[2] > 0.5 * height
            tint = stream.integers(2, TINTS) if fresh else stream.integers(0, TINTS - 2)
            lines.append(
                f'<shape type="instance" id="foliage_{len(lines)}"><ref id="spray_{tint}"/>'
                f'<transform name="to_world"><matrix value="{numbers}"/></transform></shape>'
            )
    return lines, curves


def write_spray(path: Path, leaves: int, stream: np.random.Generator) -> None:
    """Writes a spray of leaves around z: each one folded along its rib and bent down."""
    outline = np.array(
        [(0, 0), (0.28, 0.21), (0.28, -0.21), (0.66, 0.19), (0.66, -0.19), (1, 0), (0.48, 0)]
    )
    depth = np.array([0.0, 0.05, 0.05, 0.0, 0.0, -0.16, 0.0])
    fan = np.array([(6, 0, 2), (6, 2, 4), (6, 4, 5), (6, 5, 3), (6, 3, 1), (6, 1, 0)])
    vertices, faces = [], []
    for i in range(leaves):
        height = np.sqrt((i + 0.5) / leaves)
        turn = 2.399963 * i + stream.uniform(-0.3, 0.3)
        rise = np.radians(-20 + 85 * height**2) + stream.normal(0, 0.22)
        along = np.array([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)])
        across = np.array([-np.sin(turn), np.cos(turn), 0.0])
        roll = stream.normal(0, 0.35)
        up = np.cross(along, across)
        across = np.cos(roll) * across + np.sin(roll) * up
        up = np.cross(along, across)
        length = 0.062 * stream.uniform(0.75, 1.15)
        stem = np.array([0, 0, 0.062 * height - 0.02]) + 0.045 * along * (1.25 - height)
        leaf = outline[:, :1] * along + outline[:, 1:] * 1.15 * across + depth[:, None] * up
        vertices.append(stem + length * leaf)
        faces.append(fan + 7 * i)
    write_ply(path, np.concatenate(vertices), np.concatenate(faces))


def chaikin(points: Array) -> Array:
    """Cuts the corners of a polyline, keeping its ends."""
    low = 0.75 * points[:-1] + 0.25 * points[1:]
    high = 0.25 * points[:-1] + 0.75 * points[1:]
    middle = np.stack([low, high], 1).reshape(-1, points.shape[1])
    return np.concatenate([points[:1], middle, points[-1:]])


def write_pot(path: Path) -> None:
    """Writes one wedge of the pot, still round; v runs along its profile."""
    corners = [(0.0, -0.79), (0.34, -0.79), (0.36, -0.80), (0.40, -0.80), (0.415, -0.785)]
    corners += [(0.41, -0.76), (0.455, -0.70), (0.50, -0.63), (0.515, -0.57), (0.52, -0.555)]
    corners += [(0.555, -0.55), (0.565, -0.535), (0.56, -0.515), (0.54, -0.508), (0.51, -0.512)]
    corners += [(0.495, -0.53), (0.49, -0.60)]
    profile = chaikin(np.array(corners))
    along = np.gradient(profile, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    angle = np.linspace(0, 2 * np.pi / WEDGES, 6)

    def turned(radius: Array, height: Array) -> Array:
        flat = np.broadcast_to(height[:, None], (len(height), len(angle)))
        x, y = radius[:, None] * np.cos(angle), radius[:, None] * np.sin(angle)
        return np.stack([x, y, flat], -1).reshape(-1, 3)

    v, u = np.meshgrid(np.linspace(0, 1, len(profile)), np.linspace(0, 1, 6), indexing="ij")
    write_ply(
        path,
        turned(*profile.T),
        grid_faces(len(profile), 6),
        normals=turned(along[:, 1], -along[:, 0]),
        uv=np.stack([u, v], -1).reshape(-1, 2),
    )


def glaze(size: int) -> Image.Image:
    """Colour along the profile of the pot: bare foot, blue glaze that breaks on the rim."""
    v = 1 - np.linspace(0, 1, size)
    bare, blue = np.array([0.48, 0.30, 0.20]), np.array([0.14, 0.36, 0.58])
    pale, rust = np.array([0.34, 0.60, 0.70]), np.array([0.62, 0.44, 0.26])
    stops = [0.0, 0.30, 0.32, 0.36, 0.50, 0.60, 0.63, 0.68, 0.74, 0.82, 0.88, 1.0]
    shades = [bare, bare, rust, blue, blue, pale, rust, blue, blue, rust, bare, bare]
    line = np.stack([np.interp(v, stops, [s[i] for s in shades]) for i in range(3)], 1)
    return Image.fromarray((255 * line).astype(np.uint8)[:, None].repeat(4, 1))


def noise(size: int, cells: tuple[int, int], stream: np.random.Generator) -> Array:
    """Smooth noise that repeats, from 0 to 1."""
    rows, columns = (np.fft.fftfreq(size) * size / c for c in cells)
    falloff = np.exp(-(rows[:, None] ** 2 + columns**2))
    field = np.fft.ifft2(np.fft.fft2(stream.normal(size=(size, size))) * falloff).real
    field = (field - field.mean()) / field.std()
    return np.clip(0.5 + 0.22 * field, 0, 1)


def bark(size: int, stream: np.random.Generator) -> tuple[Image.Image, Image.Image]:
    """Bark as heights and as colours: plates between furrows that run upwards."""
    ridges = 1 - np.abs(2 * noise(size, (4, 11), stream) - 1) * 1.6
    plates = 0.62 * ridges + 0.38 * noise(size, (16, 20), stream)
    plates = np.clip(plates, 0, 1)
    light, dark = np.array([0.62, 0.52, 0.43]), np.array([0.26, 0.18, 0.13])
    colours = dark + (light - dark) * plates[..., None]
    heights, picture = ((255 * a).astype(np.uint8) for a in (plates, colours))
    shades = Image.fromarray(picture).quantize(24, dither=Image.Dither.NONE)
    return Image.fromarray(heights), shades


def write_moss(path: Path, stream: np.random.Generator) -> None:
    """Writes the mossy ground of the pot, still round: a mound with humps."""
    rows, columns = 10, 26
    rho = np.linspace(0, 1, rows)[:, None]
    angle = 2 * np.pi * np.arange(columns) / columns + 0.08 * stream.normal(size=(rows, columns))
    humps = stream.uniform(-1, 1, (26, 2)) * 0.5
    x, y = 0.5 * rho * np.cos(angle), 0.5 * rho * np.sin(angle)
    gaps = np.hypot(x[..., None] - humps[:, 0], y[..., None] - humps[:, 1]).min(-1)
    z = -0.545 + 0.05 * (1 - rho**2) + 0.035 * np.sqrt(np.clip(1 - (gaps / 0.11) ** 2, 0, 1))
    z = np.where(rho > 0.95, -0.56, z)
    vertices = np.stack([x, y, z], -1).reshape(-1, 3)
    uv = 4 * vertices[:, :2] + 2
    write_ply(path, vertices, closed_faces(rows, columns)[:, ::-1], uv=uv)


def write_pebble(path: Path, stream: np.random.Generator) -> None:
    """Writes a pebble of about unit radius."""
    rows, columns = 9, 12
    polar = np.linspace(0.02, np.pi - 0.02, rows)[:, None]
    angle = 2 * np.pi * np.arange(columns) / columns
    way = np.stack([np.sin(polar) * np.cos(angle), np.sin(polar) * np.sin(angle)], -1)
    way = np.concatenate([way, np.broadcast_to(np.cos(polar), (rows, columns))[..., None]], -1)
    waves = stream.normal(size=(3, 3)) * 1.6
    radius = 1 + 0.07 * np.sin(way @ waves + stream.uniform(0, 6, 3)).sum(-1, keepdims=True)
    faces = closed_faces(rows, columns)[:, ::-1]
    write_ply(path, (way * radius).reshape(-1, 3), faces)


def moss(size: int, stream: np.random.Generator) -> Image.Image:
    """Colours of moss, which serve as its heights too."""
    fine, coarse = noise(size, (26, 26), stream), noise(size, (4, 4), stream)
    light, dark = np.array([0.68, 0.74, 0.30]), np.array([0.28, 0.38, 0.12])
    earth = np.array([0.30, 0.20, 0.12])
    mix = np.clip(0.15 + 0.8 * fine, 0, 1)[..., None]
    picture = light * mix + dark * (1 - mix)
    bare = np.clip((0.2 - coarse) / 0.12, 0, 1)[..., None]
    picture = picture * (1 - bare) + earth * (0.5 + mix) * bare
    image = Image.fromarray((255 * np.clip(picture, 0, 1)).astype(np.uint8))
    return image.quantize(32, dither=Image.Dither.NONE)


def bevelled_box(centre: Array, half: Array, bevel: float) -> tuple[Array, Array]:
    """A box with bevelled edges: each corner is a triangle of three vertices."""
    signs = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    inset = bevel * (1 - np.eye(3))
    vertices = (signs[:, None] * (np.asarray(half) - inset)).reshape(-1, 3)
    polygons = [[3 * c, 3 * c + 1, 3 * c + 2] for c in range(8)]
    step = (4, 2, 1)
    for axis in range(3):
        a, b = (step[(axis + 1) % 3], step[(axis + 2) % 3])
        for side in (0, step[axis]):
            polygons.append([3 * (side + c) + axis for c in (0, a, a + b, b)])
        for other in (0, a, b, a + b):
            # An edge along the axis joins the two faces that it lies between.
            low, high = 3 * other, 3 * (other + step[axis])
            first, second = (axis + 1) % 3, (axis + 2) % 3
            polygons.append([low + first, high + first, high + second, low + second])
    faces = []
    for polygon in polygons:
        for i in range(1, len(polygon) - 1):
            face = [polygon[0], polygon[i], polygon[i + 1]]
            p, q, r = vertices[face]
            outwards = np.cross(q - p, r - p) @ (p + q + r) > 0
            faces.append(face if outwards else face[::-1])
    return vertices + centre, np.array(faces)


def write_stand(path: Path) -> None:
    """Writes the low wooden stand: a slab, a frame below it and four feet."""
    boxes = [((0, 0, -0.827), (0.64, 0.50, 0.027), 0.012)]
    boxes += [((0, s * 0.43, -0.874), (0.56, 0.022, 0.022), 0.006) for s in (-1, 1)]
    boxes += [((s * 0.57, 0, -0.874), (0.022, 0.41, 0.022), 0.006) for s in (-1, 1)]
    boxes += [
        ((s * 0.57, t * 0.43, -0.902), (0.045, 0.045, 0.05), 0.010)
        for s in (-1, 1)
        for t in (-1, 1)
    ]
    vertices, faces, count = [], [], 0
    for centre, half, bevel in boxes:
        corners, triangles = bevelled_box(np.array(centre), np.array(half), bevel)
        vertices.append(corners)
        faces.append(triangles + count)
        count += len(corners)
    write_ply(path, np.concatenate(vertices), np.concatenate(faces))


def main() -> None:
    """Writes every file of the scene."""
    folder = output_folder()
    stream = np.random.default_rng(1)
    write_trunk(folder / "bonsai_trunk.ply")
    lines, curves = foliage(stream)
    text = "\n".join(['<scene version="3.0.0">', *lines, "</scene>", ""])
    (folder / "bonsai_leaves.xml").write_text(text)
    write_curves(folder / "bonsai_branches.txt", [np.asarray(c, float) for c in curves], 3)
    for i in range(SPRAYS):
        write_spray(folder / f"bonsai_spray_{i}.ply", 44, stream)
    write_pot(folder / "bonsai_pot.ply")
    write_moss(folder / "bonsai_moss.ply", stream)
    write_pebble(folder / "bonsai_pebble.ply", stream)
    write_stand(folder / "bonsai_stand.ply")
    glaze(96).save(folder / "bonsai_glaze.png", optimize=True)
    heights, shades = bark(72, stream)
    heights.save(folder / "bonsai_bark.png", optimize=True)
    shades.save(folder / "bonsai_bark_colour.png", optimize=True)
    moss(72, stream).save(folder / "bonsai_moss.png", optimize=True)


if __name__ == "__main__":
    main()
