"""Full-size frames of trained fields by mi.render, beside those of another checkout.

    MI_NERF_DATA=… python -m tests.benchmarks.frames --against ../before
    MI_NERF_DATA=… python -m tests.benchmarks.frames --presets nerf --fields run/field.safetensors

The other checkout trains a field of each preset, and both render the same file: processes of
both take turns, each renders one frame that is not counted and some more. Times are those of the
wall clock and those of all threads together, in which threads of Dr.Jit that wait for work
count, too: with ``--threads 1``, none do. Rays pass the same points of each pixel, so the
largest difference of the frames, colour or opacity, is that of the engines.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerf.data import load_dataset
from tests.benchmarks import checkout, machine
from tests.benchmarks.results import RENDERING, Figure, Row, median_of, save

TRAIN = """
import mi_nerf

a = arguments
run = mi_nerf.start(a["data"], a["out"], preset=a["preset"], steps=a["steps"],
    variant=a["variant"])
run.train(show_bar=False)
run.save()
seen = mi_nerf.evaluate(run, split="val", views=4, variant=a["variant"])
answer({"package": mi_nerf.__file__, "psnr": seen["mean"]["psnr"]})
"""
RENDER = """
import time
import drjit as dr
import mitsuba as mi
import numpy as np
import mi_nerf

a = arguments
mi.set_variant(a["variant"])
if a["threads"]:
    dr.set_thread_count(a["threads"])
width, height = a["size"]
film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
scene = mi.load_dict({
    "type": "scene",
    "integrator": {"type": "nerf", "jitter": False},
    "sensor": {"type": "perspective", "fov": a["fov"], "film": film,
        "to_world": mi.ScalarTransform4f(np.array(a["to_world"]))},
    "box": {"type": "cube", "interior": {"type": "nerfmedium", "filename": a["field"]}},
})
times = []
for _ in range(a["frames"] + 1):
    wall, busy = time.perf_counter(), time.process_time()
    frame = np.array(mi.render(scene, spp=1, seed=0))
    times.append((time.perf_counter() - wall, time.process_time() - busy))
np.save(a["out"], frame)
answer({"package": mi_nerf.__file__, "wall": [w for w, _ in times], "busy": [b for _, b in times]})
"""


def main() -> None:
    """Renders the fields of all presets."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", default="lego_200")
    parser.add_argument("--presets", nargs="+", default=["fast", "nerf"])
    parser.add_argument("--steps", type=int, default=2000, help="of training")
    parser.add_argument("--fields", type=Path, nargs="*", help="files for the presets, trained")
    parser.add_argument("--size", type=int, nargs=2, default=(800, 800))
    parser.add_argument("--frames", type=int, default=3, help="of each process")
    parser.add_argument("--repeats", type=int, default=3, help="processes of each checkout")
    parser.add_argument("--threads", type=int, default=0, help="default: one for each core")
    options = checkout.parsed(parser)
    fields = options.fields or [None] * len(options.presets)
    if len(fields) != len(options.presets):
        parser.error(f"--fields: {len(fields)} files for {len(options.presets)} presets")
    print(f"{machine()}, {options.data}, {options.size[0]}x{options.size[1]}")
    for preset, field in zip(options.presets, fields, strict=True):
        with tempfile.TemporaryDirectory() as place:
            made = field.resolve() if field else _trained(preset, Path(place) / "run", options)
            _compare(preset, made, Path(place), options)


def _trained(preset: str, run: Path, options: argparse.Namespace) -> Path:
    """A field file that both checkouts can read: the older one makes it."""
    folder = next(iter(checkout.versions(options).values()))
    data, steps, variant = str(options.folder), options.steps, options.variant
    arguments = {"data": data, "out": str(run), "steps": steps, "variant": variant}
    seen = checkout.measured(folder, TRAIN, preset=preset, **arguments)
    print(f"{preset}: {steps} steps, {seen['psnr']:.2f} dB", flush=True)
    return run / "field.safetensors"


def _compare(preset: str, field: Path, place: Path, options: argparse.Namespace) -> None:
    """Renders one field with all checkouts in turns, and saves their rows."""
    versions = checkout.versions(options)
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in versions}
    frames: dict[str, np.ndarray[Any, Any]] = {}
    for _ in range(options.repeats):
        for name, folder in versions.items():
            out = place / "frame.npy"
            found[name].append(_rendered(folder, field, out, options))
            frames[name] = np.load(out)
    for name, folder in versions.items():
        busy = [b for process in found[name] for b in process["busy"][1:]]
        wall = [w for process in found[name] for w in process["wall"][1:]]
        figures = {
            "busy": median_of(busy, "s"),
            "wall": median_of(wall, "s"),
            "first": median_of([process["wall"][0] for process in found[name]], "s"),
        }
        if name == "this" and len(versions) > 1:
            before = [b for process in found[options.against_name] for b in process["busy"][1:]]
            difference = np.abs(frames[name] - frames[options.against_name]).max()
            figures["ratio"] = Figure(float(np.median(busy) / np.median(before)))
            figures["difference"] = Figure(float(difference))
        print(f"{preset}, {name}: " + ", ".join(f"{k} {f.value:.3g}" for k, f in figures.items()))
        size = f"{options.size[0]}×{options.size[1]}"
        threads = str(options.threads or "all")
        labels = {"preset": preset, "size": size, "threads": threads, "version": name}
        save("frames", [Row(labels, figures)], options, options.variant, RENDERING, checkout=folder)


def _rendered(folder: Path, field: Path, out: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Frames from the first validation view."""
    dataset = load_dataset(options.folder, "val", limit=1)
    to_world = np.asarray(dataset.cam_to_world[0], float) @ np.diag([-1.0, 1, -1, 1])
    return checkout.measured(
        folder,
        RENDER,
        field=str(field),
        out=str(out),
        size=list(options.size),
        fov=math.degrees(dataset.intrinsics.angle_x),
        to_world=to_world.tolist(),
        frames=options.frames,
        threads=options.threads,
        variant=options.variant,
    )


if __name__ == "__main__":
    main()
