"""Marching in waves sees what the flattened path sees, and ends rays where a plain loop does."""

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
from mi_nerf.fields.network import NetworkConfig
from mi_nerf.fields.neural import NeuralField
from mi_nerf.march import render
from mi_nerf.march import waves as module
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.placing import place_samples
from mi_nerf.march.render import render_rays
from mi_nerf.march.settings import MarchSettings
from mi_nerf.march.walk import walk_rays
from tests.march.test_walk import (
    BOX,
    NARROW,
    agree,
    image,
    kernels_of_a_second_frame,
    random_grid,
    rays_around,
    scene_of_network,
)
from tests.support.analytic import AnalyticField
from tests.support.arrays import unit, vectors

WIDE = replace(NARROW, network=replace(NARROW.network, width=80))


class AtOnceField(AnalyticField):
    """A formula that is best asked about many points at once."""

    def at_once(self, emission: bool = True) -> Callable[..., Any] | None:
        def answers(p: Any, d: Any) -> list[Any]:
            self.blocks.append(len(p[0]))
            color = self._emission
            assert color is not None
            found = [self._density(p), *(color(p, d) if emission else [])]
            dr.eval(found)
            return found

        return answers


def waves(scale: float, *box: Corner, ndc: Ndc | None = None) -> AtOnceField:
    """Density and colour that vary along every ray."""
    return AtOnceField(
        lambda p: scale * (1.1 + dr.sin(5 * p.x) * dr.cos(3 * p.z + p.y)),
        lambda p, d: [0.5 + 0.25 * dr.sin(p.y), 0.5 + 0.5 * d.z + 0 * p.x, dr.square(dr.cos(p.x))],
        *(box or BOX),
        ndc=ndc,
    )


def waves_at(scale: float, p: np.ndarray, d: np.ndarray) -> np.ndarray:
    """The same in double precision: density and colours, (4, N)."""
    x, y, z = p.T
    density = scale * (1.1 + np.sin(5 * x) * np.cos(3 * z + y))
    return np.array([density, 0.5 + 0.25 * np.sin(y), 0.5 + 0.5 * d[:, 2], np.cos(x) ** 2])


@pytest.fixture(params=[(1 << 16, 1 << 12), (37, 1)], ids=["one wave", "many waves"])
def sizes(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also waves of so few rays and samples that rays join and leave all the time."""
    rays, queries = request.param
    monkeypatch.setattr(module, "_RAYS", rays)
    monkeypatch.setattr(module, "_LEAST_QUERIES", queries)


# ---- The same samples -------------------------------------------------------


@pytest.mark.usefixtures("sizes")
@pytest.mark.parametrize("share", [0.0, 0.05, 1.0])
def test_no_occupied_sample_is_missed(ad: Any, share: float) -> None:
    o, d = (vectors(ad, v) for v in rays_around(300, 1))
    grid = random_grid(ad, (17, 9, 33), share, 2)
    walked = agree(MarchedField(waves(0.4), MarchSettings(samples=100), grid), o, d)
    assert bool(dr.any(walked.queries > 0)) == (share > 0)


@settings(max_examples=25, deadline=None)
@given(
    st.tuples(*[st.integers(1, 40)] * 3),
    st.sampled_from([1e-3, 0.3, 0.9]),
    st.sampled_from([1, 2, 7, 64, 300]),
    st.sampled_from([(3, 1), (64, 500), (1 << 16, 1 << 12)]),
    st.integers(0, 2**16),
)
@pytest.mark.slow
def test_random_grids_rays_and_waves(
    shape: tuple[int, int, int], share: float, samples: int, sizes: tuple[int, int], seed: int
) -> None:
    import drjit.llvm.ad as ad

    o, d = (vectors(ad, v) for v in rays_around(40, seed))
    grid = random_grid(ad, shape, share, seed)
    jitter = upload(ad.Float, np.random.default_rng(seed).random(40, np.float32))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_RAYS", sizes[0])
        patch.setattr(module, "_LEAST_QUERIES", sizes[1])
        agree(MarchedField(waves(0.4), MarchSettings(samples=samples), grid), o, d, jitter)


@pytest.mark.usefixtures("sizes")
def test_between_bounds_and_without_a_grid(ad: Any) -> None:
    o, d = (vectors(ad, v) for v in rays_around(80, 4))
    agree(MarchedField(waves(0.4), MarchSettings(samples=40, near=2.5, far=4.5)), o, d)


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


@pytest.mark.usefixtures("sizes")
@pytest.mark.parametrize("stop", [0.0, 1e-3, 0.02])
def test_sees_what_a_plain_loop_in_double_precision_sees(ad: Any, stop: float) -> None:
    """Up to the first sample behind which less than ``stop`` passes, and not one more."""
    rays, count = rays_around(60, 9), 64
    march = MarchSettings(samples=count, stop=stop)
    marched = MarchedField(waves(5.0), march, random_grid(ad, (8, 8, 8), 0.5, 10))
    o, d = (vectors(ad, v) for v in rays)
    samples = place_samples(marched, o, d)
    t, delta = (np.array(v).reshape(-1, count).astype(float) for v in (samples.t, samples.delta))
    wanted = np.zeros(60 * count, bool)
    wanted[np.array(samples.index)] = True
    expected, needed = np.zeros((5, 60)), np.zeros(60, int)
    for r, (origin, direction) in enumerate(zip(*rays, strict=True)):
        transmittance = 1.0
        for s in np.flatnonzero(wanted.reshape(-1, count)[r]):
            if transmittance < stop:
                break
            p = origin.astype(float) + t[r, s] * direction
            density, *color = waves_at(5.0, p[None], direction[None])[:, 0]
            weight = transmittance * -np.expm1(-density * delta[r, s])
            expected[:, r] += weight * np.array([*color, 1, t[r, s]])
            transmittance -= weight
            needed[r] += 1
    expected[4] /= np.where(expected[3] > 0, expected[3], 1)
    walked = walk_rays(marched, o, d)
    np.testing.assert_allclose(image(walked), expected, atol=3e-5)
    vain = np.array(walked.queries).astype(int) - needed
    assert (vain >= 0).all() and (vain < module._MOST_SAMPLES).all()
    assert vain.any() == (stop > 0)


def test_rays_that_have_ended_are_not_asked_about(ad: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Opaque at once: two samples of each ray, however many rays there are."""
    monkeypatch.setattr(module, "_LEAST_QUERIES", 1)
    field, (o, d) = waves(1e4), (vectors(ad, v) for v in rays_around(100, 2))
    walked = walk_rays(MarchedField(field, MarchSettings(samples=64, stop=1e-3)), o, d)
    hit = int(dr.count(walked.opacity > 0)[0])
    assert field.blocks == [2 * hit] and 0 < hit


def test_density_alone(ad: Any) -> None:
    o, d = (vectors(ad, v) for v in rays_around(60, 11))
    marched = MarchedField(waves(2.0), MarchSettings(samples=30), random_grid(ad, (9,) * 3, 0.4, 1))
    both, alone = walk_rays(marched, o, d), walk_rays(marched, o, d, emission=False)
    assert alone.color == []
    for name in ("optical_depth", "opacity", "queries"):
        assert np.array_equal(np.array(getattr(alone, name)), np.array(getattr(both, name)))


def test_no_rays_and_none_that_hit(ad: Any) -> None:
    marched = MarchedField(waves(2.0), MarchSettings(samples=30))
    none = dr.zeros(ad.Array3f, 0)
    assert image(render_rays(marched, none, none)).shape == (5, 0)
    o, d = vectors(ad, [(9, 9, 9)] * 3), vectors(ad, [(1, 0, 0)] * 3)
    seen = render_rays(marched, o, d)
    assert image(seen).shape == (5, 3) and not image(seen).any() and seen.queries == 0


# ---- Networks ---------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("view_dependent", [True, False])
def test_wide_networks(view_dependent: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """As by the flattened path with Dr.Jit's own matrix products."""
    marched, o, d = scene_of_network(WIDE, view_dependent)
    fast = render_rays(marched, o, d)
    monkeypatch.setattr(NeuralField, "_multiplies_on_host", lambda *_: False)
    monkeypatch.setattr(render, "can_walk", lambda _: False)
    slow = render_rays(marched, o, d)
    assert fast.queries == slow.queries > 0
    np.testing.assert_allclose(image(fast), image(slow), atol=1e-5)


def test_a_second_frame_compiles_nothing() -> None:
    """With other weights, another grid, and another number of rays and samples."""
    history = kernels_of_a_second_frame(WIDE, 200)
    assert not [entry for entry in history if entry["cache_hit"] == 0]


def test_which_networks_are_asked_at_once() -> None:
    import drjit.llvm.ad as ad

    wide, narrow = (NeuralField.create(c, 0, ad.TensorXf) for c in (WIDE, NARROW))
    assert wide.fused() is None and narrow.fused() is not None
    assert wide.at_once() is not None and narrow.at_once() is None
    published = replace(NARROW, network=NetworkConfig())
    assert NeuralField.create(published, 0, ad.TensorXf).at_once() is not None
