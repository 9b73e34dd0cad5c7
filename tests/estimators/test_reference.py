"""The reference estimator: as exact as it says, on smooth fields and on others."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest

from mi_nerf.cameras.ndc import Ndc
from mi_nerf.estimators.reference import Reference, reference
from mi_nerf.fields.closed_form import closed_form
from mi_nerf.fields.neural import NeuralField
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.occupancy import OccupancyGrid
from mi_nerf.march.render import render_rays
from mi_nerf.march.settings import MarchSettings
from tests.fields.test_closed_form import JUMPS, VALUES, directed, within
from tests.support import closed_forms as oracle
from tests.support.analytic import AnalyticField, uniform
from tests.support.arrays import unit, vectors
from tests.support.fields import SMALL

CASES = [*VALUES.items(), *JUMPS.items()]
NAMES = [*VALUES, *map("{}-0".format, JUMPS)]
AMOUNTS = ("density", "before", "beyond", "thickness", "peak", "slope")

every_case = pytest.mark.parametrize(("kind", "values"), CASES, ids=NAMES)


def numbers(found: Any) -> np.ndarray:
    """Colour, opacity and depth, (R, 5), of a Reference or a RayImage."""
    color = found.color if isinstance(found, Reference) else np.transpose(found.color)
    return np.column_stack([color, np.array(found.opacity), np.array(found.depth)])


def denser(values: dict[str, Any], factor: float) -> dict[str, Any]:
    return {k: v * factor if k in AMOUNTS else v for k, v in values.items()}


# ---- Against closed forms ---------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("dense", [1e-5, 1, 30, 1000])
@every_case
def test_the_error_is_at_most_the_stated_one(
    ad: Any, kind: str, values: dict[str, Any], dense: float
) -> None:
    """Of every ray and channel; thin fog, opaque surfaces, bends and jumps included."""
    field = closed_form(kind, denser(values, dense), ad.TensorXf64)
    o, d = directed(150)
    found = reference(field, vectors(ad, o, "64"), vectors(ad, d, "64"), max_intervals=2048)
    exact = oracle.seen(kind, oracle.values_of(field.config), within(field, o, d))
    assert (np.abs(numbers(found) - exact) <= found.error + 1e-13).all()
    assert np.median(found.error[:, :4]) < 1e-3 and np.median(found.error[:, 4]) < 2e-2


@pytest.mark.slow
@every_case
def test_far_better_than_quadrature(ad: Any, kind: str, values: dict[str, Any]) -> None:
    """By single precision, where rounding is all that remains on smooth fields."""
    field = closed_form(kind, values, ad.TensorXf)
    rays = [v.astype(np.float32).astype(float) for v in directed(150)]
    o, d = (vectors(ad, v) for v in rays)
    exact = oracle.seen(kind, oracle.values_of(field.config), within(field, *rays))
    found = reference(field, o, d, max_intervals=1 << 13)
    error = np.abs(numbers(found) - exact)
    assert (error <= found.error + 1e-7).all()
    quadrature = np.abs(
        numbers(render_rays(MarchedField(field, MarchSettings(samples=64)), o, d)) - exact
    )
    for channels in (slice(3, 4), slice(4, 5)):
        rms, coarse = (np.sqrt(np.mean(e[:, channels] ** 2)) for e in (error, quadrature))
        assert rms < 1e-7 or rms < 0.02 * coarse


@pytest.mark.parametrize("kind", ["fog", "gaussian"])
def test_extrapolation_is_of_fourth_order(ad: Any, kind: str) -> None:
    """Twice as many intervals, a sixteenth of the error."""
    field = closed_form(kind, VALUES[kind], ad.TensorXf64)
    o, d = directed(64)
    exact = oracle.seen(kind, oracle.values_of(field.config), within(field, o, d))
    errors = []
    for first in (16, 32):
        found = reference(
            field,
            *(vectors(ad, v, "64") for v in (o, d)),
            intervals=first,
            max_intervals=4 * first,
        )
        assert set(found.intervals) == {4 * first}
        errors.append(np.sqrt(np.mean((numbers(found)[:, 3:] - exact[:, 3:]) ** 2)))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.5)


def test_differences_alone_would_be_fooled(ad: Any) -> None:
    """A jump beside the end of an interval of every N: all marches err alike."""
    values = {"before": 0.5, "beyond": 5.0, "edge": 0.0, "position": 1e-4}
    field = closed_form("step", values, ad.TensorXf64)
    o, d = np.array([[0.1, 0.2, -3.0]]), np.array([[0.0, 0.0, 1.0]])
    rays = [vectors(ad, v, "64") for v in (o, d)]
    marches = [
        np.array(render_rays(MarchedField(field, MarchSettings(samples=n)), *rays).opacity)
        for n in (256, 1024)
    ]
    exact = oracle.seen("step", oracle.values_of(field.config), within(field, o, d))[0, 3]
    found = reference(field, *rays, max_intervals=1024)
    true = abs(found.opacity[0] - exact)
    assert true > 1e6 * abs(marches[1] - marches[0])
    assert true <= found.error[0, 3] < 100 * true


def test_a_better_tolerance_takes_more_intervals(ad: Any) -> None:
    field = closed_form("shell", VALUES["shell"], ad.TensorXf64)
    o, d = directed(40)
    v, rays = oracle.values_of(field.config), within(field, o, d)
    exact = oracle.seen("shell", v, rays)
    counts = []
    for tolerance in (1e-3, 1e-5):
        found = reference(
            field, *(vectors(ad, x, "64") for x in (o, d)), tolerance=tolerance, intervals=32
        )
        assert found.error[:, :4].max() <= 1.001 * tolerance
        assert (found.error[:, 4] <= 1.001 * tolerance * (rays.far - rays.near) + 1e-12).all()
        assert np.abs(numbers(found) - exact)[:, :4].max() <= tolerance
        counts.append(found.intervals)
    assert (counts[0] <= counts[1]).all() and counts[0].mean() < 0.5 * counts[1].mean()


# ---- Other fields and rays ----------------------------------------------------


@pytest.mark.slow
def test_learned_field(ad: Any) -> None:
    """Against the same weights in double precision, marched very finely."""
    o, d = (v.astype(np.float32) for v in directed(24))
    field = NeuralField.create(SMALL, 3, ad.TensorXf)
    found = reference(field, vectors(ad, o), vectors(ad, d))
    double = NeuralField.create(SMALL, 3, ad.TensorXf64)
    settings = MarchSettings(samples=4096)
    exact = numbers(
        render_rays(MarchedField(double, settings), vectors(ad, o, "64"), vectors(ad, d, "64"))
    )
    error = np.abs(numbers(found) - exact)
    assert exact[:, 3].max() > 0.5
    assert (error <= found.error + 1e-6).all() and found.error[:, :4].max() < 2e-5


def test_normalised_device_coordinates(ad: Any) -> None:
    """Constant density along d': opacity and mean t' in closed form; emission sees d."""
    ndc = Ndc(1.4, 1.8)
    rng = np.random.default_rng(0)
    o = rng.uniform(-0.2, 0.2, (30, 3))
    d = unit(np.c_[rng.uniform(-0.4, 0.4, (30, 2)), -np.ones(30)])
    d[0] = (0, 0, 1)  # looks away
    field = AnalyticField(uniform(3.0), lambda p, d: [d.x, d.y, d.z], ndc=ndc)
    rays = [vectors(ad, v, "64") for v in (o, d)]
    found = reference(field, *rays)
    assert found.opacity[0] == found.depth[0] == found.error[0].max() == 0

    projected = ndc.rays(*rays)
    length = np.array(projected.length)[1:]
    opacity = -np.expm1(-3 * length)
    mean = 1 / 3 - length / np.expm1(3 * length)
    disparity = 1 - mean / length  # depth is n/(1 − t') behind the origin, along −z
    depth = (1 / disparity + o[1:, 2]) / -d[1:, 2]
    exact = np.column_stack([d[1:] * opacity[:, None], opacity, depth])
    assert (np.abs(numbers(found)[1:] - exact) <= found.error[1:] + 1e-12).all()
    assert found.error[1:].max() < 1e-4


@pytest.mark.slow
def test_bounds_and_blocks(ad: Any) -> None:
    """Numbers, arrays and none; results do not depend on how the work is divided."""
    field = closed_form("slab", {"density": 2.0}, ad.TensorXf)
    o, d = vectors(ad, [(0, 0, -3), (0.5, 0, -3)]), vectors(ad, [(0, 0, 1), (0, 0, 1)])
    for bounds, length in (
        ((None, None), [2, 2]),
        ((2.5, None), [1.5, 1.5]),
        ((2.5, 3), [0.5, 0.5]),
        ((ad.Float([0, 3.5]), ad.Float([3, dr.inf])), [1, 0.5]),
        ((None, 1), [0, 0]),
    ):
        found = reference(field, o, d, bounds=bounds)
        assert found.opacity == pytest.approx(-np.expm1(-2 * np.array(length)), rel=1e-6)
    fog = closed_form("fog", {}, ad.TensorXf)
    o, d = (vectors(ad, v) for v in directed(10))
    whole, parts = (reference(fog, o, d, block=b, tolerance=1e-4) for b in (16384, 100))
    assert numbers(whole) == pytest.approx(numbers(parts), rel=1e-6, abs=1e-7)


def test_cells_marked_as_empty_are_empty(ad: Any) -> None:
    """Three of seven along the ray, whose ends are no ends of intervals."""
    field = closed_form("slab", {"density": 0.9}, ad.TensorXf)
    cells = np.ones((1, 1, 7), bool)
    cells[..., [0, 3, 4]] = False
    grid = OccupancyGrid(field.lower, field.upper, cells, ad.Float)
    o, d = vectors(ad, [(0.1, 0.2, -3), (0.1, 0.2, 3)]), vectors(ad, [(0, 0, 1), (0, 0, -1)])
    found = reference(field, o, d, occupancy=grid, max_intervals=4096)
    exact = -np.expm1(-0.9 * 2 * 4 / 7)
    assert (np.abs(found.opacity - exact) <= found.error[:, 3]).all()
    assert found.error[:, 3].max() < 5e-3


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"tolerance": 0.0}, "tolerance=0.0, expected a number above 0"),
        ({"tolerance": float("nan")}, "tolerance=nan, expected"),
        ({"intervals": 4}, "intervals=4, expected at least 8"),
        ({"max_intervals": 128}, "max_intervals=128, expected at least 512"),
    ],
)
def test_bad_settings(ad: Any, settings: dict[str, Any], message: str) -> None:
    field = closed_form("slab", {}, ad.TensorXf)
    ray = vectors(ad, [(0, 0, -3)]), vectors(ad, [(0, 0, 1)])
    with pytest.raises(ValueError, match=message):
        reference(field, *ray, **settings)
