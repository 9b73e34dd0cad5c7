"""A training loop of Mitsuba's own parts beside mi_nerf's trainer: time to the same PSNR.

    MI_NERF_DATA=… python -m tests.benchmarks.native --seconds 60
    python -m tests.benchmarks.native --data path-traced-dataset --downscale 1

Both train the field of one preset from the same weights: the trainer by ``mi_nerf.start``, and a
loop of ``mi.ad.loaders.RayDataLoader``, ``mi.render``, ``dr.backward`` and ``mi.ad.Adam``, as
docs/mitsuba.md has it, with the trainer's learning rates. Each is a process of its own; seconds
count from when Mitsuba is there, and what is looked at on the way stops the clock.
The time that the loop needs is where its curve passes what the trainer has at the end; the loop
trains for ``--share`` times the seconds, along a schedule of that length.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from tests.benchmarks import checkout, machine
from tests.benchmarks.resolution import passed
from tests.benchmarks.results import ROOT, Figure, Protocol, Row, mean_of, save

TRAINER = """
import time
import mi_nerf

a = arguments
curve = []

def look(run):
    with run.clock_stopped():
        run.save()
        seen = mi_nerf.evaluate(run, split=a["split"], views=a["views"], variant=a["variant"])
        curve.append([run.seconds, seen["mean"]["psnr"]])
    return seen

def after_step(run):
    if a["looks"] and run.seconds >= a["looks"][0]:
        a["looks"].pop(0)
        look(run)

run = mi_nerf.start(a["data"], a["out"], preset=a["preset"], max_seconds=a["seconds"],
    downscale=a["downscale"], seed=a["seed"], variant=a["variant"])
run.train(show_bar=False, after_step=after_step)
seen = look(run)
answer({"package": mi_nerf.__file__, "curve": curve, "steps": run.trainer.step_count,
    "size": seen["size"], "views": seen["views"]})
"""

LOOP = """
import time
import mi_nerf
import drjit as dr
import mitsuba as mi
from mi_nerf.base.variants import choose_variant

a = arguments
mi.set_variant(choose_variant(a["variant"]))
clock = time.perf_counter()
data = mi_nerf.load_dataset(a["data"], "train", downscale=a["downscale"])
start = a["out"] + "-start.safetensors"
mi_nerf.save_field(start, mi_nerf.fresh_field(data, preset=a["preset"], seed=a["seed"]))

scene = mi.load_dict({
    "type": "scene",
    "integrator": {"type": "nerf", "encoded": data.color_space == "srgb", "samples": 64},
    "views": {"type": "nerfviews", "filename": a["data"], "downscale": a["downscale"]},
    "box": {
        "type": "cube",
        "bsdf": {"type": "null"},
        "interior": {"type": "nerfmedium", "filename": start, "training": True},
    },
})
views, medium = scene.sensors()[0], scene.shapes()[0].interior_medium()
images = views.images()
params = mi.traverse(scene)
params.keep("box.interior_medium.(?!to_world)")
optimizer = mi.ad.Adam(lr=1e-2, beta_2=0.99, epsilon=1e-15, mask_updates=True, params=params)

curve, step, begins, loader = [], 0, list(a["begins"]), None

def look():
    global clock
    seconds = time.perf_counter() - clock
    file = a["out"] + ".safetensors"
    mi_nerf.save_field(file, medium.field_file())
    seen = mi_nerf.evaluate(file, data=a["data"], split=a["split"], downscale=a["downscale"],
        views=a["views"], variant=a["variant"])
    curve.append([seconds, seen["mean"]["psnr"]])
    clock = time.perf_counter() - seconds
    return seen

while (seconds := time.perf_counter() - clock) < a["seconds"]:
    if a["looks"] and seconds >= a["looks"][0]:
        a["looks"].pop(0)
        look()
    if begins and step >= begins[0][0]:
        loader = mi.ad.loaders.RayDataLoader(views, images, begins.pop(0)[1], seed=a["seed"],
            regular_reshuffle=True, tile_size=1 << 20)
    rate = 1e-2 * min(1, (step + 1) / 100) * 0.1 ** (seconds / a["seconds"])
    optimizer.set_learning_rate(rate)
    params.update(optimizer)
    target, sensor = loader.next()
    image = mi.render(scene, params, sensor=sensor, seed=step)
    color, alpha = (image - target)[..., :3], (image - target)[..., 3:]
    # The mean square over backgrounds of any grey, of premultiplied images.
    loss = dr.mean(color * (color - alpha) + dr.square(alpha) / 3, axis=None)
    dr.backward(loss)
    optimizer.step()
    dr.sync_thread()
    step += 1
seen = look()
answer({"package": mi_nerf.__file__, "curve": curve, "steps": step,
    "size": seen["size"], "views": seen["views"]})
"""

# Pixels in a batch of the loop, from which step on: their samples about fill a block of the
# network, and become fewer on every ray as space turns out to be empty.
_BEGINS = ((0, 1024), (400, 2048), (1000, 4096))

# What the figures depend on.
_PARTS = ("cameras", "data", "fields", "march", "plugins", "training")


def main() -> None:
    """Trains in both ways and compares."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", default="lego_200")
    parser.add_argument("--split", default="val")
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--seconds", type=float, default=60.0, help="of the trainer")
    parser.add_argument("--share", type=float, default=1.5, help="of these, for the loop")
    parser.add_argument("--seeds", type=int, default=1, help="how many")
    parser.add_argument("--views", type=int, default=8, help="of the split, evenly spread")
    parser.add_argument("--looks", type=int, default=6, help="on the way")
    options = checkout.parsed(parser)
    print(f"{machine()}, {options.data}, downscale {options.downscale}, {options.seconds:g} s")
    pairs = [_pair(seed, options) for seed in range(options.seeds)]
    times = [passed(loop["curve"], trainer["curve"][-1][1]) for trainer, loop in pairs]
    first = pairs[0][0]
    width, height = first["size"]
    row = Row(
        {
            "data": options.data,
            "preset": options.preset,
            "size": f"{width}×{height}",
            "time": f"{options.seconds:g} s",
        },
        {
            "trainer": mean_of([t["curve"][-1][1] for t, _ in pairs], "dB"),
            "loop": mean_of([n["curve"][-1][1] for _, n in pairs], "dB"),
            "trainer_steps": mean_of([t["steps"] for t, _ in pairs]),
            "loop_steps": mean_of([n["steps"] for _, n in pairs]),
            "same_quality": mean_of(times, "s"),
            "share": Figure(float(np.mean(times)) / options.seconds),
        },
        Protocol(options.data, options.split, first["views"], (width, height)),
        tuple(range(options.seeds)),
    )
    for name, figure in row.figures.items():
        print(f"{name} {figure.value:.4g} {figure.unit}")
    if math.isfinite(max(times)):
        save("native", [row], options, options.variant, _PARTS)


def _pair(seed: int, options: argparse.Namespace) -> tuple[dict[str, Any], dict[str, Any]]:
    """The trainer's run and the loop's."""
    found = []
    for name, program, share in (("trainer", TRAINER, 1.0), ("loop", LOOP, options.share)):
        seconds = share * options.seconds
        looks = np.geomspace(seconds / 8, seconds, options.looks + 1)[:-1]
        with tempfile.TemporaryDirectory() as place:
            run = checkout.measured(
                ROOT,
                program,
                data=str(options.folder),
                out=str(Path(place) / "run"),
                preset=options.preset,
                seconds=seconds,
                seed=seed,
                downscale=options.downscale,
                variant=options.variant,
                split=options.split,
                views=options.views,
                begins=_BEGINS,
                looks=[float(s) for s in looks],
            )
        curve = ", ".join(f"{s:.1f} s {p:.2f} dB" for s, p in run["curve"])
        print(f"{name}, seed {seed}: {run['steps']} steps; {curve}", flush=True)
        found.append(run)
    return found[0], found[1]


if __name__ == "__main__":
    main()
