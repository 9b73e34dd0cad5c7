"""What a GPU changes of a configuration; none is needed to know."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import pytest
from drjit import nn

from mi_nerf.base import variants
from mi_nerf.base.errors import InputError
from mi_nerf.training import device
from mi_nerf.training.config import HALF_BLOCK, with_settings
from mi_nerf.training.device import for_device
from mi_nerf.training.presets import PRESETS, preset
from mi_nerf.training.scaling import usual_batch

CUDA = "cuda_ad_rgb"


@pytest.mark.parametrize("name", PRESETS)
def test_a_cpu_changes_nothing(name: str) -> None:
    assert for_device(preset(name), "llvm_ad_rgb") is not None
    assert for_device(preset(name), "llvm_ad_rgb") == preset(name)


@pytest.mark.parametrize("name", PRESETS)
def test_steps_are_larger_on_a_gpu(name: str) -> None:
    usual, found = preset(name).sampling, for_device(preset(name), CUDA).sampling
    batch = usual.batch or usual_batch(preset(name).grid is not None)
    assert found.batch == batch * (1 if usual.rays else 16)
    assert found.block >= min(found.batch, 1 << 18) and found.max_rays == 4 * usual.max_rays
    assert replace(found, batch=usual.batch, block=usual.block, max_rays=usual.max_rays) == (usual)
    assert replace(for_device(preset(name), CUDA), sampling=usual) == preset(name)


def test_what_was_chosen_stays() -> None:
    config = with_settings(preset("fast"), ["sampling.batch=5000", "sampling.max_rays=16384"])
    found = for_device(config, CUDA, ["sampling.max_rays"]).sampling
    assert (found.batch, found.max_rays, found.block) == (5000, 16384, 1 << 18)


def test_half_precision_keeps_small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "has_cooperative_vectors", lambda variant: True)
    config = replace(preset("fast"), half_precision=True)
    found = for_device(config, CUDA).sampling
    assert (found.batch, found.block) == (16 * usual_batch(features=True), HALF_BLOCK)


def test_half_precision_needs_the_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "has_cooperative_vectors", lambda variant: False)
    with pytest.raises(InputError, match="half_precision=true'?: not on this device, expected an"):
        for_device(replace(preset("fast"), half_precision=True), CUDA)


def test_half_precision_refuses_large_blocks() -> None:
    settings = ["half_precision=true", "sampling.block=65536", "sampling.batch=65536"]
    with pytest.raises(InputError, match="half_precision=true with block=65536, expected 16384 at"):
        with_settings(preset("fast"), settings)


def test_cooperative_vectors_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """By packing one: Dr.Jit refuses that where driver or OptiX do not know them."""
    import drjit.llvm.ad as arrays

    assert not variants.has_cooperative_vectors("llvm_ad_rgb")
    monkeypatch.setattr(variants, "available_variants", lambda: [CUDA])
    monkeypatch.setattr(variants, "array_module", lambda variant: arrays)
    assert variants.has_cooperative_vectors(CUDA)

    def refuse(*_: object) -> None:
        raise RuntimeError("jit_coop_vec_pack(): ... requires CUDA 12.8 or newer")

    monkeypatch.setattr(nn, "CoopVec", refuse)
    assert not variants.has_cooperative_vectors(CUDA)


@pytest.mark.cuda
@pytest.mark.skipif(not dr.has_backend(dr.JitBackend.CUDA), reason="no GPU")
def test_the_answer_holds_on_this_device() -> None:
    from importlib import import_module

    half = import_module("drjit.cuda.ad").Float16
    if variants.has_cooperative_vectors(CUDA):
        assert [float(x[0]) for x in nn.CoopVec(half(1), half(2))] == [1, 2]
    else:
        with pytest.raises(RuntimeError):
            nn.CoopVec(half(1), half(2))
