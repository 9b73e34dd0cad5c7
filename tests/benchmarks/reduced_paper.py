"""The published model at a reduced size, trained to the end of its schedule.

    MI_NERF_DATA=… python -m tests.benchmarks.reduced_paper
    python -m tests.benchmarks.reduced_paper --scene kettle --seconds 300 --set network.width=128

Structure and schedule are those of the preset ``paper``: eight layers with a skip, a coarse and a
fine network, L = 10 and 4, a learning rate that falls from 5e-4 to a tenth over the run. Smaller
are the images (lego_200 at half its size, 100x100, or a scene path-traced for this), the widths
(64 and 32), the samples (32 + 64) and the rays (256): ten minutes on two CPU cores by default,
from process start on, compilation included. Then held-out views are measured by the nerf2020
protocol. How long the published model itself would take with these images is measured, too.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from mi_nerf import generation
from mi_nerf.base.variants import array_module, choose_variant
from mi_nerf.data import load_dataset, split_to_measure
from mi_nerf.scene_xml.library import find_scene
from mi_nerf.training.forecast import PUBLISHED_STEPS, duration, step_seconds
from mi_nerf.training.presets import preset
from tests.benchmarks import data_folder, machine, trained
from tests.benchmarks.results import TRAINING, Figure, Row, add_options, save

REDUCED = ["network.width=64", "network.view_width=32", "sampling.rays=256"]
REDUCED += ["sampling.samples=32", "sampling.fine=64", "sampling.render_samples=32"]


def main() -> None:
    """Trains every seed to its end, and prints a line each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default="lego_200", help="in the folder MI_NERF_DATA names")
    parser.add_argument("--scene", help="path-trace this one instead, 60 views of 100x100")
    parser.add_argument("--downscale", type=int, help="default: 2, of a scene 1")
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--steps", type=int, help="of the schedule, in place of seconds")
    parser.add_argument("--seeds", type=int, default=1, help="how many")
    parser.add_argument("--views", type=int, default=25)
    parser.add_argument("--set", nargs="*", default=[], help="changes, as of mi-nerf train")
    parser.add_argument("--no-published", action="store_true", help="do not time that one")
    parser.add_argument("--variant")
    add_options(parser)
    options = parser.parse_args()
    variant = choose_variant(options.variant)
    budget = f"{options.steps:,} steps" if options.steps else f"{options.seconds:g} s"
    print(f"{machine()}, {variant}; {' '.join([*REDUCED, *options.set])}; {budget} a run")
    with tempfile.TemporaryDirectory() as folder:
        data = _data(options, Path(folder), variant)
        if not options.no_published:
            published = _published(data, options, variant)
            save("reduced_paper", [published], options, variant, TRAINING)
        runs = []
        for seed in range(options.seeds):
            runs.append(_trained(data, Path(folder) / f"seed_{seed}", seed, options, variant))
            print(f"seed {seed}: {trained.line(runs[-1])}", flush=True)
    model = ", ".join(["reduced", *options.set])
    labels = {"model": model, "images": _images(data, runs[0]["size"]), "time": budget}
    row = trained.row(labels, runs, data.name, range(options.seeds))
    save("reduced_paper", [row], options, variant, TRAINING)


def _images(data: Path, size: tuple[int, int]) -> str:
    return f"{data.name}, {size[0]}×{size[1]}"


def _data(options: argparse.Namespace, folder: Path, variant: str) -> Path:
    """The images, path-traced if a scene was named."""
    if options.scene is None:
        options.downscale = options.downscale or 2
        return data_folder(options.data)
    options.downscale = options.downscale or 1
    views = generation.Options(train=60, val=0, test=10, size=(100, 100), spp=64)
    place = folder / options.scene
    generation.generate(find_scene(options.scene), place, variant, views, show=False)
    return place


def _published(data: Path, options: argparse.Namespace, variant: str) -> Row:
    """What the whole preset would take with these images."""
    dataset = load_dataset(data, "train", downscale=options.downscale, limit=10)
    seconds = step_seconds(preset("paper"), dataset, array_module(variant))
    count = PUBLISHED_STEPS["paper"]
    print(
        f"the published model: {seconds:.3g} s a step, {count:,} steps would take about "
        f"{duration(seconds * count)}",
        flush=True,
    )
    size = (dataset.intrinsics.width, dataset.intrinsics.height)
    labels = {"model": "as published", "images": _images(data, size), "time": f"{count:,} steps"}
    whole = Figure(seconds * count / 86400, "days")
    return Row(labels, {"step": Figure(seconds, "s"), "whole": whole})


def _trained(
    data: Path, folder: Path, seed: int, options: argparse.Namespace, variant: str
) -> dict[str, object]:
    """One run and its quality."""
    folder.mkdir()
    train = ["--preset", "paper", "--seed", str(seed), "--variant", variant]
    train += ["--downscale", str(options.downscale), "--set", *REDUCED, *options.set]
    steps, seconds = ["--steps", str(options.steps)], ["--max-seconds", str(options.seconds)]
    train += steps if options.steps else seconds
    evaluate = ["--split", split_to_measure(data, None), "--views", str(options.views)]
    return trained.by_command(data, folder, train, [*evaluate, "--variant", variant])


if __name__ == "__main__":
    main()
