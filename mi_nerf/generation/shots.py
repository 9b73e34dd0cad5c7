"""Where the cameras of each kind of protocol stand, and what they are like."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..base.checks import positive
from ..base.errors import InputError, Option
from ..cameras.pinhole import Intrinsics
from ..cameras.poses import look_at
from ..scene_xml.scene_file import Bounds, SceneFile
from . import viewpoints
from .plan import View
from .protocol import CAMERA_ANGLE_X, HOLD_OUT, RADIUS, SPLITS, Cameras, Options
from .rooms import find_room
from .sensors import CAMERAS, SensorCamera, in_size
from .surfaces import depth_bounds, trace_surfaces

Array = np.ndarray[Any, Any]

Seeing = Callable[[Array, Intrinsics], Array]  # which of (N, 4, 4) poses see the object, (N,)

_SPARE = 4  # places for each camera, of which some may not see the object
_UNIT_BOX = 1.001  # a scene inside [-1, 1]^3, but for rounding, gets the paper's cameras,
_SMALLEST = 0.4  # unless it is smaller than a fifth of that
# Forward-facing views: how far cameras move sideways, per distance of the nearest content.
_SPREAD = 0.4
_ROOM_ANGLE = math.radians(75)  # of cameras in rooms: horizontal field of view
_ROOM_ANGLES = math.radians(40), math.radians(100)  # that is taken from a sensor in the room


@dataclass(frozen=True)
class Shots:
    """The part of a plan that depends on the kind of protocol."""

    cameras: Cameras
    intrinsics: Intrinsics
    views: tuple[View, ...]
    center: Array
    radius: float
    share: float = 1.0  # of places around the object that see it

    def of(self, views: Sequence[View]) -> tuple[list[Array], list[Intrinsics]]:
        """Poses and intrinsics of views."""
        return [v.pose for v in views], [v.intrinsics or self.intrinsics for v in views]


# ---- Around an object --------------------------------------------------------


def around(
    file: SceneFile,
    box: Bounds,
    up: Array,
    size: tuple[int, int],
    counts: dict[str, int],
    options: Options,
    seeing: Seeing | None = None,
) -> Shots:
    """Cameras on a (hemi)sphere around the object.

    Args:
        box: The object's.
        seeing: Which cameras see it; others are passed over, if there are enough.
    """
    center, radius = _center_and_radius(box, options)
    cameras = options.cameras or file.default("cameras") or "hemisphere"
    if cameras not in ("hemisphere", "sphere"):
        raise InputError(f"{file.path}: cameras '{cameras}', expected hemisphere or sphere")
    sphere: Cameras = "sphere" if cameras == "sphere" else "hemisphere"
    intrinsics = Intrinsics.from_angle_x(*size, CAMERA_ANGLE_X)
    elevation = _elevation(options)
    views, seen, asked = [], 0, 0
    for split, count in counts.items():
        places = count if seeing is None else _SPARE * count
        poses = viewpoints.around(
            places,
            split,
            options.seed,
            cameras=sphere,
            up=up,
            center=center,
            radius=radius,
            elevation=elevation,
        )
        if seeing is not None and count:
            good = seeing(poses, intrinsics)
            seen, asked = seen + int(good.sum()), asked + len(good)
            poses = poses[good] if good.sum() >= count else poses
        views += [View(split, i, pose, options.seed) for i, pose in enumerate(poses[:count])]
    share = seen / asked if asked else 1.0
    return Shots(sphere, intrinsics, tuple(views), center, radius, share)


def _center_and_radius(box: Bounds, options: Options) -> tuple[Array, float]:
    """The origin and 4, as in the paper, for what lies in [−1, 1]³; the same proportions else."""
    corners = np.array(box)
    extent = float(np.ptp(corners, axis=0).max())
    fits = np.abs(corners).max() <= _UNIT_BOX and extent >= _SMALLEST and options.object is None
    center = np.zeros(3) if fits else corners.mean(axis=0)
    if options.center is not None:
        center = np.array(options.center)
    reach = 1.0 if fits else extent / 2
    radius = RADIUS * reach if options.radius is None else options.radius
    if not np.isfinite(center).all():
        raise InputError("{}: expected three finite numbers", Option("center", options.center))
    return center, positive("radius", radius)


def _elevation(options: Options) -> tuple[float, float] | None:
    """Between which angles the cameras stand, checked: straight up there is no upright."""
    if options.elevation is not None:
        low, high = options.elevation
        if not -90 < low <= high < 90:
            raise InputError(
                "{}: expected two angles between -90 and 90 degrees, the lower one first",
                Option("elevation", options.elevation),
            )
    return options.elevation


# ---- Beside the scene's sensor -----------------------------------------------


def forward(
    file: SceneFile,
    scene: Any,
    sensor: SensorCamera | None,
    box: Bounds,
    up: Array,
    size: tuple[int, int],
    counts: dict[str, int],
    options: Options,
) -> Shots:
    """Cameras beside the scene's own, all looking the same way."""
    refuse(options, "the protocol 'forward'", "cameras", "center", "elevation", "object")
    pose, angle = _own_camera(sensor, box, up)
    intrinsics = Intrinsics.from_angle_x(*size, angle)
    spread = options.radius
    if spread is None:
        spread = _own_spread(file)
    if spread is None:
        spread = _SPREAD * _nearest(scene, intrinsics, pose)
    positive("radius", spread)
    poses = viewpoints.forward(sum(counts.values()), options.seed, pose, spread)
    views = [
        View(split, i, poses[k], options.seed)
        for k, (split, i) in enumerate(_hold_out(len(poses), counts))
    ]
    return Shots("forward", intrinsics, tuple(views), pose[:3, 3], spread)


def refuse(options: Options, what: str, *names: str) -> None:
    """InputError if any of these options is given."""
    for name in names:
        if getattr(options, name) is not None:
            raise InputError(f"{{}}: has no meaning for {what}", Option(name))


def _own_spread(file: SceneFile) -> float | None:
    """How far the scene itself wants forward-facing cameras to move."""
    told = file.default("spread")
    try:
        return None if told is None else float(told)
    except ValueError:
        raise InputError(f"{file.path}: spread '{told}', expected a number above 0") from None


def _own_camera(sensor: SensorCamera | None, box: Bounds, up: Array) -> tuple[Array, float]:
    """Pose and horizontal field of view of the scene's sensor, or of one outside its box."""
    if sensor is not None:
        return sensor.pose, sensor.full_angle_x
    lower, upper = np.array(box)
    _, front = viewpoints.horizontal_axes(up)
    center, reach = (lower + upper) / 2, float((upper - lower).max()) / 2
    return look_at(center - RADIUS * reach * front, center, up), CAMERA_ANGLE_X


def _nearest(scene: Any, intrinsics: Intrinsics, pose: Array) -> float:
    """z-depth of the nearest content that a camera sees."""
    depth, _ = trace_surfaces(scene, intrinsics, pose, hide_emitters=False)
    bounds = depth_bounds(intrinsics, depth)
    if bounds is None:
        raise InputError("the scene's sensor sees nothing, expected content before it")
    return bounds[0]


# ---- Inside a room -----------------------------------------------------------


def inside(
    scene: Any,
    sensor: SensorCamera | None,
    box: Bounds,
    up: Array,
    size: tuple[int, int],
    counts: dict[str, int],
    options: Options,
) -> Shots:
    """Cameras inside a room that look about.

    Args:
        box: Of all that is visible.
    """
    refuse(options, "the protocol 'room'", "cameras", "center", "radius", "elevation", "object")
    start = None if sensor is None else sensor.pose[:3, 3]
    room = find_room(scene, box, up, start, options.seed)
    angle = _ROOM_ANGLE
    if sensor is not None and start is not None:
        if (start >= box[0]).all() and (start <= box[1]).all():
            angle = min(max(sensor.full_angle_x, _ROOM_ANGLES[0]), _ROOM_ANGLES[1])
    intrinsics = Intrinsics.from_angle_x(*size, angle)
    views = []
    for stream, (split, count) in enumerate(counts.items()):
        poses = room.poses(count, options.seed, stream, intrinsics)
        views += [View(split, i, pose, options.seed) for i, pose in enumerate(poses)]
    return Shots("room", intrinsics, tuple(views), room.middle, room.clear)


# ---- The scene's own sensors -------------------------------------------------


def of_sensors(
    sensors: Sequence[SensorCamera], size: tuple[int, int] | None, options: Options, path: Any
) -> Shots:
    """Every sensor of the scene, as it is; every eighth is held out."""
    refuse(options, "the scene's own sensors", "center", "radius", "elevation")
    if not sensors:
        raise InputError(f"{path}: has no sensor that is a camera, expected one of {CAMERAS}")
    counts = _sensor_counts(len(sensors), options)
    chosen = _chosen(len(sensors), counts)
    films = [in_size(sensor, size) for sensor in sensors]
    one = all(film == films[0] for film in films)
    views = [
        View(
            split,
            number,
            sensors[k].pose,
            options.seed,
            None if one else films[k],
            sensors[k].lens,
        )
        for k, split, number in chosen
    ]
    centers = np.array([view.pose[:3, 3] for view in views])
    middle = centers.mean(axis=0)
    radius = float(np.linalg.norm(centers - middle, axis=1).max())
    return Shots("scene", films[0], tuple(views), middle, radius)


def _sensor_counts(total: int, options: Options) -> dict[str, int]:
    """How many sensors each split gets: for testing every eighth, for training all others."""
    val = options.val or 0
    test = options.test
    if test is None:
        test = -(-total // HOLD_OUT) if total > 1 and options.train is None else 0
        if options.train is not None:
            test = min(-(-total // HOLD_OUT), max(0, total - options.train - val))
    train = total - test - val if options.train is None else options.train
    if min(train - 1, val, test) < 0 or train + val + test > total:
        raise InputError(
            "{}, {}, {}: the scene has {} sensors, expected at least 1 for training and no more "
            "in all",
            *(Option(name, n) for name, n in (("train", train), ("val", val), ("test", test))),
            total,
        )
    return {"train": train, "val": val, "test": test}


def _chosen(total: int, counts: dict[str, int]) -> list[tuple[int, str, int]]:
    """The number of a sensor, its split and its number there, split by split."""
    test = _evenly(range(total), counts["test"])
    left = [k for k in range(total) if k not in test]
    val = _evenly(left, counts["val"])
    train = _evenly([k for k in left if k not in val], counts["train"])
    found = []
    for split, members in zip(SPLITS, (train, val, test), strict=True):
        found += [(k, split, i) for i, k in enumerate(sorted(members))]
    return found


# ---- Held out ----------------------------------------------------------------


def _hold_out(total: int, counts: dict[str, int]) -> list[tuple[str, int]]:
    """Split and number of each view: test views evenly spread, every eighth by default."""
    test = _evenly(range(total), counts["test"])
    val = _evenly([i for i in range(total) if i not in test], counts["val"])
    found, number = [], {"train": 0, "val": 0, "test": 0}
    for i in range(total):
        split = "test" if i in test else "val" if i in val else "train"
        found.append((split, number[split]))
        number[split] += 1
    return found


def _evenly(items: Any, count: int) -> set[int]:
    """``count`` of the items; every eighth where that makes as many."""
    if count == -(-len(items) // HOLD_OUT):
        return set(items[::HOLD_OUT])
    return {items[i * len(items) // count] for i in range(count)}
