"""A scene's sensors, made such that Mitsuba takes them one by one as cameras."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from .scene_file import SceneFile

_LOOKAT_UP = re.compile(r"""<look_?at\b[^>]*?\bup\s*=\s*["']([^"']*)["']""", re.IGNORECASE)
_SENSOR = re.compile(r"<sensor\b.*?</sensor\s*>", re.IGNORECASE | re.DOTALL)
_CAMERAS = ("perspective", "thinlens")  # of others a scale is the width of what they see
_SCALE_TOLERANCE = 1e-4  # of the axes' lengths; Mitsuba refuses cameras that scale


def separate_sensors(state: Any) -> list[str]:
    """Unpacks sensors of type ``batch``, and takes scales out of poses.

    The parts of a batch get its sampler, and its film divided among them, as in Mitsuba.

    Args:
        state: What Mitsuba's parser found, not loaded yet.

    Returns:
        What was changed, a line each.
    """
    return _unpack_batches(state) + _unscale(state)


def _unpack_batches(state: Any) -> list[str]:
    """Puts what a batch holds in its place, in the order of the file."""
    import mitsuba as mi

    root, notes = state.root.props, []
    sensors = [(k, i) for k, i in _objects(state, state.root.props, mi.ObjectType.Sensor)]
    if not any(state.nodes[i].props.plugin_name() == "batch" for _, i in sensors):
        return []
    for key, _ in sensors:
        del root[key]
    films: list[Any] = []
    for key, index in sensors:
        batch = state.nodes[index].props
        if batch.plugin_name() != "batch":
            root[key] = mi.Properties.ResolvedReference(index)
            continue
        members = _objects(state, batch, mi.ObjectType.Sensor)
        notes.append(f"{_name(batch)}, a batch, is unpacked into its {len(members)} sensors")
        for number, (_, member) in enumerate(members):
            root[f"{key}_{number}"] = mi.Properties.ResolvedReference(member)
            _share(state, batch, state.nodes[member].props, len(members), films)
    for film in films:  # at last: a node that is added moves all others in memory
        state.nodes.append(film)
    return notes


def _share(state: Any, batch: Any, member: Any, count: int, films: list[Any]) -> None:
    """Gives a member of a batch its part of the film, and the sampler."""
    import mitsuba as mi

    for kind in (mi.ObjectType.Film, mi.ObjectType.Sampler):
        for key, _ in _objects(state, member, kind):
            del member[key]
    for key, index in _objects(state, batch, mi.ObjectType.Sampler):
        member[key] = mi.Properties.ResolvedReference(index)
    for key, index in _objects(state, batch, mi.ObjectType.Film):
        film = mi.parser.SceneNode(state.nodes[index])
        film.props["width"] = int(film.props.get("width", 768)) // count
        member[key] = mi.Properties.ResolvedReference(len(state.nodes) + len(films))
        films.append(film)


def _unscale(state: Any) -> list[str]:
    """Takes scale and shear out of sensors' poses; mirroring stays."""
    import mitsuba as mi

    notes = []
    for node in state.nodes:
        if node.props.plugin_name() not in _CAMERAS or "to_world" not in node.props:
            continue
        matrix = np.array(node.props["to_world"].matrix, np.float64)
        axes = matrix[:3, :3]
        if np.abs(axes.T @ axes - np.eye(3)).max() <= _SCALE_TOLERANCE:
            continue
        if not np.linalg.matrix_rank(axes) == 3:
            continue  # nothing that a camera could be made of: Mitsuba says so
        matrix[:3, :3] = _orthonormal(axes)
        node.props["to_world"] = mi.ScalarTransform4d(matrix.tolist())
        notes.append(f"{_name(node.props)}: its to_world scales, which is left out")
    return notes


def _orthonormal(axes: Any) -> Any:
    """Viewing direction as it is, then upwards; the third axis on the side where it was."""
    forward = axes[:, 2] / np.linalg.norm(axes[:, 2])
    upward = axes[:, 1] - (axes[:, 1] @ forward) * forward
    upward /= np.linalg.norm(upward)
    left = np.cross(upward, forward) * np.sign(np.linalg.det(axes))
    return np.stack([left, upward, forward], axis=1)


def _name(props: Any) -> str:
    return f"sensor '{props.id()}'" if props.id() else "a sensor"


def _objects(state: Any, props: Any, kind: Any) -> list[tuple[str, int]]:
    """Names and node numbers of the objects of a kind that a plugin refers to."""
    import mitsuba as mi

    found = []
    for key in props.keys():  # noqa: SIM118
        value = props[key]
        if isinstance(value, mi.Properties.Reference) and value.id() in state.id_to_index:
            index = state.id_to_index[value.id()]
        elif isinstance(value, mi.Properties.ResolvedReference):
            index = value.index()
        else:
            continue
        if state.nodes[index].type == kind:
            found.append((key, index))
    return found


def named_ups(file: SceneFile) -> list[Any]:
    """The directions that ``lookat`` elements of sensors call up, (3,) each, as they stand there.

    A loaded sensor knows them no more: its own upward axis is square to where it looks. Values
    that come from parameters are left out.
    """
    found = []
    for path in [Path(str(name)) for name in file.state.files]:
        try:
            text = path.read_text(encoding="utf-8", errors="replace")
        except OSError:
            continue
        sensors = " ".join(_SENSOR.findall(text))  # lights look somewhere, too
        for value in _LOOKAT_UP.findall(sensors):
            try:
                up = np.array([float(word) for word in re.split(r"[\s,]+", value.strip())])
            except ValueError:
                continue
            if up.shape == (3,) and np.isfinite(up).all() and up.any():
                found.append(up / np.linalg.norm(up))
    return found
