"""Meshes of one material become one, always in the same order.

Mitsuba's own way puts all of a scene into one list by the addresses of materials: shapes come in
another order each time that a scene is loaded, and where surfaces coincide so do pictures.
"""

from __future__ import annotations

from typing import Any

from .instancing import children


def merge_meshes(state: Any) -> None:
    """Puts shapes that share their material into one ``merge`` each.

    Args:
        state: A ``mi.parser.ParserState`` in which equal objects are one.
    """
    import mitsuba as mi

    root = state.root.props
    groups: dict[Any, list[tuple[str, int]]] = {}
    order: list[tuple[str, int, Any]] = []
    for key, index in children(root):
        group = _material(state, index)
        order.append((key, index, group))
        if group is not None:
            groups.setdefault(group, []).append((key, index))
    merged: list[Any] = []
    for key, index, group in order:
        del root[key]
        members = groups.get(group, [])
        if len(members) < 2:
            root[key] = mi.Properties.ResolvedReference(index)
        elif members[0][0] == key:
            root[key] = mi.Properties.ResolvedReference(len(state.nodes) + len(merged))
            node = mi.parser.SceneNode()
            node.type, node.props = mi.ObjectType.Shape, mi.Properties("merge")
            for name, member in members:
                node.props[name] = mi.Properties.ResolvedReference(member)
            merged.append(node)
    for node in merged:  # at last: a node that is added moves all others in memory
        state.nodes.append(node)


def _material(state: Any, index: int) -> Any:
    """All that meshes must have in common to be one; None for what cannot be merged."""
    import mitsuba as mi

    node = state.nodes[index]
    parts = sorted(part for _, part in children(node.props)) if node.type == _shape() else []
    kinds = {state.nodes[part].type for part in parts}
    if mi.ObjectType.BSDF not in kinds or mi.ObjectType.Shape in kinds:
        return None
    flipped = "flip_normals" in node.props and bool(node.props["flip_normals"])
    return tuple(parts), flipped


def _shape() -> Any:
    import mitsuba as mi

    return mi.ObjectType.Shape
