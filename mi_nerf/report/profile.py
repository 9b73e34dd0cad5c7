"""Where the time of a training step goes, and what its arithmetic amounts to."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from ..base.errors import InputError
from ..base.kernel_stages import HOST, Launch, recording
from ..base.variants import array_module
from ..data import load_dataset
from ..tasks.tables import markdown_table, save_figure
from ..tasks.target import Target
from ..training.checkpoint import load_checkpoint
from ..training.run_folder import CHECKPOINT, read_config
from ..training.trainer import Trainer
from .arithmetic import drjit_product_rate, numpy_product_rate, training_flop

FIGURE = "step_time.png"

# What a report calls the stages of base/kernel_stages.py, and the parts of a step besides them.
LABELS = {
    "rays": "rays and pixels drawn, random numbers",
    "samples": "samples placed, empty ones left out, cut into blocks",
    "encoding": "features of positions and directions, rays gathered",
    "products": "network: matrix products; all of a narrow one on a CPU",
    "network": "network: biases and activations, forward and adjoint",
    "scatter": "density and colour, scattered to the samples",
    "compositing": "compositing and loss, forward and adjoint",
    "encoding_adjoint": "adjoint of the features, gradients added up",
    "optimizer": "optimiser",
    "occupancy": "refresh of the occupancy grid",
    "other": "kernels outside these stages",
    "python": "Python and launches, not hidden behind kernels",
}

_BUDGET = 12.0  # seconds of timed steps, if that is enough for one round of each kind
_MOST_ROUNDS = 5
_WARM_UP = 20.0  # seconds after which it ends even if kernels are still compiled


@dataclass(frozen=True)
class StepProfile:
    """Time and work of a step, averaged over rounds of ``round_steps`` steps.

    The stages are those of the profiled round whose kernels took the median time. They add
    up to ``step_ms`` (:func:`stage_times`).
    """

    round_steps: int  # one refresh of the occupancy grid falls into each, unless steps are slow
    rounds: int  # without instrumentation
    step_ms: float  # the median of these rounds
    fastest_ms: float
    slowest_ms: float
    profiled_ms: float  # of the profiled round, whose boundaries wait for kernels
    stages: dict[str, float]  # milliseconds of each of LABELS
    launches: dict[str, float]  # kernels and other device operations a step, likewise
    compiled: int  # kernels compiled in all profiled steps
    rays: float  # a step, those that counted
    queries: float  # a step
    flop_per_query: int

    @property
    def gflops(self) -> float:
        """Sustained rate of the whole step, 10^9 operations a second."""
        return self.queries * self.flop_per_query / self.step_ms / 1e6

    @property
    def gflops_in_products(self) -> float:
        """The rate while matrix products run."""
        return self.queries * self.flop_per_query / self.stages["products"] / 1e6


@dataclass(frozen=True)
class _Round:
    milliseconds: float  # a step
    rays: float
    queries: float
    launches: list[Launch]


def profile_run(
    target: Target, variant: str, on_step: Callable[[], object] | None = None
) -> dict[str, Any]:
    """Profiles steps of a run from its checkpoint on; nothing in its folder changes.

    Args:
        on_step: called after every step.

    Raises:
        InputError: if the target is a field file, or checkpoint or data cannot be read.
    """
    if target.data is None:
        raise InputError(f"{target.path}: a field file, expected a run with its checkpoint")
    backend = array_module(variant)
    config, _ = read_config(target.path)
    dataset = load_dataset(
        target.data, "train", downscale=config.downscale, limit=config.views, images=config.images
    )
    trainer = Trainer(config, dataset, backend)
    load_checkpoint(target.path / CHECKPOINT, trainer)
    profile = profile_steps(trainer, on_step=on_step)
    limits = {"drjit": drjit_product_rate(backend), "numpy": numpy_product_rate()}
    return asdict(profile) | {
        "gflops": profile.gflops,
        "gflops_in_products": profile.gflops_in_products,
        "product_gflops": limits,
        "share": profile.gflops / max(limits.values()),
    }


def profile_steps(
    trainer: Trainer, budget: float = _BUDGET, on_step: Callable[[], object] | None = None
) -> StepProfile:
    """Trains on, for about ``budget`` seconds after a warm-up, and measures.

    Rounds with and without instrumentation take turns, so that both see the same machine.

    Args:
        on_step: called after every step.
    """
    stopwatch = _Stopwatch(trainer, on_step or (lambda: None))
    count, step_ms = stopwatch.warm_up()
    pairs = int(budget * 1e3 / (2 * count * step_ms))
    plain, profiled = [stopwatch.plain_round(count)], []
    for _ in range(min(max(pairs, 1), _MOST_ROUNDS)):
        profiled.append(stopwatch.profiled_round(count))
        plain.append(stopwatch.plain_round(count))
    kernels = [sum(k.milliseconds for k in r.launches) for r in profiled]
    typical = profiled[int(np.argsort(kernels)[len(kernels) // 2])]
    parts = [part_of_step(launch) for launch in typical.launches]
    milliseconds = [r.milliseconds for r in plain]
    step_ms = float(np.median(milliseconds))
    return StepProfile(
        round_steps=count,
        rounds=len(plain),
        step_ms=step_ms,
        fastest_ms=min(milliseconds),
        slowest_ms=max(milliseconds),
        profiled_ms=typical.milliseconds,
        stages=stage_times(typical.launches, count, step_ms),
        launches={name: parts.count(name) / count for name in LABELS},
        compiled=sum(k.compiled for r in profiled for k in r.launches),
        rays=float(np.mean([r.rays for r in plain])),
        queries=float(np.mean([r.queries for r in plain])),
        flop_per_query=training_flop(trainer.field_config),
    )


def part_of_step(launch: Launch) -> str:
    """Which of ``LABELS`` a kernel counts in."""
    if "occupancy" in launch.stages:
        return "occupancy"
    if launch.type in (dr.KernelType.BatchedGemm, HOST):
        return "products"
    return launch.stages[-1] if launch.stages else "other"


def stage_times(launches: list[Launch], steps: int, step_ms: float) -> dict[str, float]:
    """Milliseconds of each of ``LABELS`` in a step of ``step_ms``; they add up to it.

    Args:
        launches: of so many ``steps``, which need not be those that took ``step_ms``. Kernels
            that took longer than that are scaled to fit.
    """
    parts = dict.fromkeys(LABELS, 0.0)
    for launch in launches:
        parts[part_of_step(launch)] += launch.milliseconds / steps
    kernels = sum(parts.values())
    scale = min(1.0, step_ms / kernels) if kernels > 0 else 1.0
    parts = {name: scale * ms for name, ms in parts.items()}
    return parts | {"python": step_ms - scale * kernels}


class _Stopwatch:
    """Takes training steps in rounds, each step waited for."""

    def __init__(self, trainer: Trainer, on_step: Callable[[], object]) -> None:
        self._trainer, self._on_step = trainer, on_step

    def warm_up(self) -> tuple[int, float]:
        """Trains until nothing is compiled any more; steps of a round, and ms of one."""
        step = self._settled_round(1)
        options = self._trainer.config.occupancy
        if not options.enabled or options.every * step.milliseconds > _BUDGET * 1e3:
            return 1, step.milliseconds
        return options.every, self._settled_round(options.every).milliseconds

    def plain_round(self, count: int) -> _Round:
        """``count`` steps as they are."""
        trainer, seconds = self._trainer, 0.0
        rays = queries = 0.0
        for _ in range(count):
            start = time.perf_counter()
            result = trainer.step(trainer.config.optimizer.lr_final)
            dr.sync_thread()
            seconds += time.perf_counter() - start
            rays += float(result.rays[0])
            queries += result.queries
            self._on_step()
        return _Round(1e3 * seconds / count, rays / count, queries / count, [])

    def profiled_round(self, count: int) -> _Round:
        """``count`` steps whose launches are recorded."""
        with recording() as recorder:
            seen = self.plain_round(count)
        return replace(seen, launches=recorder.launches)

    def _settled_round(self, count: int) -> _Round:
        """The first round that compiles nothing, or the one after which patience ends."""
        start = time.perf_counter()
        while True:
            seen = self.profiled_round(count)
            compiled = any(k.compiled for k in seen.launches)
            if not compiled or time.perf_counter() - start > _WARM_UP:
                return seen


# ---------------------------------- Presentation ----------------------------------


def summary(record: dict[str, Any]) -> str:
    """One line about the result of :func:`profile_run`."""
    return (
        f"a training step takes {record['step_ms']:.1f} ms: {record['gflops']:.1f} GFLOP/s, "
        f"{100 * record['share']:.0f} % of a plain matrix product"
    )


def markdown(record: dict[str, Any]) -> list[str]:
    """The section of ``report.md`` about the result of :func:`profile_run`."""
    limits, step_ms = record["product_gflops"], record["step_ms"]
    shares = {name: 100 * record["gflops"] / limit for name, limit in limits.items()}
    launched = sum(record["launches"].values())
    stages = [(text, record["stages"][k], record["launches"][k]) for k, text in LABELS.items()]
    stages.append(("a step", sum(record["stages"].values()), launched))
    rows = [
        (label, f"{spent:.2f}", f"{100 * spent / step_ms:.1f} %", f"{count:.1f}")
        for label, spent, count in stages
    ]
    return [
        f"A step takes {step_ms:.2f} ms, the median of {record['rounds']} rounds of "
        f"{record['round_steps']} steps ({record['fastest_ms']:.2f} to "
        f"{record['slowest_ms']:.2f} ms), each step waited for.",
        f"It makes {record['queries']:.0f} queries for {record['rays']:.0f} rays and launches "
        f"{launched:.0f} kernels and other operations on the device; "
        f"{record['compiled']} kernels were compiled in the profiled steps.",
        "",
        f"The matrix products of a query take {record['flop_per_query'] / 1e6:.3f} MFLOP, forward "
        f"and backward, which makes **{record['gflops']:.1f} GFLOP/s** for the whole step: "
        f"{shares['drjit']:.0f} % of the {limits['drjit']:.0f} GFLOP/s that a plain product "
        f"(256x256 by 256x16384) reaches in Dr.Jit and {shares['numpy']:.0f} % of the "
        f"{limits['numpy']:.0f} GFLOP/s that it reaches in NumPy on the CPU. While matrix products "
        f"run, the rate is {record['gflops_in_products']:.1f} GFLOP/s.",
        "",
        f"![Time of a step by stages]({FIGURE})",
        "",
        *markdown_table(("stage", "ms", "share", "launches"), rows),
        "",
        "Stages are measured on the device, by the times of their kernels, in other steps, in",
        f"which each stage waits for its kernels ({record['profiled_ms']:.2f} ms a step). A kernel",
        "is part of the stage that launches it. Dr.Jit fuses what it can: rays are gathered in the",
        "kernel of the features, gradients of the samples in the first kernel of the network's",
        "adjoint. Matrix products, with the packing of their factors, are told by the type of the",
        "kernel; narrow networks on a CPU, biases and activations included, are NumPy's products.",
        "Python is what the kernels leave of the step; if they took longer there than the step",
        "does here, as on a busy machine, they are scaled to fit. Neither padding of the last",
        "block nor queries of the occupancy grid count as arithmetic.",
    ]


def draw(path: Path, record: dict[str, Any]) -> None:
    """A bar for the time of each stage."""
    from matplotlib.figure import Figure

    stages = {name: ms for name, ms in record["stages"].items() if ms > 5e-4 * record["step_ms"]}
    figure = Figure(figsize=(8, 0.9 + 0.32 * len(stages)), layout="constrained")
    axes = figure.subplots()
    bars = axes.barh([LABELS[name] for name in stages], list(stages.values()), color="#9db4c9")
    shares = [f"{100 * ms / record['step_ms']:.1f} %" for ms in stages.values()]
    axes.bar_label(bars, labels=shares, padding=3, fontsize=8)
    axes.invert_yaxis()
    axes.margins(x=0.12)
    axes.set_xlabel("ms a step")
    axes.spines[["top", "right"]].set_visible(False)
    save_figure(path, figure)
