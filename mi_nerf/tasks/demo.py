"""The main job end to end: path-traced images in, a measured reconstruction out."""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np

from ..base.errors import InputError
from ..base.files import make_folder, replacing, write_json, write_text
from ..data import load_dataset
from ..generation import Options, generate
from ..scene_xml.library import find_scene
from ..training import run as training
from ..training.presets import preset
from .evaluate import evaluate, quality, reference_image

SCENE = "arches"


def run_demo(
    out: Path | None,
    variant: str,
    *,
    seconds: float = 45.0,
    seed: int = 0,
    train: int = 40,
    test: int = 8,
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
    clock = time.monotonic()
    print(f"1/4  path-tracing {train + test} views of the scene '{SCENE}'")
    options = Options(train=train, val=0, test=test, size=(size, size), spp=spp, seed=seed)
    traced = generate(find_scene(SCENE), folder / "data", variant, options)
    if not traced["complete"]:
        raise KeyboardInterrupt
    print(f"2/4  training for {seconds:.0f} s")
    config = replace(preset("nerf"), seed=seed, max_seconds=seconds)
    run = training.start(folder / "data", folder / "run", config, variant)
    run.train()
    spent = run.seconds
    print("3/4  evaluating held-out views")
    with tempfile.TemporaryDirectory() as pictures:
        record = evaluate(folder / "run", variant, split="test", images=pictures)
        write_json(folder / "eval.json", record)
        print("4/4  drawing the comparison")
        _draw_comparison(folder, Path(pictures))
    write_text(folder / "scene.xml", _SCENE_XML.format(size=4 * size).splitlines())
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
