"""From a user's wishes and a scene to a plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..base.errors import InputError, Option
from ..scene_xml.parts import Part, box_of, read_parts
from ..scene_xml.scene_file import Bounds, SceneFile
from ..scene_xml.sensors import named_ups
from .choosing import Choice, Situation, choose, protocol_name
from .emitters import Hidden
from .passes import taken
from .plan import Plan, halves
from .protocol import Options
from .sensors import SensorCamera, read_sensors
from .subject import Subject, find_subject, told_subject
from .upright import told_up, vertical

__all__ = ["make_plan", "protocol_name", "with_kept"]

Array = np.ndarray[Any, Any]

_DEFAULT_SPP = 128  # of scenes whose sensor has no sampler
_THIN = 1e-3  # of its largest extent a box has at least in each direction: readers want a volume
_MARGIN = 0.05  # around what is seen of a room


def make_plan(
    file: SceneFile, scene: Any, box: Bounds, options: Options, hidden: Hidden | None = None
) -> Plan:
    """Decides everything that the user left open.

    Args:
        scene: ``file``, loaded.
        box: Of the visible shapes of ``scene``.
        hidden: Light sources that cameras around the object do not see; default: all.

    Raises:
        InputError: for options that make no sense, alone or for this scene.
    """
    spp, about_samples = _samples(file, scene, options)
    sensors = read_sensors(scene) if file.plugins("Sensor") else []
    parts = with_kept(read_parts(file), scene, hidden)
    box = _together(box, box_of(parts))
    if options.up is None:
        up, why = vertical(sensors, named_ups(file), parts)
    else:
        up, why = told_up(options.up), "what was told"
    subject = _subject(parts, box, sensors, options, hidden is None or hidden.any)
    choice = choose(Situation(file, scene, box, up, sensors, subject, options, hidden or True))
    return Plan(
        protocol=choice.protocol,
        cameras=choice.shots.cameras,
        intrinsics=choice.shots.intrinsics,
        spp=spp,
        seed=options.seed,
        views=choice.shots.views,
        box=box,
        region=_region(box, choice),
        up=_triple(up),
        center=_triple(choice.shots.center),
        radius=choice.shots.radius,
        elevation=options.elevation,
        hide_emitters=choice.survey.hide_emitters,
        subject=choice.subject,
        survey=choice.survey,
        keep_emitters=options.keep_emitters,
        notes=(
            *about_samples,
            f"up is taken from {why}",
            *filter(None, [str(choice.subject)]),
            *choice.notes,
            *_about_sensors(sensors, choice),
            str(choice.survey),
        ),
    )


def with_kept(parts: Sequence[Part], scene: Any, hidden: Hidden | None) -> list[Part]:
    """The parts, of which light sources that are seen are like others."""
    if hidden is None or not hidden.chosen:
        return list(parts)
    kept = [s for s in scene.shapes() if s.is_emitter() and hidden.keeps(s)]
    names = {shape.id() for shape in kept}
    boxes = {_corners(shape.bbox().min, shape.bbox().max) for shape in kept}  # many have no name
    return [
        replace(part, glows=False)
        if part.name in names or _corners(part.lower, part.upper) in boxes
        else part
        for part in parts
    ]


def _corners(lower: Any, upper: Any) -> bytes:
    """A box as it can be looked up."""
    return np.float32(np.concatenate([np.ravel(lower), np.ravel(upper)])).tobytes()


def _together(a: Bounds, b: Bounds | None) -> Bounds:
    """The box around two."""
    if b is None:
        return a
    return _triple(np.minimum(a[0], b[0])), _triple(np.maximum(a[1], b[1]))


def _subject(
    parts: Sequence[Part],
    box: Bounds,
    sensors: Sequence[SensorCamera],
    options: Options,
    hides: bool,
) -> Subject:
    """What the cameras look at.

    Args:
        hides: Whether parts that glow are not seen.
    """
    if options.object is not None:
        subject = told_subject(parts, options.object)
        if hides and all(part.glows for part in parts if part.name in subject.names):
            raise InputError(
                "{}: a light source, which is not seen, expected {}",
                Option("object", " ".join(options.object)),
                Option("keep_emitters", " ".join(subject.names)),
            )
        return subject
    cameras = [sensor for sensor in sensors if sensor.kind is None]
    return find_subject(parts, box, cameras[0] if cameras else None)


def _region(box: Bounds, choice: Choice) -> Bounds:
    """The box of what a field should hold: the scene, or its part near the cameras."""
    lower, upper = np.array(box)
    shots = choice.shots
    if shots.cameras == "room":
        ends = np.quantile(choice.survey.points, [0.001, 0.999], axis=0)
        margin = _MARGIN * float(np.ptp(ends, axis=0).max())
        lower, upper = ends[0] - margin, ends[1] + margin
    elif shots.cameras in ("hemisphere", "sphere") and not choice.subject.is_all:
        lower = np.maximum(lower, shots.center - shots.radius)
        upper = np.minimum(upper, shots.center + shots.radius)
    least = _THIN * float((upper - lower).max())
    pad = np.where(upper - lower < least, least, 0.0)
    return _triple(lower - pad), _triple(upper + pad)


def _about_sensors(sensors: Sequence[SensorCamera], choice: Choice) -> list[str]:
    """What of the scene's sensors is not used, or not as the scene has it."""
    taken = choice.shots.cameras == "scene"
    notes = []
    if taken:
        lost = [f"{s.name} ({s.kind})" for s in sensors if s.kind is not None]
        if lost:
            notes.append(f"not taken, as no cameras of a dataset: {', '.join(lost)}")
    elif len(sensors) > 1:
        notes.append(
            f"{len(sensors) - 1} of the scene's {len(sensors)} sensors are not used: "
            "--cameras scene takes them all"
        )
    here = [s for s in sensors if s.kind is None] if taken else sensors[:1]
    mirrored = [s.name for s in here if s.mirrored]
    if mirrored and (taken or choice.shots.cameras == "forward"):
        notes.append(f"mirrored: {', '.join(mirrored)}; pictures are not, x is turned round")
    notes += _about(
        "lens", [s for s in here if s.lens], taken, "transforms hold the pinhole in its centre"
    )
    notes += _about(
        "crop window", [s for s in here if s.cropped], taken, "pictures are the window alone"
    )
    return notes


def _about(what: str, having: Sequence[SensorCamera], taken: bool, how: str) -> list[str]:
    if not having:
        return []
    if taken:
        return [f"{what}: {', '.join(s.name for s in having)}; {how}"]
    return [f"the {what} of {having[0].name} is not used: --cameras scene takes it"]


# ---- Numbers -----------------------------------------------------------------


def _samples(file: SceneFile, scene: Any, options: Options) -> tuple[int, list[str]]:
    """Samples a pixel, and a note where they are not those that were wanted."""
    has_sampler = bool(file.plugins("Sampler")) and bool(file.plugins("Sensor"))
    sampler = scene.sensors()[0].sampler() if has_sampler else None
    wanted = options.spp
    if wanted is None:
        wanted = _DEFAULT_SPP if sampler is None else int(sampler.sample_count())
    if wanted < 2:
        raise InputError(
            "{}: expected at least 2, of which the noise is estimated", Option("spp", wanted)
        )
    if sampler is None or (spp := _divisible(sampler, wanted)) == wanted:
        return wanted, []
    kind = sampler.class_name()
    return spp, [f"{spp} samples a pixel: the scene's sampler {kind} cannot take half of {wanted}"]


def _divisible(sampler: Any, spp: int) -> int:
    """So many samples, or some more where a sampler cannot take half of them."""
    for half in halves(spp):
        if half > 0 and (found := taken(half, sampler)) != half:
            return 2 * found
    return spp


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = np.asarray(values, np.float64).tolist()
    return x, y, z
