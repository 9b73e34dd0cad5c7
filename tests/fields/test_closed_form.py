"""Fields given by formulas: against an oracle in float64, and from XML."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mi_nerf.base.variants import array_module, choose_variant
from mi_nerf.cli import main
from mi_nerf.fields.closed_form import CLOSED_FORMS, ClosedFormField, closed_form
from mi_nerf.fields.protocol import Field
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.placing import place_samples
from mi_nerf.march.quadrature import integrate
from mi_nerf.march.query import Evaluation
from mi_nerf.march.render import render_rays
from mi_nerf.march.settings import MarchSettings
from tests.support import closed_forms as oracle
from tests.support.arrays import unit, vectors
from tests.support.fields import weight_keys

VARIANT = choose_variant()
BACKEND = array_module(VARIANT)

GLOW, AXIS, CENTER = (1.2, 0.5, 0.3), (0.3, -0.4, 1.1), (0.1, 0.05, -0.1)
PLANE = {"axis": AXIS, "position": 0.1, "radiance": GLOW}

# No number at its default, no two of them alike in their effect.
VALUES: dict[str, dict[str, Any]] = {
    "slab": {"density": 1.3, "radiance": GLOW},
    "two_color": {"density": 1.3, "axis": AXIS, "radiance": GLOW, "opposite": (0.2, 0.4, 0.9)},
    "fog": {**PLANE, "density": 1.3, "height": 0.45},
    "ramp": {**PLANE, "density": 0.7, "slope": 2.0},
    "step": {**PLANE, "before": 0.5, "beyond": 3.0, "edge": 0.15},
    "sheet": {**PLANE, "thickness": 1.1, "width": 0.3, "edge": 0.12},
    "gaussian": {"center": CENTER, "width": 0.25, "peak": 6.0, "radiance": GLOW, "extent": 4.0},
    "shell": {
        **{"center": CENTER, "inner": 0.4, "outer": 0.7, "edge": 0.12},
        **{"density": 4.0, "radiance": GLOW},
    },
}
JUMPS = {kind: {**VALUES[kind], "edge": 0.0} for kind in ("step", "sheet", "shell")}

every_kind = pytest.mark.parametrize("kind", VALUES)


def test_every_kind_is_tested() -> None:
    assert set(VALUES) == set(CLOSED_FORMS) == set(oracle.FORMULAS)


def directed(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays from all around; the first from within, along the axis, across it, past it all."""
    rng = np.random.default_rng(0)
    o = 3 * unit(rng.normal(size=(count, 3)))
    d = rng.uniform(-0.6, 0.6, (count, 3)) - o
    o[0], d[0] = (0.1, 0.2, 0.3), (-0.3, 0.5, 0.7)
    o[1], d[1] = (0.1, 0.2, -3), (0, 0, 1)
    o[2], d[2] = (-2.2, 0.05, 0.6), (1.1, 0, -0.3)  # stays at one distance from the plane
    o[3], d[3] = (3, 3, 3), (1, 0, 0)
    return o, unit(d)


def within(field: ClosedFormField, o: np.ndarray, d: np.ndarray) -> oracle.Rays:
    return oracle.Rays.in_box(o, d, field.lower, field.upper)


def case(values: dict[str, Any], kind: str, count: int = 12) -> tuple[Any, oracle.Rays]:
    """The numbers of a field, and rays through its box."""
    field = closed_form(kind, values, BACKEND.TensorXf64)
    return oracle.values_of(field.config), within(field, *directed(count))


# ---- The oracle itself ------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("dense", [1e-6, 1, 30])
@every_kind
def test_oracle_against_a_march(kind: str, dense: float) -> None:
    """Brute force, which converges with the square of the step: off by 3e-7 at worst, here."""
    v, rays = case(VALUES[kind], kind)
    amounts = ("density", "before", "beyond", "thickness", "peak", "slope")
    v = {name: x * dense if name in amounts else x for name, x in v.items()}
    exact = oracle.seen(kind, v, rays)
    marched = oracle.marched(kind, v, rays, 20_000)
    assert exact[:, 3:] == pytest.approx(marched[:, 3:], abs=1e-6)
    assert exact[:, :4] == pytest.approx(marched[:, :4], rel=1e-6, abs=1e-7 * min(dense, 1))
    assert (exact[3] == 0).all() and (exact[:3, 3] > 0).any()


@every_kind
def test_integral_of_the_oracle_has_converged(kind: str) -> None:
    v, rays = case(VALUES[kind], kind)
    few, many = (oracle.seen(kind, v, rays, panels) for panels in (4, 16))
    assert few == pytest.approx(many, rel=1e-13, abs=1e-13)


def test_oracle_of_a_slab() -> None:
    """The mean of t under σ·exp(−σt) on [0, L] is 1/σ − L/(exp(σL) − 1)."""
    v, rays = case(VALUES["slab"], "slab")
    sigma, length = 1.3, (rays.far - rays.near)[:3]
    seen = oracle.seen("slab", v, rays)[:3]
    assert seen[:, 3] == pytest.approx(-np.expm1(-sigma * length), rel=1e-14)
    depth = rays.near[:3] + 1 / sigma - length / np.expm1(sigma * length)
    assert seen[:, 4] == pytest.approx(depth, rel=1e-13)


def test_oracle_of_a_ramp() -> None:
    """With σ = kt on [0, L], ∫ T dt = √(π/2k) · erf(L·√(k/2))."""
    numbers = {"density": 0.0, "slope": 3.0, "axis": (0.0, 0.0, 2.0), "position": -1.0}
    v, rays = case(numbers, "ramp", 5)
    (ray,) = np.flatnonzero(rays.d[:, 2] == 1)
    k, length, end = 3.0, 2.0, math.exp(-6)
    integral = math.sqrt(math.pi / (2 * k)) * math.erf(length * math.sqrt(k / 2))
    depth = 2 + (integral - length * end) / (1 - end)
    assert oracle.seen("ramp", v, rays)[ray, 3:] == pytest.approx([1 - end, depth], rel=1e-13)


def test_oracle_of_a_gaussian() -> None:
    """All of a line has the optical depth peak · width · √(2π) · exp(−b²/2 width²)."""
    b, width = np.array([0.0, 0.5, 1.0, 2.0]) * 0.25, 0.25
    d = unit([[0.3, -0.8, 0.5]] * 4)
    o = np.array(CENTER) - 3 * d + b[:, None] * unit([[0.8, 0.3, 0]])
    rays = oracle.Rays(o, d, np.zeros(4), np.full(4, 6.0))
    v = oracle.values_of(closed_form("gaussian", VALUES["gaussian"], BACKEND.TensorXf64).config)
    tau = 6 * width * math.sqrt(2 * math.pi) * np.exp(-0.5 * (b / width) ** 2)
    assert oracle.seen("gaussian", v, rays)[:, 3] == pytest.approx(-np.expm1(-tau), rel=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "values"), [*VALUES.items(), *JUMPS.items()], ids=[*VALUES, *map("{}-0".format, JUMPS)]
)
def test_slopes_of_the_oracle(kind: str, values: dict[str, Any]) -> None:
    """Complex steps against central differences, where jumps are too."""
    v, rays = case(values, kind)
    h = 1e-6
    for name, slope in oracle.slopes(kind, v, rays).items():
        if name == "edge" and not v[name]:
            continue  # there is nothing below 0
        for i, entry in enumerate(np.eye(len(v[name]))):
            high, low = (
                oracle.seen(kind, {**v, name: v[name] + sign * h * entry}, rays) for sign in (1, -1)
            )
            assert slope[..., i] == pytest.approx((high - low) / (2 * h), abs=1e-7), name


# ---- Fields at points -------------------------------------------------------

signed, positive, share = st.floats(-1, 1), st.floats(0.05, 2), st.floats(0, 1)
amount = st.just(0.0) | st.floats(1e-3, 30)
color, point = st.tuples(*[st.floats(0, 5)] * 3), st.tuples(*[signed] * 3)
axis = point.filter(lambda a: math.hypot(*a) > 0.1)


def numbers(**own: Any) -> st.SearchStrategy[dict[str, Any]]:
    return st.fixed_dictionaries({"radiance": color, **own})


def plane(**own: Any) -> st.SearchStrategy[dict[str, Any]]:
    return numbers(axis=axis, position=st.floats(-0.5, 0.5), **own)


def with_edge(values: dict[str, Any]) -> dict[str, Any]:
    """An edge of 0, or a part of the greatest that there may be."""
    values = dict(values)
    if "inner" in values:
        values["outer"] += values["inner"]
        most = min(values["outer"] - values["inner"], 2 * values["inner"])
    else:
        most = values["width"]
    return {**values, "edge": values["edge"] * most}


edge = st.just(0.0) | st.floats(0.1, 1)
RANDOM = {
    "slab": numbers(density=amount),
    "two_color": numbers(density=amount, axis=axis, opposite=color),
    "fog": plane(density=amount, height=positive),
    "ramp": plane(density=amount, slope=st.floats(-9, 9)),
    "step": plane(before=amount, beyond=amount, edge=edge),
    "sheet": plane(thickness=amount, width=st.floats(0.01, 0.4), edge=edge).map(with_edge),
    "gaussian": numbers(center=point, width=positive, peak=amount),
    "shell": numbers(
        center=point, inner=st.floats(0.1, 1), outer=positive, density=amount, edge=edge
    ).map(with_edge),
}


@pytest.mark.slow
@settings(derandomize=True, max_examples=50)
@given(data=st.data(), seed=st.integers(0, 999))
@every_kind
def test_any_field_at_any_point(ad: Any, kind: str, data: st.DataObject, seed: int) -> None:
    """Density and emission with any numbers."""
    field = closed_form(kind, data.draw(RANDOM[kind]), ad.TensorXf64)
    assert isinstance(field, Field)
    rng = np.random.default_rng(seed)
    p = rng.uniform(field.lower, field.upper, (64, 3))
    d = unit(rng.normal(size=(64, 3)))
    density, emission = field.density_emission(vectors(ad, p, "64"), vectors(ad, d, "64"))
    v = oracle.values_of(field.config)
    exact = oracle.density(kind, v, p)
    assert np.array(density) == pytest.approx(exact, rel=1e-9, abs=1e-9)
    assert np.array(field.density(vectors(ad, p, "64"))) == pytest.approx(np.array(density))
    assert np.array(emission).T == pytest.approx(oracle.radiance(kind, v, d), rel=1e-12, abs=1e-14)


@every_kind
def test_single_precision(ad: Any, kind: str) -> None:
    field = closed_form(kind, VALUES[kind], ad.TensorXf)
    rng = np.random.default_rng(1)
    p = rng.uniform(field.lower, field.upper, (1000, 3)).astype(np.float32)
    v = oracle.values_of(field.config)
    exact = oracle.density(kind, v, p.astype(float))
    assert np.array(field.density(vectors(ad, p))) == pytest.approx(exact, rel=2e-6, abs=2e-5)


@every_kind
def test_defaults_lie_within_the_unit_cube(ad: Any, kind: str) -> None:
    field = closed_form(kind, {}, ad.TensorXf)
    assert min(field.lower) >= -1 and max(field.upper) <= 1
    p = np.random.default_rng(0).uniform(field.lower, field.upper, (4000, 3))
    assert oracle.density(kind, oracle.values_of(field.config), p).max() > 0


def test_slopes_in_the_centre_of_a_shell_are_finite(ad: Any) -> None:
    """An optimiser may shrink it until it is dense there, where |p| has no derivative."""
    field = closed_form("shell", {"edge": 0.2}, ad.TensorXf)
    field.parameters()["inner"][:] = 0.05
    p = vectors(ad, [(0, 0, 0)])
    dr.enable_grad(field.parameters(), p)
    density = field.density(p)
    dr.backward(density)
    assert density[0] > 0
    for leaf in (p, *field.parameters().values()):
        assert np.isfinite(np.array(dr.grad(leaf))).all()


def test_fog_does_not_overflow(ad: Any) -> None:
    """1/height is 1000: below the plane are densities of exp(1000)."""
    field = closed_form("fog", {"height": 1e-3}, ad.TensorXf)
    dr.enable_grad(field.parameters())
    density = field.density(ad.Array3f(0, 0, [-1, 1]))
    assert 1e20 < density[0] < 1e30 and density[1] == 0
    dr.backward(density)
    for tensor in field.parameters().values():
        assert np.isfinite(np.array(dr.grad(tensor))).all()


# ---- Quadrature -------------------------------------------------------------


def quadrature_errors(
    ad: Any, kind: str, values: dict[str, Any], samples: int, count: int
) -> np.ndarray:
    """Root mean square error of radiance, opacity and depth over many rays."""
    field = closed_form(kind, values, ad.TensorXf64)
    o, d = directed(count)
    image = render_rays(
        MarchedField(field, MarchSettings(samples=samples)),
        vectors(ad, o, "64"),
        vectors(ad, d, "64"),
    )
    found = np.array([*map(np.array, image.color), np.array(image.opacity), np.array(image.depth)])
    exact = oracle.seen(kind, oracle.values_of(field.config), within(field, o, d)).T
    error = np.sqrt(np.mean((found - exact) ** 2, axis=1))
    return np.array([error[:3].max(), error[3], error[4]])


@pytest.mark.slow
@every_kind
def test_quadrature_converges_with_the_square_of_the_step(ad: Any, kind: str) -> None:
    """Radiance, opacity, depth; a constant density is integrated without error."""
    coarse, fine = (quadrature_errors(ad, kind, VALUES[kind], s, 64) for s in (64, 256))
    order = np.log(coarse[2] / fine[2]) / math.log(4)
    assert fine[2] < 1e-4 and order == pytest.approx(2, abs=0.3)
    if kind in ("slab", "two_color"):
        assert coarse[:2].max() < 1e-14
    else:
        order = np.log(coarse[:2] / fine[:2]) / math.log(4)
        assert fine[:2].max() < 1e-4 and order == pytest.approx(2, abs=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", JUMPS)
def test_jumps_converge_with_the_step(ad: Any, kind: str) -> None:
    """The interval that holds the jump has an error of its length."""
    coarse, fine = (quadrature_errors(ad, kind, JUMPS[kind], s, 256) for s in (64, 1024))
    assert np.log(coarse / fine) / math.log(16) == pytest.approx(1, abs=0.25)
    assert fine.max() < 1e-3


def gradient(ad: Any, field: ClosedFormField, mix: np.ndarray, samples: int) -> np.ndarray:
    """Derivatives with respect to all numbers of a loss that weighs all outputs of all rays."""
    o, d = (vectors(ad, v, "64") for v in directed(mix.shape[1]))
    placed = place_samples(MarchedField(field, MarchSettings(samples=samples)), o, d)
    for tensor in field.parameters().values():
        dr.enable_grad(tensor)
        dr.clear_grad(tensor)
    evaluation = Evaluation(field, placed, 16384, keep=True)
    evaluation.enable_grad()
    seen = integrate(evaluation, placed)
    outputs = [*seen.color, seen.opacity, seen.depth]
    dr.backward(sum(dr.sum(ad.Float64(m) * out) for m, out in zip(mix, outputs, strict=True)))
    evaluation.backward()
    return np.concatenate([np.array(dr.grad(tensor)) for tensor in field.parameters().values()])


@pytest.mark.slow
@every_kind
def test_gradients_of_the_quadrature(ad: Any, kind: str) -> None:
    """Every number's; they converge with the step where the slope of the density jumps."""
    field = closed_form(kind, VALUES[kind], ad.TensorXf64)
    mix = np.random.default_rng(2).normal(size=(5, 16))
    slopes = oracle.slopes(kind, oracle.values_of(field.config), within(field, *directed(16)))
    assert list(slopes) == list(field.parameters())
    expected = np.concatenate([np.einsum("or,roe->e", mix, slope) for slope in slopes.values()])
    coarse, fine = (gradient(ad, field, mix, samples) for samples in (512, 32768))
    smooth = kind in ("slab", "two_color", "fog", "gaussian")
    assert fine == pytest.approx(expected, rel=1e-6 if smooth else 1e-3, abs=0 if smooth else 2e-3)
    before, after = (np.linalg.norm(found - expected) for found in (coarse, fine))
    order = np.log(before / after) / math.log(64)
    assert order == pytest.approx(2 if smooth else 1, abs=0.1 if smooth else 0.4)


# ---- What is refused --------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "values", "message"),
    [
        ("gausian", {}, "field='gausian', expected slab, two_color, fog, .*, shell$"),
        ("gaussian", {"sigma": 1.0}, "'sigma' is no parameter of 'gaussian'"),
        ("slab", {"axis": (0.0, 0.0, 1.0)}, "'axis' is no parameter of 'slab'"),
        ("gaussian", {"width": 0.0}, "width=0.0, expected a number above 0"),
        ("gaussian", {"peak": -1.0}, "peak=-1.0, expected a number of 0 or more"),
        ("gaussian", {"extent": math.inf}, "extent=inf, expected a number above 0"),
        ("slab", {"density": math.nan}, "density=nan, expected a number of 0 or more"),
        ("slab", {"density": (1.0,)}, r"density=\(1.0,\), expected a number"),
        ("slab", {"density": True}, "density=True, expected a number"),
        ("slab", {"radiance": 1.0}, "radiance=1.0, expected three numbers of 0 or more"),
        ("slab", {"radiance": (1.0, 1.0)}, "expected three numbers of 0 or more"),
        ("slab", {"radiance": (1.0, -1.0, 1.0)}, "expected three numbers of 0 or more"),
        ("slab", {"lower": (0.0, 1.0, 0.0)}, r"upper=\(1.0, 1.0, 1.0\), expected numbers above"),
        ("two_color", {"opposite": (-1.0, 0.0, 0.0)}, "opposite=.*three numbers of 0 or more"),
        ("two_color", {"axis": (0.0, 0.0, 0.0)}, "axis=.*a vector of a length above 0"),
        ("fog", {"height": -1.0}, "height=-1.0, expected a number above 0"),
        ("ramp", {"slope": "steep"}, "slope='steep', expected a number$"),
        ("ramp", {"position": math.inf}, "position=inf, expected a number$"),
        ("step", {"before": -1.0}, "before=-1.0, expected a number of 0 or more"),
        ("step", {"edge": -0.1}, "edge=-0.1, expected a number of 0 or more"),
        ("sheet", {"edge": 0.1}, "edge=0.1, expected a number up to width=0.02"),
        ("sheet", {"position": 1.0}, "position=1.0, expected the sheet to lie within the box"),
        ("shell", {"inner": 0.6}, "inner=0.6, expected a number below outer=0.6"),
        ("shell", {"edge": 0.21}, "edge=0.21, expected a number up to 0.2"),
        ("shell", {"inner": 0.01}, "edge=0.05, expected a number up to 0.02"),
    ],
)
def test_bad_formulas(kind: str, values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        closed_form(kind, values, BACKEND.TensorXf)


def test_widest_edges_are_accepted() -> None:
    """Those at which the layers are nothing but slopes; 0.6 − 0.4 is a little below 0.2."""
    closed_form("shell", {"edge": 0.2}, BACKEND.TensorXf)
    closed_form("sheet", {"edge": 0.02}, BACKEND.TensorXf)
    closed_form("sheet", {"axis": (1.0, 1.0, 0.0), "position": 1.2}, BACKEND.TensorXf)


# ---- In scenes --------------------------------------------------------------

PIXELS = (4, 3)


def scene_of(kind: str, **values: Any) -> Any:
    """A scene in which every pixel is one ray through its middle."""
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {
                **{"type": "nerf", "samples": 1024, "jitter": False},
                "aovs": "depth",
            },
            "sensor": {
                "type": "perspective",
                "fov": 30.0,
                "to_world": mi.ScalarTransform4f().look_at([1.5, -2.5, 1], [0, 0, 0], [0, 0, 1]),
                "film": {
                    **{"type": "hdrfilm", "width": PIXELS[0], "height": PIXELS[1]},
                    **{"pixel_format": "rgba", "rfilter": {"type": "box"}},
                },
                "sampler": {"type": "stratified", "sample_count": 1, "jitter": False},
            },
            "box": {
                "type": "cube",
                "bsdf": {"type": "null"},
                "interior": {"type": "nerfmedium", "field": kind, **values},
            },
        }
    )


def camera_rays(scene: Any) -> tuple[np.ndarray, np.ndarray]:
    """One through the middle of every pixel, row by row."""
    y, x = (np.indices(PIXELS[::-1]).reshape(2, -1) + 0.5) / np.array(PIXELS[::-1])[:, None]
    ray, _ = scene.sensors()[0].sample_ray(0, 0.5, mi.Point2f(x, y), mi.Point2f(0.5))
    return np.array(ray.o, float).T * np.ones((x.size, 1)), unit(np.array(ray.d).T)


@every_kind
def test_pixels(kind: str) -> None:
    """A scene with the numbers of this file, seen by Mitsuba."""
    mi.set_variant(VARIANT)
    scene = scene_of(kind, **VALUES[kind])
    image = np.array(mi.render(scene)).reshape(-1, 5)
    v, rays = case(VALUES[kind], kind)
    field = closed_form(kind, VALUES[kind], mi.TensorXf)
    rays = within(field, *camera_rays(scene))
    exact = oracle.seen(kind, v, rays)
    assert exact[:, 3].max() > 0.3 and np.ptp(exact[:, 3]) > 0.05
    assert image == pytest.approx(exact, rel=1e-3, abs=5e-4)
    names = {k.rsplit(".", 1)[1] for k in weight_keys(mi.traverse(scene))}
    assert names == set(v)


def test_numbers_of_other_types() -> None:
    """Integers, points and colours are what they seem to be."""
    mi.set_variant(VARIANT)
    rgb = {"type": "rgb", "value": [1.0, 0.5, 0.25]}
    medium = mi.load_dict(
        {"type": "nerfmedium", "field": "fog", "density": 3, "lower": [-1, -1, 0], "radiance": rgb}
    )
    assert medium.field.config.density == 3 and medium.field.lower == (-1, -1, 0)
    assert medium.field.config.radiance == (1, 0.5, 0.25)


BLOB = """<scene version="3.0.0"><integrator type="nerf"/>
    <sensor type="perspective"><float name="fov" value="20"/>
        <transform name="to_world">
            <lookat origin="0, -4, 0" target="0, 0, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="21"/><integer name="height" value="21"/>
            <string name="pixel_format" value="rgba"/><rfilter type="box"/></film>
    </sensor>
    <shape type="cube" id="box"><bsdf type="null"/>
        <medium type="nerfmedium" name="interior" id="blob">
            <string name="field" value="gaussian"/>
            <float name="width" value="0.2"/><float name="peak" value="12"/>
            <vector name="radiance" value="1.5, 0.5, 0.25"/>
        </medium></shape></scene>"""


@pytest.mark.slow
def test_from_xml() -> None:
    mi.set_variant(VARIANT)
    scene = mi.load_string(BLOB)
    image = np.array(mi.render(scene, spp=256))
    tau = 12 * 0.2 * math.sqrt(2 * math.pi)
    assert image[10, 10, 3] == pytest.approx(-math.expm1(-tau), abs=1e-3)
    assert image[10, 10, 0] == pytest.approx(1.5 * -math.expm1(-tau), rel=2e-3)
    assert image[0, 0, 3] == pytest.approx(0, abs=1e-2)
    params = mi.traverse(scene)
    params["box.interior_medium.radiance"] = mi.TensorXf([0.0, 1.0, 0.0])
    params.update()
    image = np.array(mi.render(scene, spp=16))
    assert image[10, 10, 0] == 0 and image[10, 10, 1] > 0.9


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name="peak"', 'name="top"', "'top' is no parameter of 'gaussian'"),
        ('value="gaussian"', 'value="box"', "field='box', expected slab, "),
        ('<float name="peak" value="12"/>', '<string name="peak" value="12"/>', "peak='12', exp"),
        ('<float name="peak" value="12"/>', '<vector name="peak" value="1"/>', "expected a number"),
        ("</medium>", '<string name="filename" value="a"/></medium>', "expected one of them"),
    ],
)
def test_bad_xml(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, message: str
) -> None:
    scene = tmp_path / "scene.xml"
    scene.write_text(BLOB.replace(old, new))
    assert main(["render", str(scene), "-o", str(tmp_path / "x.png")]) == 2
    line = capsys.readouterr().err
    assert message in line and line.count("\n") == 1
