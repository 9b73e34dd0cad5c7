"""The functions behind the commands, as a notebook calls them."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

import mi_nerf
from mi_nerf.cli import main
from mi_nerf.training.run_folder import read_config
from tests.support.clock import Clock

SMALL = {
    "network.width": 16,
    "network.view_width": 16,
    "occupancy.resolution": 16,
    "report_every": 0,
}


@pytest.fixture
def trained(blob: Path, tmp_path: Path) -> mi_nerf.Run:
    run = mi_nerf.start(blob, tmp_path / "run", steps=6, settings=SMALL)
    run.train(show_bar=False)
    return run


# --------------------------------------------------------------------------
#   The package
# --------------------------------------------------------------------------


def test_every_public_name_is_there_and_explained() -> None:
    assert set(mi_nerf.__all__) <= set(dir(mi_nerf))
    for name in mi_nerf.__all__:
        assert (getattr(mi_nerf, name).__doc__ or "").strip(), name
    with pytest.raises(AttributeError, match="no attribute 'qqq'"):
        mi_nerf.qqq  # noqa: B018


@pytest.mark.slow
def test_importing_the_package_imports_no_training() -> None:
    code = "import sys, mi_nerf; print([m for m in sys.modules if m.startswith('mi_nerf.t')])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "training" not in found.stdout
    code = "import mi_nerf; print(mi_nerf.start.__name__, mi_nerf.Run.__name__)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["start", "Run"]


@pytest.mark.slow
@pytest.mark.parametrize("first", ["mitsuba", "mi_nerf"])
def test_before_or_after_the_variant_is_set(first: str, blob_run: Path) -> None:
    """And across a switch to a variant without derivatives, and back."""
    lines = {
        "mitsuba": "import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); import mi_nerf",
        "mi_nerf": "import mi_nerf; import mitsuba as mi; mi.set_variant('llvm_ad_rgb')",
    }[first]
    code = f"""{lines}
image = mi_nerf.render({str(blob_run)!r}, frames=1, size=(8, 6))[0]
mi.set_variant('scalar_rgb'); mi.set_variant('llvm_ad_rgb')
again = mi_nerf.render({str(blob_run)!r}, frames=1, size=(8, 6))[0]
print(mi.variant(), image.shape, (image == again).all())"""
    if "llvm_ad_rgb" not in mi_nerf.available_variants():
        pytest.skip("no LLVM on this machine")
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert found.stdout.split("\n")[-2] == "llvm_ad_rgb (6, 8, 4) True", found.stderr


def test_the_active_variant_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    from mi_nerf.base import variants as workflow

    monkeypatch.setattr(workflow, "available_variants", lambda: ["cuda_ad_rgb", "llvm_ad_rgb"])
    monkeypatch.setattr(workflow, "choose_variant", lambda v: v or "cuda_ad_rgb")
    for active, chosen in [
        ("llvm_ad_rgb", "llvm_ad_rgb"),
        ("scalar_rgb", "cuda_ad_rgb"),
        (None, "cuda_ad_rgb"),
    ]:
        monkeypatch.setattr(mi, "variant", lambda active=active: active)
        assert workflow.active_variant() == chosen
        assert workflow.active_variant("llvm_ad_rgb") == "llvm_ad_rgb"


# --------------------------------------------------------------------------
#   Runs
# --------------------------------------------------------------------------


@pytest.mark.slow
def test_settings_by_name_or_as_text(blob: Path, tmp_path: Path) -> None:
    options = {"downscale": 2, "seed": 3, "steps": 5, "preset": "fast"}
    named = {
        "network.width": 16,
        "grid": None,
        "position.frequencies": 3,
        "occupancy.enabled": False,
        "optimizer.lr": 1e-3,
        "box": (-1, -1, -1, 1, 1.5, 1),
    }
    written = ["network.width=16", "grid=none", "position.frequencies=3", "optimizer.lr=1e-3"]
    written += ["occupancy.enabled=false", "box=-1,-1,-1,1,1.5,1"]
    a = mi_nerf.start(blob, tmp_path / "a", settings=named, **options)
    b = mi_nerf.start(blob, tmp_path / "b", settings=written, **options)
    assert a.config == b.config
    assert (a.config.network.width, a.config.grid, a.config.seed) == (16, None, 3)
    assert mi_nerf.start(blob, tmp_path / "c", settings=SMALL).config.max_seconds == 600
    with pytest.raises(mi_nerf.InputError, match="unknown setting"):
        mi_nerf.start(blob, tmp_path / "d", settings={"network.widht": 16})
    with pytest.raises(mi_nerf.InputError, match="steps=0: expected a number above 0"):
        mi_nerf.start(blob, tmp_path / "d", steps=0)
    assert not (tmp_path / "d").exists()


@pytest.mark.slow
def test_reports_are_the_lines_of_the_log(blob: Path, tmp_path: Path) -> None:
    run = mi_nerf.start(blob, tmp_path / "run", steps=6, settings=SMALL)
    reports = list(run.reports())
    log = [json.loads(line) for line in (tmp_path / "run/log.jsonl").read_text().splitlines()]
    assert reports == log and [r["step"] for r in reports] == [1, 2, 3, 4, 5, 6]
    assert not run.interrupted and run.progress == 1
    through = mi_nerf.start(blob, tmp_path / "through", steps=6, settings=SMALL)
    through.train(show_bar=False)
    for name, weights in through.trainer.field.weights().items():
        np.testing.assert_array_equal(run.trainer.field.weights()[name], weights)


@pytest.mark.slow
def test_leaving_the_loop_saves_and_a_further_one_goes_on(blob: Path, tmp_path: Path) -> None:
    through = mi_nerf.start(blob, tmp_path / "through", steps=6, settings=SMALL)
    through.train(show_bar=False)
    run = mi_nerf.start(blob, tmp_path / "run", steps=6, settings=SMALL)
    handler = signal.getsignal(signal.SIGINT)
    for report in run.reports():
        if report["step"] == 2:
            break
    assert signal.getsignal(signal.SIGINT) is handler
    resumed = mi_nerf.start(blob, tmp_path / "run", resume=True)
    assert resumed.trainer.step_count == 2
    assert [r["step"] for r in resumed.reports()] == [3, 4, 5, 6]
    assert [r["step"] for r in run.reports()] == [3, 4, 5, 6]
    for name, weights in through.trainer.field.weights().items():
        np.testing.assert_array_equal(run.trainer.field.weights()[name], weights)
        np.testing.assert_array_equal(resumed.trainer.field.weights()[name], weights)


@pytest.mark.slow
def test_an_interrupt_while_the_caller_looks_is_the_callers(blob: Path, tmp_path: Path) -> None:
    """It ends the loop as any other, and leaving the loop saves."""
    run = mi_nerf.start(blob, tmp_path / "run", steps=50, settings=SMALL)
    steps = []
    with pytest.raises(KeyboardInterrupt):
        for report in run.reports():
            steps.append(report["step"])
            if report["step"] == 3:
                signal.raise_signal(signal.SIGINT)
    assert steps == [1, 2, 3]
    assert mi_nerf.start(blob, tmp_path / "run", resume=True).trainer.step_count == 3


@pytest.mark.slow
def test_only_training_takes_training_time(
    blob: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time, "monotonic", clock := Clock())
    run = mi_nerf.start(blob, tmp_path / "run", steps=3, settings=SMALL)
    opened = run.seconds
    assert opened > 0  # reading the data and carving the hull count
    clock.now += 1000
    assert run.seconds == opened
    looks = 0
    for _ in run.reports():
        seconds = run.seconds
        clock.now += 1000
        assert run.seconds == seconds
        looks += 1
    assert looks == 3
    assert opened < run.seconds < opened + 1


@pytest.mark.slow
def test_a_picture_on_the_way_changes_nothing(blob: Path, tmp_path: Path) -> None:
    test = mi_nerf.load_dataset(blob, "test")
    runs = [mi_nerf.start(blob, tmp_path / n, steps=4, settings=SMALL) for n in "ab"]
    for _ in runs[0].reports():
        picture = runs[0].picture(test, 1)
        assert picture.shape == (24, 24, 3) and np.isfinite(picture).all()
    runs[1].train(show_bar=False)
    for name, weights in runs[1].trainer.field.weights().items():
        np.testing.assert_array_equal(runs[0].trainer.field.weights()[name], weights)


@pytest.mark.slow
def test_a_picture_is_what_the_evaluation_sees(trained: mi_nerf.Run, tmp_path: Path) -> None:
    record = mi_nerf.evaluate(trained, images=tmp_path / "images")
    test = mi_nerf.load_dataset(data_of(trained), "test")
    for k, result in enumerate(record["images"]):
        truth = mi_nerf.pictures(test)[k]
        shown = np.rint(255 * np.clip(trained.picture(test, k), 0, 1)) / 255
        assert mi_nerf.psnr(shown, truth) == pytest.approx(result["psnr"], abs=1e-6)


def data_of(run: mi_nerf.Run) -> Path:
    return Path(read_config(run.folder)[1]["data"]["path"])


# --------------------------------------------------------------------------
#   The rest of the work
# --------------------------------------------------------------------------


@pytest.mark.slow
def test_evaluate_takes_runs_folders_and_targets(trained: mi_nerf.Run) -> None:
    targets = [trained, trained.folder, str(trained.folder), mi_nerf.open_target(trained.folder)]
    records = [mi_nerf.evaluate(target, views=2) for target in targets]
    for record in records:
        record.pop("seconds_per_view")
        assert record == records[0] and record["views"] == 2
    field = trained.folder / "field.safetensors"
    lone = mi_nerf.evaluate(field, data=data_of(trained), views=2)
    assert lone["mean"] == records[0]["mean"]


def test_render_gives_what_the_command_writes(trained: mi_nerf.Run, tmp_path: Path) -> None:
    images = mi_nerf.render(trained, frames=2, size=(10, 8))
    assert [image.shape for image in images] == [(8, 10, 4)] * 2
    words = ["render", str(trained.folder), "-o", str(tmp_path / "o"), "--frames", "2"]
    assert main([*words, "--size", "10", "8"]) == 0
    for k, image in enumerate(images):
        mi_nerf.write_picture(tmp_path / "again.png", image)
        written = (tmp_path / "o" / f"orbit_{k:03d}.png").read_bytes()
        assert (tmp_path / "again.png").read_bytes() == written
    assert len(mi_nerf.render(trained, path="test", size=(4, 4))) == 5
    with pytest.raises(mi_nerf.InputError, match="not found, expected a run folder or"):
        mi_nerf.render(tmp_path / "qqq")


def test_render_of_a_scene(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text(
        '<scene version="3.0.0"><integrator type="nerf"/><sensor type="perspective"><transform '
        'name="to_world"><lookat origin="0,-4,0" target="0,0,0" up="0,0,1"/></transform></sensor>'
        '<shape type="cube"><bsdf type="null"/><medium type="nerfmedium" name="interior">'
        '<string name="field" value="shell"/></medium></shape></scene>'
    )
    (image,) = mi_nerf.render(tmp_path / "scene.xml", size=(9, 7), spp=2)
    assert image.shape == (7, 9, 4) and image[3, 4, 3] > 0.5
    orbit = mi_nerf.render(tmp_path / "scene.xml", path="orbit", frames=2, size=(9, 7), spp=1)
    assert len(orbit) == 2


def test_generate(tmp_path: Path) -> None:
    options = {"train": 2, "val": 0, "test": 1, "size": (8, 6), "spp": 4, "show": False}
    record = mi_nerf.generate("spheres", tmp_path / "data", **options)
    assert record["complete"] and len(record["views"]) == 3
    assert record["noise"]["test"]["psnr_ceiling"] > 10
    assert mi_nerf.pictures(mi_nerf.load_dataset(tmp_path / "data", "test"))[0].shape == (6, 8, 3)
    by_path = mi_nerf.generate(mi_nerf.find_scene("spheres"), tmp_path / "again", **options)
    assert by_path["views"] == record["views"]
    with pytest.raises(mi_nerf.InputError, match="holds files already"):
        mi_nerf.generate("spheres", tmp_path / "data", **options)
    with pytest.raises(mi_nerf.InputError, match="scene 'spehres': unknown"):
        mi_nerf.generate("spehres", tmp_path / "other")


def test_describe(trained: mi_nerf.Run) -> None:
    text = mi_nerf.describe(trained.folder)
    assert "2x16" in text and str(trained.folder) in text
    assert mi_nerf.describe(str(trained.folder)) == text
    assert mi_nerf.__version__ in mi_nerf.describe()


# --------------------------------------------------------------------------
#   Notebooks
# --------------------------------------------------------------------------


def test_bars_are_drawn_in_notebooks(monkeypatch: pytest.MonkeyPatch) -> None:
    from types import SimpleNamespace

    from mi_nerf.base import progress_bar as bars

    shells = {"terminal": SimpleNamespace(), "kernel": SimpleNamespace(kernel=1), "none": None}
    for name, shell in shells.items():
        ipython = SimpleNamespace(get_ipython=lambda shell=shell: shell)
        monkeypatch.setitem(sys.modules, "IPython", ipython)
        assert bars.in_notebook() == (name == "kernel")
        monkeypatch.setattr(sys.stderr, "isatty", lambda: False, raising=False)
        assert bars.progress_bar("a", "b").disable == (name != "kernel")
        assert bars.progress_bar("a", "b", show=False).disable
    monkeypatch.delitem(sys.modules, "IPython")
    assert not bars.in_notebook()
