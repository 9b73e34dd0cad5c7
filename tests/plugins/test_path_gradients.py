"""Derivatives of integrator nerf_path against finite differences and closed forms."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mi_nerf
from tests.plugins.test_nerf_path import (
    TWO_BOXES,
    chord,
    floor,
    irradiance_of_box,
    overhead,
    paths,
    point_light,
)
from tests.support.composed import (
    GLOW,
    SIZE,
    camera_rays,
    matrix_of,
    place,
    rgb,
    scene_of,
    slab,
    wall,
)
from tests.support.fields import formula_dict, small_file

pytestmark = pytest.mark.usefixtures("variant")

Change = Callable[[Any, Any], Any]  # a parameter, and a number by which it is changed


def pull_of(channels: int = 3) -> np.ndarray:
    """What is differentiated is the sum of the image times this."""
    weights = np.zeros((SIZE[1], SIZE[0], 4))
    weights[..., :channels] = np.random.default_rng(0).uniform(0.2, 1.0, (*SIZE[::-1], channels))
    return weights


def plus(value: Any, number: Any) -> Any:
    return type(value)(value) + number


def shifted(value: Any, number: Any) -> Any:
    return mi.Transform4f().translate(mi.Vector3f(number, -0.5 * number, 0.7 * number)) @ value


def turned(value: Any, number: Any) -> Any:
    return mi.Transform4f().rotate([0.6, 0, 0.8], 57.3 * number) @ value


class Slopes:
    """How a rendering follows some parameters of its scene, each changed by a number."""

    def __init__(self, scene: Any, changes: dict[str, Change], pull: np.ndarray) -> None:
        self._scene: Any = mi.load_dict(scene) if isinstance(scene, dict) else scene
        self._params = mi.traverse(self._scene)
        self._changes, self._pull = changes, pull
        self._start = {key: type(self._params[key])(self._params[key]) for key in changes}

    def _set(self, numbers: dict[str, Any]) -> None:
        for key, change in self._changes.items():
            self._params[key] = change(self._start[key], numbers[key])
        self._params.update()

    def _attached(self) -> dict[str, Any]:
        numbers = {key: mi.Float(0) for key in self._changes}
        dr.enable_grad(numbers)
        self._set(numbers)
        return numbers

    def _image(self, seed: int, spp: int) -> Any:
        return mi.render(self._scene, self._params, spp=spp, seed=seed + 1000, seed_grad=seed)

    def value(self, key: str, number: float, seed: int, spp: int) -> float:
        """Of the sum, at a changed parameter."""
        self._set({k: mi.Float(number if k == key else 0) for k in self._changes})
        image = np.array(mi.render(self._scene, spp=spp, seed=seed), np.float64)
        return float(np.sum(image * self._pull))

    def difference(self, key: str, step: float, seed: int, spp: int) -> float:
        """The central difference of renderings with the same random numbers."""
        ends = [self.value(key, sign * step, seed, spp) for sign in (1, -1)]
        return (ends[0] - ends[1]) / (2 * step)

    def backward(self, seed: int, spp: int) -> dict[str, float]:
        """The derivatives by all parameters, in backward mode."""
        numbers = self._attached()
        pull = mi.TensorXf(self._pull.astype(np.float32))
        dr.backward(dr.sum(self._image(seed, spp) * pull, axis=None))
        return {key: float(dr.grad(number)[0]) for key, number in numbers.items()}

    def forward(self, rates: dict[str, float], seed: int, spp: int) -> np.ndarray:
        """The derivative of the image if all parameters change at some rates."""
        numbers = self._attached()
        image = self._image(seed, spp)
        for key, number in numbers.items():
            dr.set_grad(number, rates[key])
        return np.array(dr.forward_to(image), np.float64)

    def errors(self, steps: dict[str, float], *, seeds: int, spp: int) -> dict[str, Any]:
        """Of the derivatives against the differences: the mean and its standard error, relative."""
        found = [self.backward(seed, spp) for seed in range(1, seeds + 1)]
        errors = {}
        for key, step in steps.items():
            expected = [self.difference(key, step, s, spp) for s in range(1, seeds + 1)]
            apart = np.array([f[key] for f in found]) - expected
            scale = abs(np.mean(expected))
            assert scale > 0, key
            standard = apart.std(ddof=1) / np.sqrt(seeds) / scale
            errors[key] = (float(abs(apart.mean()) / scale), float(standard))
        return errors


def cabinet(**options: Any) -> dict[str, Any]:
    """Two fields among a matt floor, a mirror, glass, varnish, metal, and lights of all kinds."""
    tinted = {"type": "conductor", "specular_reflectance": rgb((0.9, 0.8, 0.7))}
    ball = {"type": "sphere", "radius": 0.4}
    glass = {"type": "dielectric", "specular_transmittance": rgb((0.9, 0.8, 0.7))}
    varnish = {"type": "plastic", "diffuse_reflectance": rgb((0.3, 0.6, 0.4))}
    metal = {"type": "roughconductor", "alpha": 0.2}
    metal["specular_reflectance"] = rgb((0.8, 0.7, 0.6))
    where = place().translate([0.1, 0.3, -0.1]).rotate([0.3, 1, 0.2], 25).scale(0.5)
    blob = {"peak": 3.0, "width": 0.35, "extent": 2.5, "radiance": mi.ScalarVector3f(GLOW)}
    return scene_of(
        paths(**{"max_depth": 5, "rr_depth": 50, **options}),
        floor=floor(),
        mirror={**wall(2.2, half=2.0), "bsdf": tinted},
        glass={**ball, "center": [0.9, -0.6, -0.4], "bsdf": glass},
        varnish={**ball, "center": [-0.5, -1.1, -0.6], "bsdf": varnish},
        metal={**ball, "center": [-1, 0, -0.3], "bsdf": metal},
        lamp=overhead((9, 8, 7)),
        point=point_light([1.5, -1, 2], 5.0),
        sky={"type": "constant", "radiance": rgb((0.3, 0.3, 0.4))},
        field=formula_dict("gaussian", where, **blob),
        other=slab(place().translate([-0.5, 0.6, 0.3]).scale(0.4), 1.5, (0.2, 0.5, 0.9)),
    )


COLORS = {
    "floor.bsdf.reflectance.value": 0.05,
    "mirror.bsdf.specular_reflectance.value": 0.05,
    "glass.bsdf.specular_transmittance.value": 0.05,
    "metal.bsdf.specular_reflectance.value": 0.05,
    "lamp.emitter.radiance.value": 0.5,
    "point.intensity.value": 0.5,
    "sky.radiance.value": 0.05,
    "field.interior_medium.peak": 0.05,
    "field.interior_medium.radiance": 0.05,
    "other.interior_medium.density": 0.02,
}
PLACES = {
    "field.interior_medium.to_world": (shifted, 2e-3),
    "other.interior_medium.to_world": (turned, 2e-3),
}


@pytest.fixture(scope="module")
def slopes() -> Slopes:
    changes = dict.fromkeys(COLORS, plus) | {key: change for key, (change, _) in PLACES.items()}
    mi.set_variant("llvm_ad_rgb")
    return Slopes(cabinet(), changes, pull_of())


# ---- Finite differences with the same random numbers ----------------------------


@pytest.mark.slow
def test_derivatives_agree_with_finite_differences(slopes: Slopes) -> None:
    """Sample by sample, as these parameters do not change where paths go."""
    for key, (error, standard) in slopes.errors(COLORS, seeds=2, spp=4).items():
        assert error < 2e-3 and standard < 2e-3, (key, error, standard)


@pytest.mark.slow
def test_derivatives_of_places(slopes: Slopes) -> None:
    """By the shadow, in the mirror, through glass and by the light that a field casts."""
    steps = {key: step for key, (_, step) in PLACES.items()}
    for key, (error, standard) in slopes.errors(steps, seeds=8, spp=8).items():
        assert standard < 1e-2 and error < 2e-2, (key, error, standard)


@pytest.mark.slow
def test_forward_mode_is_the_transpose_of_backward_mode(slopes: Slopes) -> None:
    rng = np.random.default_rng(1)
    rates = {key: float(rng.normal()) for key in (*COLORS, *PLACES)}
    gradient = slopes.backward(5, 4)
    expected = sum(gradient[key] * rate for key, rate in rates.items())
    assert np.sum(slopes.forward(rates, 5, 4) * pull_of()) == pytest.approx(expected, rel=1e-3)
