"""Where a step's time goes: stages, the arithmetic of a query, and that the parts add up."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import drjit as dr
import drjit.llvm.ad as ad
import pytest

from mi_nerf.base.kernel_stages import HOST, Launch, recording, settled, stage
from mi_nerf.data import Dataset, load_dataset
from mi_nerf.fields import neural
from mi_nerf.fields.fourier import FourierEncoding
from mi_nerf.fields.hash_grid import HashGridConfig
from mi_nerf.fields.neural import NeuralFieldConfig
from mi_nerf.report.arithmetic import multiply_adds, numpy_product_rate, training_flop
from mi_nerf.report.profile import LABELS, markdown, profile_steps, stage_times
from mi_nerf.training.config import TrainConfig, with_settings
from mi_nerf.training.presets import preset
from mi_nerf.training.trainer import Trainer

SMALL = [
    "network.width=16",
    "network.view_width=8",
    "sampling.batch=1024",
    "sampling.block=512",
    "sampling.samples=24",
    "occupancy.resolution=16",
    "occupancy.start=2",
    "occupancy.every=2",
    "occupancy.queries=512",
]
VARIETIES: dict[str, tuple[str, list[str]]] = {
    "nerf": ("nerf", []),
    "fast": ("fast", ["grid.levels=2", "grid.log2_entries=8"]),
    "hierarchical": ("nerf", ["sampling.fine=8", "sampling.rays=32", "sampling.batch=2048"]),
}


@pytest.fixture(scope="module")
def views(blob: Path) -> Dataset:
    return load_dataset(blob, "train")


def small(variety: str) -> TrainConfig:
    name, settings = VARIETIES[variety]
    return with_settings(preset(name), SMALL + settings)


# --------------------------------------------------------------------------
#   Arithmetic
# --------------------------------------------------------------------------


def test_published_cost_of_a_query() -> None:
    config = NeuralFieldConfig(position=FourierEncoding(10), direction=FourierEncoding(4))
    assert multiply_adds(config) == 593_408
    assert training_flop(config) == pytest.approx(3.49e6, abs=0.005e6)
    # By hand: the inputs of layers 0 and 5 (63) and of the view branch (27) have no gradient.
    assert training_flop(config) == 6 * 593_408 - 2 * (2 * 63 * 256 + 27 * 128)


@pytest.mark.slow
@pytest.mark.parametrize("variety", VARIETIES)
def test_counted_gradients_are_those_that_are_computed(
    variety: str, views: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer, seen = Trainer(small(variety), views, ad), []
    product = neural.network_product

    def spy(config: Any, weights: Any, features: Any, **options: Any) -> Any:
        if dr.grad_enabled(list(weights.values())):
            seen.extend((name, dr.grad_enabled(values)) for name, values in features.items())
        return product(config, weights, features, **options)

    monkeypatch.setattr(neural, "network_product", spy)
    trainer.step(1e-3)
    field = trainer.field_config
    assert set(seen) == {("position", field.grid is not None), ("direction", False)}
    per_matrix = {n: s for n, s in field.shapes().items() if n.endswith("weight")}
    total = 6 * sum(rows * columns for rows, columns in per_matrix.values())
    left_out = [n for n in per_matrix if n.endswith("direction_weight")]
    left_out += [] if field.grid is not None else ["trunk_0.weight"]
    assert training_flop(field) == total - 2 * sum(
        per_matrix[n][0] * per_matrix[n][1] for n in left_out
    )


def test_entries_of_a_grid_are_no_arithmetic() -> None:
    one, other = (NeuralFieldConfig(grid=HashGridConfig(log2_entries=n)) for n in (8, 12))
    assert training_flop(one) == training_flop(other)


@pytest.mark.slow
def test_product_rate_is_a_rate() -> None:
    assert 0.1 < numpy_product_rate() < 1e5


# --------------------------------------------------------------------------
#   Stages
# --------------------------------------------------------------------------


def test_kernels_count_where_they_are_launched() -> None:
    x = dr.arange(ad.Float, 1000)
    dr.eval(x)
    late = dr.sin(x)  # traced outside, launched inside
    with recording() as recorder:
        with stage("network"):
            dr.eval(late)
            with pytest.raises(KeyError), stage("encoding"):
                settled(dr.cos(x))
                raise KeyError
            dr.eval(dr.exp(x))
        dr.eval(dr.exp2(x))
    kernels = [k for k in recorder.launches if k.type == dr.KernelType.JIT]
    assert [k.stages for k in kernels] == [("network",), ("network", "encoding"), ("network",), ()]
    assert all(k.size == 1000 and k.milliseconds >= 0 for k in kernels)


def test_without_a_recorder_nothing_is_evaluated() -> None:
    y = dr.sin(dr.arange(ad.Float, 10))
    with stage("encoding"):
        settled(y)
    assert y.state == dr.VarState.Unevaluated
    with recording(marked=False), stage("encoding"):
        settled(y)
    assert y.state == dr.VarState.Unevaluated
    assert not dr.flag(dr.JitFlag.KernelHistory)


@pytest.mark.slow
@pytest.mark.parametrize("variety", VARIETIES)
def test_recording_changes_no_kernel(variety: str, views: Dataset) -> None:
    """All that two equal trainers launch, with boundaries and without."""
    launched, placed = [], set()
    for marked in (False, True):
        trainer = Trainer(small(variety), views, ad)
        for _ in range(3):
            trainer.step(1e-3)
        with recording(marked) as recorder:
            for _ in range(3):
                trainer.step(1e-3)
        kernels = [k for k in recorder.launches if k.type != HOST]  # which only marked ones show
        launched.append(Counter((str(k.type), k.size, k.code) for k in kernels))
        placed |= {k.stages[0] for k in recorder.launches if k.stages}
    assert launched[0] == launched[1]
    assert placed == {"rays", "samples", "network", "compositing", "optimizer", "occupancy"}


# --------------------------------------------------------------------------
#   Profiles
# --------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("variety", VARIETIES)
def test_stages_and_python_add_up_to_the_step(variety: str, views: Dataset) -> None:
    trainer = Trainer(small(variety), views, ad)
    profile = profile_steps(trainer, budget=0.2)
    assert set(profile.stages) == set(LABELS)
    assert sum(profile.stages.values()) == pytest.approx(profile.step_ms)
    assert profile.fastest_ms <= profile.step_ms <= profile.slowest_ms
    assert min(profile.stages.values()) >= 0
    # Nearly all of them are in some stage, and each stage has its share.
    assert profile.launches["other"] < 0.05 * sum(profile.launches.values())
    busy = [n for n in LABELS if n not in ("other", "python") and profile.stages[n] == 0]
    assert busy == []
    assert profile.compiled == 0
    assert profile.round_steps == 2  # one refresh of the occupancy grid
    assert 0 < profile.rays < profile.queries <= trainer.config.sampling.batch
    rate = profile.queries * profile.flop_per_query / (profile.step_ms * 1e-3) / 1e9
    assert profile.gflops == pytest.approx(rate)


def test_what_kernels_leave_is_python() -> None:
    jit, gemm = dr.KernelType.JIT, dr.KernelType.BatchedGemm
    launches = [
        Launch(("network",), gemm, 1, "", 6.0, False),
        Launch(("network", "encoding"), jit, 1, "", 2.0, False),
        Launch(("occupancy", "network"), gemm, 1, "", 1.0, False),
        Launch((), jit, 1, "", 1.0, False),
    ]
    kernels = {"products": 3.0, "encoding": 1.0, "occupancy": 0.5, "other": 0.5}
    for step_ms, scale, python in ((8.0, 1.0, 3.0), (2.5, 0.5, 0.0)):
        times = stage_times(launches, 2, step_ms)
        assert {n: ms for n, ms in times.items() if ms and n != "python"} == pytest.approx(
            {name: scale * ms for name, ms in kernels.items()}
        )
        assert times["python"] == pytest.approx(python, abs=1e-12)


def test_the_table_shows_every_part() -> None:
    parts = dict.fromkeys(LABELS, 2.0)
    record = {
        "step_ms": 2.0 * len(parts),
        "stages": parts,
        "launches": parts,
        "product_gflops": {"drjit": 100.0, "numpy": 200.0},
        "gflops": 50.0,
        "gflops_in_products": 80.0,
        **{"rounds": 3, "round_steps": 16, "fastest_ms": 23.0, "slowest_ms": 26.0},
        **{"profiled_ms": 25.0, "compiled": 0, "rays": 400.0, "queries": 4000.0},
        "flop_per_query": 3_500_000,
    }
    text = "\n".join(markdown(record))
    for label in LABELS.values():
        assert f"| {label} | 2.00 | 8.3 % | 2.0 |" in text
    assert "| a step | 24.00 | 100.0 % | 24.0 |" in text
    assert "50 % of the 100 GFLOP/s" in text and "25 % of the 200 GFLOP/s" in text
