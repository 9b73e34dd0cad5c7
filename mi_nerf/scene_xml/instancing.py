"""Instances as copies: the same scene, compiled and traced faster.

Mitsuba compiles code of its own for every instance of a shape group, and bounds rotated
ones loosely. Copies of meshes merge into one mesh: a tree of 213 instanced sprays compiles
in 1.3 s instead of 16 s that way, and renders in two thirds of the time. Memory grows with
the copies, so scenes of very many instances stay as they are.
"""

from __future__ import annotations

from typing import Any

MAX_COPIES = 5000


def copy_instances(state: Any, limit: int | None = None) -> None:
    """Replaces the scene's instances by what they show, moved into place.

    Args:
        state: A ``mi.parser.ParserState`` whose references are resolved.
        limit: Number of copies beyond which nothing is changed; default: ``MAX_COPIES``.
    """
    import mitsuba as mi

    nodes = state.nodes
    groups = {
        i: [index for _, index in _children(node.props)]
        for i, node in enumerate(nodes)
        if node.props.plugin_name() == "shapegroup"
    }
    root = state.root.props
    shown = [(key, nodes[i].props) for key, i in _children(root)]
    instances = [(key, props) for key, props in shown if props.plugin_name() == "instance"]
    wanted = [(props, member) for _, props in instances for member in _members(props, groups)]
    if not instances or len(wanted) > (MAX_COPIES if limit is None else limit):
        return
    for key, index in _children(root):
        if index in groups or key in {name for name, _ in instances}:
            del root[key]
    copies: list[Any] = []
    for instance, member in wanted:
        copy = mi.parser.SceneNode(nodes[member])
        _place(copy.props, instance)
        number = len(nodes) + len(copies)
        root[f"copy_{number}"] = mi.Properties.ResolvedReference(number)
        copies.append(copy)
    for copy in copies:  # at last: a node that is added moves all others in memory
        nodes.append(copy)


def _children(props: Any) -> list[tuple[str, int]]:
    """Names and node numbers of the objects that an object refers to."""
    import mitsuba as mi

    values = [(key, props[key]) for key in props.keys()]  # noqa: SIM118
    return [(k, v.index()) for k, v in values if isinstance(v, mi.Properties.ResolvedReference)]


def _members(instance: Any, groups: dict[int, list[int]]) -> list[int]:
    """The shapes of the group that an instance shows."""
    return [member for _, index in _children(instance) for member in groups.get(index, [])]


def _place(shape: Any, instance: Any) -> None:
    """Gives a copied shape the place and a name that its instance had."""
    if "to_world" in instance:
        outer = instance["to_world"]
        shape["to_world"] = outer @ shape["to_world"] if "to_world" in shape else outer
    shape.set_id(f"{instance.id()}_{shape.id()}")
