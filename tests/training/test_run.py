"""Training steps, runs, and what happens when they go wrong."""

from __future__ import annotations

import gc
import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import drjit.llvm.ad as ad
import numpy as np
import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.base.tensor_file import read_tensors, write_tensors
from mi_nerf.cameras.pinhole import project
from mi_nerf.data import Dataset, load_dataset
from mi_nerf.fields.neural import NeuralFieldConfig
from mi_nerf.formats.field_file import load_field
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.placing import place_samples, refine
from mi_nerf.march.quadrature import integrate, over_background
from mi_nerf.march.query import Evaluation
from mi_nerf.march.render import render_rays
from mi_nerf.training import run as training
from mi_nerf.training.batches import step_rng
from mi_nerf.training.config import OptimizerConfig, TrainConfig, from_json, to_json, with_settings
from mi_nerf.training.model import resolved_octaves
from mi_nerf.training.plain import leaves
from mi_nerf.training.presets import preset
from mi_nerf.training.progress import ProgressBar
from mi_nerf.training.run import TrainingError
from mi_nerf.training.run_folder import FORMAT, cut_log, read_config
from mi_nerf.training.schedule import learning_rate
from mi_nerf.training.trainer import Trainer
from tests.support.clock import Clock
from tests.support.datasets import write_blob_dataset

SIZE, VIEWS = 20, 6
SMALL = [
    "network.width=16",
    "network.view_width=8",
    "sampling.batch=1024",
    "sampling.samples=24",
    "occupancy.resolution=16",
    "occupancy.start=8",
    "occupancy.every=4",
    "occupancy.queries=512",
]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_blob_dataset(tmp_path_factory.mktemp("blob"), train=VIEWS, test=1, size=SIZE)


@pytest.fixture(scope="module")
def views(data: Path) -> Dataset:
    return load_dataset(data, "train")


def small(*settings: str, **changes: Any) -> TrainConfig:
    return replace(with_settings(preset("nerf"), SMALL + list(settings)), **changes)


def weights_after(trainer: Trainer, steps: int, rate: float = 5e-3) -> dict[str, np.ndarray]:
    for _ in range(steps):
        trainer.step(rate)
    return trainer.field.weights()


# --------------------------------------------------------------------------
#   Steps
# --------------------------------------------------------------------------


@pytest.mark.slow
def test_a_small_field_learns_the_blob(views: Dataset) -> None:
    trainer = Trainer(small(), views, ad)
    first = float(trainer.step(1e-2).mse[0])
    for _ in range(250):
        result = trainer.step(1e-2)
    assert float(result.mse[0]) < 0.1 * first
    assert 0 < trainer.occupancy.fraction() < 1


def test_steps_depend_on_the_seed_alone(views: Dataset) -> None:
    runs = [weights_after(Trainer(small(seed=s), views, ad), 12) for s in (0, 0, 1)]
    for name, expected in runs[0].items():
        np.testing.assert_array_equal(runs[1][name], expected)
    assert any(np.abs(runs[2][n] - w).max() > 0 for n, w in runs[0].items())


@pytest.mark.slow
@pytest.mark.parametrize("background", ["white", "black", "random"])
def test_backgrounds(views: Dataset, background: str) -> None:
    """An empty field shows the background alone: its error against an even image is known."""
    color, alpha = np.array([0.3, 0.2, 0.1]), 0.6
    even = np.broadcast_to(np.float32([*color, alpha]), views.images.shape).copy()
    rays = ("sampling.rays=4096", "sampling.batch=200000", "occupancy.enabled=false")
    config = small(f"background={background}", *rays)
    trainer = Trainer(config, replace(views, images=even), ad)
    bias = trainer.field.parameters()["density.bias"]
    trainer.optimizer.assign("density.bias", bias - 100)
    behind = {"white": 1.0, "black": 0.0, "random": (np.arange(1000)[:, None] + 0.5) / 1000}
    expected = np.square(color - alpha * behind[background]).mean()
    error = 0.03 if background == "random" else 1e-5
    assert float(trainer.step(1e-2).loss[0]) == pytest.approx(expected, rel=error)


def test_incomplete_rays_do_not_count(views: Dataset) -> None:
    """Rays that lost samples to the budget leave no trace in loss and gradient."""
    config = small("sampling.rays=64", "sampling.batch=100000", "occupancy.enabled=False")
    whole = Trainer(config, views, ad)
    cut = Trainer(with_settings(config, ["sampling.batch=700"]), views, ad)
    loss = [float(t.step(0.0).loss[0]) for t in (whole, cut)]
    assert loss[0] != loss[1]
    # The same by hand: the rays before the cut, each with all of its samples.
    rng = step_rng(ad.Float, config.seed, 0)
    batch = cut._source.draw(64, rng)
    jitter = rng.random(ad.Float, 64 * config.sampling.samples)
    samples = place_samples(
        MarchedField(cut.field, cut.march_settings()), batch.o, batch.d, jitter=jitter
    )
    complete = int(samples.truncate(700)[0])
    assert 0 < complete < 64
    seen = integrate(Evaluation(cut.field, samples, 1024), samples)
    predicted = over_background(seen.color, seen.opacity, batch.background)
    target = over_background(batch.color, batch.alpha, batch.background)
    error = sum(np.square(np.array(p - t)) for p, t in zip(predicted, target, strict=True)) / 3
    assert loss[1] == pytest.approx(error[:complete].mean(), rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["nerf", "fast"])
def test_no_kernel_is_compiled_in_a_steady_state(name: str, data: Path, tmp_path: Path) -> None:
    """In a process of its own, whose kernel cache starts empty."""
    settings = SMALL + (["grid.levels=2", "grid.log2_entries=8"] if name == "fast" else [])
    script = f"""
import sys
sys.path.insert(0, {str(Path.cwd())!r})
import drjit as dr, drjit.llvm.ad as ad
from mi_nerf.data import load_dataset
from mi_nerf.training.trainer import Trainer
from mi_nerf.training.config import with_settings
from mi_nerf.training.presets import preset
from mi_nerf.training.progress import ProgressBar
config = with_settings(preset({name!r}), {settings!r})
trainer = Trainer(config, load_dataset({str(data)!r}, "train"), ad)
for _ in range(60):
    trainer.step(1e-2)
dr.set_flag(dr.JitFlag.KernelHistory, True)
dr.kernel_history_clear()
sizes = set()
for _ in range(40):
    result = trainer.step(1e-2)
    sizes.add((int(result.rays[0]), result.queries))
history = [k for k in dr.kernel_history() if k.get("cache_hit") is not None]
print(len(sizes), len(history), sum(not k["cache_hit"] for k in history))
"""
    environment = {**os.environ, "HOME": str(tmp_path)}
    output = subprocess.run(
        [sys.executable, "-c", script],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    sizes, kernels, misses = map(int, output.stdout.split())
    assert sizes > 5 and kernels > 1000  # batches did change in size
    assert misses == 0
    assert any((tmp_path / ".drjit").iterdir())  # the cache was this one


@pytest.mark.slow
def test_steps_leave_no_arrays_behind(views: Dataset, capsys: pytest.CaptureFixture[str]) -> None:
    """Resident memory over 2000 steps is measured by benchmarks/memory.py."""
    trainer = Trainer(small(), views, ad)
    counts = []
    for steps in (20, 40):
        weights_after(trainer, steps)
        gc.collect()
        capsys.readouterr()
        dr.whos()
        counts.append(len(re.findall(r"^ +\d+ +LLVM ", capsys.readouterr().out, re.MULTILINE)))
    assert counts[0] == counts[1] > 10


# --------------------------------------------------------------------------
#   Failures
# --------------------------------------------------------------------------


def test_non_finite_steps_are_skipped(views: Dataset, tmp_path: Path) -> None:
    broken = views.premultiplied().copy()
    broken[0, 8:12, 8:12] = np.nan
    trainer = Trainer(small(), replace(views, images=broken), ad)
    skipped = 0
    for _ in range(30):
        before = trainer.field.weights()
        result = trainer.step(1e-2)
        if not result.accepted[0]:
            skipped += 1
            for name, value in trainer.field.weights().items():
                np.testing.assert_array_equal(value, before[name])
    assert skipped > 0
    assert all(np.isfinite(w).all() for w in trainer.field.weights().values())


def test_too_many_skipped_steps_end_the_run(data: Path, tmp_path: Path) -> None:
    run = training.start(data, tmp_path / "run", small(steps=100, max_skipped=5), "llvm_ad_rgb")
    for name, tensor in run.trainer.field.parameters().items():
        run.trainer.optimizer.assign(name, tensor * dr.nan)
    with pytest.raises(TrainingError, match="not finite in 5 steps in a row"):
        run.train(show_bar=False)


def test_steps_without_a_whole_ray_end_the_run(data: Path, tmp_path: Path) -> None:
    """The coarse network leaves nothing of so small a batch to the fine one."""
    config = small("sampling.rays=64", "sampling.batch=24", "sampling.fine=8", max_skipped=5)
    run = training.start(data, tmp_path / "run", replace(config, steps=100), "llvm_ad_rgb")
    with pytest.raises(TrainingError, match="no ray kept all .* in 5 steps .*sampling.batch"):
        run.train(show_bar=False)


@pytest.mark.slow
def test_a_collapsed_run_restarts_and_says_so(data: Path, tmp_path: Path) -> None:
    config = small(
        "density.activation=relu",
        "density.shift=-50",
        steps=400,
        collapse_check=40,
        max_restarts=2,
    )
    run = training.start(data, tmp_path / "run", config, "llvm_ad_rgb")
    with pytest.raises(TrainingError, match="collapsed 3 times"):
        run.train(show_bar=False)
    log = [json.loads(line) for line in (tmp_path / "run/log.jsonl").read_text().splitlines()]
    assert [line["attempt"] for line in log if line.get("event") == "restart"] == [1, 2]


@pytest.mark.slow
def test_a_healthy_run_does_not_restart(data: Path, tmp_path: Path) -> None:
    config = small(steps=210, collapse_check=200)
    run = training.start(data, tmp_path / "run", config, "llvm_ad_rgb")
    run.train(show_bar=False)
    assert run.trainer.attempt == 0


# --------------------------------------------------------------------------
#   Runs
# --------------------------------------------------------------------------


def test_resuming_is_exact(data: Path, tmp_path: Path) -> None:
    through = training.start(data, tmp_path / "a", small(steps=40), "llvm_ad_rgb")
    through.train(show_bar=False)

    # The schedule follows the budget, so the interrupted run gets the full one, too.
    halves = training.start(data, tmp_path / "b", small(steps=40), "llvm_ad_rgb")
    for _ in range(17):
        halves._advance()
    halves._settle()
    halves.save()
    resumed = training.start(data, tmp_path / "b", small(), "llvm_ad_rgb", resume=True)
    assert resumed.trainer.step_count == 17
    resumed.train(show_bar=False)

    assert resumed.trainer.step_count == through.trainer.step_count == 40
    for name, expected in through.trainer.field.weights().items():
        np.testing.assert_array_equal(resumed.trainer.field.weights()[name], expected)
    np.testing.assert_array_equal(
        resumed.trainer.occupancy.mask(), through.trainer.occupancy.mask()
    )


def test_a_run_folder_holds_what_it_should(data: Path, tmp_path: Path) -> None:
    run = training.start(data, tmp_path / "run", small(steps=20), "llvm_ad_rgb")
    run.train(show_bar=False)
    names = {p.name for p in (tmp_path / "run").iterdir()}
    assert names == {"config.json", "checkpoint.safetensors", "field.safetensors", "log.jsonl"}
    line = json.loads((tmp_path / "run/log.jsonl").read_text().splitlines()[-1])
    assert {"step", "seconds", "loss", "psnr", "samples_per_ray", "learning_rate"} <= set(line)
    assert line["step"] == 20
    config, record = read_config(tmp_path / "run")
    assert config == run.config and record["versions"]["mitsuba"]


def test_an_existing_run_is_not_overwritten(data: Path, tmp_path: Path) -> None:
    training.start(data, tmp_path / "run", small(steps=5), "llvm_ad_rgb").train(show_bar=False)
    before = (tmp_path / "run/checkpoint.safetensors").read_bytes()
    with pytest.raises(InputError, match="already holds a run, expected resume=True"):
        training.start(data, tmp_path / "run", small(steps=5), "llvm_ad_rgb")
    assert (tmp_path / "run/checkpoint.safetensors").read_bytes() == before


def test_a_run_killed_before_its_first_checkpoint_starts_over(data: Path, tmp_path: Path) -> None:
    training.start(data, tmp_path / "run", small(steps=5), "llvm_ad_rgb")
    run = training.start(data, tmp_path / "run", small(), "llvm_ad_rgb", resume=True)
    run.train(show_bar=False)
    assert run.trainer.step_count == 5


def test_the_log_is_cut_back_to_the_checkpoint(data: Path, tmp_path: Path) -> None:
    training.start(data, tmp_path / "run", small(steps=5), "llvm_ad_rgb").train(show_bar=False)
    log = tmp_path / "run/log.jsonl"
    kept = log.read_text()
    log.write_text(kept + '{"step": 9, "seconds": 1}\n{"step": 1')  # killed while writing
    run = training.start(data, tmp_path / "run", small(steps=8), "llvm_ad_rgb", resume=True)
    assert log.read_text() == kept
    run.train(show_bar=False)
    assert json.loads(log.read_text().splitlines()[-1])["step"] == 8


def test_the_log_is_replaced_and_not_written_over(tmp_path: Path) -> None:
    """Killed on the way, it leaves the old one whole: so a reader still sees all of it."""
    log = tmp_path / "log.jsonl"
    before = '{"step": 1}\n{"step": 2}\n'
    log.write_text(before)
    with log.open() as reader:
        cut_log(log, 1)
        assert reader.read() == before
    assert log.read_text() == '{"step": 1}\n'


@pytest.mark.parametrize("key", ["lr", "lr_final", "beta1"])
def test_an_edited_config_does_not_resume(data: Path, tmp_path: Path, key: str) -> None:
    training.start(data, tmp_path / "run", small(steps=3), "llvm_ad_rgb").train(show_bar=False)
    path = tmp_path / "run/config.json"
    record = json.loads(path.read_text())
    record["settings"]["optimizer"][key] = 0.125
    path.write_text(json.dumps(record))
    said = f"does not fit this run: it was trained with optimizer.{key}=.*, expected 0.125 as in"
    with pytest.raises(InputError, match=said):
        training.start(data, tmp_path / "run", small(steps=5), "llvm_ad_rgb", resume=True)


def test_what_changes_no_step_may_be_edited(data: Path, tmp_path: Path) -> None:
    training.start(data, tmp_path / "run", small(steps=3), "llvm_ad_rgb").train(show_bar=False)
    path = tmp_path / "run/config.json"
    record = json.loads(path.read_text())
    record["settings"] |= {"report_every": 7, "checkpoint_every": 9, "store_activations": 1}
    record["settings"]["sampling"] |= {"render_samples": 17, "render_stop": 0.5}
    path.write_text(json.dumps(record))
    run = training.start(data, tmp_path / "run", small(steps=5), "llvm_ad_rgb", resume=True)
    run.train(show_bar=False)
    assert run.trainer.step_count == 5
    assert load_field(tmp_path / "run/field.safetensors").march.samples == 17


@pytest.mark.slow
@pytest.mark.parametrize("edited", ["config.json", "nothing"])
def test_a_checkpoint_of_version_2_knows_the_seed_alone(
    data: Path, tmp_path: Path, edited: str
) -> None:
    training.start(data, tmp_path / "run", small(steps=3), "llvm_ad_rgb").train(show_bar=False)
    path = tmp_path / "run/checkpoint.safetensors"
    arrays, text = read_tensors(path, kind="checkpoint", newest=3)
    text.pop("settings")
    write_tensors(path, arrays, kind="checkpoint", version=2, description=text)
    config = tmp_path / "run/config.json"
    if edited == "config.json":
        config.write_text(config.read_text().replace('"seed": 0', '"seed": 1'))
        with pytest.raises(InputError, match="trained with seed=0, expected 1"):
            training.start(data, tmp_path / "run", small(), "llvm_ad_rgb", resume=True)
    else:
        run = training.start(data, tmp_path / "run", small(), "llvm_ad_rgb", resume=True)
        assert run.trainer.step_count == 3


def test_settings_are_those_of_the_newest_golden_run() -> None:
    """A setting that is added needs the next version of config.json, and golden files of it."""
    golden = Path(__file__).parents[1] / "golden"
    records = [json.loads(path.read_text()) for path in golden.glob("*/run/config.json")]
    newest = [r for r in records if r.get("format") == FORMAT]  # 0.1.0 named none
    assert newest
    for record in newest:
        settings = from_json(record["settings"], "golden")
        found = {name for name, _ in leaves(record["settings"])}
        assert found == {name for name, _ in leaves(to_json(settings))}


def test_signals_are_the_callers_between_two_reports(data: Path, tmp_path: Path) -> None:
    usual = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    config = small(steps=3, report_every=0.0)
    run = training.start(data, tmp_path / "run", config, "llvm_ad_rgb")
    inside = []

    def look(_: object) -> None:
        inside.append(signal.getsignal(signal.SIGINT))

    reports = run.reports(look)
    for _ in range(2):
        next(reports)
        assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == usual
    assert len(inside) == 1 and inside[0] != usual[0]  # in training they are requests
    reports.close()
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == usual


def test_a_signal_while_the_bar_is_drawn_is_a_request(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def update(*_: object) -> None:
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(ProgressBar, "update", update)
    config = small(steps=9, report_every=0.0)
    run = training.start(data, tmp_path / "run", config, "llvm_ad_rgb")
    run.train(show_bar=False)
    assert run.interrupted and run.trainer.step_count == 1
    assert (tmp_path / "run/checkpoint.safetensors").exists()


def test_the_clock_stands_still_after_an_error(data: Path, tmp_path: Path) -> None:
    run = training.start(data, tmp_path / "run", small(steps=5), "llvm_ad_rgb")

    def fail(_: object) -> None:
        raise RuntimeError("by the caller")

    with pytest.raises(RuntimeError, match="by the caller"):
        run.train(show_bar=False, after_step=fail)
    stopped = run.seconds
    time.sleep(0.01)
    assert run.seconds == stopped


@pytest.mark.slow
def test_ctrl_c_saves_and_the_run_goes_on(data: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mi_nerf.cli", "train", str(data), "--out"]
    command += [str(tmp_path / "run"), "--steps", "100000", "--set", *SMALL, "report_every=0.1"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    log = tmp_path / "run/log.jsonl"
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and not (log.exists() and log.read_text().count("\n") > 2):
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    assert "Traceback" not in errors
    stopped = training.start(data, tmp_path / "run", small(), "llvm_ad_rgb", resume=True)
    assert stopped.trainer.step_count > 0
    last = json.loads(log.read_text().splitlines()[-1])
    assert stopped.trainer.step_count == last["step"]


@pytest.mark.slow
def test_max_seconds_counts_from_the_given_start(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time, "monotonic", clock := Clock())
    config = small(max_seconds=100.2)
    begun = clock.now - 100.0
    run = training.start(data, tmp_path / "run", config, "llvm_ad_rgb", started=begun)
    run.train(show_bar=False)
    assert 100.2 <= run.seconds < 100.25
    assert 0 < run.trainer.step_count < 200  # a look at the clock takes a millisecond


# --------------------------------------------------------------------------
#   Pieces
# --------------------------------------------------------------------------


def test_learning_rate() -> None:
    options = OptimizerConfig(lr=1e-2, lr_final=1e-4, warmup=10)
    assert learning_rate(options, 0.0, 0) == pytest.approx(1e-3)
    assert learning_rate(options, 0.0, 9) == pytest.approx(1e-2)
    assert learning_rate(options, 0.5, 500) == pytest.approx(1e-3)
    assert learning_rate(options, 1.0, 10**6) == pytest.approx(1e-4)
    assert learning_rate(replace(options, warmup=0), 0.0, 0) == pytest.approx(1e-2)


def test_octaves_follow_the_resolution(views: Dataset) -> None:
    box = ((-1.0,) * 3, (1.0,) * 3)
    coarse = resolved_octaves(views, *box)
    fine = replace(
        views,
        images=np.zeros((VIEWS, 4 * SIZE, 4 * SIZE, 4), np.float32),
        intrinsics=replace(
            views.intrinsics,
            width=4 * SIZE,
            height=4 * SIZE,
            fx=4 * views.intrinsics.fx,
            fy=4 * views.intrinsics.fy,
            cx=4 * views.intrinsics.cx,
            cy=4 * views.intrinsics.cy,
        ),
    )
    assert resolved_octaves(fine, *box) == coarse + 2


@pytest.mark.slow
@pytest.mark.parametrize("fine", [0, 16])
def test_a_step_in_parts_is_the_same_step(views: Dataset, fine: int) -> None:
    """Gradients of parts that fit in memory add up to those of all rays at once."""
    # 131 rays: the last part is smaller.
    settings = ["sampling.rays=131", "sampling.batch=100000", f"sampling.fine={fine}"]
    config = small(*settings, "occupancy.enabled=False")
    whole = Trainer(config, views, ad)
    parts = Trainer(replace(config, store_activations=1e-4), views, ad)
    assert len(list(whole._parts(131))) == 1 and len(list(parts._parts(131))) > 2
    results = [trainer.step(0.0) for trainer in (whole, parts)]
    assert int(results[0].rays[0]) == int(results[1].rays[0]) == 131
    assert results[0].queries == results[1].queries
    for name in ("loss", "mse"):
        values = [float(getattr(result, name)[0]) for result in results]
        assert values[0] == pytest.approx(values[1], rel=1e-5)
    # After one step, first moments are proportional to the gradients.
    moments = [trainer.optimizer.state() for trainer in (whole, parts)]
    for name in whole.parameters:
        expected, found = (state[f"first.{name}"] for state in moments)
        assert np.abs(expected).max() > 0
        np.testing.assert_allclose(found, expected, atol=2e-5 * np.abs(expected).max())


@pytest.mark.slow
def test_the_field_file_takes_the_occupancy_along(data: Path, tmp_path: Path) -> None:
    run = training.start(data, tmp_path / "run", small(steps=80), "llvm_ad_rgb")
    run.train(show_bar=False)
    field, occupancy = load_field(tmp_path / "run/field.safetensors").build(ad)
    # From the middle of the box to its edges, where the hull leaves cells out.
    o = ad.Array3f(dr.linspace(ad.Float, -0.75, 0.75, 16), 0.6, 4)
    d = ad.Array3f(0, 0, -1) + dr.zeros(ad.Array3f, 16)
    march = run.trainer.march_settings()
    loaded = render_rays(MarchedField(field, march, occupancy), o, d)
    trained = render_rays(MarchedField(run.trainer.field, march, run.trainer.occupancy), o, d)
    assert loaded.queries == trained.queries < render_rays(MarchedField(field, march), o, d).queries
    np.testing.assert_array_equal(np.array(loaded.opacity), np.array(trained.opacity))


# --------------------------------------------------------------------------
#   Coarse and fine network
# --------------------------------------------------------------------------

FINE = ("sampling.samples=12", "sampling.fine=12", "sampling.render_samples=12")


def test_the_loss_is_that_of_both_networks(views: Dataset) -> None:
    """NeRF Eq. 6 by hand: coarse samples, then all samples, each with its own network."""
    config = small(*FINE, "sampling.rays=64", "sampling.batch=100000", "occupancy.enabled=False")
    trainer = Trainer(config, views, ad)
    before = {name: np.array(t) for name, t in trainer.parameters.items()}
    field, coarse = trainer.field, trainer.field.coarse
    rng = step_rng(ad.Float, config.seed, 0)
    batch = trainer._source.draw(64, rng)
    jitter = rng.random(ad.Float, 64 * 12)
    first = place_samples(
        MarchedField(field, trainer.march_settings()), batch.o, batch.d, jitter=jitter
    )
    seen = [integrate(Evaluation(coarse, first, 1024), first)]
    second = refine(first, seen[0].weights, 12, jitter=rng.random(ad.Float, 64 * 12))
    assert second.count == 24 and second.coarse_queries == first.queries
    seen.append(integrate(Evaluation(field, second, 1024), second))
    target = over_background(batch.color, batch.alpha, batch.background)
    errors = []
    for image in seen:
        predicted = over_background(image.color, image.opacity, batch.background)
        pairs = zip(predicted, target, strict=True)
        errors.append(np.mean(sum(np.square(np.array(p - t)) for p, t in pairs) / 3))
    result = trainer.step(1e-2)
    assert float(result.loss[0]) == pytest.approx(sum(errors), rel=1e-5)
    assert float(result.mse[0]) == pytest.approx(errors[1], rel=1e-5)
    assert result.queries == first.queries + second.queries
    for name, tensor in trainer.parameters.items():
        assert np.abs(np.array(tensor) - before[name]).max() > 0, name


def test_sample_positions_are_detached(views: Dataset) -> None:
    """The coarse network learns from its own image alone: the fine one has no say."""
    config = small(*FINE, "sampling.rays=64", "sampling.batch=100000", "occupancy.enabled=False")
    runs = []
    for factor in (1.0, 0.0):
        trainer = Trainer(config, views, ad)
        for name, tensor in trainer.field.parameters().items():
            trainer.optimizer.assign(name, tensor * factor)
        runs.append(trainer)
        trainer._differentiate(trainer._draw())
    a, b = ({n: np.array(dr.grad(t)) for n, t in run.parameters.items()} for run in runs)
    for name, gradient in a.items():
        if name.startswith("coarse."):
            np.testing.assert_allclose(b[name], gradient, rtol=1e-4, atol=1e-8)


@pytest.mark.slow
def test_fine_samples_gather_at_the_surface(data: Path, tmp_path: Path) -> None:
    config = small(*FINE, "sampling.batch=2048", "occupancy.enabled=False", steps=300)
    run = training.start(data, tmp_path / "run", config, "llvm_ad_rgb")
    run.train(show_bar=False)
    contents = load_field(tmp_path / "run/field.safetensors")
    assert contents.march.samples == contents.march.fine == 12 and contents.coarse is not None
    field, _ = contents.build(ad)
    o, d = ad.Array3f([0, 0.1], [-4, -4], [0, 0.2]), ad.Array3f([0, 0], [1, 1], [0, 0])
    samples = place_samples(MarchedField(field, contents.march), o, d)
    t = np.array(samples.t).reshape(2, 24)
    assert (np.diff(t, axis=1) >= 0).all()
    uniform = place_samples(MarchedField(field, replace(contents.march, fine=0, samples=24)), o, d)
    surface = 4 - 0.8  # of the ball, about
    near = [np.mean(np.abs(np.array(s.t) - surface) < 0.3) for s in (samples, uniform)]
    assert near[0] > 1.2 * near[1]
    seen = render_rays(MarchedField(field, contents.march), o, d)
    assert seen.queries == samples.queries + samples.coarse_queries
    again = render_rays(MarchedField(field, contents.march), o, d)
    assert (np.array(seen.color[0]) == np.array(again.color[0])).all()  # no chance involved


@pytest.mark.slow
def test_resuming_both_networks_is_exact(data: Path, tmp_path: Path) -> None:
    config = small(*FINE, steps=20)
    through = training.start(data, tmp_path / "a", config, "llvm_ad_rgb")
    through.train(show_bar=False)
    halves = training.start(data, tmp_path / "b", config, "llvm_ad_rgb")
    for _ in range(9):
        halves._advance()
    halves._settle()
    halves.save()
    resumed = training.start(data, tmp_path / "b", small(), "llvm_ad_rgb", resume=True)
    resumed.train(show_bar=False)
    assert any(name.startswith("coarse.") for name in through.trainer.parameters)
    for name, expected in through.trainer.parameters.items():
        np.testing.assert_array_equal(np.array(resumed.trainer.parameters[name]), expected)


def test_the_paper_trains_two_published_networks() -> None:
    config = preset("paper")
    assert (config.sampling.samples, config.sampling.fine) == (64, 128)
    assert config.sampling.rays == 4096 and config.network.skip == 5
    field = NeuralFieldConfig(
        network=config.network, position=config.position, direction=config.direction
    )
    assert field.parameter_count() == 595_844


# --------------------------------------------------------------------------
#   The paper's settings for the first steps, and for real captures
# --------------------------------------------------------------------------


def test_cropped_rays_pass_the_middle(views: Dataset) -> None:
    """Only pixels 5 to 14 of 20, in both directions, with their own colours."""
    source = Trainer(small(), views, ad)._source
    for crop, low, high in ((0.5, 5, 15), (1.0, 0, 20)):
        batch = source.draw(4096, step_rng(ad.Float, 0, 0), crop)
        o, d = (np.array(v, np.float64).T for v in (batch.o, batch.d))
        camera = np.argmin(np.linalg.norm(o[:, None] - views.cam_to_world[:, :3, 3], axis=-1), 1)
        xy = np.stack(
            [
                project(o[i] + d[i], views.intrinsics, views.cam_to_world[camera[i]])[0]
                for i in range(len(o))
            ]
        )
        pixel = np.floor(xy).astype(int)
        assert np.abs(xy - pixel - 0.5).max() < 1e-3
        assert (pixel.min(), pixel.max()) == (low, high - 1)
        assert len(np.unique(camera)) == len(views)
        expected = views.premultiplied()[camera, pixel[:, 1], pixel[:, 0]]
        found = np.stack([np.array(c) for c in (*batch.color, batch.alpha)], axis=1)
        np.testing.assert_array_equal(found, expected)


def test_noise_is_for_captures_and_training_alone(views: Dataset) -> None:
    opaque = replace(views, has_alpha=False)
    losses = {}
    for name, data in (("synthetic", views), ("capture", opaque)):
        for level in (0.0, 1.0):
            config = small("background=white", "occupancy.hull=False", f"density.noise={level}")
            trainer = Trainer(config, data, ad)
            losses[name, level] = float(trainer.step(1e-3).loss[0])
    assert losses["synthetic", 0.0] == losses["synthetic", 1.0] == losses["capture", 0.0]
    assert losses["capture", 1.0] != losses["capture", 0.0]


def test_noise_does_not_depend_on_how_a_step_is_divided(views: Dataset) -> None:
    opaque = replace(views, has_alpha=False)
    settings = ["density.noise=1.0", "sampling.rays=64", "occupancy.enabled=False"]
    config = small(*settings, "sampling.batch=100000")
    losses = [
        float(Trainer(replace(config, store_activations=size), opaque, ad).step(0.0).loss[0])
        for size in (3.0, 1e-4)
    ]
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)


def test_more_samples_than_memory_are_refused(views: Dataset) -> None:
    with pytest.raises(InputError, match="one step would need .* GiB for its samples, expected"):
        Trainer(small("sampling.fine=1000000000"), views, ad)
