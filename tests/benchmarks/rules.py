"""Errors of the rules of quadrature, at equal numbers of queries.

    python -m tests.benchmarks.rules --plot docs/convergence.png
    python -m tests.benchmarks.rules runs/lego --views 10

Without a run: fields with known integrals in float64, 200 rays. Opacity is the same for all
rules where samples lie in the middle of their strata; depth, the integral of an emission
that grows with t, tells them apart. Then samples jittered as in training.

With a run: rays of its held-out views, on white, against 4096 samples a ray of the same
field, through the run's occupancy grid.
"""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import drjit as dr
import numpy as np

from mi_nerf.base.variants import array_module, choose_variant
from mi_nerf.data import load_dataset
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.placing import place_samples
from mi_nerf.march.quadrature import integrate, over_background
from mi_nerf.march.query import Evaluation
from mi_nerf.march.rules import Rule
from mi_nerf.march.settings import MarchSettings
from mi_nerf.tasks.target import open_target
from mi_nerf.training.batches import RayBatch, RaySource, step_rng
from tests.benchmarks import machine
from tests.benchmarks.results import (
    QUADRATURE,
    TRAINING,
    Figure,
    Protocol,
    Row,
    add_options,
    save,
)
from tests.fields.test_closed_form import JUMPS, VALUES
from tests.march.test_rules import errors

RULES: tuple[Rule, ...] = get_args(Rule)
FIELDS = {**VALUES, **{f"{kind}, edge 0": values for kind, values in JUMPS.items()}}
DENSE = 4096
RAYS_AT_A_TIME = 256  # with all of their samples


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", nargs="?", help="folder of a run; by default, closed forms")
    parser.add_argument("--plot", type=Path, help="picture of error against samples")
    parser.add_argument("--split", default="val")
    parser.add_argument("--views", type=int, default=10)
    parser.add_argument("--rays", type=int, default=4096, help="drawn from the views")
    parser.add_argument("--variant")
    add_options(parser)
    options = parser.parse_args()
    variant = choose_variant(options.variant)
    backend = array_module(variant)
    print(f"{machine()}, {variant}\n")
    if options.run is None:
        save("rules", closed_forms(backend, options.plot), options, variant, QUADRATURE, whole=True)
    else:
        rows = trained(backend, options)
        save("rules_trained", rows, options, variant, TRAINING)


# ---- Closed forms -------------------------------------------------------------


def closed_forms(backend: Any, plot: Path | None) -> list[Row]:
    """Errors at 64 and 192 samples, and the order of convergence from 64 to 768."""
    columns: dict[str, Callable[[str, int], float]] = {
        "opacity": lambda name, n: _errors(backend, name, "constant", n)[0],
        **{
            f"depth, {rule}": lambda name, n, rule=rule: _errors(backend, name, rule, n)[1]
            for rule in ("constant", "linear")
        },
        **{
            f"depth, jittered, {rule}": lambda name, n, rule=rule: _errors(
                backend, name, rule, n, True
            )[1]
            for rule in RULES
        },
    }
    rows = []
    for name in FIELDS:
        figures = {}
        for column, error in columns.items():
            coarse, middle, fine = (error(name, n) for n in (64, 192, 768))
            key = re.sub(r"\W+", "_", column)
            figures |= {f"{key}_64": Figure(coarse), f"{key}_192": Figure(middle)}
            if coarse > 1e-12:  # otherwise exact up to rounding
                figures[f"{key}_order"] = Figure(math.log(coarse / fine) / math.log(12))
        print(f"{name}: {' '.join(f'{k} {f.value:.2g}' for k, f in figures.items())}", flush=True)
        rows.append(Row({"field": name}, figures))
    if plot is not None:
        _draw(plot, {c: f for c, f in columns.items() if c.startswith("depth")})
    return rows


def _errors(
    backend: Any, name: str, rule: str, samples: int, jitter: bool = False
) -> tuple[float, float]:
    return errors(backend, name.split(",")[0], FIELDS[name], rule, samples, jitter)


def _draw(path: Path, columns: dict[str, Callable[[str, int], float]]) -> None:
    """Error of the depth against samples a ray, a panel for each field."""
    from matplotlib.figure import Figure

    samples = np.array([16, 32, 64, 128, 256, 512, 1024])
    colors = dict(zip(RULES, ("C0", "C1", "C2"), strict=True))
    figure = Figure(figsize=(12, 8.5), layout="constrained")
    axes = figure.subplots(3, 4, sharex=True).ravel()
    for name, axis in zip(FIELDS, axes, strict=False):
        largest = 0.0
        for column, error in columns.items():
            rule, jittered = column.split(", ")[-1], "jittered" in column
            label = f"{rule}, " + ("jittered samples" if jittered else "samples in the middle")
            values = [error(name, int(n)) for n in samples]
            largest = max(largest, values[0])
            style = "--" if jittered else "-"
            axis.loglog(samples, values, style, color=colors[rule], label=label)
        for order, line in ((1, ":"), (2, "-.")):
            guide = 2 * largest * (samples / samples[0]) ** -float(order)
            axis.loglog(samples, guide, line, color="0.6", lw=0.9, label=f"order {order}")
        smooth = "density jumps" if "edge 0" in name else "no jump"
        axis.set_title(f"{name.split(',')[0]}: {smooth}", fontsize=10)
        axis.set_xticks(samples[::2], [str(n) for n in samples[::2]])
        axis.minorticks_off()
        axis.tick_params(labelbottom=True)
        axis.set_xlabel("samples a ray")
        axis.set_ylabel("depth error (scene units)")
    axes[-1].set_axis_off()
    axes[-1].legend(*axes[0].get_legend_handles_labels(), loc="center", fontsize=10)
    figure.suptitle("Rules of quadrature: root mean square error of the depth of 200 rays, float64")
    figure.savefig(path, dpi=90)


# ---- Trained fields -------------------------------------------------------------


def trained(backend: Any, options: argparse.Namespace) -> list[Row]:
    """Mean absolute difference to the dense image, and PSNR lost against the truth."""
    target = open_target(options.run)
    if target.data is None:
        raise SystemExit(f"{options.run}: expected the folder of a run, which knows its dataset")
    views = load_dataset(
        target.data, options.split, downscale=target.downscale, limit=options.views
    )
    source = RaySource(views, "white", backend.Float)
    batch = source.draw(options.rays, step_rng(backend.Float, 0, 0))
    field, occupancy = target.contents.build(backend)
    march = replace(target.contents.march, fine=0, stop=0.0)

    def image(rule: Rule, samples: int, jitter: bool = False) -> np.ndarray[Any, Any]:
        settings = replace(march, samples=samples, rule=rule)
        return _image(backend, field, occupancy, batch, settings, jitter)

    dense = image("constant", DENSE)
    truth = np.array(over_background(batch.color, batch.alpha, batch.background))
    print(f"{options.run}: {options.rays} rays of {len(views)} views ({options.split}), on white.")
    print(f"With {DENSE} samples {_psnr(dense, truth):.3f} dB; with fewer, mean absolute")
    print("difference to that (in 1/255) and change of the PSNR:\n")
    size = (views.intrinsics.width, views.intrinsics.height)
    protocol = Protocol(
        Path(target.data).name, options.split, len(views), size, metric="pixels together, floats"
    )
    rows = []
    for samples in (32, 64, 128, 256):
        figures = {}
        for column, (rule, jitter) in _columns().items():
            found = image(rule, samples, jitter)
            lost = Figure(_psnr(found, truth) - _psnr(dense, truth), "dB")
            off = Figure(255 * float(np.abs(found - dense).mean()))
            key = re.sub(r"\W+", "_", column)
            figures |= {f"{key}_off": off, f"{key}_psnr": lost}
        print(
            f"{samples}: {' '.join(f'{k} {f.value:.3f}' for k, f in figures.items())}", flush=True
        )
        labels = {"field": Path(options.run).name, "samples": str(samples)}
        rows.append(Row(labels, figures, protocol))
    return rows


def _columns() -> dict[str, tuple[Rule, bool]]:
    middle: tuple[Rule, ...] = ("constant", "linear")
    return {
        **{rule: (rule, False) for rule in middle},
        **{f"jittered, {rule}": (rule, True) for rule in RULES},
    }


def _image(
    backend: Any, field: Any, occupancy: Any, batch: RayBatch, march: MarchSettings, jitter: bool
) -> np.ndarray[Any, Any]:
    """(3, R) colours on white."""
    parts, rng = [], np.random.default_rng(0)
    rays = len(batch.alpha)
    for start in range(0, rays, RAYS_AT_A_TIME):
        part = batch.part(start, min(RAYS_AT_A_TIME, rays - start))
        count = len(part.alpha) * march.samples
        offsets = backend.Float(rng.random(count, np.float32)) if jitter else None
        with dr.suspend_grad():
            placed = place_samples(
                MarchedField(field, march, occupancy), part.o, part.d, jitter=offsets
            )
            seen = integrate(Evaluation(field, placed, march.block), placed)
            parts.append(np.array(over_background(seen.color, seen.opacity, part.background)))
    return np.concatenate(parts, axis=1)


def _psnr(a: np.ndarray[Any, Any], b: np.ndarray[Any, Any]) -> float:
    return -10 * math.log10(np.mean((a - b) ** 2, dtype=float))


if __name__ == "__main__":
    main()
