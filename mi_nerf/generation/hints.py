"""What a scene says about its own dataset, by ``<default name="…" value="…"/>``."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from ..base.errors import InputError
from ..scene_xml.scene_file import SceneFile
from .protocol import Options

_AROUND = ("realistic360", "diffuse360")


def with_hints(file: SceneFile, options: Options) -> Options:
    """Fills in what the user left open from the scene's own defaults, for 360° protocols.

    ``cameras_object`` names the object's shapes, ``cameras_center`` and ``cameras_radius`` say
    what the cameras look at and from how far, ``cameras_elevation`` between which angles over its
    horizon, in degrees, and ``keep_emitters`` which light sources are seen. What the user says
    counts more: with another centre, or an object, the scene's own and its distance do not hold
    either.

    Raises:
        InputError: for a default that is not as many finite numbers as expected.
    """
    protocol = options.protocol or file.default("protocol") or _AROUND[0]
    if protocol not in _AROUND or options.cameras == "scene":
        return options
    found: dict[str, Any] = {}
    elsewhere = options.center is not None or options.object is not None
    if not elsewhere:
        names = file.default("cameras_object")
        found["object"] = None if names is None else tuple(names.replace(",", " ").split())
        found["center"] = _numbers(file, "cameras_center", 3)
        if options.radius is None:
            radius = _numbers(file, "cameras_radius", 1)
            found["radius"] = None if radius is None else radius[0]
    if options.elevation is None:
        found["elevation"] = _numbers(file, "cameras_elevation", 2)
    if not options.keep_emitters:
        kept = file.default("keep_emitters")
        found["keep_emitters"] = None if kept is None else tuple(kept.replace(",", " ").split())
    return replace(options, **{name: value for name, value in found.items() if value is not None})


def _numbers(file: SceneFile, name: str, count: int) -> tuple[float, ...] | None:
    """The numbers that a default lists, with or without commas."""
    text = file.default(name)
    if text is None:
        return None
    try:
        values = tuple(float(word) for word in text.replace(",", " ").split())
    except ValueError:
        values = ()
    if len(values) != count or not all(map(math.isfinite, values)):
        expected = "a finite number" if count == 1 else f"{count} finite numbers"
        raise InputError(f"{file.path}: {name} '{text}', expected {expected}")
    return values
