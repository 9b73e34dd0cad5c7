"""Rules of quadrature beside the constant one: density over cells, and linear density."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerf import load_field, save_field
from mi_nerf.base.variants import array_module, choose_variant
from mi_nerf.data import load_dataset
from mi_nerf.fields.closed_form import closed_form
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.placing import place_samples, refine
from mi_nerf.march.quadrature import composite, integrate
from mi_nerf.march.query import Evaluation
from mi_nerf.march.render import render_rays
from mi_nerf.march.rules import RULES as BY_NAME
from mi_nerf.march.rules import linear_weights, mean_transmittance, sample_weights
from mi_nerf.march.settings import MarchSettings
from mi_nerf.march.strata import cell_widths, stratified
from mi_nerf.training.trainer import Trainer
from tests.support import closed_forms as oracle
from tests.support.analytic import AnalyticField, uniform
from tests.support.arrays import unit, vectors
from tests.support.fields import scene_dict, small_file
from tests.training.test_run import small

VARIANT = choose_variant()
AD = array_module(VARIANT)
RULES = ("constant", "cells", "linear")
LINEAR = BY_NAME["linear"]
every_rule = pytest.mark.parametrize("rule", RULES)


# ---- The mean transmittance -------------------------------------------------


def test_mean_transmittance(ad: Any) -> None:
    x = np.append(np.logspace(-30, 30, 3001), [0, 0.25]).astype(np.float32)
    exact = -np.expm1(-x.astype(float)) / np.where(x > 0, x, 1).astype(float)
    exact[x == 0] = 1
    assert np.array(mean_transmittance(ad.Float(x))) == pytest.approx(exact, rel=1e-6, abs=1e-37)


def test_slope_of_the_mean_transmittance(ad: Any) -> None:
    x = np.append(np.logspace(-6, 12, 1001), [0, 1e30])
    leaf = ad.Float(x)
    dr.enable_grad(leaf)
    dr.backward(mean_transmittance(leaf))
    with np.errstate(under="ignore"):
        y = np.maximum(x, 1e-3)
        exact = (np.exp(-y) * (1 + y) - 1) / y**2
    exact[x < 1e-3] = -0.5 + x[x < 1e-3] / 3
    assert np.array(dr.grad(leaf)) == pytest.approx(exact, rel=3e-5, abs=1e-30)


# ---- Linear density against slow oracles --------------------------------------


def slow_linear(
    density: np.ndarray, t: np.ndarray, near: float, far: float
) -> tuple[np.ndarray, float]:
    """Weights and opacity of one ray in float64, half a gap at a time."""
    weights, tau = np.zeros(len(t)), 0.0
    knots = np.concatenate([[near], t, [far]])
    sigma = np.concatenate([density[:1], density, density[-1:]])
    owner = np.clip(np.arange(len(knots)) - 1, 0, len(t) - 1)
    for i in range(len(knots) - 1):
        for here, there in ((i, i + 1), (i + 1, i)):
            width = (knots[i + 1] - knots[i]) / 2
            parts = width * 0.75 * sigma[here], width * 0.25 * sigma[there]
            inside = parts[0] + parts[1]
            if inside > 0:
                gained = math.exp(-tau) * -math.expm1(-inside)
                weights[owner[here]] += gained * parts[0] / inside
                weights[owner[there]] += gained * parts[1] / inside
            tau += inside
    return weights, -math.expm1(-tau)


RAYS, SAMPLES = 4, 12
exponents = st.lists(
    st.just(-math.inf) | st.floats(-12, 12), min_size=RAYS * SAMPLES, max_size=RAYS * SAMPLES
)


@pytest.mark.slow
@given(exponents=exponents, seed=st.integers(0, 99), scale=st.sampled_from([1e-3, 1.0, 1e4]))
def test_any_medium(ad: Any, exponents: list[float], seed: int, scale: float) -> None:
    """Densities of 0 and 1e-12 to 1e12 in any order, samples anywhere, scenes of any size."""
    rng = np.random.default_rng(seed)
    density = (10.0 ** np.array(exponents)).astype(np.float32)
    near, far = (scale * np.full(RAYS, x, np.float32) for x in (1, 3))
    t = np.sort(rng.uniform(near[:, None], far[:, None], (RAYS, SAMPLES)), axis=1)
    t = t.astype(np.float32)
    emission = rng.random((3, RAYS * SAMPLES), np.float32)
    leaves = [ad.Float(density), *(ad.Float(channel) for channel in emission)]
    dr.enable_grad(leaves)
    ends = ad.Float(near), ad.Float(far)
    seen = composite(leaves[0], leaves[1:], ad.Float(t.ravel()), None, SAMPLES, LINEAR, ends)
    weights, opacity = np.array(seen.weights).reshape(RAYS, -1), np.array(seen.opacity)
    assert (weights >= 0).all() and (opacity >= 0).all() and (opacity <= 1).all()
    assert weights.sum(axis=1, dtype=float) == pytest.approx(opacity, rel=1e-5, abs=1e-30)
    for r in range(RAYS):
        part = slice(r * SAMPLES, (r + 1) * SAMPLES)
        args = (v.astype(float) for v in (density[part], t[r]))
        w, alpha = slow_linear(*args, float(near[r]), float(far[r]))
        # Widths are differences of parameters: off by an ulp of those.
        assert weights[r] == pytest.approx(w, rel=1e-3, abs=1e-5 * alpha)
        assert opacity[r] == pytest.approx(alpha, rel=1e-3, abs=1e-30)
        color = emission[:, part] @ weights[r].astype(float)
        assert [c[r] for c in seen.color] == pytest.approx(color, rel=2e-5, abs=1e-30)
    dr.backward(sum(seen.color) + seen.opacity + seen.depth / scale)
    for leaf in leaves:
        assert np.isfinite(np.array(dr.grad(leaf))).all()


def test_transmittance_is_that_of_a_polygon(ad: Any) -> None:
    """Weights in front of each sample, against a march through interpolated densities."""
    rng = np.random.default_rng(1)
    near, far, samples = 1.0, 3.0, 9
    t, density = np.sort(rng.uniform(near, far, samples)), rng.uniform(0, 3, samples)
    fine = near + (far - near) * (np.arange(400_000) + 0.5) / 400_000
    sigma = np.interp(fine, t, density)
    opacity = -math.expm1(-sigma.mean() * (far - near))
    ends = ad.Float64(near), ad.Float64(far)
    weights, found = linear_weights(ad.Float64(density), ad.Float64(t), *ends, samples)
    assert found[0] == pytest.approx(opacity, rel=1e-9)
    # In thin media a sample's share is ∫ hat(t) dt times its density.
    thin, _ = linear_weights(ad.Float64(1e-6 * density), ad.Float64(t), *ends, samples)
    hats = np.stack([np.interp(fine, t, row) for row in np.eye(samples)])
    expected = 1e-6 * density * hats.mean(axis=1) * (far - near)
    assert np.array(thin) == pytest.approx(expected, rel=1e-4)
    # Light that is linear between samples, σc, in a medium that hides some of it.
    color = rng.random(samples)
    through = np.exp(-(np.cumsum(sigma) - sigma / 2) * (far - near) / len(fine))
    light = np.interp(fine, t, density * color)
    exact = (through * light).mean() * (far - near)
    assert color @ np.array(weights) == pytest.approx(exact, rel=5e-3)


def test_both_rules_see_the_same_opacity(ad: Any) -> None:
    rng = np.random.default_rng(2)
    t = ad.Float(np.sort(rng.uniform(1, 2, (30, 20)), axis=1).ravel())
    near, far = ad.Float(np.full(30, 1)), ad.Float(np.full(30, 2))
    density = ad.Float(rng.exponential(1, 600))
    _, linear = linear_weights(density, t, near, far, 20)
    _, cells = sample_weights(density, cell_widths(t, near, far, 20), 20)
    assert np.array(linear) == pytest.approx(np.array(cells), rel=1e-5)


def test_samples_in_empty_space_have_no_colour(ad: Any) -> None:
    """They need not have been looked at; an opaque wall keeps its own colour."""
    density, t = ad.Float([0, 0, 1e5, 1e5, 0]), ad.Float([1, 2, 3, 4, 5])
    ends = ad.Float(0.5), ad.Float(5.5)
    color = ad.Float([np.nan, 9, 0.25, 0.25, 9])
    weights, _ = linear_weights(density, t, *ends, 5)
    assert np.array(weights)[[0, 1, 4]] == pytest.approx(0, abs=0)
    assert float(dr.sum(weights * dr.select(density > 0, color, 0))[0]) == pytest.approx(0.25)


@pytest.mark.parametrize("samples", [1, 2, 7])
def test_a_slab_is_exact(ad: Any, samples: int) -> None:
    t, _ = stratified(ad.Float64(0), ad.Float64(1.5), samples)
    weights, opacity = linear_weights(
        dr.full(ad.Float64, 4, samples), t, ad.Float64(0), ad.Float64(1.5), samples
    )
    assert opacity[0] == pytest.approx(-math.expm1(-6), rel=1e-12)
    assert float(dr.sum(weights)[0]) == pytest.approx(opacity[0], rel=1e-12)


def test_nan_is_not_hidden(ad: Any) -> None:
    t, ends = ad.Float([1, 2, 1, 2]), (ad.Float([0, 0]), ad.Float([3, 3]))
    seen = composite(ad.Float([1, np.nan, 1, 1]), [ad.Float(1)], t, None, 2, LINEAR, ends)
    assert np.isnan([seen.color[0][0], seen.opacity[0]]).all()
    assert np.isfinite([seen.color[0][1], seen.opacity[1]]).all()


# ---- Derivatives ------------------------------------------------------------


def test_gradients_against_finite_differences(ad: Any) -> None:
    """Every density and emission; the loss weighs colour, opacity and depth."""
    rng = np.random.default_rng(4)
    density = 10 ** rng.uniform(-3, 1.5, 40)
    density[[0, 1, 17, 39]] = 0
    emission, t = rng.random((3, 40)), np.sort(rng.uniform(1, 4, (4, 10))).ravel()
    mix, ends = rng.normal(size=(5, 4)), (dr.full(ad.Float64, 0.9, 4), dr.full(ad.Float64, 4.2, 4))

    def loss(x: Any) -> Any:
        """One for each ray, from the 160 numbers of density and emission."""
        index = dr.arange(ad.UInt32, 40)
        values = [dr.gather(ad.Float64, x, index + 40 * i) for i in range(4)]
        seen = composite(values[0], values[1:], ad.Float64(t), None, 10, LINEAR, ends)
        outputs = [*seen.color, seen.opacity, seen.depth]
        return sum(ad.Float64(m) * output for m, output in zip(mix, outputs, strict=True))

    start, step = np.concatenate([density, *emission]), 1e-5
    x = ad.Float64(start)
    dr.enable_grad(x)
    dr.backward(loss(x))
    numeric = []
    for i in range(len(start)):
        moved = [start + sign * step * np.eye(160)[i] for sign in (1, -1)]
        high, low = (np.array(loss(ad.Float64(m))).sum() for m in moved)
        numeric.append((high - low) / (2 * step))
    assert np.array(dr.grad(x)) == pytest.approx(np.array(numeric), rel=1e-6, abs=1e-8)


def test_gradient_in_empty_space(ad: Any) -> None:
    """Where nothing is, ∂opacity/∂σ is the width of the cell and ∂C/∂σ that times c."""
    density, t = dr.zeros(ad.Float, 3), ad.Float([1, 2, 4])
    dr.enable_grad(density)
    ends = ad.Float(0), ad.Float(5)
    seen = composite(density, [ad.Float([1, 2, 3])], t, None, 3, LINEAR, ends)
    dr.backward(seen.color[0])
    assert list(dr.grad(density)) == pytest.approx([1.5 * 1, 1.5 * 2, 2 * 3])


@pytest.mark.parametrize("wall", [1e2, 1e4, 1e6, 1e30])
def test_gradients_around_an_opaque_wall(ad: Any, wall: float) -> None:
    """Nothing is learnt behind it, fog in front is, and all of it is finite."""
    density = ad.Float([0.5, 0.5, wall, wall, 0.5])
    color = ad.Float([1.0, 1.0, 0.25, 0.0, 8.0])
    dr.enable_grad(density, color)
    ends = ad.Float(0.5), ad.Float(5.5)
    seen = composite(density, [color], ad.Float([1, 2, 3, 4, 5]), None, 5, LINEAR, ends)
    dr.backward(seen.color[0])
    slopes = np.array([np.array(dr.grad(density)), np.array(dr.grad(color))])
    assert np.isfinite(slopes).all()
    assert slopes[0, 0] > 0.1 and slopes[1, :3].sum() == pytest.approx(1, rel=1e-5)
    assert slopes[:, 4] == pytest.approx(0, abs=1e-20)


# ---- Fields with known integrals ----------------------------------------------


SMOOTH = {
    "fog": {"height": 0.45, "axis": (0.3, -0.4, 1.1)},
    "gaussian": {"width": 0.25, "peak": 6.0, "extent": 4.0},
    "step": {"edge": 0.4},
    "shell": {"density": 4.0, "edge": 0.15},
}
JUMPS = {"step": {"edge": 0.0}, "sheet": {"width": 0.3, "edge": 0.0}, "shell": {"edge": 0.0}}


def errors(
    ad: Any, kind: str, values: dict[str, Any], rule: str, samples: int, jitter: bool = False
) -> tuple[float, float]:
    """Root mean squares over rays: of opacity, and of depth in scene units.

    Depth is the integral of an emission t by the opacity. With samples in the middle of
    their strata, opacities of all rules are the same.
    """
    field, rng = closed_form(kind, values, ad.TensorXf64), np.random.default_rng(0)
    o = 3 * unit(rng.normal(size=(200, 3)))
    d = unit(rng.uniform(-0.3, 0.3, (200, 3)) - o)
    march = MarchSettings(samples=samples, rule=rule)
    rays = vectors(ad, o, "64"), vectors(ad, d, "64")
    offsets = ad.Float64(rng.random(200 * samples)) if jitter else None
    placed = place_samples(MarchedField(field, march), *rays, jitter=offsets)
    seen = integrate(Evaluation(field, placed, 1 << 16), placed)
    v, lines = oracle.values_of(field.config), oracle.Rays.in_box(o, d, field.lower, field.upper)
    found = np.array([np.array(seen.opacity), np.array(seen.depth)])
    error = found - oracle.seen(kind, v, lines).T[3:]
    opacity, depth = np.sqrt(np.mean(error**2, axis=1))
    return float(opacity), float(depth)


def order(ad: Any, *case: Any, jitter: bool = False) -> tuple[float, float]:
    """How fast depth converges from 64 to 512 samples, and its error at 64."""
    coarse, fine = (errors(ad, *case, samples, jitter)[1] for samples in (64, 512))
    return math.log(coarse / fine) / math.log(8), coarse


@pytest.mark.slow
@pytest.mark.parametrize("kind", SMOOTH)
def test_linear_density_is_of_second_order_too_and_no_better(ad: Any, kind: str) -> None:
    """The error of a polygon through the samples is twice that of steps, of opposite sign."""
    found = {rule: order(ad, kind, SMOOTH[kind], rule) for rule in RULES}
    for slope, _ in found.values():
        assert slope == pytest.approx(2, abs=0.3)
    error = {rule: at_64 for rule, (_, at_64) in found.items()}
    assert error["cells"] == pytest.approx(error["constant"], rel=1e-6)
    assert error["constant"] < error["linear"] < 4 * error["constant"]


@pytest.mark.slow
@every_rule
@pytest.mark.parametrize("kind", JUMPS)
def test_jumps_converge_with_the_step(ad: Any, kind: str, rule: str) -> None:
    slope, error = order(ad, kind, JUMPS[kind], rule)
    assert slope == pytest.approx(1, abs=0.4) and error < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("kind", SMOOTH)
def test_jittered_samples(ad: Any, kind: str) -> None:
    """Strata that are taken for their samples converge with step^1.5, cells with step²."""
    found = {rule: order(ad, kind, SMOOTH[kind], rule, jitter=True) for rule in RULES}
    assert found["constant"][0] == pytest.approx(1.5, abs=0.25)
    assert found["cells"][0] == pytest.approx(2, abs=0.35)
    assert found["linear"][0] == pytest.approx(2, abs=0.35)
    assert found["cells"][1] < 0.8 * found["constant"][1]


@every_rule
@pytest.mark.parametrize("scale", [1e-3, 1e4])
def test_the_unit_of_length_does_not_matter(ad: Any, rule: str, scale: float) -> None:
    """A scene and its model at another scale: the same picture."""
    images = []
    for s in (1.0, scale):
        numbers = {"inner": 0.4 * s, "outer": 0.6 * s, "edge": 0.1 * s, "density": 5 / s}
        field = closed_form("shell", numbers, ad.TensorXf)
        o, d = vectors(ad, [(s, 2 * s, 0)] * 50), unit([(-1, -2, 0.02 * i) for i in range(50)])
        jitter = ad.Float(np.random.default_rng(0).random(50))
        march = MarchSettings(samples=40, rule=rule)
        seen = render_rays(MarchedField(field, march), o, vectors(ad, d), jitter=jitter)
        images.append([np.array(seen.opacity), np.array(seen.color[0]), np.array(seen.depth) / s])
    assert images[1][0].max() > 0.5
    assert np.array(images[1]) == pytest.approx(np.array(images[0]), rel=2e-4, abs=2e-5)


@pytest.mark.usefixtures("short_rounds")
@every_rule
def test_rays_that_end_early(ad: Any, rule: str) -> None:
    """They lose less than ``stop`` of the opacity, and ask less often."""
    field = closed_form("fog", {"density": 30.0}, ad.TensorXf)
    d = unit(np.random.default_rng(3).normal(size=(64, 3)) - (0, 0, 3))
    rays = vectors(ad, [(0, 0, 0.9)] * 64), vectors(ad, d)
    march = MarchSettings(samples=64, rule=rule)
    all_of_it = render_rays(MarchedField(field, march), *rays)
    ended = render_rays(MarchedField(field, replace(march, stop=0.01)), *rays)
    assert ended.queries < 0.8 * all_of_it.queries
    lost = np.array(all_of_it.opacity) - np.array(ended.opacity)
    assert (np.abs(lost) < 0.01).all() and lost.max() > 1e-6


# ---- Where rules are chosen ---------------------------------------------------


@pytest.mark.slow
def test_refined_samples_keep_the_rule(ad: Any) -> None:
    field = closed_form("gaussian", {}, ad.TensorXf)
    o, d = vectors(ad, [(0, 0, -3)]), vectors(ad, [(0, 0, 1)])
    first = place_samples(MarchedField(field, MarchSettings(samples=8, rule="linear")), o, d)
    more = refine(first, integrate(Evaluation(field, first, 64), first).weights, 24)
    found = integrate(Evaluation(field, more, 64), more)
    expected, _ = linear_weights(
        Evaluation(field, more, 64).density, more.t, more.near, more.far, 32
    )
    assert np.array(found.weights) == pytest.approx(np.array(expected))


@every_rule
@pytest.mark.parametrize("fine", [0, 16])
def test_widths_are_those_between_the_ends(rule: str, fine: int) -> None:
    """Also of samples refined, which lie in no equal strata any more; near the origin."""
    field, rng = AnalyticField(uniform(1.0)), np.random.default_rng(3)
    o, d = vectors(AD, np.full((9, 3), 0.1)), vectors(AD, unit(rng.normal(size=(9, 3))))
    march = MarchSettings(samples=12, rule=rule)
    placed = place_samples(MarchedField(field, march), o, d, jitter=AD.Float(rng.random(9 * 12)))
    if fine:
        placed = refine(placed, AD.Float(rng.random(9 * 12)), fine)
    ends = np.array(placed.edges()).reshape(9, 13 + fine)
    t, delta = (np.array(x).reshape(9, 12 + fine) for x in (placed.t, placed.delta))
    assert np.diff(ends) == pytest.approx(delta, abs=1e-6)
    assert np.all((ends[:, :-1] <= t) & (t <= ends[:, 1:]))
    assert ends[:, 0] == pytest.approx(placed.near.numpy()) and delta.min() >= 0
    equal = delta == pytest.approx(np.broadcast_to(delta[:, :1], delta.shape), rel=1e-5)
    assert equal == (rule == "constant" and not fine)


@pytest.mark.slow
@pytest.mark.parametrize("rule", ["cells", "linear"])
def test_training(blob: Path, rule: str) -> None:
    """The loss of a step is that of the rule; a small field learns."""
    config = small(f"sampling.rule={rule}")
    trainer = Trainer(config, load_dataset(blob, "train"), AD)
    assert trainer.march_settings().rule == rule
    first = float(trainer.step(1e-2).mse[0])
    for _ in range(100):
        result = trainer.step(1e-2)
    assert float(result.mse[0]) < 0.3 * first


def test_unknown_rules() -> None:
    with pytest.raises(ValueError, match="rule='cubic', expected constant or cells or linear"):
        MarchSettings(rule="cubic")  # type: ignore[arg-type]


def test_field_files_remember_the_rule(tmp_path: Path) -> None:
    path = small_file(tmp_path)
    contents = load_field(path)
    save_field(path, replace(contents, march=replace(contents.march, rule="linear")))
    assert load_field(path).march.rule == "linear"


@pytest.mark.slow
def test_the_rule_of_a_scene(tmp_path: Path) -> None:
    """The integrator's, or else the file's; an image of each differs from the others."""
    mi.set_variant(VARIANT)
    path = small_file(tmp_path, samples=6)

    def image(**integrator: Any) -> np.ndarray:
        return np.array(mi.render(mi.load_dict(scene_dict(path, integrator=integrator)), seed=1))

    images = {rule: image(rule=rule) for rule in RULES}
    contents = load_field(path)
    for rule in RULES:
        save_field(path, replace(contents, march=replace(contents.march, rule=rule)))
        assert image() == pytest.approx(images[rule])
        for other in RULES:
            assert rule == other or np.abs(images[rule] - images[other]).max() > 1e-4
            assert images[rule] == pytest.approx(images[other], abs=0.2)
