"""The main job end to end: path-traced images in, a measured reconstruction out."""

from __future__ import annotations

import math
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
from tqdm.auto import tqdm

from .cameras import Intrinsics, look_at, sensor_dict
from .data import load_dataset
from .errors import InputError
from .evaluation import evaluate, quality, reference_image
from .files import make_folder, replacing, write_json
from .rendering import load_scene, write_picture
from .scene_library import find_scene
from .target import open_target
from .training import run as training
from .training.presets import preset

Image = np.ndarray[Any, Any]

SCENE = "spheres"
CAMERA_ANGLE_X = 0.6911  # of nerf_synthetic
RADIUS = 4.0


def run_demo(
    out: Path | None,
    variant: str,
    *,
    seconds: float = 45.0,
    seed: int = 0,
    views: dict[str, int] | None = None,
    size: int = 128,
    spp: int = 128,
) -> dict[str, Any]:
    """Path-traces a small dataset, trains on it, evaluates held-out views, compares.

    Everything lands in one folder: ``data/``, ``run/``, ``eval.json``, ``comparison.png``
    and ``scene.xml``, which shows the trained field in Mitsuba.

    Returns:
        The evaluation record.

    Raises:
        InputError: if ``out`` is given and not empty.
    """
    folder = _fresh_folder(out)
    views = views or {"train": 40, "test": 8}
    clock = time.monotonic()
    print(f"1/4  path-tracing {sum(views.values())} views of scenes/{SCENE}.xml")
    _trace_dataset(folder / "data", variant, views, size, spp, seed)
    print(f"2/4  training for {seconds:.0f} s")
    config = replace(preset("nerf"), seed=seed, max_seconds=seconds)
    run = training.start(folder / "data", folder / "run", config, variant)
    run.train()
    spent = run.seconds
    print("3/4  evaluating held-out views")
    with tempfile.TemporaryDirectory() as pictures:
        record = evaluate(open_target(folder / "run"), variant, split="test", images=pictures)
        write_json(folder / "eval.json", record)
        print("4/4  drawing the comparison")
        _draw_comparison(folder, Path(pictures))
    _write_scene(folder / "scene.xml", size)
    print(
        f"\nheld-out {quality(record)} after {spent:.0f} s of training; "
        f"{time.monotonic() - clock:.0f} s in all\n"
        f"comparison: {folder / 'comparison.png'} (truth, reconstruction, 5 x error)\n"
        f"in Mitsuba: mi-nerf render {folder / 'scene.xml'} -o field.png"
    )
    return record


def _fresh_folder(out: Path | None) -> Path:
    if out is not None:
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise InputError(f"{out}: expected a new or an empty folder")
        return make_folder(out)
    number = 1
    while (folder := Path("mi-nerf-demo" + (f"-{number}" if number > 1 else ""))).exists():
        number += 1
    return make_folder(folder)


def _trace_dataset(
    folder: Path, variant: str, views: dict[str, int], size: int, spp: int, seed: int
) -> None:
    import mitsuba as mi

    mi.set_variant(variant)
    scene = load_scene(find_scene(SCENE))
    camera = Intrinsics.from_angle_x(size, size, CAMERA_ANGLE_X)
    bar = tqdm(total=sum(views.values()), unit="view", disable=not sys.stderr.isatty())
    first = 0
    with bar:
        for split, count in views.items():
            make_folder(folder / split)
            frames = []
            for i, pose in enumerate(_hemisphere(count, seed + first)):
                sensor = mi.load_dict(sensor_dict(camera, pose, spp=spp))
                image = np.array(mi.render(scene, sensor=sensor, spp=spp, seed=seed + first + i))
                write_picture(folder / split / f"r_{i}.png", image)
                frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": pose.tolist()})
                bar.update()
            record = {"camera_angle_x": CAMERA_ANGLE_X, "frames": frames}
            write_json(folder / f"transforms_{split}.json", record)
            first += count


def _hemisphere(count: int, seed: int) -> list[Image]:
    """Cameras evenly spread over the upper hemisphere (Fibonacci lattice), looking inwards."""
    turn = np.random.default_rng(seed).random() * 2 * math.pi
    poses = []
    for i in range(count):
        height = 0.08 + 0.87 * (i + 0.5) / count
        angle = turn + i * math.pi * (3 - math.sqrt(5))
        level = math.sqrt(1 - height * height)
        origin = RADIUS * np.array([level * math.cos(angle), level * math.sin(angle), height])
        poses.append(look_at(origin, (0, 0, 0)))
    return poses


def _draw_comparison(folder: Path, pictures: Path) -> None:
    """Three held-out views: truth, reconstruction, and the error five times enlarged."""
    dataset = load_dataset(folder / "data", "test").evenly_spread(3)
    rows = []
    for k, name in enumerate(dataset.names):
        truth = reference_image(dataset, k)
        image = iio.imread(pictures / f"{name}.png") / 255
        rows.append(np.concatenate([truth, image, np.abs(truth - image) * 5], axis=1))
    picture = np.clip(np.concatenate(rows, axis=0), 0, 1)
    picture = np.kron(picture, np.ones((2, 2, 1)))
    with replacing(folder / "comparison.png") as path:
        iio.imwrite(path, np.rint(picture * 255).astype(np.uint8), extension=".png")


def _write_scene(path: Path, size: int) -> None:
    with replacing(path) as temporary:
        temporary.write_text(_SCENE_XML.format(size=4 * size))


_SCENE_XML = """<scene version="3.0.0">
    <integrator type="nerf"/>
    <sensor type="perspective" id="sensor">
        <float name="fov" value="39.597"/>
        <transform name="to_world">
            <lookat origin="2.2, -2.6, 2.1" target="0, 0, 0" up="0, 0, 1"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="{size}"/>
            <integer name="height" value="{size}"/>
            <string name="pixel_format" value="rgba"/>
        </film>
        <sampler type="independent"><integer name="sample_count" value="4"/></sampler>
    </sensor>
    <shape type="cube" id="box">
        <bsdf type="null"/>
        <medium type="nerfmedium" name="interior" id="field">
            <string name="filename" value="run/field.safetensors"/>
        </medium>
    </shape>
</scene>
"""
