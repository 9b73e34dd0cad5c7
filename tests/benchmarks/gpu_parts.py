"""The measurements of :mod:`tests.benchmarks.gpu`, each called by it in a process of its own.

A part writes its JSON file whenever it has found something, so that a limit leaves what is there.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

import mi_nerf
from mi_nerf import generation
from mi_nerf.base.machine import machine
from mi_nerf.base.variants import array_module, choose_variant
from mi_nerf.cameras.pinhole import Intrinsics, sensor_dict
from mi_nerf.cameras.poses import look_at
from mi_nerf.data import load_dataset
from mi_nerf.fields.fused_network import WIDEST, HalfNetwork
from mi_nerf.fields.network import NetworkConfig, initial_weights
from mi_nerf.report.arithmetic import drjit_product_rate
from mi_nerf.report.profile import profile_steps
from mi_nerf.scene_xml.library import find_scene
from mi_nerf.tasks.evaluate import evaluate
from mi_nerf.training import run as training
from mi_nerf.training.config import TrainConfig, with_settings
from mi_nerf.training.device import for_device
from mi_nerf.training.presets import PRESETS, preset
from mi_nerf.training.run_folder import FIELD
from mi_nerf.training.trainer import Trainer
from tests.benchmarks.gpu import Record, query_device, write_result
from tests.support.datasets import write_blob_dataset

_STEP_SECONDS = 4.0  # of profiled steps a preset
_FRAMES = 15

_SMALL = ["network.width=16", "network.view_width=16", "sampling.samples=16"]
_SMALL += ["sampling.render_samples=16", "sampling.batch=2048", "sampling.block=1024"]
_SMALL += ["occupancy.resolution=16"]
_SMALL_ROWS = {"paper": ["sampling.rays=32", "sampling.fine=16"]}


class Findings(dict[str, Any]):
    """A record that is in its file whenever something has been added."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self._file = file

    def add(self, **values: Any) -> None:
        """Adds values, and what the memory of the process has come to."""
        self.update(values)
        self["resident_mb"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3)
        write_result(self._file, self)

    def attempt(self, name: str, measure: Callable[[], Any]) -> None:
        """Adds what ``measure`` returns, or its error in one line."""
        try:
            self.add(**{name: measure()})
        except Exception as error:
            self.add(**{name: {"error": one_line(error)}})


def one_line(error: BaseException) -> str:
    """An error as text without line breaks."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:500]


# ---- The device ---------------------------------------------------------------------


def device(found: Findings, options: argparse.Namespace) -> None:
    """What it is called, and what of the program it is capable of."""
    choose_variant(options.variant)
    backend = array_module(options.variant)
    mi.set_variant(options.variant)
    found.add(machine=machine(options.variant))
    if options.variant.startswith("cuda"):
        card = {k: query_device(k) for k in ("name", "driver_version", "memory.total")}
        card |= {"cuda": list(dr.detail.cuda_version())}
        card |= {"capability": dr.detail.cuda_compute_capability()}
        found["machine"]["gpu"] = card["name"] or found["machine"]["gpu"]
        found.add(card=card)
    found.attempt("product_gflops", lambda: round(drjit_product_rate(backend), 1))
    found.attempt("surfaces", _trace_a_surface)
    found.attempt("half_precision", lambda: _differentiate_in_half_precision(backend))


def _trace_a_surface() -> str:
    """Needs OptiX on a GPU."""
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere"}})
    ray = mi.Ray3f(mi.Point3f(0, 0, -3), mi.Vector3f(0, 0, 1))
    distance = float(scene.ray_intersect(ray).t[0])
    return "works" if abs(distance - 2) < 1e-5 else f"a distance of {distance}, expected 2"


def _differentiate_in_half_precision(backend: Any) -> str:
    """Cooperative vectors: the answers and a gradient, against tensors in single precision."""
    config = NetworkConfig(depth=1, width=WIDEST, skip=-1, feature_layer=False, view_width=WIDEST)
    arrays = initial_weights(config.shapes(8, 3), 0)
    rng, count, answers = np.random.default_rng(0), 1024, []
    inputs = rng.uniform(-1, 1, (11, count)).astype(np.float32)
    for half in (True, False):
        weights = {name: backend.TensorXf(value) for name, value in arrays.items()}
        for value in weights.values():
            dr.enable_grad(value)
        rows = [backend.Float(row) for row in inputs]
        if half:
            network = HalfNetwork(config, weights, dr.opaque(backend.Float, 1024.0))
            density, color = network(rows[:8], rows[8:])
        else:
            position, direction = (backend.TensorXf(x) for x in (inputs[:8], inputs[8:]))
            h = mi_nerf.fields.network.trunk(config, weights, position)
            density = mi_nerf.fields.network.density_head(config, weights, h)
            color = mi_nerf.fields.network.color_head(config, weights, h, direction)
        dr.backward(dr.mean(density + color[0] + color[1] + color[2]))
        gradient = np.array(dr.grad(weights["trunk_0.weight"]))
        answers.append((np.array(density), gradient))
    wrong = max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in zip(*answers, strict=True))
    return "works" if wrong < 0.02 else f"a relative error of {wrong:.3g}, expected below 0.02"


# ---- Images -------------------------------------------------------------------------


def data(found: Findings, options: argparse.Namespace) -> None:
    """Says which images there are, and makes some where there are none."""
    folder, published = options.folder / "data", os.environ.get("MI_NERF_DATA")
    if options.small:
        write_blob_dataset(folder)
        found.add(images="a ball, 24x24", split="test", folder=str(folder))
    elif published and (Path(published) / "lego_800").is_dir():
        found.add(images="lego_800", split="val", folder=str(Path(published) / "lego_800"))
    else:
        views = generation.Options(train=50, val=0, test=5, size=(800, 800), spp=16)
        generation.generate(find_scene("bonsai"), folder, options.variant, views, show=False)
        found.add(images="bonsai, path-traced, 800x800", split="test", folder=str(folder))


def _images(options: argparse.Namespace) -> tuple[Path, str]:
    """The folder and the split to measure, as :func:`data` has left them."""
    known = json.loads((options.folder / "data.json").read_text())
    if "folder" not in known:
        raise RuntimeError("there are no images")
    return Path(known["folder"]), known["split"]


# ---- Training -----------------------------------------------------------------------


def train(found: Findings, options: argparse.Namespace) -> None:
    """The preset ``fast`` for some seconds from process start on, then held-out views."""
    folder, split = _images(options)
    config = _config("fast", options.small)
    if options.half:
        config = dataclasses.replace(config, half_precision=True)
    config = dataclasses.replace(config, max_seconds=options.train_seconds)
    place = options.folder / options.name
    given = {"half_precision"}  # as chosen here, whatever the device is capable of
    run = training.start(
        folder, place, config, options.variant, started=options.started, given=given
    )
    found.add(train_seconds=options.train_seconds, begun=round(run.seconds, 2))
    first: list[float] = []
    run.train(show_bar=False, after_step=lambda r: None if first else first.append(r.seconds))
    found.add(
        first_step=round(first[0], 2),
        steps=run.trainer.step_count,
        parameters=run.field_file().parameter_count(),
        watermark_mib=_watermark(options.variant),
    )
    measured = evaluate(run, split=split, views=options.views)
    found.add(
        psnr=round(measured["mean"]["psnr"], 3),
        ssim=round(measured["mean"]["ssim"], 4),
        views=len(measured["images"]),
        seconds_per_view=measured["seconds_per_view"],
        queries_per_ray=measured["queries_per_ray"],
    )


def _config(name: str, small: bool, *changes: str) -> TrainConfig:
    settings = [*_SMALL, *_SMALL_ROWS.get(name, [])] if small else []
    return with_settings(preset(name), [*settings, *changes])


def _watermark(variant: str) -> float:
    """The most that Dr.Jit has allocated, MiB."""
    backend = dr.JitBackend.CUDA if variant.startswith("cuda") else dr.JitBackend.LLVM
    return round(dr.detail.malloc_watermark(backend) / 2**20, 1)


def steps(found: Findings, options: argparse.Namespace) -> None:
    """Training steps of every preset, with what each stage takes, and of half precision."""
    folder, _ = _images(options)
    dataset = load_dataset(folder, "train", limit=20)
    rows: dict[str, TrainConfig] = {}
    for name in PRESETS:
        config = _config(name, options.small)
        rows[name] = for_device(config, options.variant)
        if name == "fast":
            half = dataclasses.replace(config, half_precision=True)
            rows["fast, half precision"] = for_device(half, options.variant)
            rows["fast, as on a CPU"] = config
    kinds: dict[TrainConfig, str] = {}
    for name, config in rows.items():
        plain = dataclasses.replace(config, preset="")
        if plain in kinds:
            found.add(**{name: {"as": kinds[plain]}})
            continue
        kinds[plain] = name
        backend = array_module(options.variant)

        def measure(config: TrainConfig = config, backend: Any = backend) -> Record:
            start = time.monotonic()
            budget = 0.2 if options.small else _STEP_SECONDS
            profile = profile_steps(Trainer(config, dataset, backend), budget)
            row = {**dataclasses.asdict(profile), "gflops": profile.gflops}
            row |= {"steps_per_second": 1e3 / profile.step_ms}
            row |= {"samples_per_second": 1e3 * profile.queries / profile.step_ms}
            return row | {"measured_in": round(time.monotonic() - start, 1)}

        found.attempt(name, measure)


# ---- Rendering ----------------------------------------------------------------------


def render(found: Findings, options: argparse.Namespace) -> None:
    """``mi.render`` of the longest training's field, again and again; the first one compiles."""
    fields = [options.folder / name / FIELD for name in ("train_long", "train_short")]
    field = next((f for f in fields if f.exists()), None)
    if field is None:
        raise RuntimeError("no field was trained")
    mi.set_variant(options.variant)
    size = 32 if options.small else 800
    camera = Intrinsics.from_angle_x(size, size, 0.6911)
    box = {"type": "cube", "interior": {"type": "nerfmedium", "filename": str(field)}}
    sensor = sensor_dict(camera, look_at((0, -4, 1), (0, 0, 0)))
    scene = mi.load_dict(
        {"type": "scene", "integrator": {"type": "nerf"}, "sensor": sensor, "box": box}
    )
    seconds: list[float] = []
    for seed in range(3 if options.small else _FRAMES + 1):
        start = time.perf_counter()
        dr.eval(mi.render(scene, spp=1, seed=seed))
        dr.sync_thread()
        seconds.append(time.perf_counter() - start)
        found.add(size=[size, size], first=seconds[0])
        if len(seconds) > 1:
            rest = seconds[1:]
            found.add(median=float(np.median(rest)), least=min(rest), greatest=max(rest))
    found.add(watermark_mib=_watermark(options.variant))


PARTS = {f.__name__: f for f in (device, data, train, steps, render)}


def main() -> None:
    """One part."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--name", required=True, help="of its file, and of its run")
    parser.add_argument("--variant", required=True)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--started", type=float, help="on the clock of time.monotonic()")
    parser.add_argument("--train-seconds", type=float)
    parser.add_argument("--views", type=int, default=25)
    parser.add_argument("--half", action="store_true")
    parser.add_argument("--small", action="store_true")
    options = parser.parse_args()
    found = Findings(options.folder / f"{options.name}.json")
    try:
        PARTS[options.part](found, options)
    except Exception as error:
        found.add(error=one_line(error))
        raise


if __name__ == "__main__":
    main()
