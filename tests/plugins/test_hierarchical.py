"""Fields with a coarse and a fine network in Mitsuba: as mi_nerf's own evaluation shows them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mi_nerf
from mi_nerf.base.color import srgb_to_linear
from mi_nerf.fields.network import initial_weights
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.render import render_rays
from tests.support.composed import GLOW, camera_rays, nerf, place, slab
from tests.support.fields import scene_dict, small_file

pytestmark = pytest.mark.usefixtures("variant")

SAMPLES, FINE = 24, 16


@pytest.fixture
def pair(tmp_path: Path) -> Path:
    """A field of two networks whose file asks for no fine samples."""
    contents = mi_nerf.load_field(small_file(tmp_path, samples=SAMPLES))
    coarse = initial_weights(contents.config.shapes(), 5)
    path = tmp_path / "pair.safetensors"
    mi_nerf.save_field(path, replace(contents, coarse=coarse))
    return path


def shown(file: Path, **options: Any) -> np.ndarray:
    """R, G, B and opacity of all camera rays, one a pixel, through ``mi.render``."""
    scene = mi.load_dict(scene_dict(file, spp=1, integrator={"jitter": False, **options}))
    return np.array(mi.render(scene), np.float64).reshape(-1, 4)


def evaluated(file: Path, fine: int, coarse: bool = False) -> np.ndarray:
    """The same rays by :func:`render_rays`, in linear radiance."""
    scene = mi.load_dict(scene_dict(file, spp=1))
    o, d = (v.T.astype(np.float32) for v in camera_rays(scene))
    field, grid = mi_nerf.load_field(file).build(mi)
    march = replace(mi_nerf.load_field(file).march, fine=fine)
    marched = MarchedField(field.coarse if coarse else field, march, grid)
    seen = render_rays(marched, mi.Point3f(o), mi.Vector3f(d))
    color, opacity = np.array(seen.color, np.float64).T, np.array(seen.opacity, np.float64)[:, None]
    straight = color / np.where(opacity > 0, opacity, 1)
    return np.concatenate([srgb_to_linear(straight) * opacity, opacity], axis=1)


def test_fine_samples_are_those_of_evaluation(pair: Path) -> None:
    images = {fine: shown(pair, fine=fine) for fine in (0, FINE)}
    for fine, image in images.items():
        np.testing.assert_allclose(image, evaluated(pair, fine), atol=3e-6)
    np.testing.assert_array_equal(shown(pair), images[0])  # what the file says
    assert np.abs(images[0] - images[FINE]).max() > 1e-3


def test_the_file_may_be_overruled(pair: Path, tmp_path: Path) -> None:
    contents = mi_nerf.load_field(pair)
    path = tmp_path / "fine.safetensors"
    mi_nerf.save_field(path, replace(contents, march=replace(contents.march, fine=FINE)))
    np.testing.assert_allclose(shown(path), evaluated(pair, FINE), atol=3e-6)
    np.testing.assert_array_equal(shown(path, fine=0), shown(pair))


def test_the_coarse_network_is_shown_on_its_own(pair: Path) -> None:
    image = shown(pair, network="coarse", fine=FINE)
    np.testing.assert_allclose(image, evaluated(pair, 0, coarse=True), atol=3e-6)
    assert np.abs(image - shown(pair)).max() > 0.05


@pytest.mark.parametrize("network", ["coarse", "fine"])
def test_both_networks_are_parameters(pair: Path, network: str) -> None:
    """Either picture has derivatives by its own network, as finite differences have them."""
    integrator = {"network": network, "fine": FINE, "jitter": False, "stop": 0.0}
    scene = mi.load_dict(scene_dict(pair, spp=1, integrator=integrator))
    params = mi.traverse(scene)
    keys = [f"box.interior_medium.{prefix}color_bias" for prefix in ("", "coarse_")]
    start = [params[key] + 0 for key in keys]

    def total(x: float, **seeds: int) -> Any:
        for key, value in zip(keys, start, strict=True):
            params[key] = value + x
            dr.enable_grad(params[key])
        params.update()
        return dr.sum(mi.render(scene, params, **seeds), axis=None)

    dr.backward(total(0.0, seed=1, seed_grad=3))
    found = [float(np.sum(np.array(dr.grad(params[key])))) for key in keys]
    step = 1e-2
    expected = float((total(step, seed=3) - total(-step, seed=3)).array[0]) / (2 * step)
    own = found[1] if network == "coarse" else found[0]
    assert own == pytest.approx(expected, rel=2e-3) and abs(own) > 1
    # The fine picture follows the coarse network by where its samples are, not differentiably.
    assert found[0 if network == "coarse" else 1] == 0


def test_a_change_of_the_coarse_network_moves_the_samples(pair: Path) -> None:
    scene = mi.load_dict(scene_dict(pair, spp=1, integrator={"fine": FINE, "jitter": False}))
    before = np.array(mi.render(scene))
    params = mi.traverse(scene)
    key = "box.interior_medium.coarse_density_bias"
    params[key] = params[key] - 50.0  # nothing there: samples anywhere
    params.update()
    after = np.array(mi.render(scene))
    assert 1e-4 < np.abs(after - before).max() < 0.2


def test_a_coarse_network_that_is_not_finite_is_refused(pair: Path) -> None:
    """It only places samples, but NaN leaves none."""
    scene = mi.load_dict(scene_dict(pair, spp=1, integrator={"fine": FINE}))
    params, key = mi.traverse(scene), "box.interior_medium.coarse_density_bias"
    good = np.array(params[key])
    mi.render(scene)
    params[key] = mi.TensorXf(np.full_like(good, np.nan))
    params.update()
    with pytest.raises(RuntimeError) as caught:
        mi.render(scene)
    assert "coarse_density_bias: NaN or infinite" in str(caught.value.__cause__ or caught.value)
    params[key] = mi.TensorXf(good)
    params.update()
    assert np.isfinite(np.array(mi.render(scene))).all()


def test_what_is_refused(pair: Path, tmp_path: Path) -> None:
    alone = {"type": "scene", "sensor": {"type": "perspective"}, "box": slab(place(), 1.0, GLOW)}
    for options, message in (
        ({"fine": -1}, "nerf: fine=-1, expected 0 or more"),
        ({"network": "both"}, "nerf: network='both', expected fine or coarse"),
        ({"fine": 8}, "nerf: fine=8, expected a field with a coarse network"),
        ({"network": "coarse"}, "network=coarse, expected a field with a coarse network in 'box'"),
    ):
        with pytest.raises(RuntimeError) as failure:
            mi.render(mi.load_dict(alone | {"integrator": nerf(None, **options)}))
        assert message in f"{failure.value} {failure.value.__cause__}"
