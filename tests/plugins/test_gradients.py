"""The gradient of mi.render against the trainer's path and finite differences."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mi_nerf
from mi_nerf.fields.neural import NeuralField
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.placing import place_samples
from mi_nerf.march.quadrature import integrate
from mi_nerf.march.query import Evaluation
from tests.support.fields import scene_dict, small_file, weight_keys

SEED = 7


@pytest.fixture
def setup(tmp_path: Path) -> tuple[Any, Any, np.ndarray]:
    return gradient_setup(tmp_path)


def gradient_setup(folder: Path) -> tuple[Any, Any, np.ndarray]:
    """A scene of a linear field, its contents, and weights for every image channel."""
    mi.set_variant("llvm_ad_rgb")
    path = small_file(folder, color_space="linear", density_activation="softplus")
    scene = mi.load_dict(scene_dict(path, spp=1, integrator={"jitter": False, "aovs": "depth"}))
    pull = np.random.default_rng(0).normal(size=(12, 16, 5))
    return scene, mi_nerf.load_field(path), pull


def rendered_gradient(scene: Any, pull: np.ndarray) -> dict[str, np.ndarray]:
    """d(Σ pull · image)/d(weights) through mi.render; the image itself may use any seed."""
    params = mi.traverse(scene)
    for key in weight_keys(params):
        dr.enable_grad(params[key])
        dr.clear_grad(params[key])
    params.update()
    image = mi.render(scene, params, seed=SEED + 1, seed_grad=SEED)
    dr.backward(dr.sum(image * mi.TensorXf(pull.astype(np.float32)), axis=None))
    return {
        key.rpartition(".")[2]: np.array(dr.grad(params[key]), np.float64)
        for key in weight_keys(params)
    }


def camera_rays(scene: Any, float_type: Any, vector_type: Any) -> tuple[Any, Any]:
    """The rays that mi.render traces for SEED with one sample a pixel, in another precision."""
    sensor, integrator = scene.sensors()[0], scene.integrator()
    sampler, _ = integrator.prepare(sensor, SEED, 1, integrator.aov_names())
    ray, _, _ = integrator.sample_rays(scene, sensor, sampler)
    o, d = np.array(ray.o, np.float64), np.array(ray.d, np.float64)
    d /= np.linalg.norm(d, axis=0)
    make = [vector_type(*(float_type(np.ascontiguousarray(r)) for r in v)) for v in (o, d)]
    return make[0], make[1]


def loss_of(field: Any, rays: Any, contents: Any, pull: Any, keep: Any = None) -> Any:
    """Σ pull · (R, G, B, opacity, depth) by the trainer's own functions."""
    samples = place_samples(MarchedField(field, contents.march), *rays)
    evaluation = Evaluation(field, samples, 4096, keep=True)
    evaluation.enable_grad()
    seen = integrate(evaluation, samples)
    total = dr.sum(
        sum(
            value * type(value)(np.ascontiguousarray(pull[..., i].ravel()))
            for i, value in enumerate([*seen.color, seen.opacity, seen.depth])
        )
    )
    if keep is not None:
        keep.append(evaluation)
    return total


def trainer_errors(scene: Any, contents: Any, pull: np.ndarray) -> dict[str, float]:
    """Largest difference of mi.render's gradient to the trainer's, relative, by tensor."""
    from_render = rendered_gradient(scene, pull)
    field, _ = contents.build(mi)
    for tensor in field.parameters().values():
        dr.enable_grad(tensor)
    kept: list[Evaluation] = []
    dr.backward(loss_of(field, camera_rays(scene, mi.Float, mi.Vector3f), contents, pull, kept))
    kept[0].backward()
    errors = {}
    for name, tensor in field.parameters().items():
        expected = np.array(dr.grad(tensor), np.float64)
        difference = np.abs(from_render[name.replace(".", "_")] - expected)
        errors[name] = float(difference.max() / np.abs(expected).max())
    return errors


def difference_errors(scene: Any, contents: Any, pull: np.ndarray) -> dict[str, float]:
    """The same to central differences in float64, along a random direction for each tensor."""
    import drjit.llvm.ad as ad

    gradient = rendered_gradient(scene, pull)
    rays = camera_rays(scene, ad.Float64, ad.Array3f64)
    # Softplus has no kinks, but ReLU does: small steps keep all units on their side.
    step = 1e-7
    rng = np.random.default_rng(1)

    def value(weights: dict[str, np.ndarray]) -> float:
        field = NeuralField(contents.config, weights, ad.TensorXf64)
        with dr.suspend_grad():
            return float(loss_of(field, rays, contents, pull)[0])

    errors = {}
    for name, weight in contents.weights.items():
        direction = rng.normal(size=weight.shape)
        direction /= np.linalg.norm(direction)
        shifted = [
            {**contents.weights, name: weight.astype(np.float64) + sign * step * direction}
            for sign in (1, -1)
        ]
        expected = (value(shifted[0]) - value(shifted[1])) / (2 * step)
        ours = gradient[name.replace(".", "_")]
        errors[name] = abs(float(np.sum(ours * direction)) - expected) / float(np.linalg.norm(ours))
    return errors


@pytest.mark.slow
def test_mi_render_agrees_with_the_trainer(setup: Any) -> None:
    errors = trainer_errors(*setup)
    assert max(errors.values()) < 1e-4, errors


def test_mi_render_agrees_with_finite_differences(setup: Any) -> None:
    errors = difference_errors(*setup)
    assert max(errors.values()) < 1e-4, errors


@pytest.mark.slow
def test_forward_mode_is_the_transpose_of_backward_mode(setup: Any) -> None:
    scene, _, pull = setup
    gradient = rendered_gradient(scene, pull)
    params = mi.traverse(scene)
    rng = np.random.default_rng(2)
    expected = 0.0
    for key in weight_keys(params):
        tangent = rng.normal(size=params[key].shape)
        name = key.rpartition(".")[2]
        expected += float(np.sum(gradient[name] * tangent))
        dr.clear_grad(params[key])
        dr.enable_grad(params[key])
        dr.set_grad(params[key], mi.TensorXf(tangent.astype(np.float32)))
    image = mi.render(scene, params, seed=SEED + 1, seed_grad=SEED)
    slope = np.array(dr.forward_to(image), np.float64)
    assert float(np.sum(slope * pull)) == pytest.approx(expected, rel=1e-3)


@pytest.mark.slow
def test_srgb_fields_differentiate_at_zero_opacity(tmp_path: Path) -> None:
    mi.set_variant("llvm_ad_rgb")
    path = small_file(tmp_path, density_shift=-60.0)
    scene = mi.load_dict(scene_dict(path, spp=1))
    gradient = rendered_gradient(scene, np.ones((12, 16, 4)))
    assert all(np.isfinite(g).all() for g in gradient.values())


@pytest.mark.slow
def test_chunks_do_not_change_the_gradient(setup: Any) -> None:
    scene, _, pull = setup
    whole = rendered_gradient(scene, pull)
    medium = scene.shapes()[0].interior_medium()
    medium.march = replace(medium.march, chunk=32 * 50, block=128)
    parts = rendered_gradient(scene, pull)
    for name, expected in whole.items():
        np.testing.assert_allclose(parts[name], expected, atol=2e-5 * np.abs(expected).max())
