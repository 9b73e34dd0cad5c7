"""Which cameras a plan has: those that the user asks for, if they see anything.

Cameras around a room see the black backs of its walls, or the walls alone. A scene is taken for a
room if more than half of what such cameras meet is black, if no light falls on it, if from three
quarters of all places around the object it is not seen, or if the scene's own sensor stands
enclosed and next to none of them sees that place. Unless somebody asked for cameras around the
scene, they then are inside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ..base.checks import valid_size
from ..base.errors import InputError, Option
from ..scene_xml.scene_file import Bounds, SceneFile
from . import shots
from .probes import Hides, blocked
from .protocol import HOLD_OUT, PROTOCOLS, SPLITS, Options
from .rooms import is_enclosed
from .sensors import SensorCamera
from .shots import Shots
from .subject import Subject
from .survey import Survey, look, percent, sees

Array = np.ndarray[Any, Any]

_DARKNESS, _SEEING, _LIT, _HIDDEN, _ENCLOSED = 0.5, 0.25, 0.005, 0.9, 0.8
_NOTHING = 5e-3  # share of the pixels that sees the object by chance, past edges of walls
_WORTH_A_WORD = 0.02  # darkness that is mentioned


@dataclass(frozen=True, eq=False)
class Situation:
    """What is known of a scene when its cameras are chosen, and what the user wants."""

    file: SceneFile
    scene: Any
    box: Bounds  # of all that is visible
    up: Array
    sensors: Sequence[SensorCamera]
    subject: Subject
    options: Options
    hidden: Hides = True  # light sources that cameras around the object do not see

    @property
    def sensor(self) -> SensorCamera | None:
        """The scene's first sensor."""
        return self.sensors[0] if self.sensors else None


@dataclass(frozen=True, eq=False)
class Choice:
    """The cameras of a plan."""

    protocol: str
    shots: Shots
    survey: Survey  # what they see
    subject: Subject  # what they look at
    notes: tuple[str, ...] = ()  # for people, a line each


def protocol_name(file: SceneFile, options: Options) -> str:
    """The protocol that the user, or else the scene, asks for."""
    name = options.protocol or file.default("protocol") or "realistic360"
    if name not in PROTOCOLS:
        raise InputError(f"protocol '{name}': unknown, expected {', '.join(PROTOCOLS)}")
    return name


def choose(here: Situation) -> Choice:
    """Where the cameras stand.

    Raises:
        InputError: for options that make no sense, alone or for this scene.
    """
    name = protocol_name(here.file, here.options)
    if here.options.cameras == "scene":
        return _of_sensors(name, here)
    if name == "room":
        return _inside(here)
    size = valid_size(here.options.size or PROTOCOLS[name].size)
    counts = _counts(name, here.options)
    if name == "forward":
        beside = shots.forward(
            here.file, here.scene, here.sensor, here.box, here.up, size, counts, here.options
        )
        return _surveyed(name, here, beside, here.subject, hide=False)
    return _around(name, here, size, counts)


def _of_sensors(name: str, here: Situation) -> Choice:
    """The scene's own; before the sky or before nothing as the protocol says, lamps of rooms on."""
    cameras = [sensor for sensor in here.sensors if sensor.kind is None]
    chosen = shots.of_sensors(cameras, here.options.size, here.options, here.file.path)
    hide = name not in ("forward", "room") and not _stands_enclosed(here, cameras[0])
    return _surveyed(name, here, chosen, here.subject, hide=here.hidden if hide else False)


def _inside(here: Situation, *notes: str) -> Choice:
    size = valid_size(here.options.size or PROTOCOLS["room"].size)
    counts = _counts("room", here.options)
    chosen = shots.inside(here.scene, here.sensor, here.box, here.up, size, counts, here.options)
    return _surveyed("room", here, chosen, Subject(here.box), *notes, hide=False)


def _around(name: str, here: Situation, size: tuple[int, int], counts: dict[str, int]) -> Choice:
    """Cameras around the object, or inside if the scene is a room and nobody asked for others."""
    seeing = None if here.subject.is_all else partial(sees, here.scene, here.subject, here.hidden)
    chosen = shots.around(here.file, here.subject.box, here.up, size, counts, here.options, seeing)
    found = _surveyed(name, here, chosen, here.subject, hide=here.hidden)
    reason = _why_room(here, found)
    if reason is None:
        return found
    if not _wants_around(here):
        try:
            return _inside(here, f"{reason}: this is a room, cameras are inside")
        except InputError:
            reason += ", but there is no room either"
    if found.survey.coverage < _NOTHING and here.options.center is None:
        raise InputError(
            f"protocol '{name}': {reason}, and none sees the object, expected {{}}",
            Option("protocol", "room"),
        )
    seen = percent(found.survey.coverage)
    warning = f"warning: {reason}; {seen} of the pixels see the object"
    return replace(found, notes=(warning,))


def _surveyed(
    name: str, here: Situation, chosen: Shots, subject: Subject, *notes: str, hide: Hides
) -> Choice:
    """The choice, with what the training cameras see of the object."""
    poses, intrinsics = chosen.of([view for view in chosen.views if view.split == "train"])
    survey = look(here.scene, subject, poses, intrinsics, hide_emitters=hide)
    if survey.coverage == 0 and not notes:
        notes = ("warning: the cameras see nothing of the object",)
    elif chosen.share < 1 - _WORTH_A_WORD and not notes:
        notes = (f"{percent(1 - chosen.share)} of the places around it do not see the object",)
    elif survey.darkness > _WORTH_A_WORD and not notes:
        dark = percent(survey.darkness)
        notes = (f"{dark} of what the cameras see is the back of one-sided surfaces, black",)
    return Choice(name, chosen, survey, subject, notes)


# ---- Rooms -------------------------------------------------------------------


def _why_room(here: Situation, found: Choice) -> str | None:
    """Why cameras around the scene make no sense; None where they do."""
    survey = found.survey
    if survey.darkness > _DARKNESS:
        dark = percent(survey.darkness)
        return f"{dark} of what cameras around the scene see is the black back of its surfaces"
    if found.shots.share < _SEEING:
        return f"{percent(1 - found.shots.share)} of the places around the object do not see it"
    if survey.lit < _LIT and here.scene.emitters():
        return "no light falls on what cameras around the scene see"
    sensor = here.sensor
    if sensor is None or not _stands_enclosed(here, sensor):
        return None
    views = [view for view in found.shots.views if view.split == "train"]
    places = np.array([view.pose[:3, 3] for view in views])
    inside = np.broadcast_to(sensor.pose[:3, 3], places.shape)
    hidden = float(blocked(here.scene, places, inside).mean())
    if hidden < _HIDDEN:
        return None
    return f"{sensor.name} is enclosed, {percent(hidden)} of the cameras around the scene outside"


def _stands_enclosed(here: Situation, sensor: SensorCamera) -> bool:
    place = sensor.pose[:3, 3]
    if (place < here.box[0]).any() or (place > here.box[1]).any():
        return False
    return is_enclosed(here.scene, place, _ENCLOSED)


def _wants_around(here: Situation) -> bool:
    """Whether cameras around an object are what somebody asked for, not merely the default."""
    o = here.options
    given = (o.protocol, o.cameras, o.center, o.radius, o.object, here.file.default("protocol"))
    return any(value is not None for value in given)


# ---- Numbers -----------------------------------------------------------------


def _counts(name: str, options: Options) -> dict[str, int]:
    """How many views each split gets."""
    protocol = PROTOCOLS[name]
    counts = {}
    for split in SPLITS:
        given = getattr(options, split)
        counts[split] = getattr(protocol, split) if given is None else given
        if counts[split] < (split == "train"):
            least = "at least 1" if split == "train" else "0 or more"
            raise InputError("{}: expected {}", Option(split, counts[split]), least)
    if name == "forward" and options.test is None and options.train is not None:
        # Every eighth of all: one in seven of the training views, rounded up.
        counts["test"] = -(-counts["train"] // (HOLD_OUT - 1))
    return counts
