"""Quality after a given time on full-size images, beside that of another checkout.

    MI_NERF_DATA=… python -m tests.benchmarks.resolution --seconds 600 --against ../before
    MI_NERF_DATA=… python -m tests.benchmarks.resolution --data lego_200 --downscale 2 \\
        --seconds 120 --shares 0.35 0.6 1 --against ../before

Every training is a process of its own, seconds count from its start, and what is looked at on
the way stops the clock. With --shares, this checkout trains for such shares of the time, too,
each to the end of its schedule; with --looks, the longest training is looked at so often on its
way. Where one of these curves passes what the other checkout has at the end is the time that
this one needs for the same quality.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tests.benchmarks import checkout, machine
from tests.benchmarks.results import (
    TRAINING,
    Figure,
    Protocol,
    Row,
    mean_of,
    save,
)

TRAIN = """
import resource
import mi_nerf

a = arguments
steps = []
curve = []

def look(run):
    with run.clock_stopped():
        run.save()
        seen = mi_nerf.evaluate(run, split=a["split"], views=a["views"], variant=a["variant"])
        curve.append([run.seconds, seen["mean"]["psnr"]])
    return seen

def after_step(run):
    if not steps:
        steps.append(run.seconds)
    if a["looks"] and run.seconds >= a["looks"][0]:
        a["looks"].pop(0)
        look(run)

run = mi_nerf.start(a["data"], a["out"], preset=a["preset"], max_seconds=a["seconds"],
    downscale=a["downscale"], seed=a["seed"], settings=a["settings"], variant=a["variant"],
    started=a["started"])
run.train(show_bar=False, after_step=after_step)
seconds, memory = run.seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
seen = mi_nerf.evaluate(run, split=a["split"], views=a["views"], variant=a["variant"])
answer({
    "package": mi_nerf.__file__,
    "psnr": seen["mean"]["psnr"],
    "ssim": seen["mean"]["ssim"],
    "steps": run.trainer.step_count,
    "seconds_per_view": seen["seconds_per_view"],
    "queries_per_ray": seen["queries_per_ray"],
    "parameters": run.field_file().parameter_count(),
    "memory": memory,
    "first_step": steps[0],
    "curve": [*curve, [a["seconds"], seen["mean"]["psnr"]]],
    "size": seen["size"],
    "views": seen["views"],
})
"""
_UNITS = {
    "psnr": "dB",
    "ssim": "",
    "steps": "",
    "seconds_per_view": "s",
    "queries_per_ray": "",
    "parameters": "",
    "memory": "MB",
    "first_step": "s",
}


def main() -> None:
    """Trains with both checkouts in turns."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", default="lego_800")
    parser.add_argument("--split", default="val")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--presets", nargs="+", default=["fast"])
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--seeds", type=int, default=1, help="how many")
    parser.add_argument("--views", type=int, default=25, help="of the split, evenly spread")
    parser.add_argument("--shares", type=float, nargs="*", default=[], help="of the seconds")
    parser.add_argument("--looks", type=int, default=0)
    parser.add_argument("--set", nargs="*", default=[], help="settings of this checkout")
    options = checkout.parsed(parser)
    print(f"{machine()}, {options.data}, downscale {options.downscale}, {options.seconds:g} s")
    for preset in options.presets:
        _compare(preset, options)


def _compare(preset: str, options: argparse.Namespace) -> None:
    """Trains one preset with all checkouts and seeds, and saves their rows."""
    places = checkout.versions(options)
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in places}
    times: list[float] = []
    for seed in range(options.seeds):
        for name, folder in places.items():
            shares = sorted({*options.shares, 1.0}) if name == "this" else [1.0]
            runs = [
                _trained(folder, name, preset, share * options.seconds, seed, options)
                for share in shares
            ]
            found[name].append(runs[-1])
            if name == "this" and len(places) > 1:
                level = found[options.against_name][-1]["psnr"]
                ends = [run["curve"][-1] for run in runs]
                times.append(min(passed(c, level) for c in [ends, *(r["curve"] for r in runs)]))
    for name, folder in places.items():
        figures = {k: mean_of([r[k] for r in found[name]], u) for k, u in _UNITS.items()}
        if name == "this" and times and math.isfinite(max(times)):
            figures["same_quality"] = mean_of(times, "s")
            figures["share"] = Figure(float(np.mean(times)) / options.seconds)
        row = Row(
            _labels(preset, name, found[name][0]["size"], options),
            figures,
            _protocol(found[name][0], options),
            tuple(range(options.seeds)),
        )
        print(f"{name}: " + ", ".join(f"{k} {f.value:.4g} {f.unit}" for k, f in figures.items()))
        save("resolution", [row], options, options.variant, TRAINING, checkout=folder)


def _labels(
    preset: str, version: str, size: Sequence[int], options: argparse.Namespace
) -> dict[str, str]:
    return {
        "data": options.data,
        "preset": " ".join([preset, *options.set]),
        "size": f"{size[0]}×{size[1]}",
        "time": f"{options.seconds:g} s",
        "version": version,
    }


def _protocol(run: dict[str, Any], options: argparse.Namespace) -> Protocol:
    width, height = run["size"]
    return Protocol(options.data, options.split, run["views"], (width, height))


def _trained(
    folder: Path, name: str, preset: str, seconds: float, seed: int, options: argparse.Namespace
) -> dict[str, Any]:
    looks: list[float] = []
    if name == "this" and seconds == options.seconds and options.looks:
        looks = [float(s) for s in np.geomspace(seconds / 16, seconds, options.looks + 1)[:-1]]
    with tempfile.TemporaryDirectory() as place:
        run = checkout.measured(
            folder,
            TRAIN,
            data=str(options.folder),
            out=str(Path(place) / "run"),
            preset=preset,
            seconds=seconds,
            seed=seed,
            downscale=options.downscale,
            settings=options.set if name == "this" else [],
            variant=options.variant,
            split=options.split,
            views=options.views,
            looks=looks,
        )
    print(f"{name}, {preset}, seed {seed}, {seconds:g} s: {run['psnr']:.2f} dB", flush=True)
    return run


def passed(curve: Sequence[Sequence[float]], level: float) -> float:
    """Seconds at which a curve of (seconds, PSNR) passes a level for the first time.

    Between two points, the PSNR is taken to be linear in the logarithm of time. A curve that
    begins above the level gives its first point, which is too late rather than too early; one
    that stays below gives infinity.
    """
    before: Sequence[float] | None = None
    for point in curve:
        if point[1] >= level:
            if before is None:
                return point[0]
            share = (level - before[1]) / (point[1] - before[1])
            return float(before[0] * (point[0] / before[0]) ** share)
        before = point
    return math.inf


if __name__ == "__main__":
    main()
