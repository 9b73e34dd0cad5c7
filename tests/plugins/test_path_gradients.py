"""Derivatives of integrator nerf_path against finite differences and closed forms."""

from __future__ import annotations

import subprocess
import sys
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

    def errors(
        self, steps: dict[str, float], *, seeds: int, spp: int, first: int = 1
    ) -> dict[str, Any]:
        """Of the derivatives against the differences: the mean and its standard error, relative."""
        numbers = range(first, first + seeds)
        found = [self.backward(seed, spp) for seed in numbers]
        errors = {}
        for key, step in steps.items():
            expected = [self.difference(key, step, s, spp) for s in numbers]
            apart = np.array([f[key] for f in found]) - expected
            scale = abs(np.mean(expected))
            assert scale > 0, key
            standard = apart.std(ddof=1) / np.sqrt(seeds) / scale
            errors[key] = (float(abs(apart.mean()) / scale), float(standard))
        return errors


# Choices that do not depend on what is changed: differences have common random numbers.
FIXED = {"max_depth": 5, "rr_depth": 50, "emitter_candidates": 1, "sample_fields": False}


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
        paths(**{**FIXED, **options}),
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
    "field.interior_medium.to_world": (shifted, 5e-4),
    "other.interior_medium.to_world": (turned, 5e-4),
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
def test_derivatives_by_what_lights_are_chosen_by() -> None:
    """Powers and colours decide which light is chosen: differences are noisy, without bias."""
    keys = ("lamp.emitter.radiance.value", "sky.radiance.value", "floor.bsdf.reflectance.value")
    changes = dict.fromkeys(keys, plus)
    slopes = Slopes(cabinet(emitter_candidates=8, sample_fields=True), changes, pull_of())
    steps = {key: 4 * COLORS[key] for key in keys}
    for key, (error, standard) in slopes.errors(steps, seeds=8, spp=8).items():
        assert standard < 2e-2 and error < max(4 * standard, 2e-3), (key, error, standard)


@pytest.mark.slow
def test_derivatives_of_places(slopes: Slopes) -> None:
    """By the shadow, in the mirror, through glass and by the light that a field casts."""
    # With seed 1, a path is so steep that differences are right for steps below 1e-5 alone.
    steps = {key: step for key, (_, step) in PLACES.items()}
    for key, (error, standard) in slopes.errors(steps, seeds=3, spp=4, first=6).items():
        assert standard < 1e-2 and error < 2e-2, (key, error, standard)


@pytest.mark.slow
def test_forward_mode_is_the_transpose_of_backward_mode(slopes: Slopes) -> None:
    rng = np.random.default_rng(1)
    rates = {key: float(rng.normal()) for key in (*COLORS, *PLACES)}
    gradient = slopes.backward(5, 4)
    expected = sum(gradient[key] * rate for key, rate in rates.items())
    assert np.sum(slopes.forward(rates, 5, 4) * pull_of()) == pytest.approx(expected, rel=1e-3)


# ---- Closed forms ---------------------------------------------------------------


def shadowed_floor(scene: Any, move: Any, density: float, at: np.ndarray) -> np.ndarray:
    """A matt floor at z = −1 below a slab, lit by a point light; (R,) without its colour.

    Everything is exp(−σ·length): of the slab before the camera, and before the light.
    """
    o, d = camera_rays(scene, seed=1)
    reach = (-1 - o[:, 2]) / d[:, 2]
    p = o + reach[:, None] * d
    there = (np.abs(p[:, :2]).max(axis=1) < 5) & (reach > 0)
    distance = np.linalg.norm(at - p, axis=1)
    to_light = (at - p) / distance[:, None]
    tau = density * (chord(p, to_light, move, distance) + chord(o, d, move, reach))
    return np.where(there, 20 / distance**2 * to_light[:, 2] * np.exp(-tau) / np.pi, 0)


def test_shadow_of_a_slab_agrees_with_the_exact_derivative() -> None:
    """By density, place, floor and lamp: exp(−σd) in float64, in its own derivatives."""
    color, density, at = np.array([0.6, 0.5, 0.4]), 1.2, np.array([0.2, 0.1, 2.5])
    move, matrix = TWO_BOXES[0][0](), "box.interior_medium.to_world"
    shift = {
        matrix: lambda value, number: value @ mi.Transform4f().translate([0.5 * number, number, 0])
    }
    keys = ("box.interior_medium.density", "floor.bsdf.reflectance.value", "light.intensity.value")
    objects = {
        "floor": floor(color),
        "box": slab(move, density, (0, 0, 0)),
        "light": point_light(at),
    }
    scene = mi.load_dict(scene_of(paths(max_depth=2, jitter=False), **objects))
    pull = pull_of()
    seen = Slopes(scene, dict.fromkeys(keys, plus) | shift, pull).backward(1, 1)
    weights = pull[..., :3].reshape(-1, 3)

    def total(density: float, step: float = 0.0) -> float:
        moved = move @ place().translate([0.5 * step, step, 0])
        image = shadowed_floor(scene, moved, density, at)[:, None] * color
        return float(np.sum(weights * image))

    exact = {
        keys[0]: (total(density + 1e-4) - total(density - 1e-4)) / 2e-4,
        keys[1]: float(np.sum(weights * shadowed_floor(scene, move, density, at)[:, None])),
        keys[2]: total(density) / 20,
        matrix: (total(density, 1e-3) - total(density, -1e-3)) / 2e-3,
    }
    for key, expected in exact.items():
        assert seen[key] == pytest.approx(expected, rel=2e-3), key
    assert exact[keys[0]] < -0.1 and abs(exact[matrix]) > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("sampled", [False, True])
def test_light_of_a_box_agrees_with_the_derivative_of_its_closed_form(sampled: bool) -> None:
    """On a floor below: by the density of what shines, within noise, and by its colour."""
    move = place().translate([0.1, 0.2, 0.1]).rotate([0.3, 1, 0.2], 25).scale([0.5, 0.4, 0.3])
    integrator = paths(max_depth=2, paths=500, samples=8, sample_fields=sampled)
    color = np.array([0.6, 0.5, 0.4])
    scene = mi.load_dict(scene_of(integrator, floor=floor(color), field=slab(move, 2.0, GLOW)))
    o, d = camera_rays(scene, seed=1)
    reach = (-1 - o[:, 2]) / d[:, 2]
    clear = (chord(o, d, move, np.inf) == 0) & (reach > 0) & (reach < 7)
    p = o[clear] + reach[clear, None] * d[clear]
    pull = np.where(clear.reshape(SIZE[::-1])[..., None], pull_of(), 0)
    keys = ("field.interior_medium.density", "field.interior_medium.radiance")
    slopes = Slopes(scene, dict.fromkeys(keys, plus), pull)
    # One sample a pixel is at another place for every seed: only paths differ here.
    seen = slopes.backward(1, 1)
    weights = pull[..., :3].reshape(-1, 3)[clear] @ (color * np.array(GLOW)) / np.pi

    def total(density: float) -> float:
        return float(np.sum(weights * irradiance_of_box(p, move, density)))

    exact = (total(2.05) - total(1.95)) / 0.1
    by_color = pull[..., :3].reshape(-1, 3)[clear] @ color / np.pi
    radiance = float(np.sum(by_color * irradiance_of_box(p, move, 2.0)))
    # Standard errors: 3.5e-2, as short chords decide, and 1e-2. With 1500 paths: 4e-3, 5e-4 off.
    assert seen[keys[0]] == pytest.approx(exact, rel=0.1)
    assert seen[keys[1]] == pytest.approx(radiance, rel=3e-2)


# ---- Replay ---------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [{}, {"rr_depth": 1}, {"paths": 3, "emitter_candidates": 8}, {"sample_fields": True}]
)
def test_a_replay_takes_away_all_that_a_path_has_brought(
    options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    from mi_nerf.plugins import path_replay
    from mi_nerf.plugins import paths as module

    replays: list[Any] = []

    class Kept(path_replay.Replay):
        def __init__(self, radiance: Any, *arguments: Any) -> None:
            super().__init__(radiance, *arguments)
            self.before = np.array(radiance)
            replays.append(self)

    monkeypatch.setattr(module, "Replay", Kept)
    changes = {"field.interior_medium.peak": plus, "floor.bsdf.reflectance.value": plus}
    gradient = Slopes(cabinet(**options), changes, pull_of()).backward(1, 1)
    assert np.isfinite(list(gradient.values())).all()
    assert len(replays) == options.get("paths", 1)
    for replay in replays:
        assert replay.before.max() > 0.1
        np.testing.assert_allclose(np.array(replay.radiance), 0, atol=2e-6 * replay.before.max())


@pytest.mark.slow
def test_neither_what_is_kept_nor_what_waits_changes_a_derivative(
    slopes: Slopes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fields are asked again where nothing is kept, and about few rays where nothing waits."""
    from mi_nerf.plugins import path_derivatives, path_replay
    from mi_nerf.plugins import paths as module

    asked: list[str] = []
    for name in ("see", "transmittance"):
        ask = getattr(module, name)
        monkeypatch.setattr(
            module, name, lambda *a, ask=ask, name=name: (asked.append(name), ask(*a))[1]
        )
    kept = slopes.backward(5, 4)
    once, asked[:] = len(asked) / 2, []  # for the picture, and once more for its derivative
    monkeypatch.setattr(path_replay, "_KEPT_A_RAY", 0)
    again = slopes.backward(5, 4)
    assert len(asked) == 3 * once > 0
    monkeypatch.setattr(path_derivatives, "_WAITING", 1)
    single = slopes.backward(5, 4)
    for key, gradient in kept.items():
        assert again[key] == pytest.approx(gradient, rel=1e-4), key
        assert single[key] == pytest.approx(gradient, rel=1e-3), key


@pytest.mark.slow
def test_derivatives_end_where_pictures_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """Behind a share ``stop`` of light, no sample is asked; what is lost is no more than that."""
    from mi_nerf.march import query
    from mi_nerf.plugins import crossing

    asked: list[int] = []

    class Counted(query.Evaluation):
        def backward(self) -> None:
            asked.append(len(self.asked))
            super().backward()

    monkeypatch.setattr(crossing, "Evaluation", Counted)
    monkeypatch.setattr(query, "_LEAST_QUERIES", 64)  # so few rays would be asked about at once
    blob = {"peak": 40.0, "width": 0.3, "extent": 2.5, "radiance": mi.ScalarVector3f(GLOW)}
    changes = {"field.interior_medium.radiance": plus, "field.interior_medium.peak": plus}
    found, queries = [], []
    for stop in (0.0, 1e-3):
        field = formula_dict("gaussian", place().scale(0.6), **blob)
        scene = scene_of(paths(max_depth=2, stop=stop), floor=floor(), field=field)
        asked.clear()
        found.append(Slopes(scene, changes, pull_of()).backward(1, 4))
        queries.append(sum(asked))
    assert 0 < queries[1] < 0.9 * queries[0]
    key = "field.interior_medium.radiance"
    assert found[1][key] == pytest.approx(found[0][key], rel=1e-3)
    assert found[1][key] != found[0][key]
    key = "field.interior_medium.peak"
    assert found[1][key] == pytest.approx(found[0][key], rel=5e-2)


@pytest.mark.slow
def test_weights_of_a_network_seen_in_a_mirror(tmp_path: Path) -> None:
    """In a random direction of all its weights, against finite differences."""
    file = small_file(tmp_path, density_activation="softplus")
    box = {"type": "cube", "interior": {"type": "nerfmedium", "filename": str(file)}}
    mirror = {**wall(2.0, half=5.0), "bsdf": {"type": "conductor", "material": "none"}}
    scene = mi.load_dict(scene_of(paths(stop=0.0), box=box, mirror=mirror, floor=floor()))
    rng = np.random.default_rng(3)
    keys = [k for k in mi.traverse(scene).keys() if "_weight" in k]  # noqa: SIM118
    start = {k: np.array(mi.traverse(scene)[k]) for k in keys if "interior" in k}
    ways = {k: mi.TensorXf(rng.normal(size=v.shape).astype(np.float32)) for k, v in start.items()}
    changes = {
        key: lambda value, number, way=way: value + way * number for key, way in ways.items()
    }
    slopes = Slopes(scene, changes, pull_of())
    errors = slopes.errors(dict.fromkeys(ways, 2e-3), seeds=2, spp=1)
    assert len(errors) > 3
    for key, (error, standard) in errors.items():
        assert error < 2e-2 and standard < 2e-2, (key, error, standard)


def test_a_lamp_without_power_and_a_black_floor_have_derivatives() -> None:
    """Of the light that comes at once: what comes later is weighed by a ratio to zero."""
    light = {"type": "point", "position": [0.2, 0.1, 2.5], "intensity": rgb((0, 0, 0))}
    objects = {"floor": floor(), "light": light}
    key = "light.intensity.value"
    slopes = Slopes(scene_of(paths(max_depth=2), **objects), {key: plus}, pull_of())
    assert slopes.backward(1, 1)[key] == pytest.approx(slopes.value(key, 1.0, 1, 1), rel=1e-3)
    objects = {"floor": floor((0, 0, 0)), "light": point_light((0.2, 0.1, 2.5))}
    key = "floor.bsdf.reflectance.value"
    slopes = Slopes(scene_of(paths(max_depth=2), **objects), {key: plus}, pull_of())
    assert slopes.backward(1, 1)[key] == pytest.approx(slopes.value(key, 1.0, 1, 1), rel=1e-3)


@pytest.mark.slow
def test_a_derivative_compiles_nothing_after_the_first_ones() -> None:
    objects = {"floor": floor(), "lamp": overhead((9, 8, 7)), "field": formula_dict("gaussian")}
    key = "field.interior_medium.peak"
    slopes = Slopes(scene_of(paths(max_depth=4), **objects), {key: plus}, pull_of())
    for seed in (1, 2):
        slopes.backward(seed, 2)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        slopes.backward(3, 2)
        kernels = dr.kernel_history()
    assert len(kernels) > 50 and not [k for k in kernels if k.get("cache_hit") == 0]


@pytest.mark.slow
def test_memory_grows_neither_with_depth_nor_with_samples() -> None:
    """Peaks of processes that do one backward pass, in passes of the same number of rays."""
    command = [sys.executable, "-m", "tests.benchmarks.path_gradient", "--size", "64", "--case"]
    peaks = []
    for case in (("2", "4"), ("16", "4"), ("2", "64")):
        done = subprocess.run([*command, *case], check=True, capture_output=True, text=True)
        peaks.append(float(done.stdout.split()[-2]))
    assert max(peaks[1:]) < 1.3 * peaks[0], peaks


# ---- What has none --------------------------------------------------------------


def test_derivatives_by_colors_that_are_no_numbers_are_refused() -> None:
    objects = {"floor": floor(), "light": point_light((0, 0, 2.0)), "box": formula_dict("slab")}
    for integrator in (paths(), {"type": "nerf", "nested": {"type": "path"}}):
        scene = mi.load_dict(scene_of(integrator, **objects))
        params, key = mi.traverse(scene), "floor.bsdf.reflectance.value"
        params[key] = mi.Color3f(np.nan)
        dr.enable_grad(params[key])
        params.update()
        with pytest.raises(mi_nerf.InputError, match=f"'{key}' is NaN or infinite, expected"):
            dr.backward(mi.render(scene, params))


@pytest.mark.parametrize("kind", ["nerf", "nerf_path"])
@pytest.mark.parametrize(
    ("key", "what"),
    [
        ("floor.to_world", "of where a surface is"),
        ("light.position", "of it in Mitsuba"),
        ("sensor.to_world", "of a sensor"),
        ("sensor.x_fov", "of a sensor"),
    ],
)
def test_what_has_no_derivative_is_refused(key: str, what: str, kind: str) -> None:
    objects = {"floor": floor(), "light": point_light((0, 0, 2.0)), "box": formula_dict("slab")}
    integrator = paths() if kind == "nerf_path" else {"type": "nerf", "nested": {"type": "path"}}
    scene = mi.load_dict(scene_of(integrator, **objects))
    params = mi.traverse(scene)
    params[key] = type(params[key])(params[key])
    dr.enable_grad(params[key])
    params.update()
    expected = f"{kind}: the gradient of '{key}' is wanted, but there is no derivative {what}: "
    with pytest.raises(mi_nerf.InputError, match=expected):
        dr.backward(mi.render(scene, params))
