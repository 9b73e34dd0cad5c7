"""The walk within one kernel sees what the flattened path sees, sample by sample."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mi_nerf.base.arrays import upload
from mi_nerf.base.box import Corner
from mi_nerf.cameras.ndc import Ndc
from mi_nerf.fields.fourier import FourierEncoding
from mi_nerf.fields.hash_grid import HashGridConfig
from mi_nerf.fields.network import NetworkConfig
from mi_nerf.fields.neural import NeuralField, NeuralFieldConfig
from mi_nerf.march import render
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.occupancy import OccupancyGrid
from mi_nerf.march.placing import place_samples
from mi_nerf.march.quadrature import integrate
from mi_nerf.march.query import Evaluation
from mi_nerf.march.render import render_rays
from mi_nerf.march.settings import MarchSettings
from mi_nerf.march.walk import Walked, can_walk, walk_rays
from tests.support.analytic import AnalyticField
from tests.support.arrays import unit, vectors

BOX: tuple[Corner, Corner] = ((-1.0, -0.5, -2.0), (1.0, 1.5, 0.25))
NARROW = NeuralFieldConfig(
    *BOX,
    position=FourierEncoding(frequencies=1),
    grid=HashGridConfig(levels=3, features=2, log2_entries=8, coarsest=4, finest=16),
    direction=FourierEncoding(frequencies=1),
    network=NetworkConfig(depth=2, width=16, skip=1, view_width=8),
    density_scale=3.0,
)


class PlainField(AnalyticField):
    """A formula that may be asked within a kernel."""

    def fused(self, emission: bool = True) -> Callable[..., Any] | None:
        if not emission:
            return self._density
        color = self._emission
        assert color is not None
        return lambda p, d: (self._density(p), color(p, d))


def waves(scale: float, *box: Corner, ndc: Ndc | None = None) -> PlainField:
    """Density and colour that vary along every ray."""
    return PlainField(
        lambda p: scale * (1.1 + dr.sin(5 * p.x) * dr.cos(3 * p.z + p.y)),
        lambda p, d: [0.5 + 0.25 * dr.sin(p.y), dr.abs(d.z), 0.1 + dr.square(dr.cos(p.x))],
        *(box or BOX),
        ndc=ndc,
    )


def rays_around(count: int, seed: int, far: float = 4.0) -> tuple[np.ndarray, np.ndarray]:
    """Origins around the box or within it, and directions, some along an axis."""
    rng = np.random.default_rng(seed)
    o = far * unit(rng.normal(size=(count, 3)))
    o[::5] = rng.uniform(BOX[0], BOX[1], o[::5].shape)
    d = rng.uniform(*BOX, (count, 3)) - o
    axis = rng.integers(0, 3, count)
    for i in range(0, count, 4):  # along an axis, towards the box, in either direction
        straight = np.where(rng.random(3) < 0.5, 0.0, -0.0)
        straight[axis[i]] = np.sign(d[i, axis[i]]) or 1.0
        others = [k for k in range(3) if k != axis[i]]
        o[i, others] = rng.uniform(np.array(BOX[0]), np.array(BOX[1]))[others]
        d[i] = straight
    return o.astype(np.float32), unit(d).astype(np.float32)


def flattened(
    marched: MarchedField, o: Any, d: Any, jitter: Any = None
) -> tuple[np.ndarray, np.ndarray]:
    """Colour, opacity and depth (5, R), and queries of each ray, by the other path."""
    samples = place_samples(marched, o, d, jitter=jitter)
    evaluation = Evaluation(marched.field, samples, 1024)
    seen = integrate(evaluation, samples)
    asked = np.bincount(np.array(samples.index) // samples.count, minlength=samples.rays)
    return image(seen), asked


def image(seen: Any) -> np.ndarray:
    return np.array([np.array(v) for v in (*seen.color, seen.opacity, seen.depth)])


def random_grid(ad: Any, shape: tuple[int, ...], share: float, seed: int) -> OccupancyGrid:
    rng = np.random.default_rng(seed)
    return OccupancyGrid(*BOX, rng.random(shape) < share, ad.Float)


def agree(marched: MarchedField, o: Any, d: Any, jitter: Any = None) -> Walked:
    """Asserts that both paths ask the same samples and see the same."""
    assert can_walk(marched)
    expected, asked = flattened(marched, o, d, jitter)
    walked = walk_rays(marched, o, d, jitter=jitter)
    assert np.array_equal(np.array(walked.queries), asked)
    size = 1 + np.abs(expected[4]).max()
    np.testing.assert_allclose(image(walked)[:4], expected[:4], atol=1e-5)
    visible = expected[3] > 1e-4
    np.testing.assert_allclose(image(walked)[4, visible], expected[4, visible], atol=1e-5 * size)
    return walked


# ---- The same samples -------------------------------------------------------


@pytest.mark.parametrize("share", [0.0, 0.003, 0.05, 0.5, 1.0])
def test_no_occupied_sample_is_missed(ad: Any, share: float) -> None:
    o, d = (vectors(ad, v) for v in rays_around(300, 1))
    grid = random_grid(ad, (17, 9, 33), share, 2)
    march = MarchSettings(samples=100)
    walked = agree(MarchedField(waves(0.4), march, grid), o, d)
    assert bool(dr.any(walked.queries > 0)) == (share > 0)


@settings(max_examples=25, deadline=None)
@given(
    st.tuples(*[st.integers(1, 40)] * 3),
    st.sampled_from([1e-3, 0.02, 0.3, 0.9]),
    st.sampled_from([1, 2, 7, 64, 300]),
    st.sampled_from([0.5, 4.0, 300.0, 1e5]),
    st.integers(0, 2**16),
)
@pytest.mark.slow
def test_random_grids_and_rays(
    shape: tuple[int, int, int], share: float, samples: int, far: float, seed: int
) -> None:
    """Also from so far away that positions in the box are rounded to a cell and more."""
    import drjit.llvm.ad as ad

    o, d = (vectors(ad, v) for v in rays_around(64, seed, far))
    grid = random_grid(ad, shape, share, seed)
    jitter = upload(ad.Float, np.random.default_rng(seed).random(64, np.float32))
    agree(MarchedField(waves(0.4), MarchSettings(samples=samples), grid), o, d, jitter)


def test_without_a_grid_every_sample_counts(ad: Any) -> None:
    o, d = (vectors(ad, v) for v in rays_around(50, 3))
    walked = agree(MarchedField(waves(0.4), MarchSettings(samples=16)), o, d)
    assert set(np.array(walked.queries)) <= {0, 16}


def test_between_bounds(ad: Any) -> None:
    o, d = (vectors(ad, v) for v in rays_around(80, 4))
    grid = random_grid(ad, (8, 8, 8), 0.3, 5)
    agree(MarchedField(waves(0.4), MarchSettings(samples=40, near=2.5, far=4.5), grid), o, d)


def test_in_normalised_device_coordinates(ad: Any) -> None:
    box = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    field = waves(0.4, *box, ndc=Ndc(near=1.0, scale_x=1.0, scale_y=1.0))
    rng = np.random.default_rng(6)
    target = np.stack([*rng.uniform(-1, 1, (2, 60)), -np.ones(60)], axis=1)
    o, d = vectors(ad, np.zeros((60, 3))), vectors(ad, unit(target))
    walked = agree(MarchedField(field, MarchSettings(samples=30)), o, d)
    assert dr.all(walked.queries > 0)


def test_one_origin_for_all_rays(ad: Any) -> None:
    o, d = rays_around(40, 7)
    marched = MarchedField(waves(0.4), MarchSettings(samples=20), random_grid(ad, (8,) * 3, 0.3, 8))
    shared = walk_rays(marched, vectors(ad, o[1:2]), vectors(ad, d))
    repeated = walk_rays(marched, vectors(ad, np.repeat(o[1:2], 40, 0)), vectors(ad, d))
    assert np.array_equal(image(shared), image(repeated)) and image(shared)[3].any()


# ---- Ends of rays -----------------------------------------------------------


def test_a_ray_ends_at_its_transmittance(ad: Any) -> None:
    """Behind the first sample where less than ``stop`` passes, nothing is asked."""
    o, d = (vectors(ad, v) for v in rays_around(100, 9))
    march, stop = MarchSettings(samples=64), 0.02
    marched = MarchedField(waves(5.0), march, random_grid(ad, (8, 8, 8), 0.5, 10))
    samples = place_samples(marched, o, d)
    tau = np.array(Evaluation(marched.field, samples, 1024).density) * np.array(samples.delta)
    tau, wanted = tau.reshape(-1, 64), np.zeros(6400, bool)
    wanted[np.array(samples.index)] = True
    before = np.cumsum(tau, axis=1) - tau
    expected = (wanted.reshape(-1, 64) & (before < -np.log(stop))).sum(axis=1)
    whole = walk_rays(marched, o, d)
    ended = walk_rays(replace(marched, settings=replace(march, stop=stop)), o, d)
    assert np.array_equal(np.array(ended.queries), expected)
    lost = image(whole) - image(ended)
    assert (np.abs(lost[:4]) <= 1.1 * stop).all() and lost[3].max() > 1e-4
    assert int(dr.sum(ended.queries)[0]) < int(dr.sum(whole.queries)[0])


def test_density_alone(ad: Any) -> None:
    o, d = (vectors(ad, v) for v in rays_around(60, 11))
    marched = MarchedField(waves(2.0), MarchSettings(samples=30), random_grid(ad, (9,) * 3, 0.4, 1))
    both, alone = walk_rays(marched, o, d), walk_rays(marched, o, d, emission=False)
    assert alone.color == []
    for name in ("optical_depth", "opacity", "queries"):
        assert np.array(getattr(alone, name)) == pytest.approx(np.array(getattr(both, name)))


# ---- Networks ---------------------------------------------------------------


def scene_of_network(config: NeuralFieldConfig, view_dependent: bool) -> tuple[Any, Any, Any]:
    """A network in a grid, and 200 rays: their origins and directions."""
    import drjit.llvm.ad as ad

    config = replace(config, network=replace(config.network, view_dependent=view_dependent))
    field = NeuralField.create(config, 5, ad.TensorXf)
    o, d = (vectors(ad, v) for v in rays_around(200, 12))
    grid = random_grid(ad, (12, 12, 12), 0.2, 13)
    return MarchedField(field, MarchSettings(samples=50), grid), o, d


@pytest.mark.slow
@pytest.mark.parametrize("view_dependent", [True, False])
def test_narrow_networks(view_dependent: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    marched, o, d = scene_of_network(NARROW, view_dependent)
    agree(marched, o, d)
    fast = render_rays(marched, o, d)
    monkeypatch.setattr(render, "can_walk", lambda _: False)
    slow = render_rays(marched, o, d)
    assert fast.queries == slow.queries > 0
    np.testing.assert_allclose(image(fast), image(slow), atol=1e-5)


def kernels_of_a_second_frame(config: NeuralFieldConfig, rays: int) -> list[dict[str, Any]]:
    """Of 321 rays through a field with other weights and another grid, after so many rays."""
    import drjit.llvm.ad as ad

    def frame(rays: int, seed: int) -> list[dict[str, Any]]:
        field = NeuralField.create(config, seed, ad.TensorXf)
        grid = random_grid(ad, (12, 12, 12), 0.2, seed)
        o, d = (vectors(ad, v) for v in rays_around(rays, seed))
        marched = MarchedField(field, MarchSettings(samples=50, stop=1e-3), grid)
        grid.bits()
        dr.eval(o, d)
        dr.sync_thread()
        dr.kernel_history_clear()
        render_rays(marched, o, d)
        dr.sync_thread()
        return list(dr.kernel_history([dr.KernelType.JIT]))

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        frame(rays, 1)
        return frame(321, 2)


def test_a_second_frame_compiles_nothing() -> None:
    """With other weights, another grid, and another number of rays; it is one large kernel."""
    history = kernels_of_a_second_frame(NARROW, 100)
    assert not [entry for entry in history if entry["cache_hit"] == 0]
    assert sum(entry["size"] >= 321 for entry in history) <= 3  # bounds, the march, the depth


def test_what_cannot_be_walked() -> None:
    import drjit.llvm.ad as ad

    field, march = NeuralField.create(NARROW, 0, ad.TensorXf), MarchSettings()
    assert can_walk(MarchedField(field, march))
    for change in ({"rule": "linear"}, {"rule": "cells"}, {"hidden": 9.0}):
        assert not can_walk(MarchedField(field, replace(march, **change)))
    wide = replace(NARROW, network=replace(NARROW.network, width=65))
    assert can_walk(MarchedField(NeuralField.create(wide, 0, ad.TensorXf), march))
    assert not can_walk(MarchedField(AnalyticField(lambda p: p.x), march))
    coarse = NeuralField.create(NARROW, 0, ad.TensorXf, field)
    assert can_walk(MarchedField(coarse, march))
    assert not can_walk(MarchedField(coarse, replace(march, fine=8)))
