"""The same scenes in every variant: pictures, derivatives, and from one variant to another."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.composed import lamp, place, rgb, scene_of, wall
from tests.support.fields import formula_dict, scene_dict, small_file
from tests.support.variants import EVERY, NAMES, USUAL, variant

LUMINANCE = np.array([0.212671, 0.715160, 0.072169])
OTHERS = EVERY[1:]
assert NAMES[0] == USUAL

# How the integrators are called in scenes with surfaces.
# Mitsuba's Python integrators are other ones late in a session that has changed variants often.
ALONE = "MI_NERF_TESTS_ALONE"
alone = pytest.mark.skipif(ALONE not in os.environ, reason="run in a process of its own")

WITH_SURFACES: dict[str, dict[str, Any]] = {
    "path": {"type": "nerf", "nested": {"type": "path", "max_depth": 3}},
    "prb": {"type": "nerf", "nested": {"type": "prb", "max_depth": 3}},
    "nerf_path": {"type": "nerf_path", "max_depth": 3},
    "sample_fields": {"type": "nerf_path", "max_depth": 3, "sample_fields": True},
}


@pytest.fixture
def network(tmp_path: Path) -> Path:
    return small_file(tmp_path, color_space="srgb", density_activation="softplus")


def formula() -> dict[str, Any]:
    """A field of two colours, either of which is far from grey."""
    numbers = {
        "radiance": mi.ScalarVector3f(1.0, 0.5, 0.1),
        "opposite": mi.ScalarVector3f(0.1, 0.3, 1.2),
        "axis": mi.ScalarVector3f(0, 1, 0),
        "density": 3.0,
    }
    return formula_dict("two_color", place().scale(0.5), **numbers)


def surfaces() -> dict[str, Any]:
    """A field before a grey wall and above a mirror, under a white lamp and a white sky."""
    ground = place().translate([0, 0, -0.9]).scale(4)
    mirror = {"type": "conductor", "material": "none"}
    over = place().translate([0, -1, 4]).rotate([1, 0, 0], 180)
    return {
        "cube": formula(),
        "wall": wall(2.5, (0.5, 0.5, 0.5)),
        "ground": {"type": "rectangle", "to_world": ground, "bsdf": mirror},
        "lamp": lamp(0.0, (3.0, 3.0, 3.0), 1.0) | {"to_world": over},
        "sky": {"type": "constant", "radiance": rgb((0.4, 0.4, 0.4))},
    }


def seen(scene: dict[str, Any], seed: int = 0, spp: int = 4) -> np.ndarray:
    return np.array(mi.render(mi.load_dict(scene), seed=seed, spp=spp), np.float64)


# ---- Fields alone: no noise but that of RGB -------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", OTHERS)
@pytest.mark.parametrize("kind", ["formula", "network", "tracking", "path"])
def test_fields_alone_look_the_same(name: str, kind: str, network: Path) -> None:
    integrator = {
        "tracking": {"type": "nerf_tracking", "majorant": 4.0},
        "path": {"type": "nerf_path"},
    }.get(kind, {"type": "nerf"})

    def render() -> np.ndarray:
        if kind == "network":
            return seen(scene_dict(network))
        return seen(scene_of(integrator, cube=formula()))

    with variant(USUAL):
        expected = render()
    with variant(name):
        found = render()
    # A spectral camera draws a wavelength more, and with it other places on the film.
    if "_mono" in name:
        np.testing.assert_allclose(found[..., 0], expected[..., :3] @ LUMINANCE, atol=2e-6)
    else:
        assert found.shape == expected.shape
        inside = expected[..., 3] > 0.5
        assert inside.sum() > 20
        np.testing.assert_allclose(found[inside].mean(0), expected[inside].mean(0), rtol=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("name", [p for p in OTHERS if "_spectral" in str(p)])
def test_light_of_fields_has_no_noise_of_wavelengths(name: str) -> None:
    """The very same rays and samples: exact where RGB is, without any averaging."""
    with variant(name):
        scene = mi.load_dict(scene_of({"type": "nerf", "jitter": False}, cube=formula()))
        integrator, sensor = scene.integrator(), scene.sensors()[0]
        sampler, _ = integrator.prepare(sensor, 3, 1, [])
        ray, _, _ = integrator.sample_rays(scene, sensor, sampler)
        places = np.array(ray.o), np.array(ray.d)
        found = np.array(mi.render(scene, seed=3, spp=1))
    with variant(USUAL):
        from mi_nerf.plugins.integral import see
        from mi_nerf.plugins.placement import find_fields
        from mi_nerf.plugins.sampled import Rays

        scene = mi.load_dict(scene_of({"type": "nerf", "jitter": False}, cube=formula()))
        marched = scene.integrator()._marched(find_fields(scene))
        o, d = mi.Point3f(places[0]), mi.Vector3f(places[1])
        values = see(marched, Rays(o, d, mi.Float(np.full(len(places[0][0]), np.inf)), None)).values
    expected = np.stack([np.array(v) for v in values[:4]], -1).reshape(found.shape)
    np.testing.assert_allclose(found, expected, atol=2e-6)


# ---- Among surfaces ------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", [p for p in OTHERS if "_mono" in str(p)])
@pytest.mark.parametrize("kind", WITH_SURFACES)
def test_mono_is_luminance(name: str, kind: str) -> None:
    """The same random numbers, so to rounding: all surfaces are grey."""

    def render() -> np.ndarray:
        scene = scene_of(WITH_SURFACES[kind], **surfaces())
        scene["integrator"] = scene["integrator"] | {"aovs": "depth,opacity"}
        return seen(scene)

    with variant(USUAL):
        expected = render()
    with variant(name):
        found = render()
    np.testing.assert_allclose(found[..., 0], expected[..., :3] @ LUMINANCE, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(found[..., 1:], expected[..., 4:], rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", [p for p in OTHERS if "_spectral" in str(p)])
@pytest.mark.parametrize(
    "kind", [pytest.param(k, marks=alone) if k == "prb" else k for k in WITH_SURFACES]
)
def test_spectral_is_rgb_within_noise(name: str, kind: str) -> None:
    """Means of quarters of the image by 16 seeds each, at 4 standard errors and the 3e-4 by
    which Mitsuba's daylight is not white."""

    def quarters() -> tuple[np.ndarray, np.ndarray]:
        scene = mi.load_dict(scene_of(WITH_SURFACES[kind], **surfaces()))
        images = [np.array(mi.render(scene, seed=s, spp=32), np.float64) for s in range(16)]
        height, width = images[0].shape[:2]
        parts = np.stack(images).reshape(16, 2, height // 2, 2, width // 2, -1).mean(axis=(2, 4))
        return parts.mean(0), parts.std(0, ddof=1) / 4

    with variant(USUAL):
        expected, error = quarters()
    with variant(name):
        found, noise = quarters()
    bound = 4 * np.hypot(error, noise) + 3e-4 * expected
    assert (np.abs(found - expected) <= bound).all()
    assert (bound[..., :3] < 0.05 * expected[..., :3]).all()  # so that it says something


@pytest.mark.slow
def test_a_film_may_ask_for_luminance_and_alpha() -> None:
    film = {"pixel_format": "luminance_alpha"}
    for name in ("llvm_ad_mono", USUAL, "llvm_ad_spectral"):
        with variant(name):
            scene = scene_of({"type": "nerf"}, cube=formula())
            scene["sensor"]["film"] |= film
            found = seen(scene)
        assert found.shape == (12, 16, 2)
        assert found[6, 8, 1] > 0.9 and 0.1 < found[6, 8, 0] < 1


@pytest.mark.slow
def test_a_film_of_spectral_bands() -> None:
    """``specfilm`` gets spectra: equal for white light in bands where daylight is."""
    with variant("llvm_ad_spectral"):
        band = {"type": "regular", "wavelength_min": 500.0, "wavelength_max": 600.0}
        white = {"radiance": mi.ScalarVector3f(1, 1, 1), "density": 50.0}
        cube = formula_dict("slab", place().scale(1.5), **white)
        scene = scene_of({"type": "nerf"}, cube=cube)
        scene["sensor"]["film"] = {
            "type": "specfilm",
            "width": 4,
            "height": 4,
            "rfilter": {"type": "box"},
            "band": {**band, "values": "1, 1"},
        }
        found = seen(scene, spp=1024)
        scene = scene_of({"type": "path"}, lamp=lamp(-1.5, (1, 1, 1)))
        scene["sensor"]["film"] = {
            "type": "specfilm",
            "width": 4,
            "height": 4,
            "rfilter": {"type": "box"},
            "band": {**band, "values": "1, 1"},
        }
        expected = seen(scene, spp=1024)
    np.testing.assert_allclose(found.mean(), expected.mean(), rtol=0.01)
    assert expected.mean() > 0.1


# ---- Derivatives ---------------------------------------------------------------------------

DIFFERENTIABLE = {"nerf": {"type": "nerf"}, **WITH_SURFACES}


def slope(scene: Any, key: str, pull: np.ndarray, step: float, **options: Any) -> float:
    """d(Σ pull · image)/d(first entry of a parameter) by central differences, with one seed."""
    params = mi.traverse(scene)
    kind, start = type(params[key]), np.array(params[key], np.float32)

    def total(change: float) -> float:
        moved = start.copy()
        moved.flat[0] += change
        params[key] = kind(moved)
        params.update()
        return float((np.array(mi.render(scene, **options), np.float64) * pull).sum())

    up, down = total(step), total(-step)
    total(0.0)
    return (up - down) / (2 * step)


@pytest.mark.slow
@pytest.mark.parametrize("name", OTHERS)
@pytest.mark.parametrize("kind", DIFFERENTIABLE)
def test_derivatives_against_finite_differences(name: str, kind: str, network: Path) -> None:
    """Of a field's density and colour, a wall's colour: backward and forward, common seeds."""
    with variant(name):
        parts = surfaces() if kind != "nerf" else {"cube": formula()}
        scene = mi.load_dict(scene_of(DIFFERENTIABLE[kind], **parts))
        integrator = scene.integrator()
        if not integrator.differentiable:
            pytest.skip("has no derivatives")
        if kind == "prb" and "_polarized" in name:
            pytest.skip("Mitsuba's own has none")
        params = mi.traverse(scene)
        keys = ["cube.interior_medium.density", "cube.interior_medium.radiance"]
        if kind != "nerf" and "_mono" in name:  # elsewhere coefficients of a spectrum
            keys.append("wall.bsdf.reflectance.value")
        options = {"spp": 4, "seed": 5}
        shape = np.array(mi.render(scene, **options)).shape
        pull = np.random.default_rng(0).random(shape)
        pull_in = mi.TensorXf(pull.astype(np.float32))
        expected = [slope(scene, key, pull, 1e-2, **options) for key in keys]
        for key in keys:
            dr.enable_grad(params[key])
        params.update()
        integrator.render_backward(scene, params, pull_in, **options)
        found = [np.array(dr.grad(params[key])).flat[0] for key in keys]
        np.testing.assert_allclose(found, expected, rtol=1e-2)
        for i, key in enumerate(keys):
            for other in keys:
                dr.set_grad(params[other], 0)
            one = np.zeros(np.array(params[key]).shape, np.float32)
            one.flat[0] = 1
            dr.set_grad(params[key], type(params[key])(one))
            params.update()
            change = np.array(integrator.render_forward(scene, params, **options))
            np.testing.assert_allclose((change * pull).sum(), expected[i], rtol=1e-2)


@pytest.mark.slow
@pytest.mark.parametrize("name", OTHERS)
def test_weights_of_a_network(name: str, network: Path) -> None:
    with variant(name):
        scene = mi.load_dict(scene_dict(network, integrator={"jitter": False}))
        params, key = mi.traverse(scene), "box.interior_medium.color_bias"
        options = {"spp": 2, "seed": 5}
        shape = np.array(mi.render(scene, **options)).shape
        pull = np.random.default_rng(0).random(shape)
        expected = slope(scene, key, pull, 2e-2, **options)
        dr.enable_grad(params[key])
        params.update()
        pull_in = mi.TensorXf(pull.astype(np.float32))
        scene.integrator().render_backward(scene, params, pull_in, **options)
        np.testing.assert_allclose(np.array(dr.grad(params[key])).flat[0], expected, rtol=1e-2)


@pytest.mark.slow
def test_mitsubas_replay_in_a_process_of_its_own() -> None:
    command = [sys.executable, "-m", "pytest", "-q", __file__, "-p", "no:cacheprovider"]
    command += ["-k", "replay_has_no or (within_noise and prb)"]
    environment = os.environ | {ALONE: "1"}
    root = Path(__file__).parents[2]
    done = subprocess.run(command, env=environment, cwd=root, capture_output=True, text=True)
    assert done.returncode == 0 and "3 passed" in done.stdout, done.stdout


@alone
def test_mitsubas_replay_has_no_polarised_derivatives() -> None:
    with variant("llvm_ad_mono_polarized"):
        scene = mi.load_dict(scene_of(WITH_SURFACES["prb"], **surfaces()))
        params = mi.traverse(scene)
        dr.enable_grad(params["wall.bsdf.reflectance.value"])
        params.update()
        image = mi.render(scene, params, spp=1)
        with pytest.raises(Exception, match="'prb' has no derivatives in polarised variants, exp"):
            dr.backward(dr.sum(image, axis=None))


# ---- From one variant to another -----------------------------------------------------------


@pytest.mark.slow
def test_back_and_forth() -> None:
    """Scenes of before work, and new ones look the same; derivatives, too."""
    kinds = [DIFFERENTIABLE[k] for k in ("prb", "nerf_path")]
    names = [USUAL, "llvm_ad_mono", "llvm_ad_spectral"]
    scenes: dict[str, list[Any]] = {}
    first: dict[str, list[np.ndarray]] = {}

    def look(scene: Any) -> np.ndarray:
        params, key = mi.traverse(scene), "cube.interior_medium.density"
        if not scene.integrator().differentiable:
            return np.array(mi.render(scene, spp=2, seed=1))
        dr.enable_grad(params[key])
        params.update()
        image = mi.render(scene, params, spp=2, seed=1)
        dr.backward(dr.sum(image, axis=None))
        slope = np.array(dr.grad(params[key])).ravel()
        dr.clear_grad(params[key])
        return np.concatenate([np.array(image).ravel(), slope])

    mi.set_variant(USUAL)
    try:
        for name in [*names, *names]:
            mi.set_variant(name)
            mi.set_variant("scalar_rgb")
            mi.set_variant(name)
            new = [mi.load_dict(scene_of(kind, **surfaces())) for kind in kinds]
            if name not in scenes:
                scenes[name], first[name] = new, [look(scene) for scene in new]
            for old, young, expected in zip(scenes[name], new, first[name], strict=True):
                np.testing.assert_allclose(look(old), expected, rtol=1e-5, atol=1e-5)
                np.testing.assert_allclose(look(young), expected, rtol=1e-5, atol=1e-5)
                assert type(old.integrator()) is type(young.integrator())
    finally:
        mi.set_variant(USUAL)


def test_plugins_are_those_of_the_active_variant() -> None:
    import importlib

    import mi_nerf.plugins

    found = {}
    for name in ("llvm_ad_mono", USUAL, "llvm_ad_mono"):
        with variant(name):
            module = importlib.import_module("mi_nerf.plugins.nerf")
            assert mi_nerf.plugins.nerf is module  # type: ignore[attr-defined]
            assert issubclass(module.NerfIntegrator, mi.Integrator)
            assert found.setdefault(name, module) is module
    assert found["llvm_ad_mono"] is not found[USUAL]


@pytest.mark.parametrize("plugin", ["nerf", "nerf_path", "nerf_tracking", "nerfmedium"])
def test_variants_without_derivatives_say_so(plugin: str) -> None:
    with variant("scalar_rgb"), pytest.raises(RuntimeError) as caught:
        mi.load_dict({"type": plugin})
    assert f"InputError: {plugin}: variant 'scalar_rgb' has no derivatives, expected a variant" in (
        str(caught.value)
    )


def test_variants_in_double_precision_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """This Mitsuba has none: a scalar one under such a name."""
    from mi_nerf import plugins

    with variant("scalar_rgb"):
        monkeypatch.setattr(mi, "variant", lambda: "llvm_ad_rgb_double")
        plugins.register()
        monkeypatch.undo()
        with pytest.raises(RuntimeError, match="'llvm_ad_rgb_double' computes in double precis"):
            mi.load_dict({"type": "nerf"})
        plugins._modules.pop("llvm_ad_rgb_double")
        plugins._modules.pop("scalar_rgb", None)
        plugins.register()


@pytest.mark.parametrize("name", ["llvm_ad_mono", "llvm_ad_spectral"])
def test_encoded_pictures_are_rgb(name: str, network: Path) -> None:
    with variant(name):
        for kind in ("nerf", "nerf_tracking"):
            scene = scene_dict(network, integrator={"type": kind, "encoded": True})
            with pytest.raises(RuntimeError) as caught:
                mi.render(mi.load_dict(scene))
            assert f"{kind}: encoded=true in variant '{name}', expected" in str(
                caught.value.__cause__
            )
