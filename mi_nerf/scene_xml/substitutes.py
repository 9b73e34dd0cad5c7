"""What does not matter to a task is no reason to refuse a scene: it is replaced, and said so.

Films, samplers and light transport algorithms of older Mitsubas, or of other programs that read
its XML, do not exist in the one that is installed. Where a task brings its own anyway, a plugin
of the same kind takes their place, with those of their properties that it knows.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any

from .instancing import children

# What stands in for an unknown plugin of each kind. Parts come before what holds them.
_STAND_INS = {
    "ReconstructionFilter": "gaussian",
    "Film": "hdrfilm",
    "Sampler": "independent",
    "Sensor": "perspective",
    "Integrator": "path",
}
REPLACEABLE = tuple(_STAND_INS)  # kinds that a dataset does not depend on, or brings its own of

# Ways to the same picture that a path tracer finds as well, in Mitsuba 0.4 to 0.6.
_TRANSPORT = frozenset(
    "adaptive bdpt erpt irrcache mlt photonmapper ppm pssmlt sppm volpath_simple vpl".split()
)
_DEPTHS = ("max_depth", "rr_depth", "hide_emitters")  # what all of them have in common
_SIZES = ("width", "height", "crop_width", "crop_height", "crop_offset_x", "crop_offset_y")

# What is kept where the plugin refuses the rest.
_KEPT = {
    "Film": _SIZES,
    "Sampler": ("sample_count",),
    "Sensor": ("to_world", "fov", "fov_axis"),
    "Integrator": _DEPTHS,
    "ReconstructionFilter": (),
}


def substitute(state: Any, kinds: Iterable[str]) -> list[str]:
    """Replaces unknown plugins of some kinds by the usual ones; says what was replaced by what.

    Of films, samplers and reconstruction filters, properties that the plugin does not know go as
    well. Integrators are replaced only where a path tracer makes the same picture.

    Args:
        state: A ``mi.parser.ParserState``, upgraded, whose references are resolved.
        kinds: Names of ``mi.ObjectType``: any of Film, Integrator, ReconstructionFilter,
            Sampler, Sensor.
    """
    import mitsuba as mi

    wanted = set(kinds)
    notes = []
    for kind, stand_in in _STAND_INS.items():
        if kind not in wanted:
            continue
        for node in state.nodes:
            if node.type == getattr(mi.ObjectType, kind):
                notes += _mend(state, node.props, kind, stand_in)
    return list(dict.fromkeys(notes))  # once for all of several sensors


def add_integrator(state: Any) -> list[str]:
    """Adds what shows all that a scene holds, if there is no integrator; says so."""
    import mitsuba as mi

    if any(node.type == mi.ObjectType.Integrator for node in state.nodes):
        return []
    media = {n.props.plugin_name() for n in state.nodes if n.type == mi.ObjectType.Medium}
    name = "nerf" if "nerfmedium" in media else "volpath" if media else "path"
    node = mi.parser.SceneNode()
    node.type = mi.ObjectType.Integrator
    node.props = mi.Properties(name)
    state.root.props["added_integrator"] = mi.Properties.ResolvedReference(len(state.nodes))
    state.nodes.append(node)
    return [f"no integrator in the scene, '{name}' is taken"]


def _mend(state: Any, props: Any, kind: str, stand_in: str) -> list[str]:
    """Makes one plugin one that exists, if that is this task's business."""
    if kind == "Integrator":
        return _other_transport(state, props)
    name = props.plugin_name()
    known = _exists(name, kind)
    if known and kind == "Sensor":
        return []
    found = _tried(props, [name, stand_in] if known else [stand_in], _KEPT[kind])
    if found is None:  # loading the scene tells why
        return []
    name_now, left = found
    gone = [key for key in _own(props) if key not in left]
    for key in gone:
        del props[key]
    props.set_plugin_name(name_now)
    if name_now != name:
        fault = "cannot be used here" if known else "does not exist in this Mitsuba"
        return [f"{_words(kind)} '{name}' {fault}, taken as '{name_now}'"]
    return [f"{_words(kind)} '{name}': {', '.join(gone)} not understood, left out"] if gone else []


def _other_transport(state: Any, props: Any) -> list[str]:
    """A path tracer in place of an algorithm that would make the same picture."""
    import mitsuba as mi

    name = props.plugin_name()
    if name not in _TRANSPORT or _exists(name, "Integrator"):
        return []
    has_media = any(node.type == mi.ObjectType.Medium for node in state.nodes)
    stand_in = "volpath" if has_media else _STAND_INS["Integrator"]
    for key, index in children(props):  # the one that an adaptive or caching integrator asks
        inner = state.nodes[index].props
        for depth in _DEPTHS:
            if depth in inner and depth not in props:
                props[depth] = inner[depth]
        del props[key]
    for key in props.keys():  # noqa: SIM118
        if key not in _DEPTHS:
            del props[key]
    props.set_plugin_name(stand_in)
    return [f"integrator '{name}' does not exist in this Mitsuba, '{stand_in}' in its place"]


def _tried(props: Any, names: list[str], kept: tuple[str, ...]) -> tuple[str, set[str]] | None:
    """The first of some plugins that can be made, and with which properties; or ``None``."""
    import mitsuba as mi

    manager = mi.PluginManager.instance()
    everything = _own(props)
    few = [key for key in everything if key in kept]
    for name, keys in itertools.product(names, (everything, few)):
        trial = mi.Properties(props)
        for key in trial.keys():  # noqa: SIM118
            if key not in keys:
                del trial[key]
        trial.set_plugin_name(name)
        try:
            manager.create_object(trial)
        except RuntimeError:
            continue
        return name, set(keys) - set(trial.unqueried())
    return None


def _own(props: Any) -> list[str]:
    """The names of an object's properties that are no other objects."""
    others = {key for key, _ in children(props)}
    return [key for key in props.keys() if key not in others]  # noqa: SIM118


def _exists(name: str, kind: str) -> bool:
    """Whether there is a plugin of this name and kind."""
    import mitsuba as mi

    manager = mi.PluginManager.instance()
    found = manager.plugin_type(name)
    if found != mi.ObjectType.Unknown:
        return bool(found == getattr(mi.ObjectType, kind))
    try:  # of plugins in Python, the type is not told
        manager.create_object(mi.Properties(name))
    except RuntimeError as error:
        return f'Plugin "{name}" not found' not in str(error)
    return True


def _words(kind: str) -> str:
    return "reconstruction filter" if kind == "ReconstructionFilter" else kind.lower()
