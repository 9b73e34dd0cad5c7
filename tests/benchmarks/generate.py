"""What generating a dataset costs beyond path tracing it, and whether its noise is true.

    python -m tests.benchmarks.generate
    python -m tests.benchmarks.generate --scene bonsai --size 200 --views 8
    python -m tests.benchmarks.generate --workers 2

In turns, several times: the whole command ``mi-nerf generate`` and a process that loads
the same scene, moves one sensor and calls ``mi.render`` for the same views, samples and
pixels, and does nothing with the images. Then, in this process: the kernels that
``generate`` compiles after its first view, starting from an empty cache if HOME is an empty
folder; and its estimate of the ground-truth noise against renderings of 16 times as many
samples. With ``--workers N`` only this: the command with one worker and with N, and without any,
in turns, whose files must be the same.
"""

from __future__ import annotations

import argparse
import hashlib
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

import mi_nerf
from mi_nerf.base.variants import choose_variant
from mi_nerf.generation import Options, generate
from mi_nerf.generation.noise import mean_image
from mi_nerf.generation.run import prepare
from mi_nerf.generation.tracer import Tracer
from mi_nerf.images.metrics import to_8bit
from mi_nerf.images.write import on_white
from mi_nerf.scene_xml.library import find_scene
from mi_nerf.scene_xml.scene_file import SceneFile
from tests.benchmarks import machine
from tests.benchmarks.results import GENERATION, Figure, Row, add_options, mean_of, median_of, save

_BARE_LOOP = """
import sys
import mi_nerf, mitsuba as mi, numpy as np
from mi_nerf.cameras.pinhole import Intrinsics, sensor_dict
from mi_nerf.cameras.poses import mitsuba_from_opengl
from mi_nerf.generation.viewpoints import around
variant, path, size, views, spp = sys.argv[1], sys.argv[2], *map(int, sys.argv[3:])
mi.set_variant(variant)
scene = mi.load_file(path)
sensor = mi.load_dict(sensor_dict(Intrinsics.from_angle_x(size, size, 0.6911), np.eye(4)))
parameters = mi.traverse(sensor)
up, center = np.array([0.0, 0.0, 1.0]), np.zeros(3)
poses = around(views, "train", 0, cameras="hemisphere", up=up, center=center, radius=4.0)
for i, pose in enumerate(poses):
    matrix = mi.ScalarTransform4f(mitsuba_from_opengl(pose).tolist())
    parameters["to_world"] = mi.Transform4f(matrix)
    parameters.update()
    np.array(mi.render(scene, sensor=sensor, spp=spp, seed=i))
"""


def main() -> None:
    """Prints the three measurements."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default="spheres")
    parser.add_argument("--size", type=int, default=400)
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--views", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--workers", type=int, default=0, help="processes to compare with one")
    parser.add_argument("--variant")
    add_options(parser)
    options = parser.parse_args()
    variant = choose_variant(options.variant)
    print(f"{machine()}, {variant}, mi_nerf {mi_nerf.__version__}")
    print(f"{options.scene}, {options.views} views of {options.size}^2, {options.spp} spp")
    if options.workers:
        rows = [_workers(options, variant)]
    else:
        rows = [_kernels(options, variant)]  # first: what follows fills the kernel cache
        if options.repeats:
            rows.append(_speed(options, variant))
        rows.append(_noise(options, variant))
    save("generate", rows, options, variant, GENERATION)


def _of_scene(options: argparse.Namespace) -> str:
    return f"{options.scene}, {options.size}×{options.size}, {options.spp} samples a pixel"


def _speed(options: argparse.Namespace, variant: str) -> Row:
    path = find_scene(options.scene)
    size, views, spp = (str(n) for n in (options.size, options.views, options.spp))
    seconds: dict[str, list[float]] = {"generate": [], "bare loop": []}
    for _ in range(options.repeats):
        with tempfile.TemporaryDirectory() as folder:
            seconds["generate"].append(_timed(_command(options, variant, folder)))
        command = [sys.executable, "-c", _BARE_LOOP, variant, str(path), size, views, spp]
        seconds["bare loop"].append(_timed(command))
    for name, values in seconds.items():
        each = ", ".join(f"{v:.1f}" for v in values)
        print(f"{name}: {np.median(values) / options.views:.3f} s a view ({each} s in all)")
    ratio = np.median(seconds["generate"]) / np.median(seconds["bare loop"])
    print(f"ratio of the medians: {ratio:.3f}")
    figures = {
        f"{name}, a view": median_of([v / options.views for v in values], "s")
        for name, values in seconds.items()
    }
    what = f"mi-nerf generate, the whole command, against a bare loop of mi.render: {options.views}"
    return Row(
        {"what": f"{what} views of {_of_scene(options)}"}, {**figures, "times": Figure(ratio)}
    )


def _command(options: argparse.Namespace, variant: str, folder: str) -> list[str]:
    """``mi-nerf generate`` as a command line."""
    size = str(options.size)
    command = [sys.executable, "-m", "mi_nerf.cli", "generate"]
    command += [str(find_scene(options.scene)), folder, "--train", str(options.views)]
    command += ["--val", "0", "--test", "0", "--size", size, size, "--spp", str(options.spp)]
    return [*command, "--cameras", "hemisphere", "--variant", variant]


def _workers(options: argparse.Namespace, variant: str) -> Row:
    """The whole command with so many workers, one of them or none, and whether files agree."""
    counts = (0, 1, options.workers)
    seconds: dict[int, list[float]] = {count: [] for count in counts}
    digests = set()
    for _ in range(options.repeats):
        for count in counts:
            with tempfile.TemporaryDirectory() as folder:
                command = [*_command(options, variant, folder), "--workers", str(count)]
                seconds[count].append(_timed(command))
                digests.add(_digest(Path(folder)))
    if len(digests) != 1:
        raise SystemExit("files depend on the number of workers, or on chance")
    names = {0: "no worker", 1: "1 worker", options.workers: f"{options.workers} workers"}
    for count, values in seconds.items():
        print(f"{names[count]}: {', '.join(f'{v:.1f}' for v in values)} s in all")
    figures = {names[count]: median_of(values, "s") for count, values in seconds.items()}
    times = {
        f"times as fast as {names[count]}": Figure(
            float(np.median(seconds[count]) / np.median(seconds[options.workers]))
        )
        for count in (0, 1)
    }
    print(", ".join(f"{figure.value:.3f} {name}" for name, figure in times.items()))
    what = f"mi-nerf generate, the whole command: {options.views} views of {_of_scene(options)}"
    return Row({"what": f"{what}; the same bytes"}, {**figures, **times})


def _digest(folder: Path) -> str:
    """Of the names and contents of all files in a folder."""
    total = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        total.update(f"{path.relative_to(folder)} {path.stat().st_size} ".encode())
        total.update(path.read_bytes())
    return total.hexdigest()


def _timed(command: list[str]) -> float:
    start = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - start


def _options(options: argparse.Namespace, views: int, spp: int) -> Options:
    return Options(train=views, val=0, test=0, size=(options.size, options.size), spp=spp)


def _kernels(options: argparse.Namespace, variant: str) -> Row:
    """Counts cache misses view by view."""
    misses: list[int] = []
    trace = Tracer.trace

    def counting(self: Tracer, view: Any) -> Any:
        dr.kernel_history_clear()
        result = trace(self, view)
        misses.append(sum(k.get("cache_hit") == 0 for k in dr.kernel_history()))
        return result

    with tempfile.TemporaryDirectory() as folder, dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        Tracer.trace = counting  # type: ignore[method-assign]
        try:
            wanted = _options(options, 4, options.spp)
            generate(find_scene(options.scene), folder, variant, wanted, show=False)
        finally:
            Tracer.trace = trace  # type: ignore[method-assign]
    print(f"kernels compiled in views 1 to 4: {misses}")
    what = f"kernels compiled after the first view of {_of_scene(options)}"
    return Row({"what": what}, {"kernels": Figure(sum(misses[1:]))})


def _noise(options: argparse.Namespace, variant: str) -> Row:
    """The estimated mean squared error against the difference to 16 times the samples."""
    mi.set_variant(variant)
    ratios = []
    with tempfile.TemporaryDirectory() as name:
        scene = find_scene(options.scene)
        wanted = _options(options, 4, options.spp)
        record = generate(scene, name, variant, wanted, show=False)
        tracer, plan = prepare(SceneFile(scene), _options(options, 4, 16 * options.spp))
        for view in plan.views:  # the same cameras, another seed for the noise
            image = np.array(mi.Bitmap(str(Path(name) / f"{view.name}.exr")), np.float32)
            halves = tracer.trace(replace(view, seed=1)).halves
            truth = mean_image(*halves, (1, 1))
            noise = record["views"][view.name]["noise"]
            linear = np.mean((image - truth)[..., :3] ** 2)
            shown = [on_white(x) for x in (image, truth)]
            srgb = np.mean((shown[0] - shown[1]) ** 2)
            rounded = np.mean((to_8bit(shown[0]) - to_8bit(shown[1])) ** 2)
            # The longer rendering has a sixteenth of the variance itself.
            true = np.array([linear, srgb, rounded]) / (1 + 1 / 16)
            told = np.array([noise[k] for k in ("mse_linear", "mse_srgb", "mse_8bit")])
            ratios.append(told / true)
            print(f"{view.name}: ceiling {noise['psnr_ceiling']:.2f} dB; told / true: {ratios[-1]}")
    print(f"mean ratio: linear, sRGB, 8 bits: {np.mean(ratios, axis=0)}")
    names = ("linear", "sRGB", "8 bits")
    figures = {name: mean_of(v, "") for name, v in zip(names, np.transpose(ratios), strict=True)}
    what = "estimated noise of the ground truth over the difference to 16 times as many samples"
    return Row({"what": f"{what}: {_of_scene(options)}"}, figures)


if __name__ == "__main__":
    main()
