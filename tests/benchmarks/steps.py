"""Milliseconds of a training step, beside another checkout and beside what the machine allows.

    MI_NERF_DATA=… python -m tests.benchmarks.steps --against ../before

Processes of both checkouts take turns, each trains until the occupancy has formed and then times
steps in rounds, one refresh of the occupancy grid in each; medians of all rounds and their
range. Presets need not make equally many queries a step, so the time of 10,000 queries is given
as well.

The bounds are what matrix products and the features of a hash grid need at the least, each by
itself at the rate that this machine reaches: a plain product, by Dr.Jit or NumPy, whichever is
faster, and plain reads of and additions to the entries of the field's table around points on
random rays, eight a level, at places known beforehand. Sines, the optimiser, samples and Python
have no bound here.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from mi_nerf.base.variants import array_module
from mi_nerf.data import load_dataset
from mi_nerf.fields.hash_grid import HashGridConfig
from mi_nerf.report.arithmetic import drjit_product_rate, numpy_product_rate, training_flop
from mi_nerf.training.model import field_config
from mi_nerf.training.presets import preset as preset_config
from tests.benchmarks import checkout, machine
from tests.benchmarks.results import TRAINING, Figure, Row, median_of, save

STEPS = """
import time
import drjit as dr
import mi_nerf

a = arguments
run = mi_nerf.start(a["data"], a["out"], preset=a["preset"], downscale=a["downscale"],
    steps=a["warm_up"] + a["rounds"] * a["round"], settings=a["settings"], variant=a["variant"])
step, seen = run.trainer.step, []

def timed(*arguments, **options):
    dr.sync_thread()
    start = time.perf_counter()
    result = step(*arguments, **options)
    dr.sync_thread()
    seen.append((time.perf_counter() - start, result.queries))
    return result

run.trainer.step = timed
run.train(show_bar=False)
rounds = [seen[i:i + a["round"]] for i in range(a["warm_up"], len(seen), a["round"])]
answer({
    "package": mi_nerf.__file__,
    "ms": [1e3 * sum(s for s, _ in r) / len(r) for r in rounds],
    "queries": [sum(q for _, q in r) / len(r) for r in rounds],
})
"""
_REPETITIONS = 9
_ON_RAY = 10  # queries


def main() -> None:
    """Times all presets."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", default="lego_200")
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--presets", nargs="+", default=["fast", "nerf"])
    parser.add_argument("--warm-up", type=int, default=320, help="steps before")
    parser.add_argument("--rounds", type=int, default=8, help="of each process")
    parser.add_argument("--repeats", type=int, default=3, help="processes of each checkout")
    parser.add_argument("--set", nargs="*", default=[], help="settings of both checkouts")
    options = checkout.parsed(parser)
    print(f"{machine()}, {options.data}, downscale {options.downscale}")
    for preset in options.presets:
        _compare(preset, options)


def _compare(preset: str, options: argparse.Namespace) -> None:
    """Times one preset with all checkouts in turns, and saves their rows."""
    places = checkout.versions(options)
    ms: dict[str, list[float]] = {name: [] for name in places}
    queries: dict[str, list[float]] = {name: [] for name in places}
    for _ in range(options.repeats):
        for name, folder in places.items():
            seen = _timed(folder, preset, options)
            ms[name] += seen["ms"]
            queries[name] += seen["queries"]
    for name, folder in places.items():
        figures = {
            "step": median_of(ms[name], "ms"),
            "queries": Figure(float(np.mean(queries[name]))),
        }
        figures["of_10000"] = Figure(1e4 * figures["step"].value / figures["queries"].value, "ms")
        if name == "this":
            figures |= bounds(preset, figures, options)
            if len(places) > 1:
                before = np.median(ms[options.against_name]) / np.mean(
                    queries[options.against_name]
                )
                figures["ratio"] = Figure(figures["of_10000"].value / float(1e4 * before))
        print(f"{preset}, {name}: " + ", ".join(f"{k} {f.value:.3g}" for k, f in figures.items()))
        labels = {"preset": " ".join([preset, *options.set]), "version": name}
        save("steps", [Row(labels, figures)], options, options.variant, TRAINING, checkout=folder)


def _timed(folder: Path, preset: str, options: argparse.Namespace) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as place:
        return checkout.measured(
            folder,
            STEPS,
            data=str(options.folder),
            out=str(Path(place) / "run"),
            preset=preset,
            downscale=options.downscale,
            settings=options.set,
            variant=options.variant,
            warm_up=options.warm_up,
            rounds=options.rounds,
            round=16,
        )


# ---- Bounds -------------------------------------------------------------------


def bounds(
    preset: str, figures: dict[str, Figure], options: argparse.Namespace
) -> dict[str, Figure]:
    """Milliseconds that the products and the features of a step need at the least."""
    backend = array_module(options.variant)
    dataset = load_dataset(options.folder, "train", downscale=options.downscale)
    config = field_config(preset_config(preset), dataset)
    queries = int(figures["queries"].value)
    rate = max(drjit_product_rate(backend), numpy_product_rate())
    products = 1e3 * queries * training_flop(config) / (1e9 * rate)
    found = {"product_rate": Figure(rate, "GFLOP/s"), "products": Figure(products, "ms")}
    features = 0.0
    if config.grid is not None:
        reads, adds = table_times(backend, config.grid, queries)
        found |= {"reads": Figure(reads, "ms"), "adds": Figure(adds, "ms")}
        features = reads + adds
    share = (products + features) / figures["step"].value
    return {**found, "bound": Figure(products + features, "ms"), "share": Figure(share)}


def table_times(backend: Any, grid: HashGridConfig, queries: int) -> tuple[float, float]:
    """Milliseconds to read the vertices around so many queries, and to add to them.

    A vertex is read as its features together, as the encoding does.
    """
    features, rng = grid.features, np.random.default_rng(0)
    places = vertices(grid, points_on_rays(queries, rng))
    table = backend.Float(rng.random(grid.entries() * features, np.float32))
    vertex: Any = backend.Float if features == 1 else getattr(backend, f"Array{features}f")
    index = backend.UInt32(places.ravel())
    vertex: Any = backend.Float if features == 1 else getattr(backend, f"Array{features}f")
    index = backend.UInt32(np.stack(places, axis=1).ravel().astype(np.uint32))  # query by query
    dr.eval(table, index)

    def read() -> None:
        found = dr.gather(vertex, table, index)
        dr.eval(dr.sum(dr.sum(found, axis=0) if features > 1 else found))

    def add(mode: Any) -> None:
        sums = dr.zeros(backend.Float, len(table))
        dr.scatter_add(sums, vertex(1), index, mode=mode)
        dr.eval(sums)

    modes = [dr.ReduceMode.Auto]
    if dr.backend_v(backend.Float) == dr.JitBackend.LLVM:
        modes.append(dr.ReduceMode.Expand)  # a table for each thread
    return _milliseconds(read), min(_milliseconds(lambda mode=mode: add(mode)) for mode in modes)


def points_on_rays(count: int, rng: np.random.Generator) -> np.ndarray[Any, Any]:
    """(count, 3) points of [0, 1]³, ten at a time in a row as neighbours on a ray."""
    first = rng.random((-(-count // _ON_RAY), 1, 3))
    directions = rng.normal(size=first.shape)
    directions /= 128 * np.linalg.norm(directions, axis=-1, keepdims=True)
    points = first + directions * np.arange(_ON_RAY)[:, None]
    return points.reshape(-1, 3)[:count].clip(0, 1)


def vertices(grid: HashGridConfig, points: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """(N, levels, 8) entries of the table around the points: in order, or hashed (Teschner)."""
    corners = np.indices((2, 2, 2)).reshape(3, 8).T
    found, start = [], 0
    for level in range(grid.levels):
        side = math.ceil(grid.coarsest * grid.growth() ** level - 1) + 1
        size = min(side**3, 1 << grid.log2_entries)
        at = (points[:, None] * (side - 2)).astype(np.uint32) + corners.astype(np.uint32)
        x, y, z = np.moveaxis(at, -1, 0)
        hashed = x ^ y * np.uint32(2654435761) ^ z * np.uint32(805459861)
        entry = x + side * (y + side * z) if side**3 <= size else hashed % size
        found.append(start + entry)
        start += size
    return np.stack(found, axis=1).astype(np.uint32)


def _milliseconds(work: Any) -> float:
    """The least of some repetitions, after one that compiles."""
    times = []
    for _ in range(_REPETITIONS):
        start = time.perf_counter()
        work()
        dr.sync_thread()
        times.append(time.perf_counter() - start)
    return 1e3 * min(times[1:])


if __name__ == "__main__":
    main()
