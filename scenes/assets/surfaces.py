"""Textures that repeat, texture coordinates and foliage, for the scripts of this folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from geometry import Array, write_ply
from PIL import Image
from scipy.spatial import cKDTree
from solids import Solid, extrude, mesh, shape, step, wedge

# ---- Pictures ----------------------------------------------------------------


def noise(size: int, cells: tuple[float, float], rng: np.random.Generator) -> Array:
    """Smooth noise that repeats, of mean 0 and deviation 1; ``cells`` high and wide."""
    rows, columns = (np.fft.fftfreq(size) * size / c for c in cells)
    falloff = np.exp(-(rows[:, None] ** 2 + columns**2))
    field = np.fft.ifft2(np.fft.fft2(rng.normal(size=(size, size))) * falloff).real
    return (field - field.mean()) / field.std()


def rough(size: int, cells: float, octaves: int, rng: np.random.Generator) -> Array:
    """Noise of several scales, each finer by half and weaker by 0.6; mean 0, deviation 1."""
    scales = [2.0**k for k in range(octaves)]
    total = sum(0.6**k * noise(size, (cells * s,) * 2, rng) for k, s in enumerate(scales))
    return np.asarray(total / np.std(total))


def cells(size: int, points: Array, stretch: float = 1.0) -> tuple[Array, Array]:
    """Cells around points of the unit square, which repeats: their numbers, and to the edge.

    Args:
        points: (N, 2) as x and y.
        stretch: What a distance along y counts more than one along x.
    """
    y, x = (np.mgrid[:size, :size] + 0.5) / size
    where = np.stack([x, y * stretch], -1).reshape(-1, 2)
    tree = cKDTree(points * [1, stretch], boxsize=[1, stretch])
    distance, index = tree.query(where, k=2)
    edge = (distance[:, 1] - distance[:, 0]).reshape(size, size)
    return index[:, 0].reshape(size, size), edge


def blend(first: Sequence[float] | Array, second: Sequence[float] | Array, t: Array) -> Array:
    """From one colour, or picture, to another; ``t`` is clipped to [0, 1]."""
    t = np.clip(t, 0, 1)[..., None]
    return np.asarray(first) * (1 - t) + np.asarray(second) * t


def save(path: Path, picture: Array, quality: int = 80) -> None:
    """Writes a picture of sRGB values from 0 to 1, (H, W, 3) or (H, W)."""
    Image.fromarray(np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8)).save(
        path, quality=quality
    )


# ---- Solids with texture coordinates in scene units --------------------------


def box_mapped(solid: Solid) -> Array:
    """Coordinates uv of each vertex as seen along the axis that its normal follows most."""
    axis = np.abs(solid.normals).argmax(1)
    x, y, z = solid.vertices.T
    u = np.where(axis == 0, y, x)
    v = np.where(axis == 2, y, z)
    return np.stack([u, v], 1)


def write_solid(path: Path, solid: Solid, uv: Array | None = None) -> None:
    """Writes a solid; without coordinates of its own it gets those of ``box_mapped``."""
    uv = box_mapped(solid) if uv is None else uv
    write_ply(path, solid.vertices, solid.faces, normals=solid.normals, uv=uv)


def write_turned(path: Path, profile: Array, parts: int, steps: int) -> None:
    """Writes one of ``parts`` equal pieces of a solid of revolution."""
    profile = np.asarray(profile, float)
    solid, uv = wedge(profile, parts, steps)
    lengths = np.linalg.norm(np.diff(profile, axis=0), axis=1).sum()
    around = np.round(2 * np.pi * profile[:, 0].max(), 1) / parts
    write_ply(path, solid.vertices, solid.faces, normals=solid.normals, uv=uv * [around, lengths])


def slab(profile: Array | Sequence[Sequence[float]], depth: float, bevel: float = 0.0) -> Solid:
    """``extrude`` for a profile that runs either way around."""
    points = np.asarray(profile, float)
    x, z = points.T
    clockwise = (x * np.roll(z, -1) - np.roll(x, -1) * z).sum() < 0
    return extrude(points[::-1] if clockwise else points, depth, bevel)


def prism(plan: Array, low: float, high: float, bevel: float) -> Solid:
    """A plan in x and y, from one height to another."""
    solid = slab(plan, high - low, bevel)

    def stand(a: Array) -> Array:
        return np.stack([a[:, 0], a[:, 2], -a[:, 1]], 1)

    middle = [0, 0, (low + high) / 2]
    return Solid(stand(solid.vertices) + middle, solid.faces, stand(solid.normals))


def tube(line: Array, radius: float | Array, sides: int = 8) -> Solid:
    """A round rod along a line of points; open at its ends."""
    line = np.asarray(line, float)
    along = np.gradient(line, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(along[0], [0.31, 0.17, 0.94])
    frames = []
    for direction in along:
        across = across - (across @ direction) * direction
        across /= np.linalg.norm(across)
        frames.append((across, np.cross(direction, across)))
    angle = 2 * np.pi * np.arange(sides) / sides
    first, second = (np.array([frame[k] for frame in frames])[:, None] for k in (0, 1))
    out = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
    radii = np.broadcast_to(radius, len(line))[:, None, None]
    i = np.arange(sides)
    j = (i + 1) % sides
    ring = np.vstack([np.stack([i, j, j + sides], 1), np.stack([i, j + sides, i + sides], 1)])
    faces = np.vstack([ring + sides * k for k in range(len(line) - 1)])
    return Solid((line[:, None] + radii * out).reshape(-1, 3), faces, out.reshape(-1, 3))


# ---- XML ---------------------------------------------------------------------


def put_mesh(
    scene: str, file: str, name: str, material: str, at: Sequence[float], *steps: str
) -> str:
    """The XML of a mesh of a scene, moved to a place after the other steps."""
    x, y, z = (round(float(v), 3) for v in at)
    return mesh(f"{scene}_{file}.ply", name, [*steps, step("translate", x=x, y=y, z=z)], material)


def turn(angle: float) -> str:
    """A rotation about z, in degrees."""
    return step("rotate", z=1, angle=round(float(angle), 1))


def scale(size: float) -> str:
    """The same scale along all axes."""
    return step("scale", value=round(float(size), 3))


def block(name: str, low: Sequence[float], high: Sequence[float], material: str) -> str:
    """A box between two corners."""
    (a, b, c), (x, y, z) = (np.array(high) - low) / 2, (np.array(low) + high) / 2
    steps = [step("scale", x=a, y=b, z=c), step("translate", x=x, y=y, z=z)]
    return shape("cube", name, steps, material)


# ---- Leaves ------------------------------------------------------------------


def frame(axis: Array, spin: float) -> Array:
    """A rotation that takes z to ``axis``."""
    side = np.cross([0.31, 0.87, 0.23], axis)
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    first = np.cos(spin) * side + np.sin(spin) * other
    return np.stack([first, np.cross(axis, first), axis], 1)


def leaves(spots: Array, axes: Array, sizes: Array, rng: np.random.Generator) -> tuple[Array, ...]:
    """Folded leaves of four triangles at these places, each pointing along its axis."""
    outline = np.array([(0, 0, 0), (0.26, 0.08, 0.45), (0, 0, 0.5), (-0.26, 0.08, 0.45), (0, 0, 1)])
    fan = np.array([(0, 1, 2), (0, 2, 3), (2, 1, 4), (3, 2, 4)])
    vertices, faces = [], []
    for i, (spot, axis, size) in enumerate(zip(spots, axes, sizes, strict=True)):
        axis = axis / np.linalg.norm(axis)
        vertices.append(spot + size * outline @ frame(axis, rng.uniform(0, 2 * np.pi)).T)
        faces.append(fan + 5 * i)
    return np.concatenate(vertices), np.concatenate(faces)


def tuft(count: int, size: float, rng: np.random.Generator) -> tuple[Array, ...]:
    """A ball of leaves of radius 1 that point outwards and somewhat up."""
    way = rng.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    spots = way * rng.uniform(0.25, 1, (count, 1)) ** 0.6 * (1 - size)
    axes = way + rng.normal(0, 0.45, (count, 3)) + [0, 0, 0.25]
    return leaves(spots, axes, size * rng.uniform(0.7, 1.2, count), rng)
