"""Whoever sets a variant puts the caller's back."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

import mi_nerf
from mi_nerf.base.variants import (
    active_variant,
    available_variants,
    choose_variant,
    unsuitable,
    using_variant,
)
from mi_nerf.tasks import render as rendering

OURS = choose_variant()

# A field-free scene with two sensors.
SCENE = """<scene version="3.0.0"><integrator type="direct"/><emitter type="constant"/>
<shape type="sphere"/><sensor type="perspective"/><sensor type="perspective"/></scene>"""


@pytest.fixture
def callers() -> Iterator[str]:
    """A variant that is none of mi_nerf's."""
    before = mi.variant()
    mi.set_variant("scalar_rgb")
    yield "scalar_rgb"
    mi.set_variant(before or OURS)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "scene.xml"
    path.write_text(SCENE)
    return path


def test_the_variant_is_put_back(callers: str) -> None:
    with using_variant(OURS):
        assert mi.variant() == OURS
        with using_variant(OURS):
            assert mi.variant() == OURS
        assert mi.variant() == OURS
    assert mi.variant() == callers
    with pytest.raises(ZeroDivisionError), using_variant(OURS):
        1 / 0  # noqa: B018
    assert mi.variant() == callers


def test_nothing_is_set_where_nothing_changes(
    callers: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    changes: list[str] = []
    monkeypatch.setattr(mi, "set_variant", changes.append)
    with using_variant(callers):
        pass
    assert changes == []


def test_without_a_variant_there_is_none_to_put_back(monkeypatch: pytest.MonkeyPatch) -> None:
    changes: list[str] = []
    monkeypatch.setattr(mi, "variant", lambda: changes[-1] if changes else None)
    monkeypatch.setattr(mi, "set_variant", changes.append)
    with using_variant(OURS):
        pass
    assert changes == [OURS]


@pytest.mark.slow
def test_functions_leave_the_variant_alone(
    callers: str, blob: Path, blob_run: Path, scene: Path, tmp_path: Path
) -> None:
    made = tmp_path / "made"
    mi_nerf.generate(scene, made, train=1, val=0, test=1, size=(4, 4), spp=2, show=False)
    assert mi.variant() == callers
    assert [image.shape for image in mi_nerf.render(scene, size=(4, 4), spp=1, show=False)] == [
        (4, 4, 4)
    ] * 2
    assert mi.variant() == callers
    mi_nerf.start(blob, tmp_path / "run", steps=1, settings={"network.width": 16}).train()
    mi_nerf.render(blob_run, frames=1, size=(4, 4), show=False)
    mi_nerf.evaluate(blob_run, views=1)
    mi_nerf.describe(blob_run)
    assert mi.variant() == callers


@pytest.mark.parametrize("end", ["exhausted", "closed", "never started", "dropped"])
def test_frames_keep_their_variant_until_they_end(callers: str, scene: Path, end: str) -> None:
    count, frames = rendering.scene_frames(scene, OURS, size=(4, 4), spp=1)
    assert count == 2 and mi.variant() == OURS
    if end != "never started":
        assert next(frames)[1].shape == (4, 4, 4)
        assert mi.variant() == OURS
    if end == "exhausted":
        assert len(list(frames)) == 1
    elif end == "dropped":
        del frames
    else:
        frames.close()
    assert mi.variant() == callers


def test_frames_and_scenes_that_fail(
    callers: str, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(rendering, "_rgba", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            mi_nerf.render(scene, size=(4, 4), spp=1, show=False)
    assert mi.variant() == callers
    scene.write_text(SCENE.replace("sphere", "speer"))
    with pytest.raises(mi_nerf.InputError, match="speer"):
        mi_nerf.render(scene, show=False)
    assert mi.variant() == callers
    with pytest.raises(mi_nerf.InputError, match="speer"):
        mi_nerf.generate(scene, scene.parent / "out", show=False)
    assert mi.variant() == callers


def test_an_interruption_between_two_frames(
    callers: str, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Interrupting(list):  # type: ignore[type-arg]
        def __call__(self, *_: object, **__: object) -> Interrupting:
            return self

        def __enter__(self) -> Interrupting:
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def update(self) -> None:
            raise KeyboardInterrupt

    monkeypatch.setattr("mi_nerf.api.progress_bar", Interrupting())
    with pytest.raises(KeyboardInterrupt):
        mi_nerf.render(scene, size=(4, 4), spp=1)
    assert mi.variant() == callers


# ---- Which are accepted ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("llvm_ad_rgb", None),
        ("llvm_ad_mono_polarized", None),
        ("cuda_ad_spectral", None),
        ("metal_ad_rgb", None),
        ("scalar_rgb", "has no derivatives"),
        ("llvm_rgb", "has no derivatives"),
        ("cuda_spectral_polarized", "has no derivatives"),
        ("llvm_ad_rgb_double", "double precision"),
        ("scalar_spectral_double", "double precision"),
    ],
)
def test_what_has_derivatives_in_single_precision_is_accepted(name: str, why: str | None) -> None:
    found = unsuitable(name)
    assert found is None if why is None else why in str(found)


def test_rgb_comes_first_and_what_has_been_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    installed = ["scalar_rgb", "metal_ad_rgb", "metal_ad_mono", "llvm_ad_rgb_double"]
    installed += ["llvm_ad_mono", "llvm_ad_rgb", "cuda_ad_mono", "cuda_ad_rgb", "new_ad_rgb"]
    monkeypatch.setattr(mi, "variants", lambda: installed)
    there = {"Metal", "LLVM"}
    monkeypatch.setattr("drjit.has_backend", lambda backend: backend.name in there)
    expected = ["llvm_ad_rgb", "metal_ad_rgb", "llvm_ad_mono", "metal_ad_mono"]
    assert available_variants() == expected
    there |= {"CUDA"}
    assert available_variants()[:3] == ["cuda_ad_rgb", "llvm_ad_rgb", "metal_ad_rgb"]
    there -= {"CUDA", "LLVM"}
    assert choose_variant() == "metal_ad_rgb"
    assert choose_variant("metal_ad_mono") == "metal_ad_mono"
    there.clear()
    with pytest.raises(mi_nerf.InputError, match="no usable backend"):
        choose_variant()


@pytest.mark.parametrize("name", ["llvm_ad_mono", "llvm_ad_spectral"])
def test_functions_keep_the_active_variant_whatever_its_colors(
    callers: str, name: str, scene: Path, tmp_path: Path
) -> None:
    """Pictures of a scene are those of the variant; a dataset needs colours."""
    with using_variant(name):
        assert active_variant() == name
        image = next(iter(mi_nerf.render(scene, size=(4, 4), spp=64, show=False)))
        assert image.shape == (4, 4, 4) and np.isfinite(image).all()
        assert mi.variant() == name
        if name.endswith("mono"):
            assert (image[..., 0] == image[..., 1]).all()
            with pytest.raises(mi_nerf.InputError, match="'llvm_ad_mono': knows no colours"):
                mi_nerf.generate(scene, tmp_path / "made", show=False)
            assert not (tmp_path / "made").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["llvm_ad_mono", "llvm_ad_spectral"])
def test_training_and_measuring_are_the_same_in_any_colors(
    callers: str, name: str, blob: Path, tmp_path: Path
) -> None:
    """They know nothing of Mitsuba's colours: Dr.Jit's arrays are those of the backend."""
    found = {}
    for variant in ("llvm_ad_rgb", name):
        with using_variant(variant):
            run = mi_nerf.start(blob, tmp_path / variant, steps=5, settings={"network.width": 16})
            run.train()
            assert run.variant == variant == mi.variant()
            found[variant] = mi_nerf.evaluate(run, views=1)["mean"]["psnr"]
    assert found[name] == pytest.approx(found["llvm_ad_rgb"], abs=1e-3)
