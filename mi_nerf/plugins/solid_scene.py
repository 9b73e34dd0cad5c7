"""The surfaces and lights of a scene, without the cubes of its fields."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ..base.errors import InputError
from .placement import is_field


class SolidScene:
    """A scene without the cubes of its fields; made again when shapes have changed.

    A path tracer must not meet the cubes: even with a ``null`` BSDF they cast shadows on
    whatever they contain.
    """

    def __init__(self) -> None:
        self._made_of: list[Any] = []
        self._scene: mi.Scene | None = None

    def of(self, scene: mi.Scene) -> mi.Scene:
        """The scene, less its cubes, in its present state."""
        parts = [
            part
            for part in _parts(scene)
            if isinstance(part, mi.Shape | mi.Emitter) and not _holds_field(part)
        ]
        lights = [v for part in parts for v in _parts(part) if isinstance(v, mi.Emitter)]
        made_of = [v for part in parts + lights for v in (part, *_parts(part))]
        if self._scene is None or not _same(made_of, self._made_of):
            props = mi.Properties("scene")
            for i, part in enumerate(parts):
                props[f"part_{i}"] = part
            self._scene, self._made_of = mi.Scene(props), made_of
        return self._scene


def has_surfaces(scene: mi.Scene) -> bool:
    """Whether a scene holds any shape but cubes of fields."""
    return not all(_holds_field(shape) for shape in scene.shapes())


def check_no_loose_field(scene: mi.Scene) -> None:
    """Refuses a field that is part of the scene, but not of any of its shapes.

    Raises:
        InputError: naming it.
    """
    for part in _parts(scene):
        if isinstance(part, mi.Medium) and is_field(part):
            raise InputError(
                f"nerfmedium: '{part.id()}' is in no shape, expected the interior of a 'cube'"
            )


def _holds_field(part: Any) -> bool:
    return isinstance(part, mi.Shape) and is_field(part.interior_medium())


class _Children(mi.TraversalCallback):
    """Takes down everything that an object says it consists of."""

    def __init__(self, node: Any) -> None:
        super().__init__()
        self._node = node
        self.values: list[Any] = []

    def put(self, name: str, value: Any, flags: Any = None, kind: Any = None) -> None:
        """Called by the object."""
        self.values.append(value if kind is None else mi.get_property(value, kind, self._node))


def _parts(node: Any) -> list[Any]:
    """Objects and values, without history, that an object consists of."""
    children = _Children(node)
    node.traverse(children)
    return [dr.detach(value) for value in children.values]


def _same(a: list[Any], b: list[Any]) -> bool:
    """Whether lists hold the very same objects and arrays, not just equal ones."""
    return len(a) == len(b) and all(
        x is y or (type(x) is type(y) and _identity(x) == _identity(y))
        for x, y in zip(a, b, strict=True)
    )


def _identity(value: Any) -> Any:
    """What tells a value from all others that are alive."""
    if isinstance(value, mi.Object):
        return id(value)
    if isinstance(value, mi.Transform4f):
        value = value.matrix
    if not dr.is_jit_v(value):
        return value
    return [_identity(v) for v in value] if dr.depth_v(value) > 1 else value.index
