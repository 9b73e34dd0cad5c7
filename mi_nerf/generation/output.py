"""The files of a dataset: what each view writes, and what describes them all.

Forward-facing captures also have the layout of LLFF (Mildenhall et al. 2019).
"""

from __future__ import annotations

import hashlib
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from ..base.files import make_folder, replacing, write_json
from ..cameras.pinhole import Intrinsics
from ..images.write import write_exr, write_picture
from .noise import estimate, mean_image
from .plan import Plan, View
from .protocol import SPLITS
from .surfaces import depth_bounds
from .tracer import TracedView

Array = np.ndarray[Any, Any]


def write_view(folder: Path, view: View, traced: TracedView, plan: Plan) -> dict[str, Any]:
    """Writes the four pictures of a view; returns its entry of ``dataset.json``."""
    image = mean_image(*traced.halves, traced.samples)
    stem = folder / view.name
    write_picture(_with(stem, ".png"), image)
    write_exr(_with(stem, ".exr"), image)
    write_exr(_with(stem, "_depth.exr"), traced.depth)
    write_exr(_with(stem, "_normal.exr"), traced.normal)
    bounds = depth_bounds(plan.camera_of(view), traced.depth)
    return {
        "noise": estimate(*traced.halves, traced.samples).record(),
        "invalid_samples": traced.invalid,
        "depth_bounds": None if bounds is None else list(bounds),
        "sha256": {path.name: file_digest(path) for path in view_files(folder, view)},
    }


def view_files(folder: Path, view: View) -> list[Path]:
    """The files of a view: colour in two forms, distance, normals."""
    return [_with(folder / view.name, end) for end in (".png", ".exr", "_depth.exr", "_normal.exr")]


def is_intact(folder: Path, view: View, entry: Any) -> bool:
    """Whether all files of a view are as they were written."""
    expected = entry.get("sha256", {}) if isinstance(entry, dict) else {}
    return all(
        path.is_file() and file_digest(path) == expected.get(path.name)
        for path in view_files(folder, view)
    )


def file_digest(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def write_transforms(folder: Path, plan: Plan) -> None:
    """Writes ``transforms_{split}.json`` for every split that has views."""
    for split in SPLITS:
        if views := plan.of_split(split):
            frames = [_frame(view) for view in views]
            write_json(
                folder / f"transforms_{split}.json",
                {**_camera(plan.intrinsics), "aabb": plan.region, "frames": frames},
            )


def write_forward_capture(folder: Path, plan: Plan, entries: dict[str, Any]) -> None:
    """Writes ``poses_bounds.npy`` and, in its order, ``images/``: the layout of LLFF."""
    known = [entry["depth_bounds"] for entry in entries.values() if entry["depth_bounds"]]
    everywhere = (min(b[0] for b in known), max(b[1] for b in known))
    bounds = [entries[view.name]["depth_bounds"] or everywhere for view in plan.views]
    poses = np.array([view.pose for view in plan.views])
    make_folder(folder / "images")
    for i, view in enumerate(plan.views):
        with replacing(folder / "images" / f"view_{i:03d}.png") as temporary:
            shutil.copyfile(_with(folder / view.name, ".png"), temporary)
    with replacing(folder / "poses_bounds.npy") as temporary:
        np.save(temporary, poses_bounds(poses, plan.intrinsics, np.array(bounds)))


def poses_bounds(poses: Array, intrinsics: Intrinsics, bounds: Array) -> Array:
    """The rows of ``poses_bounds.npy``, (N, 17).

    A row is the 3×5 matrix [R | t | (height, width, focal)] row by row, then the near and
    far z-depth. The columns of R are the camera's down, right and backward axes.

    Args:
        poses: OpenGL camera-to-world matrices, (N, 4, 4).
        bounds: Near and far z-depth of each view, (N, 2).
    """
    right, up, back, origin = (poses[:, :3, i] for i in range(4))
    film = np.array([intrinsics.height, intrinsics.width, intrinsics.fx])
    film = np.broadcast_to(film, origin.shape)
    matrix = np.stack([-up, right, back, origin, film], axis=-1)
    return np.concatenate([matrix.reshape(-1, 15), bounds], axis=1)


def _frame(view: View) -> dict[str, Any]:
    own = {} if view.intrinsics is None else _camera(view.intrinsics)
    if view.lens is not None:
        own["lens"] = {"aperture_radius": view.lens.radius, "focus_distance": view.lens.focus}
    return {
        **own,
        "file_path": f"./{view.name}",
        "transform_matrix": view.pose.tolist(),
        "depth_file_path": f"./{view.name}_depth.exr",
        "normal_file_path": f"./{view.name}_normal.exr",
    }


def _camera(camera: Intrinsics) -> dict[str, Any]:
    """The camera in the keys of Blender's exporter and in those of nerfstudio."""
    return {
        # Rounded where the detour by the focal length leaves a trace.
        "camera_angle_x": round(2 * math.atan(camera.width / (2 * camera.fx)), 12),
        "camera_angle_y": round(2 * math.atan(camera.height / (2 * camera.fy)), 12),
        "camera_model": "PINHOLE",
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "w": camera.width,
        "h": camera.height,
    }


def _with(stem: Path, end: str) -> Path:
    return stem.with_name(stem.name + end)
