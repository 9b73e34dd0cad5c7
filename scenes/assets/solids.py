"""Bevelled blocks, solids of revolution and XML lines, for the scripts of this folder."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from geometry import Array

CREASE = np.cos(np.radians(35.0))  # Neighbours that turn more than this keep an edge


class Solid(NamedTuple):
    """A triangle mesh with one shading normal per vertex."""

    vertices: Array
    faces: Array
    normals: Array


def merge(solids: Sequence[Solid]) -> Solid:
    """Several meshes as one."""
    starts = np.cumsum([0, *(len(solid.vertices) for solid in solids[:-1])])
    faces = [solid.faces + start for solid, start in zip(solids, starts, strict=True)]
    return Solid(
        np.vstack([solid.vertices for solid in solids]),
        np.vstack(faces),
        np.vstack([solid.normals for solid in solids]),
    )


def moved(solid: Solid, offset: Sequence[float], turn: float = 0.0) -> Solid:
    """The mesh turned about z by ``turn`` degrees, then moved by ``offset``."""
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    vertices = solid.vertices @ rotation.T + np.asarray(offset)
    return Solid(vertices, solid.faces, solid.normals @ rotation.T)


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _outline(profile: Array, bevel: float) -> tuple[Array, Array, Array]:
    """Points and normals around a profile, its corners cut off, and the points of its cap."""
    edges = _unit(np.roll(profile, -1, axis=0) - profile)
    normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
    points, directions, inner = [], [], []
    for i, point in enumerate(profile):
        before, after = i - 1, i
        both = normals[before] + normals[after]
        mitre = point - 2 * bevel * both / (both @ both)
        if edges[before] @ edges[after] > CREASE:
            points.append(point)
            directions.append(_unit(both))
            inner.append(mitre)
        else:
            points += [point - bevel * edges[before], point + bevel * edges[after]]
            directions += [normals[before], normals[after]]
            inner += [mitre, mitre]
    return np.array(points), np.array(directions), np.array(inner)


def _ears(polygon: Array) -> Array:
    """Triangles of a simple polygon that runs counter-clockwise (ear clipping)."""

    def cross(a: Array, b: Array, c: Array) -> float:
        return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))

    gaps = np.linalg.norm(np.roll(polygon, -1, axis=0) - polygon, axis=1)
    left, triangles = [i for i, gap in enumerate(gaps) if gap > 1e-9], []
    while len(left) > 3:
        for k in range(len(left)):
            i, j, n = left[k - 1], left[k], left[(k + 1) % len(left)]
            a, b, c = polygon[i], polygon[j], polygon[n]
            inside = (
                cross(a, b, p) > 0 and cross(b, c, p) > 0 and cross(c, a, p) > 0
                for p in polygon[[m for m in left if m not in (i, j, n)]]
            )
            if cross(a, b, c) > 1e-12 and not any(inside):
                triangles.append((i, j, n))
                left.pop(k)
                break
        else:
            raise ValueError("the polygon crosses itself or runs clockwise")
    return np.array([*triangles, tuple(left)])


def extrude(profile: Array, depth: float, bevel: float) -> Solid:
    """A profile in x and z, counter-clockwise seen from -y, extruded along y.

    All edges are bevelled; flat faces keep their normals, and only the bevels shade
    smoothly from one to the next.
    """
    points, directions, inner = _outline(np.asarray(profile, float), bevel)
    count = len(points)

    def ring(at: Array, y: float) -> Array:
        return np.stack([at[:, 0], np.full(count, y), at[:, 1]], axis=1)

    half = depth / 2
    rings = [ring(inner, -half), ring(points, bevel - half)]
    rings += [ring(points, half - bevel), ring(inner, half)]
    sides = ring(directions, 0.0)
    front = np.tile([0.0, -1.0, 0.0], (count, 1))
    cap = _ears(inner)
    faces = [cap, cap[:, ::-1] + 3 * count]
    this, after = np.arange(count), np.roll(np.arange(count), -1)
    for row in range(3):
        a, b = this + row * count, after + row * count
        faces += [np.stack([a, a + count, b], 1), np.stack([b, a + count, b + count], 1)]
    return Solid(np.vstack(rings), np.vstack(faces), np.vstack([front, sides, sides, -front]))


def box(size: Sequence[float], bevel: float) -> Solid:
    """A bevelled box of this size along x, y and z around the origin."""
    x, z = size[0] / 2, size[2] / 2
    return extrude(np.array([[-x, -z], [x, -z], [x, z], [-x, z]]), size[1], bevel)


def arc(radius: float, start: float, stop: float, count: int) -> Array:
    """Points on a circle around the origin, from one angle in degrees to another."""
    angle = np.radians(np.linspace(start, stop, count))
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def wedge(profile: Array, parts: int, steps: int) -> tuple[Solid, Array]:
    """One of ``parts`` equal pieces of a solid of revolution, and its coordinates uv.

    The profile is radius and height from the bottom up, with the solid to its left.
    Copies turned about z by 360 / parts degrees close the solid without a seam.
    """
    apart = np.linalg.norm(np.diff(profile, axis=0), axis=1) > 1e-9
    profile = profile[np.concatenate([[True], apart])]
    edges = _unit(np.diff(profile, axis=0))
    normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    rows: list[tuple[int, Array]] = [(0, normals[0])]
    for i in range(1, len(profile) - 1):
        if edges[i - 1] @ edges[i] > CREASE:
            rows.append((i, _unit(normals[i - 1] + normals[i])))
        else:
            rows += [(i, normals[i - 1]), (i, normals[i])]
    rows.append((len(profile) - 1, normals[-1]))
    angle = np.radians(np.linspace(0.0, 360.0 / parts, steps + 1))
    c, s, one = np.cos(angle), np.sin(angle), np.ones(steps + 1)
    vertices, directions, uv, faces = [], [], [], []
    for row, (i, normal) in enumerate(rows):
        (r, z), (nr, nz) = profile[i], normal
        vertices.append(np.stack([r * c, r * s, z * one], 1))
        directions.append(np.stack([nr * c, nr * s, nz * one], 1))
        uv.append(np.stack([np.linspace(0, 1, steps + 1), length[i] / length[-1] * one], 1))
        if row + 1 < len(rows) and rows[row + 1][0] != i:
            a = np.arange(steps) + row * (steps + 1)
            b = a + steps + 1
            if profile[i][0] > 0:
                faces.append(np.stack([a, a + 1, b], 1))
            if profile[i + 1][0] > 0:
                faces.append(np.stack([b, a + 1, b + 1], 1))
    solid = Solid(np.vstack(vertices), np.vstack(faces), np.vstack(directions))
    return solid, np.vstack(uv)


def spline(points: Sequence[Sequence[float]], steps: int) -> Array:
    """A smooth curve through the points (Catmull-Rom), ``steps`` pieces between two."""
    p = np.asarray(points, float)
    p = np.vstack([2 * p[0] - p[1], p, 2 * p[-1] - p[-2]])
    t = (np.arange(steps) / steps)[:, None]
    out = []
    for a, b, c, d in zip(p[:-3], p[1:-2], p[2:-1], p[3:], strict=True):
        bend = (2 * a - 5 * b + 4 * c - d) * t + (3 * b - a - 3 * c + d) * t * t
        out.append(b + 0.5 * t * (c - a + bend))
    return np.vstack([*out, p[-2:-1]])


def step(kind: str, **values: float) -> str:
    """One step of a transform: translate, rotate or scale."""
    listed = " ".join(f'{name}="{value:.5g}"' for name, value in values.items())
    return f"<{kind} {listed}/>"


def shape(kind: str, name: str, steps: Sequence[str], bsdf: str, extra: str = "") -> str:
    """The XML of a shape with a transform and a reference to its BSDF."""
    moves = f'<transform name="to_world">{"".join(steps)}</transform>' if steps else ""
    material = f'<ref id="{bsdf}"/>' if bsdf else ""
    return f'    <shape type="{kind}" id="{name}">{extra}{moves}{material}</shape>'


def mesh(file: str, name: str, steps: Sequence[str], bsdf: str) -> str:
    """The XML of a mesh from a file beside the scripts."""
    extra = f'<string name="filename" value="../assets/{file}"/>'
    return shape("ply", name, steps, bsdf, extra)


def fragment(lines: Sequence[str], comment: str) -> str:
    """A file for <include> from these lines."""
    return "\n".join([f"<!-- {comment} -->", '<scene version="3.0.0">', *lines, "</scene>", ""])
