"""From a user's wishes and a scene to all that determines a dataset."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..base.checks import positive, valid_size
from ..base.errors import InputError, Option
from ..cameras.pinhole import Intrinsics
from ..cameras.poses import look_at, opengl_from_mitsuba
from ..scene_xml.scene_file import Bounds, SceneFile
from . import viewpoints
from .protocol import CAMERA_ANGLE_X, HOLD_OUT, PROTOCOLS, RADIUS, SPLITS, Cameras, Options
from .surfaces import depth_bounds, trace_surfaces

Array = np.ndarray[Any, Any]

_DEFAULT_SPP = 128  # of scenes whose sensor has no sampler
_UNIT_BOX = 1.001  # a scene inside [-1, 1]^3, but for rounding, gets the paper's cameras
# Forward-facing views: how far cameras move sideways, per distance of the nearest content.
_SPREAD = 0.4


@dataclass(frozen=True)
class View:
    """One image to be made."""

    split: str
    index: int  # within the split
    pose: Array  # (4, 4) OpenGL camera-to-world
    seed: int  # of the dataset

    @property
    def name(self) -> str:
        """Its files' common path in the dataset, such as ``train/r_0``."""
        return f"{self.split}/r_{self.index}"

    def render_seed(self, half: int, part: int) -> int:
        """A seed for each rendering, which does not depend on how many views there are."""
        sequence = np.random.SeedSequence(
            [self.seed, SPLITS.index(self.split), self.index, half, part]
        )
        return int(sequence.generate_state(1, np.uint32)[0])


@dataclass(frozen=True)
class Plan:
    """Everything that a dataset follows from, apart from the scene itself."""

    protocol: str
    cameras: Cameras
    intrinsics: Intrinsics
    spp: int
    seed: int
    views: tuple[View, ...]
    box: Bounds  # of all that is visible
    up: tuple[float, float, float]
    center: tuple[float, float, float]  # what the cameras look at; forward: where they are
    radius: float  # their distance from it; forward: how far they move from it
    keep_emitters: tuple[str, ...] = ()  # light sources that are seen all the same

    @property
    def halves(self) -> tuple[int, int]:
        """Samples a pixel of the two images from which the noise is estimated."""
        return halves(self.spp)

    @property
    def hide_emitters(self) -> bool:
        """Objects are seen before nothing, forward-facing scenes before their sky."""
        return self.cameras != "forward"

    @property
    def pixels(self) -> int:
        """Of one image."""
        return self.intrinsics.width * self.intrinsics.height

    @property
    def scale(self) -> float:
        """A length that is typical of the scene."""
        return max(float(np.linalg.norm(np.subtract(*self.box))), self.radius)

    def of_split(self, split: str) -> list[View]:
        """The views of one split."""
        return [view for view in self.views if view.split == split]

    def __str__(self) -> str:
        """The plan in a line or two, for people."""
        corners = " to ".join(_numbers(corner) for corner in self.box)
        counts = ", ".join(f"{len(self.of_split(s))} {s}" for s in SPLITS)
        size = f"{self.intrinsics.width}x{self.intrinsics.height}"
        where = (
            f"beside {_numbers(self.center)}, up to {self.radius:.3g} from it"
            if self.cameras == "forward"
            else f"on a {self.cameras} of radius {self.radius:.4g} around {_numbers(self.center)}"
        )
        return (
            f"{self.protocol}: {counts} views of {size}, {self.spp} samples a pixel\n"
            f"scene box {corners}; cameras {where}, up {_numbers(self.up)}"
        )

    def record(self) -> dict[str, Any]:
        """What ``dataset.json`` says of it."""
        return {
            "protocol": self.protocol,
            "cameras": self.cameras,
            "views": {split: len(self.of_split(split)) for split in SPLITS},
            "size": [self.intrinsics.width, self.intrinsics.height],
            "spp": self.spp,
            "seed": self.seed,
            "camera_angle_x": round(math.radians(self.intrinsics.fov_x), 12),
            "up": list(self.up),
            "center": list(self.center),
            "radius": self.radius,
            **({"keep_emitters": list(self.keep_emitters)} if self.keep_emitters else {}),
        }


def protocol_name(file: SceneFile, options: Options) -> str:
    """The protocol that the user, or else the scene, asks for."""
    name = options.protocol or file.default("protocol") or "realistic360"
    if name not in PROTOCOLS:
        raise InputError(f"protocol '{name}': unknown, expected {', '.join(PROTOCOLS)}")
    return name


def make_plan(file: SceneFile, scene: Any, box: Bounds, options: Options) -> Plan:
    """Decides everything that the user left open.

    Args:
        scene: ``file``, loaded.
        box: Of the visible shapes of ``scene``.

    Raises:
        InputError: for options that make no sense, alone or for this scene.
    """
    name = protocol_name(file, options)
    counts = _counts(name, options)
    size = valid_size(options.size or PROTOCOLS[name].size)
    sensor = scene.sensors()[0] if file.plugins("Sensor") else None
    spp = options.spp
    if spp is None:
        spp = _sampler_spp(sensor) if file.plugins("Sampler") else _DEFAULT_SPP
    if spp < 2:
        raise InputError(
            "{}: expected at least 2, of which the noise is estimated", Option("spp", spp)
        )
    up = _up_axis(options, sensor)
    if name == "forward":
        shots = _forward(file, scene, sensor, box, up, size, counts, options)
    else:
        shots = _around(file, box, up, size, counts, options)
    return Plan(
        protocol=name,
        cameras=shots.cameras,
        intrinsics=shots.intrinsics,
        spp=spp,
        seed=options.seed,
        views=shots.views,
        box=box,
        up=_triple(up),
        center=_triple(shots.center),
        radius=shots.radius,
        keep_emitters=options.keep_emitters,
    )


# ---- Where the cameras stand -------------------------------------------------


@dataclass(frozen=True)
class _Shots:
    """The part of a plan that depends on the kind of protocol."""

    cameras: Cameras
    intrinsics: Intrinsics
    views: tuple[View, ...]
    center: Array
    radius: float


def _around(
    file: SceneFile,
    box: Bounds,
    up: Array,
    size: tuple[int, int],
    counts: dict[str, int],
    options: Options,
) -> _Shots:
    """Cameras on a (hemi)sphere around the scene."""
    center, radius = _center_and_radius(box, options)
    cameras = options.cameras or file.default("cameras") or "hemisphere"
    if cameras not in ("hemisphere", "sphere"):
        raise InputError(f"{file.path}: cameras '{cameras}', expected hemisphere or sphere")
    sphere: Cameras = "sphere" if cameras == "sphere" else "hemisphere"
    views = []
    for split, count in counts.items():
        poses = viewpoints.around(
            count, split, options.seed, cameras=sphere, up=up, center=center, radius=radius
        )
        views += [View(split, i, pose, options.seed) for i, pose in enumerate(poses)]
    intrinsics = Intrinsics.from_angle_x(*size, CAMERA_ANGLE_X)
    return _Shots(sphere, intrinsics, tuple(views), center, radius)


def _forward(
    file: SceneFile,
    scene: Any,
    sensor: Any,
    box: Bounds,
    up: Array,
    size: tuple[int, int],
    counts: dict[str, int],
    options: Options,
) -> _Shots:
    """Cameras beside the scene's own, all looking the same way."""
    for option in ("cameras", "center"):
        if getattr(options, option) is not None:
            raise InputError("{}: has no meaning for the protocol 'forward'", Option(option))
    pose, angle = _own_camera(sensor, box, up)
    intrinsics = Intrinsics.from_angle_x(*size, angle)
    spread = options.radius
    if spread is None:
        spread = _own_spread(file)
    if spread is None:
        spread = _SPREAD * _nearest(scene, intrinsics, pose)
    positive("radius", spread)
    poses = viewpoints.forward(sum(counts.values()), options.seed, pose, spread)
    views = _hold_out(poses, counts, options.seed)
    return _Shots("forward", intrinsics, views, pose[:3, 3], spread)


def _own_spread(file: SceneFile) -> float | None:
    """How far the scene itself wants forward-facing cameras to move."""
    told = file.default("spread")
    try:
        return None if told is None else float(told)
    except ValueError:
        raise InputError(f"{file.path}: spread '{told}', expected a number above 0") from None


def _center_and_radius(box: Bounds, options: Options) -> tuple[Array, float]:
    """The origin and 4, as in the paper, for scenes in [−1, 1]³; the same proportions else."""
    corners = np.array(box)
    fits = np.abs(corners).max() <= _UNIT_BOX
    center = np.zeros(3) if fits else corners.mean(axis=0)
    if options.center is not None:
        center = np.array(options.center)
    reach = 1.0 if fits else float(np.ptp(corners, axis=0).max()) / 2
    radius = RADIUS * reach if options.radius is None else options.radius
    if not np.isfinite(center).all():
        raise InputError("{}: expected three finite numbers", Option("center", options.center))
    return center, positive("radius", radius)


def halves(spp: int) -> tuple[int, int]:
    """Splits samples a pixel in two."""
    return spp // 2, spp - spp // 2


# ---- Numbers -----------------------------------------------------------------


def _counts(name: str, options: Options) -> dict[str, int]:
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


def _sampler_spp(sensor: Any) -> int:
    """The samples of a sensor's sampler, or some more where it cannot take half of them."""
    if sensor is None:
        return _DEFAULT_SPP
    sampler = sensor.sampler()
    spp = int(sampler.sample_count())
    for half in halves(spp):
        sampler.set_sample_count(half)
        if half > 0 and sampler.sample_count() != half:
            return 2 * int(sampler.sample_count())
    return spp


# ---- Cameras -----------------------------------------------------------------


def _up_axis(options: Options, sensor: Any) -> Array:
    """The coordinate axis that is vertical: as told, or as the scene's own sensor stands."""
    up = np.zeros(3)
    if options.up is not None or sensor is None:
        up["xyz".index(options.up or "z")] = 1.0
        return up
    upwards = _pose(sensor)[:3, 1]
    axis = int(np.argmax(np.abs(upwards)))
    up[axis] = math.copysign(1.0, upwards[axis])
    return up


def _pose(sensor: Any) -> Array:
    matrix = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)
    pose = opengl_from_mitsuba(matrix)
    pose[:3, :3] /= np.linalg.norm(pose[:3, :3], axis=0)
    return pose


def _own_camera(sensor: Any, box: Bounds, up: Array) -> tuple[Array, float]:
    """Pose and horizontal field of view of the scene's sensor, or of one outside its box."""
    import mitsuba as mi

    if sensor is None:
        lower, upper = np.array(box)
        _, front = viewpoints.horizontal_axes(up)
        center, reach = (lower + upper) / 2, float((upper - lower).max()) / 2
        return look_at(center - RADIUS * reach * front, center, up), CAMERA_ANGLE_X
    parameters = mi.traverse(sensor)
    has_angle = "x_fov" in parameters
    angle = math.radians(float(parameters["x_fov"][0])) if has_angle else CAMERA_ANGLE_X
    return _pose(sensor), angle


def _nearest(scene: Any, intrinsics: Intrinsics, pose: Array) -> float:
    """z-depth of the nearest content that a camera sees."""
    depth, _ = trace_surfaces(scene, intrinsics, pose, hide_emitters=False)
    bounds = depth_bounds(intrinsics, depth)
    if bounds is None:
        raise InputError("the scene's sensor sees nothing, expected content before it")
    return bounds[0]


def _hold_out(poses: Array, counts: dict[str, int], seed: int) -> tuple[View, ...]:
    """Views of a forward-facing capture: test views evenly spread, every eighth by default."""
    total = len(poses)
    test = _evenly(range(total), counts["test"])
    val = _evenly([i for i in range(total) if i not in test], counts["val"])
    views, number = [], {"train": 0, "val": 0, "test": 0}
    for i, pose in enumerate(poses):
        split = "test" if i in test else "val" if i in val else "train"
        views.append(View(split, number[split], pose, seed))
        number[split] += 1
    return tuple(views)


def _evenly(items: Any, count: int) -> set[int]:
    """``count`` of the items; every eighth where that makes as many."""
    if count == -(-len(items) // HOLD_OUT):
        return set(items[::HOLD_OUT])
    return {items[i * len(items) // count] for i in range(count)}


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = np.asarray(values, np.float64).tolist()
    return x, y, z


def _numbers(values: tuple[float, float, float]) -> str:
    return "(" + ", ".join(f"{v:.3g}" for v in values) + ")"
