"""Pictures of several passes: how the samples of a pixel are spread over them."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.plugins.test_nerf_path import floor, overhead, paths
from tests.support.composed import SIZE, nerf, render, scene_of

pytestmark = pytest.mark.usefixtures("variant")

PIXELS = SIZE[0] * SIZE[1]


def scene_with(sampler: str, integrator: dict[str, Any], spp: int) -> Any:
    scene = scene_of(integrator, spp=spp, floor=floor(), lamp=overhead((9, 8, 7)))
    scene["sensor"]["sampler"] = {"type": sampler, "sample_count": spp}
    scene["sensor"]["film"]["rfilter"] = {"type": "gaussian"}  # a box would put all in the middle
    return mi.load_dict(scene)


def positions(sampler: str, spp: int, at_a_time: int) -> list[np.ndarray]:
    """Where on the film the samples of each pass are, (H·W, K, 2) with pixel corners taken off."""
    scene = scene_with(sampler, nerf("path"), spp)
    integrator, sensor = scene.integrator(), scene.sensors()[0]
    found = []
    for camera in integrator._passes(scene, sensor, 3, spp, at_a_time * PIXELS):
        position = np.array(camera.position).T.reshape(PIXELS, -1, 2)
        found.append(position - np.floor(position))
    return found


@pytest.mark.parametrize("sampler", ["stratified", "multijitter", "orthogonal", "ldsampler"])
@pytest.mark.parametrize("at_a_time", [32, 6, 1])
def test_samples_are_spread_over_all_passes(sampler: str, at_a_time: int) -> None:
    """Every column and row of an n × n grid in a pixel has n of n², and mostly each cell one."""
    count, side = (25, 5) if sampler == "orthogonal" else (16, 4)
    passes = positions(sampler, count, at_a_time)
    size = {32: count, 6: 5 if side == 5 else 4, 1: 1}[at_a_time]
    assert [p.shape[1] for p in passes] == [size] * (count // size)
    cells = (np.concatenate(passes, axis=1) * side).astype(int)
    for axis in range(2):
        counts = np.stack([(cells[..., axis] == i).sum(axis=1) for i in range(side)])
        assert (counts == side).mean() > 0.999  # but for rounding
    if sampler in ("stratified", "multijitter"):
        both = np.sort(cells[..., 0] * side + cells[..., 1], axis=1)
        assert (both == np.arange(count)).mean() > 0.99


def test_passes_compile_nothing_after_the_second() -> None:
    """Whatever their number: a large picture has many."""
    scene = scene_with("multijitter", paths(), 16)
    integrator, sensor = scene.integrator(), scene.sensors()[0]
    known: set[Any] = set()
    new = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for _ in integrator._passes(scene, sensor, 3, 16, 2 * PIXELS):
            kernels = {k["hash"] for k in dr.kernel_history() if k.get("hash")}
            dr.kernel_history_clear()
            new.append(len(kernels - known))
            known |= kernels
    assert new[0] > 0 and new[2:] == [0] * 6


def test_passes_of_independent_samples_have_seeds_of_their_own() -> None:
    passes = positions("independent", 5, 2)
    assert [p.shape[1] for p in passes] == [2, 2, 1]
    flat = [p[:, 0].ravel() for p in passes]
    assert all(abs(np.corrcoef(a, b)[0, 1]) < 0.2 for a, b in zip(flat, flat[1:], strict=False))


@pytest.mark.slow
def test_spread_samples_are_less_noisy_in_passes_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in one pass; and the mean is that of independent ones."""
    from mi_nerf.plugins.nerf_path import NerfPathIntegrator

    means, noise = {}, {}
    for sampler, at_a_time in (("independent", 2), ("multijitter", 16), ("multijitter", 2)):
        monkeypatch.setattr(NerfPathIntegrator, "rays_per_pass", at_a_time * PIXELS)
        scene = scene_with(sampler, paths(max_depth=2), 16)
        images = np.array([render(scene, seed=i)[..., :3] for i in range(24)])
        means[sampler, at_a_time] = images.mean()
        noise[sampler, at_a_time] = images.var(axis=0, ddof=1).mean()
    assert noise["multijitter", 2] < 0.6 * noise["independent", 2]
    assert noise["multijitter", 2] < 1.3 * noise["multijitter", 16]
    assert means["multijitter", 2] == pytest.approx(means["independent", 2], rel=1e-2)
