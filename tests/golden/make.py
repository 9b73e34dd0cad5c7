"""Writes files of every format, and what this version reads out of them.

    python -m tests.golden.make tests/golden/VERSION

The folders beside this file were written so, each by the version whose name it bears (0.1.0
with other import paths; ``unreleased`` by the present state): all later versions must read
them and find what that one found, see ``tests/formats/test_golden.py``. ``OUT`` is created
and receives

- ``fourier.safetensors``: a field of Fourier features with an occupancy grid, near and far
  limits, and early termination;
- ``hash_grid.safetensors``: a field of a hash grid with an occupancy grid, of linear colours;
- ``fine_ndc.safetensors``: a field with a coarse network, in normalised device coordinates;
- ``data/``: a dataset of 8x8 pixels, train and test;
- ``run/``: a run of a few steps on it, with an occupancy grid, a coarse network and Muon. In
  its ``config.json`` the dataset's path is replaced by ``DATA_PATH``, so that its bytes do not
  depend on the machine;
- ``expected.json``: what the fields look like, and what training and evaluation say.

Numbers are those of a CPU (variant ``llvm_ad_rgb``), to the last digit; those of another CPU
or compiler may differ there.
"""

from __future__ import annotations

import argparse
import json
import shutil
import struct
import tempfile
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import drjit.llvm.ad as backend
import mitsuba as mi
import numpy as np

import mi_nerf
from mi_nerf import FieldFile, NeuralFieldConfig, load_field, save_field
from mi_nerf.cameras.ndc import Ndc
from mi_nerf.fields.fourier import FourierEncoding
from mi_nerf.fields.hash_grid import HashGridConfig
from mi_nerf.fields.network import NetworkConfig
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.render import render_rays
from mi_nerf.march.settings import MarchSettings

VARIANT = "llvm_ad_rgb"
DATA_PATH = "/golden/data"  # in config.json, in place of where the dataset was
STEPS, FURTHER_STEPS = 24, 5
SETTINGS = {
    "report_every": 0,  # a line of the log for every step
    "network.width": 16,
    "network.view_width": 8,
    "position.frequencies": 3,
    "direction.frequencies": 1,
    "density.gain": 3.0,
    "occupancy.resolution": 12,
    "occupancy.queries": 2048,
    "occupancy.decay": 0.5,
    "occupancy.start": 4,
    "occupancy.threshold": 0.2,
    "occupancy.every": 4,
    "optimizer.warmup": 4,
    "sampling.samples": 12,
    "sampling.fine": 8,
    "sampling.render_samples": 16,
    "sampling.batch": 4096,
}

# ---------------------------------- Field files ----------------------------------


def weights(config: NeuralFieldConfig, seed: int) -> dict[str, np.ndarray]:
    """Random weights that make a field neither empty nor opaque."""
    rng = np.random.default_rng(seed)
    result = {}
    for name, shape in config.shapes().items():
        scale = 0.3 if len(shape) == 1 else 0.8 if name.startswith("grid") else shape[1] ** -0.5
        result[name] = (1.5 * scale * rng.standard_normal(shape)).astype(np.float32)
    return result


def fourier() -> FieldFile:
    """Two layers of 8 with a skip, in a box of its own; 5x7x6 cells."""
    config = NeuralFieldConfig(
        position=FourierEncoding(frequencies=3),
        direction=FourierEncoding(frequencies=2, convention="one"),
        network=NetworkConfig(depth=2, width=8, skip=1, view_width=6),
        density_shift=-0.5,
        density_scale=1.5,
    ).in_box((-1.0, -1.5, -0.75), (1.25, 1.5, 1.25))
    occupancy = np.random.default_rng(13).random((5, 7, 6)) < 0.7
    march = MarchSettings(samples=24, near=0.4, far=3.0, rule="linear", stop=1e-3)
    return FieldFile(config, weights(config, 1), occupancy, march, {"made_by": "make.py"})


def hash_grid() -> FieldFile:
    """Three levels of 2^6 entries, linear colours, no feature layer."""
    config = NeuralFieldConfig(
        color_space="linear",
        color_activation="exp",
        density_activation="exp",
        position=FourierEncoding(frequencies=0),
        grid=HashGridConfig(levels=3, features=2, log2_entries=6, coarsest=3, finest=12),
        direction=FourierEncoding(frequencies=1),
        network=NetworkConfig(depth=1, width=8, skip=-1, feature_layer=False, view_width=8),
    ).in_box((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5))
    occupancy = np.random.default_rng(12).random((6, 6, 6)) < 0.8
    march = MarchSettings(samples=32, stop=1e-3)
    return FieldFile(config, weights(config, 2), occupancy, march, {"made_by": "make.py"})


def fine_ndc() -> FieldFile:
    """Coarse and fine network of a forward-facing capture; no occupancy grid."""
    config = NeuralFieldConfig(
        position=FourierEncoding(frequencies=2),
        direction=FourierEncoding(frequencies=1, include_input=False),
        network=NetworkConfig(depth=2, width=8, skip=-1, feature_relu=True, view_width=6),
        density_activation="relu",
        density_shift=0.5,
        density_scale=1.5,
        ndc=Ndc(scale_x=1.5, scale_y=2.0, near=1.0),
    ).in_box((-1.25, -1.5, -1.0), (1.25, 1.5, 1.0))
    march = MarchSettings(samples=16, fine=12)
    return FieldFile(
        config, weights(config, 3), None, march, {"made_by": "make.py"}, weights(config, 4)
    )


def rays_around() -> tuple[np.ndarray, np.ndarray]:
    """Six rays from outside into the box, one that begins inside, one that misses."""
    rng = np.random.default_rng(21)
    o = rng.standard_normal((8, 3))
    o *= 3 / np.linalg.norm(o, axis=1, keepdims=True)
    d = rng.uniform(-0.5, 0.5, (8, 3)) - o
    o[6], d[6] = (0.1, 0.2, -0.1), (0.4, -0.7, 0.5)
    o[7], d[7] = (3, 0, 0), (0.6, 0.8, 0.1)
    return o, d


def rays_forward() -> tuple[np.ndarray, np.ndarray]:
    """Seven rays along -z, one of them from before the near plane, and one backwards."""
    rng = np.random.default_rng(22)
    o = rng.uniform(-0.2, 0.2, (8, 3))
    d = np.stack([*rng.uniform(-0.4, 0.4, (2, 8)), np.full(8, -1.0)], axis=1)
    o[6, 2] = -1.5
    d[7, 2] = 1.0
    return o, d


def rendered(path: Path, o: np.ndarray, d: np.ndarray) -> dict[str, Any]:
    """The rays and what they see of a field file, by its own march settings."""
    o, d = o.astype(np.float32), d / np.linalg.norm(d, axis=1, keepdims=True)
    d = d.astype(np.float32)
    contents = load_field(path)
    field, occupancy = contents.build(backend)
    rays = [mi.Vector3f(*(backend.Float(a[:, i]) for i in range(3))) for a in (o, d)]
    seen = render_rays(MarchedField(field, contents.march, occupancy), *rays)
    return {
        "o": o.tolist(),
        "d": d.tolist(),
        "color": np.stack([np.array(c) for c in seen.color], axis=1).tolist(),
        "opacity": np.array(seen.opacity).tolist(),
        "depth": np.array(seen.depth).tolist(),
    }


# ---------------------------------- Dataset ----------------------------------


def write_png(path: Path, image: np.ndarray) -> None:
    """An (H, W, 4) image of bytes; by hand, so that the bytes depend on no library."""
    height, width, _ = image.shape
    rows = b"".join(b"\0" + row.tobytes() for row in image)

    def chunk(kind: bytes, data: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + check

    header = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows, 9))
        + chunk(b"IEND", b"")
    )


def write_split(folder: Path, split: str, views: int, height: float, angle: float = 0.6) -> None:
    """8x8 views of a ball coloured by its normal, from cameras on a circle."""
    size, frames = 8, []
    (folder / split).mkdir(parents=True)
    for k in range(views):
        turn = 2 * np.pi * k / views
        o = np.array([4 * np.cos(turn), 4 * np.sin(turn), height])
        back = o / np.linalg.norm(o)
        right = np.cross((0, 0, 1), back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, o], axis=1)
        y, x = (np.mgrid[:size, :size] + 0.5) * 2 / size - 1
        local = np.stack([x, -y, np.full_like(x, -1 / np.tan(angle / 2))], axis=-1)
        d = local @ pose[:3, :3].T
        d /= np.linalg.norm(d, axis=-1, keepdims=True)
        b = d @ o
        inside = 0.64 - (o @ o - b * b)  # of a ball of radius 0.8; below 0 where it is missed
        normal = (o - d * (b + np.sqrt(np.maximum(inside, 0)))[..., None]) / 0.8
        alpha = np.clip(inside / 0.1, 0, 1)[..., None]
        image = np.concatenate([np.clip(0.5 + 0.5 * normal, 0, 1), alpha], axis=-1)
        write_png(folder / split / f"r_{k}.png", np.rint(255 * image).astype(np.uint8))
        frames.append({"file_path": f"./{split}/r_{k}", "transform_matrix": pose.tolist()})
    text = json.dumps({"camera_angle_x": angle, "frames": frames}, indent=1)
    (folder / f"transforms_{split}.json").write_text(text + "\n")


# ---------------------------------- Run ----------------------------------


def trained(out: Path) -> dict[str, Any]:
    """Trains ``out/run`` on ``out/data``, and a copy of it further."""
    run = mi_nerf.start(
        out / "data", out / "run", steps=STEPS, seed=3, settings=SETTINGS, variant=VARIANT
    )
    losses = [report["loss"] for report in run.reports()]
    log = [json.loads(line) for line in (out / "run" / "log.jsonl").read_text().splitlines()]
    assert [line["loss"] for line in log] == losses and len(losses) == STEPS
    measured = mi_nerf.evaluate(out / "run", variant=VARIANT)
    with tempfile.TemporaryDirectory() as folder:
        copy = shutil.copytree(out / "run", Path(folder) / "run")
        again = mi_nerf.start(
            out / "data", copy, steps=STEPS + FURTHER_STEPS, resume=True, variant=VARIANT
        )
        further = list(again.reports())
    assert [report["step"] for report in further] == [STEPS + 1 + k for k in range(FURTHER_STEPS)]
    config = out / "run" / "config.json"
    text, place = config.read_text(), json.dumps(str((out / "data").resolve()))
    assert text.count(place) == 1
    config.write_text(text.replace(place, json.dumps(DATA_PATH)))
    return {
        "data_path_in_config": DATA_PATH,
        "step": log[-1]["step"],
        "losses": losses,
        "psnr": measured["mean"]["psnr"],
        "psnr_of_images": [image["psnr"] for image in measured["images"]],
        "resumed": {
            "steps": STEPS + FURTHER_STEPS,  # the argument of mi_nerf.start(..., resume=True)
            "losses": [report["loss"] for report in further],
        },
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("out", type=Path, metavar="OUT")
    out = parser.parse_args().out
    mi.set_variant(VARIANT)
    out.mkdir(parents=True, exist_ok=True)
    for old in ("run", "data"):
        shutil.rmtree(out / old, ignore_errors=True)
    expected: dict[str, Any] = {
        "versions": {
            "mi_nerf": mi_nerf.__version__,
            "mitsuba": mi.__version__,
            "drjit": dr.__version__,
        },
        "variant": VARIANT,
        "fields": {},
    }
    fields = {
        "fourier": (fourier(), rays_around()),
        "hash_grid": (hash_grid(), rays_around()),
        "fine_ndc": (fine_ndc(), rays_forward()),
    }
    for name, (contents, rays) in fields.items():
        path = out / f"{name}.safetensors"
        provenance = {"mi_nerf": mi_nerf.__version__, **contents.provenance}
        save_field(path, replace(contents, provenance=provenance))
        expected["fields"][path.name] = rendered(path, *rays)
    write_split(out / "data", "train", 6, 1.0)
    write_split(out / "data", "test", 3, 1.5)
    expected["fields"]["run/field.safetensors"] = {}  # in this place; it is trained next
    expected["run"] = trained(out)
    expected["fields"]["run/field.safetensors"] = rendered(
        out / "run" / "field.safetensors", *rays_around()
    )
    (out / "expected.json").write_text(json.dumps(expected, indent=1) + "\n")


if __name__ == "__main__":
    main()
