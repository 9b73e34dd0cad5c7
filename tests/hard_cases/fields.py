"""Rows 14 to 16: fields with closed forms, seen from awkward places."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from mi_nerf.fields.closed_form import closed_form
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.placing import place_samples
from mi_nerf.march.quadrature import integrate
from mi_nerf.march.query import Evaluation
from mi_nerf.march.rules import sample_weights
from mi_nerf.march.settings import MarchSettings
from mi_nerf.march.strata import points_along, stratified
from tests.hard_cases import Finding, relative
from tests.support import closed_forms as oracle
from tests.support import naive
from tests.support.arrays import unit, vectors


class Probe:
    """A field of one kind and rays through it: opacities, and a derivative of their sum."""

    def __init__(
        self, ad: Any, kind: str, values: dict[str, Any], o: np.ndarray, d: np.ndarray, wrt: str
    ) -> None:
        self.field = closed_form(kind, values, ad.TensorXf)
        self._number = self.field.parameters()[wrt]
        self._o, self._d = vectors(ad, o), vectors(ad, d)
        v = oracle.values_of(self.field.config)
        rays = oracle.Rays.in_box(
            *(np.asarray(x, np.float32).astype(float) for x in (o, d)),
            *(self.field.lower, self.field.upper),
        )
        self.opacity = oracle.seen(kind, v, rays)[:, 3]
        self.slope = oracle.slopes(kind, v, rays)[wrt][:, 3, 0].sum()

    def errors(self, settings: MarchSettings) -> tuple[float, float]:
        """Relative errors of mi_nerf's opacities (of the largest) and of the derivative."""
        samples = place_samples(MarchedField(self.field, settings), self._o, self._d)
        self._enable()
        evaluation = Evaluation(self.field, samples, 16384, keep=True)
        evaluation.enable_grad()
        opacity = integrate(evaluation, samples).opacity
        dr.backward(dr.sum(opacity))
        evaluation.backward()
        return self._compare(opacity)

    def naive_errors(self, near: Any, far: Any, count: int) -> tuple[float, float]:
        """The same with samples between given bounds, in the box or not."""
        float_type = type(self._o[0])
        t, delta = stratified(near, far, count)
        ray = dr.arange(dr.uint32_array_t(float_type), len(t)) // count
        p = points_along(self._o, self._d, t, ray)
        inside = dr.all((p >= self.field.lower) & (p <= self.field.upper))
        self._enable()
        density = dr.select(inside, self.field.density(p), 0)
        opacity = sample_weights(density, delta, count)[1]
        dr.backward(dr.sum(opacity))
        return self._compare(opacity)

    def naive_bounds(self) -> tuple[Any, Any]:
        """Where the rays' lines are in the box, before or behind their origins."""
        return naive.box_interval(self._o, self._d, self.field.lower, self.field.upper)

    def _enable(self) -> None:
        dr.enable_grad(self._number)
        dr.clear_grad(self._number)

    def _compare(self, opacity: Any) -> tuple[float, float]:
        error = np.abs(np.array(opacity) - self.opacity).max() / self.opacity.max()
        return float(error), relative(np.array(dr.grad(self._number))[0], self.slope)


# ---- Row 14 ------------------------------------------------------------------------

# Straight through a sheet that lies where 64 even samples have the middle of a gap.
THICKNESSES = (1e-1, 3e-2, 1e-2, 3e-3, 1e-3, 3e-4)


def sheet_errors(ad: Any, thickness: float) -> dict[str, tuple[float, float]]:
    """Errors of opacity and of ∂ opacity/∂(optical depth) for three ways to sample.

    The hierarchy's coarse field is the same sheet, as wide as two of the coarse strata: a
    network that is trained with jittered samples knows no more than that.
    """
    o, d = np.array([(0.1, 0.2, -3.0)]), np.array([(0.0, 0.0, 1.0)])
    values = {"thickness": 0.5, "width": thickness, "edge": 0.5 * thickness}
    probe = Probe(ad, "sheet", values, o, d, "thickness")
    result = {f"{n} even": probe.errors(MarchSettings(samples=n)) for n in (64, 192)}
    probe.field.coarse = closed_form("sheet", {"width": 1 / 16, "edge": 0.0}, ad.TensorXf)
    result["64 + 128"] = probe.errors(MarchSettings(samples=64, fine=128))
    return result


def thin_sheet(ad: Any) -> list[Finding]:
    """Row 14: a sheet of thickness 1e-3 in a box of 2, of optical depth 0.5."""
    errors = sheet_errors(ad, 1e-3)
    what = ("relative error of its opacity", "of its derivative by the optical depth")
    pairs = zip(what, errors["64 even"], errors["64 + 128"], strict=True)
    return [Finding(*pair) for pair in pairs]


# ---- Rows 15 and 16 ------------------------------------------------------------------


def inside_the_volume(ad: Any) -> list[Finding]:
    """Row 15: rays that start inside fog, in all directions, and on a face of its box."""
    rng = np.random.default_rng(0)
    o = rng.uniform(-0.9, 0.9, (64, 3))
    d = unit(rng.normal(size=(64, 3)))
    o[:8, 2], d[:8, 2] = -1, np.abs(d[:8, 2])  # the face z = −1, inwards
    probe = Probe(ad, "fog", {"density": 0.8, "height": 0.7}, o, d, "density")
    usual = probe.naive_errors(*probe.naive_bounds(), 256)
    ours = probe.errors(MarchSettings(samples=256))
    what = ("relative error of opacities from inside", "of ∂ opacity/∂σ")
    return [Finding(*pair) for pair in zip(what, usual, ours, strict=True)]


def scene_unit(ad: Any) -> list[Finding]:
    """Row 16: a Gaussian in scenes of 1e-3 and 1e4 units; near 2 and far 6, or its box."""
    rng = np.random.default_rng(0)
    o = 4 * unit(rng.normal(size=(64, 3)))
    d = unit(rng.uniform(-0.5, 0.5, (64, 3)) - o)
    usual, ours = [], []
    for scale in (1e-3, 1e4):
        values = {"width": 0.25 * scale, "peak": 6 / scale}
        probe = Probe(ad, "gaussian", values, scale * o, d, "peak")
        usual.append(probe.naive_errors(dr.full(ad.Float, 2, 64), ad.Float(6), 256))
        ours.append(probe.errors(MarchSettings(samples=256)))
    what = ("relative error of opacities, the worse of both", "of ∂ opacity/∂peak")
    worst = zip(what, np.max(usual, axis=0), np.max(ours, axis=0), strict=True)
    return [Finding(name, float(a), float(b)) for name, a, b in worst]
