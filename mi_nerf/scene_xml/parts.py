"""The shapes of a scene one by one, as its author made them: names, boxes, how flat they are.

A scene that is loaded to be rendered holds meshes of one material merged into one, without the
names of its parts. Here their geometry alone is loaded, apart.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .scene_file import Bounds, SceneFile

Array = np.ndarray[Any, Any]

_FLAT = 0.05  # thickness of what counts as flat, per largest extent
_NARROW = 0.1  # breadth below which it is a rod
_LOOKED_AT = 20_000  # vertices of a mesh that show how flat it is
_PIECES, _ASKED = 50_000, 256  # that a mesh is divided into at most; of which flatness is known
_FACES = 300_000  # of the largest mesh that is divided into pieces


@dataclass(frozen=True, eq=False)
class Part:
    """A shape, or a connected piece of a mesh."""

    name: str  # its id, or kind and number
    lower: Array  # (3,) corners of its box, world space
    upper: Array
    glows: bool  # it is a light source
    normal: Array | None  # (3,) unit, of flat shapes
    levels: tuple[float, float]  # between which n·p lies on it, of flat shapes
    shape: Any = None  # Mitsuba's; of pieces None

    @property
    def size(self) -> float:
        """The largest extent of its box."""
        return float((self.upper - self.lower).max())

    def holds(self, points: Array, tolerance: float) -> Array:
        """Which of (N, 3) points may lie on it: those in its box and, if flat, in its plane."""
        inside = ((points >= self.lower - tolerance) & (points <= self.upper + tolerance)).all(-1)
        if self.normal is not None:
            level = points @ self.normal
            inside &= (level >= self.levels[0] - tolerance) & (level <= self.levels[1] + tolerance)
        return np.asarray(inside)


def read_parts(file: SceneFile) -> list[Part]:
    """All shapes that a scene shows, copies of instances included. A variant must be set.

    Raises:
        InputError: if Mitsuba refuses them.
    """
    bare = SceneFile(file.path, file.parameters)
    glowing = _strip(bare.state)
    shapes = [shape for shape in bare.load(merge=False).shapes() if shape.bbox().valid()]
    numbers: Counter[str] = Counter()
    parts = []
    for shape in shapes:
        kind = shape.class_name().lower()
        numbers[kind] += 1
        given = shape.id() and not shape.id().startswith("_")
        name = shape.id() if given else f"{kind} {numbers[kind]}"
        box = shape.bbox()
        lower, upper = (np.ravel(corner).astype(np.float64) for corner in (box.min, box.max))
        if np.isfinite([lower, upper]).all():
            part = Part(name, lower, upper, shape.id() in glowing, None, (0.0, 0.0), shape)
            parts.append(_with_plane(part))
    return parts


def box_of(parts: Sequence[Part]) -> Bounds | None:
    """The box of all shapes that are no light sources; None without any.

    That of a loaded scene may be less: Mitsuba forgets rectangles that it merges with meshes.
    """
    visible = [part for part in parts if not part.glows]
    if not visible:
        return None
    lower = np.min([part.lower for part in visible], axis=0)
    upper = np.max([part.upper for part in visible], axis=0)
    return tuple(lower.tolist()), tuple(upper.tolist())


def pieces(part: Part) -> list[Part]:
    """The connected pieces of a mesh, the largest first; the part alone if it has but one.

    Vertices in one place are one: files write them once for each normal.
    """
    if part.shape is None or not part.shape.is_mesh() or part.shape.face_count() > _FACES:
        return [part]
    used, faces = np.unique(_faces(part.shape), return_inverse=True)
    points, same = np.unique(_vertices(part.shape)[used], axis=0, return_inverse=True)
    label = _connected(same.reshape(-1)[faces.reshape(-1, 3)], len(points))
    names, piece = np.unique(label, return_inverse=True)
    if not 1 < len(names) <= _PIECES:
        return [part]
    order = np.argsort(piece, kind="stable")
    groups = np.split(points[order], np.flatnonzero(np.diff(piece[order])) + 1)
    groups.sort(key=lambda group: -np.ptp(group, axis=0).max())
    return [_piece(part, group, number, len(groups)) for number, group in enumerate(groups, 1)]


def is_open(part: Part) -> bool:
    """Whether a mesh has a rim, as a sheet does and the skin of a solid thing does not."""
    if part.shape is None or not part.shape.is_mesh() or part.shape.face_count() > _FACES:
        return False
    _, same = np.unique(_vertices(part.shape), axis=0, return_inverse=True)
    corners = same.reshape(-1)[_faces(part.shape)]
    edges = np.sort(np.concatenate([corners[:, [i, (i + 1) % 3]] for i in range(3)]), axis=1)
    return bool((np.unique(edges, axis=0, return_counts=True)[1] == 1).any())


def _piece(part: Part, points: Array, number: int, count: int) -> Part:
    """One of a mesh's pieces; of all but the first few it is not asked whether they are flat."""
    piece = replace(
        part,
        name=f"{part.name} (piece {number} of {count})",
        lower=points.min(axis=0),
        upper=points.max(axis=0),
        normal=None,
        shape=None,
    )
    return _with_plane(piece, points) if number <= _ASKED else piece


def _strip(state: Any) -> set[str]:
    """Leaves nothing but geometry in a parsed scene; returns the ids of what glowed."""
    import mitsuba as mi

    glowing = set()
    for number, node in enumerate(state.nodes):
        if node.type == mi.ObjectType.Shape and not node.props.id():
            node.props.set_id(f"_{number}")
    for node in [state.root, *(n for n in state.nodes if n.type == mi.ObjectType.Shape)]:
        for key in list(node.props.keys()):
            kind = _kind(state, node.props[key])
            if kind == mi.ObjectType.Emitter:
                glowing.add(node.props.id())
            if kind not in (None, mi.ObjectType.Shape):
                del node.props[key]
    return glowing


def _kind(state: Any, value: Any) -> Any:
    """The type of the object that a property refers to; None for other properties."""
    import mitsuba as mi

    if isinstance(value, mi.Properties.ResolvedReference):
        return state.nodes[value.index()].type
    if isinstance(value, mi.Properties.Reference) and value.id() in state.id_to_index:
        return state.nodes[state.id_to_index[value.id()]].type
    return None


# ---- Flat or not -------------------------------------------------------------


def _with_plane(part: Part, vertices: Array | None = None) -> Part:
    """The part with the plane that it lies in, if it is flat."""
    shape = part.shape
    if vertices is None and shape is not None and shape.is_mesh():
        vertices = _vertices(shape)
    if vertices is not None and len(vertices) > 3:
        step = -(-len(vertices) // _LOOKED_AT)
        centered = vertices[::step] - vertices[::step].mean(axis=0)
        axes = np.linalg.eigh(centered.T @ centered)[1].T
    elif shape is not None and shape.class_name() in ("Rectangle", "Disk"):
        point, normal = _point_and_normal(shape)
        level = float(point @ normal)
        return replace(part, normal=normal, levels=(level, level))
    else:
        axes = np.eye(3)
        vertices = np.stack([part.lower, part.upper])
    along = vertices @ axes.T
    extents = np.ptp(along, axis=0)
    thin, broad, long = np.argsort(extents)
    if not (extents[thin] <= _FLAT * extents[long] and extents[broad] > _NARROW * extents[long]):
        return part
    levels = float(along[:, thin].min()), float(along[:, thin].max())
    return replace(part, normal=axes[thin], levels=levels)


def _point_and_normal(shape: Any) -> tuple[Array, Array]:
    import mitsuba as mi

    sample = shape.sample_position(mi.Float(0), mi.Point2f(0.4, 0.6))
    return np.ravel(sample.p).astype(np.float64), np.ravel(sample.n).astype(np.float64)


# ---- Meshes ------------------------------------------------------------------


def _vertices(mesh: Any) -> Array:
    import drjit as dr
    import mitsuba as mi

    index = dr.arange(mi.UInt32, mesh.vertex_count())
    return np.array(mesh.vertex_position(index)).T.astype(np.float64)


def _faces(mesh: Any) -> Array:
    import drjit as dr
    import mitsuba as mi

    return np.array(mesh.face_indices(dr.arange(mi.UInt32, mesh.face_count()))).T


def _connected(faces: Array, count: int) -> Array:
    """The least vertex that each of ``count`` vertices is connected with, (count,).

    A vertex points at a lower one of its piece, at last at the least (Shiloach & Vishkin 1982).
    """
    label = np.arange(count)
    while True:
        roots = label[faces]
        if (roots == roots[:, :1]).all():
            return label
        np.minimum.at(label, roots, roots.min(axis=1, keepdims=True))
        while (label[label] != label).any():
            label = label[label]
