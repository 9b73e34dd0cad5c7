"""Reader of the layout that Blender exporters, NeRF and many others use.

A folder holds ``transforms_{split}.json`` for each split, and images::

    {
      "camera_angle_x": 0.69,            horizontal view angle in radians, or
      "fl_x": 1111.1,                    the focal length in pixels; then perhaps
                                         "fl_y", "cx", "cy" and the size "w", "h"
      "frames": [{
        "file_path": "./train/r_0",      ".png" is appended when it has no
                                         extension; ".exr" images are linear
        "transform_matrix": [[...], ...] 4x4 camera-to-world, OpenGL axes
      }],
      "near": 2, "far": 6,               optional: z-depths, scene units
      "aabb": [[x, y, z], [x, y, z]]     optional: the scene's box, min and max
    }

With ``images="exr"`` the linear image beside each of these files is read in its place:
``r_0.exr`` for ``r_0`` and for ``r_0.png``. Exact surfaces beside a file are known, too:
:mod:`mi_nerf.data.surfaces`.

Further keys are ignored, except those that would change the camera into one that
this reader does not know: lens distortion and intrinsics that vary with the frame
are errors. ``"from_mitsuba": true`` (instant-ngp) means Mitsuba's axes.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.box import Box
from ..base.errors import InputError, Option
from ..cameras.pinhole import Intrinsics
from ..cameras.poses import is_rigid, opengl_from_mitsuba
from ..images.read import IMAGE_SUFFIXES, Progress, read_images
from .dataset import Dataset, evenly_spread_indices
from .surfaces import SurfaceFiles

_USUAL_SPLITS = ("train", "val", "test")
_INTRINSIC_KEYS = ("camera_angle_x", "fl_x", "fl_y", "cx", "cy", "w", "h")
_DISTORTION_KEYS = ("k1", "k2", "k3", "k4", "p1", "p2")


def splits(folder: Path) -> tuple[str, ...]:
    """The splits that ``folder`` holds: train, val, test first, then any others."""
    prefix = "transforms_"
    found = {file.stem[len(prefix) :] for file in folder.glob(prefix + "*.json")}
    usual = [name for name in _USUAL_SPLITS if name in found]
    return (*usual, *sorted(found.difference(usual)))


def load(
    folder: Path,
    split: str,
    *,
    downscale: int = 1,
    limit: int | None = None,
    images: str | None = None,
    progress: Progress | None = None,
) -> Dataset:
    """Reads one split. Arguments and errors as for :func:`mi_nerf.data.load_dataset`."""
    file = folder / f"transforms_{split}.json"
    meta, frames = _read_json(file)
    _require_plain_pinhole(file, meta, frames)
    if limit is not None:
        frames = [frames[i] for i in evenly_spread_indices(len(frames), limit)]

    poses = np.stack([_pose(file, frame) for frame in frames])
    near, far, box = _depth_range_and_box(file, meta)
    paths = [_image_path(file, frame, images) for frame in frames]
    stack = read_images(paths, downscale, progress)
    width, height = stack.width, stack.height
    return Dataset(
        path=folder,
        split=split,
        names=_unique_names(folder, paths),
        images=stack.pixels,
        color_space=stack.color_space,
        has_alpha=stack.has_alpha,
        cam_to_world=opengl_from_mitsuba(poses) if meta.get("from_mitsuba") else poses,
        intrinsics=_intrinsics(file, meta, width, height).downscale(downscale),
        near=near,
        far=far,
        box=box,
        surface_files=tuple(SurfaceFiles.beside(p, width, height, downscale) for p in paths),
    )


def views_of(folder: Path, images: str | None) -> list[tuple[Path, NDArray[np.float64]]]:
    """The files and the OpenGL poses of all views of all splits, for readers of other layouts.

    Raises:
        InputError: as for :func:`load`.
    """
    found = []
    for split in splits(folder):
        file = folder / f"transforms_{split}.json"
        meta, frames = _read_json(file)
        mitsuba = bool(meta.get("from_mitsuba"))
        for frame in frames:
            pose = _pose(file, frame)
            pose = opengl_from_mitsuba(pose[None])[0] if mitsuba else pose
            found.append((_image_path(file, frame, images), pose))
    return found


# ---- The JSON file ---------------------------------------------------------


def _read_json(file: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The file's content and its frames, of which there is at least one."""
    if not file.is_file():
        others = ", ".join(splits(file.parent)) or "none"
        raise InputError(f"{file}: no such file; splits in this folder: {others}")
    try:
        meta = json.loads(file.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{file}: expected valid JSON ({error})") from error
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(f'{file}: expected an object with a list of "frames"')
    if not frames:
        raise InputError(f'{file}: the split is empty, expected at least one of "frames"')
    for index, frame in enumerate(frames):
        if not isinstance(frame.get("file_path"), str) or not frame["file_path"]:
            raise InputError(f'{file}: frame {index}: expected a "file_path"')
    return meta, frames


def _number(file: Path, meta: dict[str, Any], key: str) -> float | None:
    """``meta[key]`` as a finite number, None where there is no such key."""
    value = meta.get(key)
    if value is None:
        return None
    # JSON's true and false would pass for numbers in Python, and so may NaN.
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not is_number or not abs(value) <= sys.float_info.max:
        raise InputError(f'{file}: expected a finite number as "{key}", got {value!r}')
    return float(value)


def _pose(file: Path, frame: dict[str, Any]) -> NDArray[np.float64]:
    """The frame's camera-to-world matrix, (4, 4), known to be rigid."""
    where = f'{file}: frame "{frame["file_path"]}"'
    try:
        pose = np.asarray(frame.get("transform_matrix"), np.float64)
    except (TypeError, ValueError, OverflowError):  # ragged, or not numbers
        pose = np.empty(0)
    if pose.shape != (4, 4):
        raise InputError(f'{where}: expected a 4x4 "transform_matrix"')
    if not np.isfinite(pose).all():
        raise InputError(f'{where}: "transform_matrix" holds NaN or infinity')
    if not is_rigid(pose):
        raise InputError(
            f'{where}: expected a rigid "transform_matrix" '
            "(a rotation without scale, shear or mirroring, and a translation)"
        )
    return pose


def _depth_range_and_box(
    file: Path, meta: dict[str, Any]
) -> tuple[float | None, float | None, Box | None]:
    """The optional keys ``near``, ``far`` and ``aabb``."""
    near, far = _number(file, meta, "near"), _number(file, meta, "far")
    if near is not None and near < 0:
        raise InputError(f'{file}: expected "near" of 0 or more, got {near:g}')
    if far is not None and far <= (near or 0):
        raise InputError(f'{file}: expected "far" beyond near, got {far:g}')
    if meta.get("aabb") is None:
        return near, far, None
    try:
        corners = np.asarray(meta["aabb"], np.float64)
    except (TypeError, ValueError, OverflowError):
        corners = np.empty(0)
    in_order = corners.shape == (2, 3) and bool((corners[0] < corners[1]).all())
    if not in_order or not np.isfinite(corners).all():
        raise InputError(f'{file}: expected "aabb" as [[x, y, z], [x, y, z]], min below max')
    (x0, y0, z0), (x1, y1, z1) = corners.tolist()
    return near, far, ((x0, y0, z0), (x1, y1, z1))


# ---- The camera ------------------------------------------------------------


def _require_plain_pinhole(
    file: Path, meta: dict[str, Any], frames: Sequence[dict[str, Any]]
) -> None:
    """Refuses cameras that would silently be taken for other ones."""
    model = meta.get("camera_model", "PINHOLE")
    if model not in ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV"):
        raise InputError(f'{file}: expected "camera_model" PINHOLE, got {model!r}')
    for source in (meta, *frames):
        for key in _DISTORTION_KEYS:
            if source.get(key):
                raise InputError(
                    f'{file}: expected images without lens distortion, got "{key}" {source[key]}'
                )
    for frame in frames:
        for key in _INTRINSIC_KEYS:
            if key in frame and frame[key] != meta.get(key):
                raise InputError(
                    f'{file}: frame "{frame["file_path"]}": expected one camera for all '
                    f'frames, got its own "{key}"'
                )


def _intrinsics(file: Path, meta: dict[str, Any], width: int, height: int) -> Intrinsics:
    """The camera of images of this size; ``fl_x`` wins over ``camera_angle_x``."""
    numbers = {key: _number(file, meta, key) for key in _INTRINSIC_KEYS}
    stated = numbers["w"] or width, numbers["h"] or height
    if stated != (width, height):
        raise InputError(
            f"{file}: expected images of {stated[0]:g}x{stated[1]:g}, they are {width}x{height}"
        )
    angle, fx, fy = numbers["camera_angle_x"], numbers["fl_x"], numbers["fl_y"]
    cx, cy = numbers["cx"], numbers["cy"]
    try:
        if fx is None:
            if angle is None:
                raise InputError('expected "camera_angle_x" or "fl_x"')
            fx = Intrinsics.from_angle_x(width, height, angle).fx
        return Intrinsics(
            width,
            height,
            fx,
            fx if fy is None else fy,
            0.5 * width if cx is None else cx,
            0.5 * height if cy is None else cy,
        )
    except InputError as error:
        raise InputError(f"{file}: {error}") from error


# ---- The images ------------------------------------------------------------


def _image_path(file: Path, frame: dict[str, Any], images: str | None = None) -> Path:
    """Where the frame's image of a kind is; names may contain dots, so not every suffix counts."""
    path = file.parent / str(frame["file_path"])
    suffix = path.suffix.lower() if path.suffix.lower() in IMAGE_SUFFIXES else ""
    is_kind = {None: bool(suffix), "exr": suffix == ".exr", "png": suffix not in ("", ".exr")}
    if not is_kind[images]:
        stem = path.stem if suffix else path.name
        path = path.with_name(f"{stem}.{images or 'png'}")
    if path.is_file():
        return path
    if images is not None:
        option = Option("images", images)
        raise InputError(
            '{}: no such image, expected by {} for "{}" of {}',
            path, option, frame["file_path"], file,
        )  # fmt: skip
    raise InputError(f'{path}: no such image, expected by {file}, "{frame["file_path"]}"')


def _unique_names(folder: Path, paths: Sequence[Path]) -> tuple[str, ...]:
    """File names without extension, with their folder's name where that is ambiguous."""
    repeated = {stem for stem, count in Counter(path.stem for path in paths).items() if count > 1}
    return tuple(
        path.stem if path.stem not in repeated else f"{path.parent.name}_{path.stem}"
        for path in paths
    )
