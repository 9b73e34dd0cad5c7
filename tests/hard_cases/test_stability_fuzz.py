"""Random rays, boxes, densities and sample counts: what must hold whatever they are.

Media are tables of random densities and colours over the cells of a box, so that neighbouring
samples may differ by 24 orders of magnitude. All that varies reaches the kernels as data.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mi_nerf.base.arrays import upload
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.placing import place_samples
from mi_nerf.march.quadrature import Composite, integrate
from mi_nerf.march.query import Evaluation
from mi_nerf.march.rules import sample_weights
from mi_nerf.march.samples import Samples
from mi_nerf.march.settings import MarchSettings
from tests.support.analytic import AnalyticField
from tests.support.arrays import unit, vectors

RAYS, CELLS = 32, 4
COUNTS = (1, 2, 3, 7, 16, 65, 256, 1024)


@dataclass(frozen=True)
class Medium:
    """A box of random cells, and rays from around, inside and on its faces."""

    seed: int
    scale: float = 1.0  # of the scene: lengths count as many units, densities are per unit
    least: float = -12.0  # exponents of densities
    most: float = 12.0
    empty: float = 0.2  # share of the cells that hold nothing
    aspect: float = 1.0  # of the longest side of the box to the shortest

    def numbers(self) -> dict[str, np.ndarray]:
        """Corners, table and rays of scale 1; all coordinates are multiples of 2^-10."""
        rng = np.random.default_rng(self.seed)
        size = self.aspect ** -rng.random(3)
        middle = rng.uniform(-2, 2, 3)
        density = 10 ** rng.uniform(self.least, self.most, CELLS**3)
        density[rng.random(CELLS**3) < self.empty] = 0
        lower, upper = (np.round(1024 * (middle + s * size)) / 1024 for s in (-1, 1))
        o = middle + size * rng.uniform(-4, 4, (RAYS, 3))
        o[:8] = rng.uniform(lower, upper, (8, 3))  # from inside
        o[8:12, 0] = lower[0]  # from the plane of a face
        d = rng.uniform(lower, upper, (RAYS, 3)) - o
        d[12:16, 1:] = 0  # parallel to an axis
        d[16] = (1e-40, 0, 1)
        return {
            "lower": lower,
            "upper": upper,
            "density": density,
            "o": o,
            "d": unit(d),
            "color": rng.random((3, CELLS**3)) * 10 ** rng.uniform(-3, 4),
        }

    def field(self, ad: Any) -> AnalyticField:
        """The table as a field."""
        n = self.numbers()
        lower, size = (self.scale * v for v in (n["lower"], n["upper"] - n["lower"]))
        low, rate = (vectors(ad, [v]) for v in (lower, CELLS / size))
        density = upload(ad.Float, (n["density"] / self.scale).astype(np.float32))
        colors = [upload(ad.Float, c.astype(np.float32)) for c in n["color"]]

        def cell(p: Any) -> Any:
            index = ad.UInt32(0)
            for i in range(3):
                place = dr.clip(dr.floor((p[i] - low[i]) * rate[i]), 0, CELLS - 1)
                index = index * CELLS + ad.UInt32(place)
            return index

        return AnalyticField(
            lambda p: dr.gather(ad.Float, density, cell(p)),
            lambda p, d: [dr.gather(ad.Float, c, cell(p)) for c in colors],
            *(tuple(map(float, v)) for v in (lower, lower + size)),
        )


def look(
    ad: Any, medium: Medium, count: int, jitter: bool
) -> tuple[Composite, Samples, Evaluation]:
    """What the medium's rays see, ready to be differentiated."""
    n, field = medium.numbers(), medium.field(ad)
    o = vectors(ad, (n["o"] * medium.scale).astype(np.float32))
    random = np.random.default_rng(medium.seed).random(RAYS * count, np.float32)
    samples = place_samples(
        MarchedField(field, MarchSettings(samples=count)),
        o,
        vectors(ad, n["d"]),
        jitter=upload(ad.Float, random) if jitter else None,
    )
    evaluation = Evaluation(field, samples, 1024)
    evaluation.enable_grad()
    return integrate(evaluation, samples), samples, evaluation


def rows(seen: Composite) -> np.ndarray:
    return np.array([np.array(dr.detach(r)) for r in (*seen.color, seen.opacity, seen.depth)])


media = st.builds(
    Medium,
    seed=st.integers(0, 1 << 30),
    scale=st.floats(-3, 4).map(lambda e: 10.0**e),
    least=st.floats(-12, 0),
    most=st.floats(0, 12),
    empty=st.sampled_from([0.0, 0.2, 0.9, 1.0]),
    aspect=st.sampled_from([1.0, 30.0, 1000.0]),
)
counts, flags = st.sampled_from(COUNTS), st.booleans()
common = settings(max_examples=60, suppress_health_check=[HealthCheck.too_slow])


@common
@given(medium=media, count=counts, jitter=flags)
def test_energy_is_never_created(ad: Any, medium: Medium, count: int, jitter: bool) -> None:
    """Nothing is NaN; opacities lie in [0, 1] and are the sums of weights; colours below them."""
    seen, samples, _ = look(ad, medium, count, jitter)
    found, opacity = rows(seen), np.array(dr.detach(seen.opacity))
    weights = np.array(dr.detach(seen.weights), float).reshape(RAYS, count)
    assert np.isfinite(found).all() and np.isfinite(weights).all()
    assert (weights >= 0).all() and (0 <= opacity).all() and (opacity <= 1).all()
    np.testing.assert_allclose(weights.sum(axis=1), opacity, rtol=3e-5, atol=1e-30)
    brightest = medium.numbers()["color"].max(axis=1)[:, None]
    assert (found[:3] >= 0).all() and (found[:3] <= brightest * opacity * (1 + 3e-5) + 1e-30).all()
    near, far = np.array(samples.near), np.array(samples.far)
    visible = opacity > 1e-20
    assert (found[4] >= near * (1 - 3e-5) * visible).all()
    assert (found[4] <= far * (1 + 3e-5)).all()


@pytest.mark.slow
@common
@given(medium=media, count=counts, jitter=flags)
def test_gradients_are_finite(ad: Any, medium: Medium, count: int, jitter: bool) -> None:
    """Of all outputs by every density and colour; and by colour they are the weights."""
    seen, _, evaluation = look(ad, medium, count, jitter)
    dr.backward(sum(seen.color) + seen.opacity + seen.depth / medium.scale)
    assert np.isfinite(np.array(dr.grad(evaluation.density))).all()
    weights = np.array(dr.detach(seen.weights))
    for channel in evaluation.emission:
        np.testing.assert_allclose(np.array(dr.grad(channel)), weights, rtol=1e-6)


@pytest.mark.slow
@common
@given(medium=media, count=counts, power=st.integers(-10, 13))
def test_the_unit_of_the_scene_changes_nothing(
    ad: Any, medium: Medium, count: int, power: int
) -> None:
    """From 2^-10 to 2^13: powers of 2 change no digit of a coordinate, so none of an image."""
    one, other = (dataclasses.replace(medium, scale=s) for s in (1.0, 2.0**power))
    expected, found = (rows(look(ad, m, count, jitter=True)[0]) for m in (one, other))
    found[4] /= other.scale
    np.testing.assert_array_equal(found, expected)


@pytest.mark.slow
@common
@given(medium=media, count=counts, factor=st.floats(1, 1e6))
def test_denser_media_are_not_less_opaque(
    ad: Any, medium: Medium, count: int, factor: float
) -> None:
    seen, samples, evaluation = look(ad, medium, count, jitter=True)
    density = dr.detach(evaluation.density) * dr.opaque(ad.Float, factor)
    opacity = sample_weights(density, samples.delta, count)[1]
    assert (np.array(opacity) >= np.array(dr.detach(seen.opacity)) * (1 - 1e-6)).all()
