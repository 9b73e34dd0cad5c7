"""Reader of forward-facing captures in the layout of LLFF (Mildenhall et al. 2019).

A folder holds ``poses_bounds.npy`` and the pictures, in ``images/`` or, reduced K
times, in ``images_K/``. Where there are several, ``images/`` is read, or else the
smallest K. Row i of the N×17 array belongs to the i-th picture in alphabetical order:

- 15 numbers, a 3×5 matrix row by row: rotation (its columns are the camera's down,
  right and backward axes), position, and height, width, focal length in pixels of the
  full resolution. The size of the pictures themselves says how far they are reduced;
- the near and far z-depth of what the view shows.

The capture is brought into a frame of its own: lengths are divided by ¾ of the
smallest near depth, so that everything lies beyond z-depth 4/3, and the average camera
moves to the origin and looks along −z. There, :attr:`Dataset.ndc` has its near plane
at z-depth 1. Every eighth view, from the first, is for testing; there is no ``val``.

``mi-nerf generate`` also writes ``transforms_{split}.json``, whose views are those of the rows:
they have the same poses. ``images="exr"`` reads their linear images, if ``images/`` holds none,
and their exact surfaces are known here, too.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.box import Box
from ..base.errors import InputError, Option
from ..cameras.ndc import Ndc
from ..cameras.pinhole import Intrinsics
from ..cameras.poses import average_pose, is_rigid
from ..images.read import IMAGE_SUFFIXES, Progress, read_images
from . import blender
from .dataset import Dataset, evenly_spread_indices
from .surfaces import SurfaceFiles

POSES = "poses_bounds.npy"
SPLITS = ("train", "test")
_HOLD_OUT = 8  # one in so many views is for testing
_NEAR_MARGIN = 0.75  # of the smallest near depth: where the near plane is put

# Least descent of a unit ray along −z: beyond, its projection leaves all bounds.
_LEAST_SLOPE = 1e-3


class _Capture(NamedTuple):
    """The content of ``poses_bounds.npy``, in the capture's own frame."""

    cam_to_world: NDArray[np.float64]  # (N, 4, 4), OpenGL axes
    intrinsics: Intrinsics  # at full resolution
    near: float  # smallest and largest z-depth, scene units
    far: float
    scale: float  # its unit of length is that of the array divided by this


def recognises(folder: Path) -> bool:
    """Whether ``folder`` is in this layout."""
    return (folder / POSES).is_file()


def load(
    folder: Path,
    split: str,
    *,
    downscale: int = 1,
    limit: int | None = None,
    images: str | None = None,
    progress: Progress | None = None,
) -> Dataset:
    """Reads one split. Arguments and errors as for :func:`mi_nerf.data.load_dataset`.

    Raises:
        InputError: Also for captures that do not face forward.
    """
    file = folder / POSES
    rows = _read_rows(file)
    capture = _normalised(file, rows)
    traced = _traced(folder, rows, images)
    paths = _image_paths(folder, len(rows), images, traced)
    rays = _corner_rays(capture)
    _require_forward(file, paths, rays)
    chosen = _members(file, split, len(paths))
    if limit is not None:
        chosen = [chosen[i] for i in evenly_spread_indices(len(chosen), limit)]
    stack = read_images([paths[i] for i in chosen], downscale, progress)
    width, height = stack.width, stack.height
    intrinsics = _resized(file, capture.intrinsics, width, height)
    ndc = Ndc(2 * intrinsics.fx / intrinsics.width, 2 * intrinsics.fy / intrinsics.height)
    return Dataset(
        path=folder,
        split=split,
        names=_names(paths, chosen),
        images=stack.pixels,
        color_space=stack.color_space,
        has_alpha=stack.has_alpha,
        cam_to_world=capture.cam_to_world[chosen],
        intrinsics=intrinsics.downscale(downscale),
        near=capture.near,
        far=capture.far,
        box=_seen_box(ndc, *rays),
        ndc=ndc,
        surface_files=tuple(
            _surface_files(traced.get(i), width, height, downscale, capture.scale)
            if paths[i].parent.name == "images" or images == "exr"  # not of reduced pictures
            else None
            for i in chosen
        ),
    )


# ---- The array ---------------------------------------------------------------


def _read_rows(file: Path) -> NDArray[np.float64]:
    """The rows, (N, 17), of which there is at least one."""
    try:
        rows = np.load(file, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{file}: expected a NumPy array ({error})") from error
    if not isinstance(rows, np.ndarray) or rows.dtype.kind not in "fiu":
        raise InputError(f"{file}: expected an array of numbers")
    if rows.ndim != 2 or rows.shape[1] != 17 or not len(rows):
        raise InputError(f"{file}: expected an array of shape (N, 17), got {rows.shape}")
    rows = rows.astype(np.float64)
    broken = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if broken.size:
        raise InputError(f"{file}: row {broken[0]}: expected finite numbers")
    return rows


def _normalised(file: Path, rows: NDArray[np.float64]) -> _Capture:
    """Poses and depths in the frame of the average camera, in units of the near plane."""
    matrices, bounds = rows[:, :15].reshape(-1, 3, 5), rows[:, 15:]
    wrong = np.flatnonzero((bounds[:, 0] <= 0) | (bounds[:, 1] <= bounds[:, 0]))
    if wrong.size:
        near, far = bounds[wrong[0]]
        raise InputError(
            f"{file}: row {wrong[0]}: expected depths 0 < near < far, got {near:g} and {far:g}"
        )
    poses = _poses(rows)
    for i, pose in enumerate(poses):
        if not is_rigid(pose):
            raise InputError(f"{file}: row {i}: expected a rotation, with columns of length 1")
    scale = 1 / (_NEAR_MARGIN * bounds[:, 0].min())
    poses[:, :3, 3] *= scale
    try:
        middle = average_pose(poses)
    except InputError as error:
        raise InputError(f"{file}: {_EXPECTED}, its views look in opposite directions") from error
    near, far = float(bounds[:, 0].min() * scale), float(bounds[:, 1].max() * scale)
    film = _film(file, matrices[:, :, 4])
    return _Capture(np.linalg.inv(middle) @ poses, film, near, far, float(scale))


def _poses(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """OpenGL camera-to-world matrices, (N, 4, 4), in the units of the array."""
    matrices = rows[:, :15].reshape(-1, 3, 5)
    down, right, back, position = (matrices[:, :, i] for i in range(4))
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = np.stack([right, -down, back, position], axis=-1)
    return poses


def _film(file: Path, films: NDArray[np.float64]) -> Intrinsics:
    """The camera that all rows, (N, 3) of height, width and focal length, share."""
    different = np.flatnonzero((films != films[0]).any(axis=1))
    if different.size:
        raise InputError(f"{file}: row {different[0]}: expected the camera of row 0 for all views")
    height, width, focal = films[0].tolist()
    try:
        # Not int(width): a broken size is for Intrinsics to refuse.
        return Intrinsics(width, height, focal, focal, width / 2, height / 2)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error


# ---- Views and their pictures ------------------------------------------------


def _members(file: Path, split: str, count: int) -> list[int]:
    """The views of a split."""
    if split not in SPLITS:
        raise InputError(f"{file}: has no split '{split}', expected {' or '.join(SPLITS)}")
    members = [i for i in range(count) if (i % _HOLD_OUT == 0) == (split == "test")]
    if not members:
        raise InputError(f"{file}: expected at least 2 views, the first is for testing")
    return members


def _image_paths(
    folder: Path, count: int, images: str | None, traced: dict[int, Path]
) -> list[Path]:
    """The pictures of a kind in alphabetical order, as many as there are poses.

    Args:
        traced: the views that are known to lie elsewhere: these if radiance is wanted.
    """
    pictures = _image_folder(folder)
    kinds = {None: IMAGE_SUFFIXES, "exr": {".exr"}, "png": IMAGE_SUFFIXES - {".exr"}}[images]
    paths = sorted(p for p in pictures.iterdir() if p.suffix.lower() in kinds)
    if images == "exr" and not paths:
        if len(traced) == count:
            return [traced[i] for i in range(count)]
        option = Option("images", images)
        raise InputError("{}: no OpenEXR images in it, expected by {}", pictures, option)
    if len(paths) != count:
        raise InputError(
            f"{pictures}: expected {count} images, one for each row of {POSES}, got {len(paths)}"
        )
    return paths


def _names(paths: list[Path], chosen: list[int]) -> tuple[str, ...]:
    """Those of the files; where these come from several folders, numbers as in ``images/``."""
    one_folder = len({path.parent for path in paths}) == 1
    return tuple(paths[i].stem if one_folder else f"view_{i:03d}" for i in chosen)


# ---- What generate knows besides ---------------------------------------------


def _traced(folder: Path, rows: NDArray[np.float64], images: str | None) -> dict[int, Path]:
    """The files of the views that ``transforms_{split}.json`` lists, by the rows of their poses.

    Raises:
        InputError: if they cannot be read but are what to read.
    """
    try:
        views = blender.views_of(folder, images)
    except InputError:  # no business of those who read ``images/``
        if images == "exr" and not any(_image_folder(folder).glob("*.exr")):
            raise
        return {}
    found = {}
    for i, pose in enumerate(_poses(rows)):
        reach = 1e-6 * max(1.0, float(np.abs(pose).max()))
        same = [path for path, other in views if np.abs(pose - other).max() <= reach]
        if len(same) == 1:
            found[i] = same[0]
    return found


def _surface_files(
    traced: Path | None, width: int, height: int, downscale: int, scale: float
) -> SurfaceFiles | None:
    """Distances in the capture's units; the field's normals live in another space."""
    files = None if traced is None else SurfaceFiles.beside(traced, width, height, downscale)
    return None if files is None else replace(files, normal=None, scale=scale)


def _image_folder(folder: Path) -> Path:
    """``images/``, or the ``images_K/`` of the smallest K."""
    if (folder / "images").is_dir():
        return folder / "images"
    reduced = {
        int(suffix): path
        for path in folder.glob("images_*")
        if path.is_dir() and (suffix := path.name.removeprefix("images_")).isdecimal()
    }
    if not reduced:
        raise InputError(f"{folder}: expected a folder images or images_K beside {POSES}")
    return reduced[min(reduced)]


def _resized(file: Path, full: Intrinsics, width: int, height: int) -> Intrinsics:
    """The camera of pictures of this size that show the whole film."""
    # Reducing a picture rounds its size: by less than a pixel.
    if abs(width * full.height - height * full.width) > max(full.width, full.height):
        raise InputError(
            f"{file}: expected images with the proportions of {full.width:g}x{full.height:g}, "
            f"they are {width}x{height}"
        )
    focal = full.fx * width / full.width
    return Intrinsics(width, height, focal, focal, width / 2, height / 2)


# ---- Forward-facing ----------------------------------------------------------

_EXPECTED = "expected a forward-facing capture"


def _corner_rays(capture: _Capture) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Origins and directions (unit) of the rays through the corners of the films, (N, 4, 3)."""
    film = capture.intrinsics
    x, y = film.width / (2 * film.fx), film.height / (2 * film.fy)
    local = np.array([(x, y, -1), (-x, y, -1), (-x, -y, -1), (x, -y, -1)])
    d = local @ np.swapaxes(capture.cam_to_world[:, :3, :3], 1, 2)
    o = np.broadcast_to(capture.cam_to_world[:, None, :3, 3], d.shape)
    return o, d / np.linalg.norm(d, axis=-1, keepdims=True)


def _require_forward(
    file: Path, paths: list[Path], rays: tuple[NDArray[np.float64], NDArray[np.float64]]
) -> None:
    """Refuses captures of which some ray never meets the near plane.

    The corners suffice: rays between them descend at least as steeply as one of them.
    """
    _, d = rays
    slope = d[..., 2].max(axis=1)
    worst = int(np.argmax(slope))
    if slope[worst] > -_LEAST_SLOPE:
        angle = np.degrees(np.arccos(np.clip(-slope[worst], -1, 1)))
        raise InputError(
            f"{file}: {_EXPECTED}, but view {paths[worst].stem} sees {angle:.0f} degrees away "
            "from the average view direction, expected less than 90"
        )


def _seen_box(ndc: Ndc, o: NDArray[np.float64], d: NDArray[np.float64]) -> Box:
    """The box in normalised device coordinates that all views see, at least [−1, 1]³.

    Rays are straight there, so their ends suffice: on the near plane and at infinity.
    """
    t = -(ndc.near + o[..., 2:]) / d[..., 2:]
    start = np.concatenate([o + t * d, np.ones_like(t)], axis=-1)
    end = np.concatenate([d, np.zeros_like(t)], axis=-1)
    clip = np.stack([start, end]).reshape(-1, 4) @ ndc.matrix().T
    (x0, y0), (x1, y1) = (
        edge(clip[:, :2] / clip[:, 3:], axis=0).tolist() for edge in (np.min, np.max)
    )
    return (min(x0, -1.0), min(y0, -1.0), -1.0), (max(x1, 1.0), max(y1, 1.0), 1.0)
