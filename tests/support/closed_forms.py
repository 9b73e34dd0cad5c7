"""What rays see of the fields given by formulas: an oracle in NumPy float64.

For each kind there are its density and the optical depth between two points of a ray that
no kink separates, both exact: ∫ of a linear function, of an exponential, of a Gaussian
(erf) or of a linear function of the distance from a centre (arsinh). From these follow

    T(t) = exp(−τ(t)),    opacity = 1 − T(far),    radiance = c(d) · opacity,

exactly as well, and the mean distance under the weights T·σ,

    depth = near + ∫ (T(t) − T(far)) dt / opacity

(the mean of t, by parts). That integral has no elementary form but for constant density,
so it is a Gauss-Legendre sum of the exact T on panels between the kinks, converged to 1e-12.
Derivatives are complex steps, exact to rounding: the oracle is analytic between kinks and
computes with the complex places of kinks, so that moving jumps count.

Arrays are ``(R, …)`` for R rays; values may be complex, comparisons look at real parts.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

Values = Mapping[str, np.ndarray]  # the numbers of a formula: 1 or 3 entries each
Array = np.ndarray

STEP = 1e-30  # of complex differentiation: its square vanishes against rounding
PANELS, NODES = 4, 20  # of the integral of T, between neighbouring kinks
GRADES = 8  # parts of a panel, each half as long as the next: T falls at once in dense media


def values_of(config: Any) -> dict[str, Array]:
    """The numbers of a configuration, apart from its box."""
    box = ("lower", "upper", "extent")
    numbers = {k: v for k, v in dataclasses.asdict(config).items() if k not in box}
    return {name: np.atleast_1d(np.array(value, float)) for name, value in numbers.items()}


# ---- Functions of complex arguments -------------------------------------------


def clip(x: Array, low: Any, high: Any) -> Array:
    """x limited to [low, high], by real parts."""
    x = np.where(np.real(x) < np.real(low), low, x)
    return np.where(np.real(x) > np.real(high), high, x)


def magnitude(x: Array) -> Array:
    """|x| of almost real numbers."""
    return np.where(np.real(x) < 0, -x, x)


def erf(x: Array) -> Array:
    """The error function of almost real numbers, to first order in the imaginary part."""
    real = np.real(x)
    value = np.array([math.erf(v) for v in real.ravel()]).reshape(real.shape)
    if not np.iscomplexobj(x):
        return value
    return value + 1j * np.imag(x) * (2 / math.sqrt(math.pi)) * np.exp(-(real**2))


def mean_decay(x: Array) -> Array:
    """(1 − exp(−x))/x."""
    small = np.abs(x) < 1e-4
    safe = np.where(small, 1, x)
    series = 1 - x / 2 * (1 - x / 3 * (1 - x / 4))
    return np.where(small, series, -np.expm1(-safe) / safe)


def rise(x: Array, edge: Array) -> Array:
    """0 below −edge/2, 1 above edge/2, linear in between."""
    if edge.real == 0:
        return np.where(np.real(x) > 0, 1.0, 0.0)
    return clip(x / edge + 0.5, 0, 1)


def squared(v: Array) -> Array:
    return np.sum(v * v, axis=-1)


# ---- Rays ---------------------------------------------------------------------


@dataclass
class Rays:
    """o + t·d with near ≤ t ≤ far; R of them."""

    o: Array  # (R, 3)
    d: Array  # (R, 3), of unit length
    near: Array  # (R,)
    far: Array  # (R,), equal to near where the box is missed

    @classmethod
    def in_box(cls, o: Array, d: Array, lower: Any, upper: Any) -> Rays:
        """The part of the rays inside a box."""
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([(np.asarray(corner) - o) / d for corner in (lower, upper)])
        outside = (d == 0) & ((o < lower) | (o > upper))
        enter = np.where(d == 0, -np.inf, ends.min(axis=0)).max(axis=1)
        leave = np.where(d == 0, np.inf, ends.max(axis=0)).min(axis=1)
        near = np.maximum(enter, 0)
        hit = (leave > near) & ~outside.any(axis=1)
        return cls(o, d, np.where(hit, near, 0), np.where(hit, leave, 0))

    def at(self, t: Array) -> Array:
        """Points of the rays, (R, …, 3), for t of shape (R, …)."""
        over = (slice(None), *[None] * (t.ndim - 1))
        return self.o[over] + t[..., None] * self.d[over]

    def each(self, x: Array, t: Array) -> Array:
        """One number a ray, brought to the shape of t."""
        return x[(slice(None), *[None] * (t.ndim - 1))]


# ---- The formulas -------------------------------------------------------------

Density = Callable[[Values, Array], Array]
Kinks = Callable[[Values, Rays], Array]
Thickness = Callable[[Values, Rays, Array, Array], Array]


@dataclass(frozen=True)
class Formula:
    density: Density  # at points (…, 3)
    kinks: Kinks  # where on the rays density is not smooth: (R, K), in any order
    thickness: Thickness | None = None  # ∫ σ dt between a and b; None: σ is linear there

    def optical_depth(self, v: Values, rays: Rays, a: Array, b: Array) -> Array:
        """∫ σ dt from ``a`` to ``b``, (R, …), without kinks in between."""
        if self.thickness is not None:
            return self.thickness(v, rays, a, b)
        return self.density(v, rays.at(0.5 * (a + b))) * (b - a)


def smooth(v: Values, rays: Rays) -> Array:
    return np.zeros((len(rays.o), 0))


def distance(v: Values, p: Array) -> Array:
    """From the plane of a formula, along its axis."""
    return p @ v["axis"] / np.sqrt(squared(v["axis"])) - v["position"]


def crossings(v: Values, rays: Rays, *levels: Array) -> Array:
    """Where rays reach distances from the plane; nowhere (NaN, ±∞) if parallel to it."""
    start = distance(v, rays.o)
    rate = rays.d @ v["axis"] / np.sqrt(squared(v["axis"]))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([(level - start) / rate for level in levels], axis=-1)


def constant(v: Values, p: Array) -> Array:
    return v["density"] * np.ones(p.shape[:-1])


def fog(v: Values, p: Array) -> Array:
    return v["density"] * np.exp(-distance(v, p) / v["height"])


def fog_thickness(v: Values, rays: Rays, a: Array, b: Array) -> Array:
    rate = rays.d @ v["axis"] / np.sqrt(squared(v["axis"])) / v["height"]
    return fog(v, rays.at(a)) * (b - a) * mean_decay(rays.each(rate, b) * (b - a))


def ramp(v: Values, p: Array) -> Array:
    return clip(v["density"] + v["slope"] * distance(v, p), 0, np.inf)


def ramp_kinks(v: Values, rays: Rays) -> Array:
    return crossings(v, rays, -v["density"] / v["slope"])


def step(v: Values, p: Array) -> Array:
    return v["before"] + (v["beyond"] - v["before"]) * rise(distance(v, p), v["edge"])


def step_kinks(v: Values, rays: Rays) -> Array:
    return crossings(v, rays, -v["edge"] / 2, v["edge"] / 2)


def sheet(v: Values, p: Array) -> Array:
    inside = rise(v["width"] / 2 - magnitude(distance(v, p)), v["edge"])
    return v["thickness"] / v["width"] * inside


def sheet_kinks(v: Values, rays: Rays) -> Array:
    outer, inner = (v["width"] + v["edge"]) / 2, (v["width"] - v["edge"]) / 2
    return crossings(v, rays, -outer, -inner, inner, outer)


def gaussian(v: Values, p: Array) -> Array:
    return v["peak"] * np.exp(-squared(p - v["center"]) / (2 * v["width"] ** 2))


def closest(v: Values, rays: Rays) -> tuple[Array, Array]:
    """Where rays come closest to the centre, and the square of how close, (R,) each."""
    offset = rays.o - v["center"]
    middle = -np.sum(offset * rays.d, axis=1)
    return middle, squared(offset + middle[:, None] * rays.d)


def gaussian_thickness(v: Values, rays: Rays, a: Array, b: Array) -> Array:
    middle, b2 = (rays.each(x, b) for x in closest(v, rays))
    width = v["width"] * math.sqrt(2)
    top = v["peak"] * np.exp(-b2 / width**2) * width * math.sqrt(math.pi) / 2
    return top * (erf((b - middle) / width) - erf((a - middle) / width))


def shell(v: Values, p: Array) -> Array:
    r = np.sqrt(squared(p - v["center"]))
    return v["density"] * (rise(r - v["inner"], v["edge"]) - rise(r - v["outer"], v["edge"]))


def shell_kinks(v: Values, rays: Rays) -> Array:
    """Where rays meet the spheres at which the slope changes, and closest to the centre."""
    middle, b2 = closest(v, rays)
    ends = [middle]
    for radius in (v["inner"], v["outer"]):
        for side in (-0.5, 0.5):
            square = (radius + side * v["edge"]) ** 2 - b2
            half = np.sqrt(np.where(np.real(square) > 0, square, 0))
            ends += [middle - half, middle + half]
    return np.stack(ends, axis=-1)


def shell_thickness(v: Values, rays: Rays, a: Array, b: Array) -> Array:
    """With σ = α + βr between a and b; β and α from where their middle is."""
    middle, b2 = (rays.each(x, b) for x in closest(v, rays))
    r = np.sqrt(b2 + (0.5 * (a + b) - middle) ** 2)
    alpha = np.zeros(r.shape, r.dtype)
    beta = np.zeros(r.shape, r.dtype)
    for sign, radius in ((1, v["inner"]), (-1, v["outer"])):
        offset = np.real(r - radius)
        within = np.abs(offset) < v["edge"].real / 2
        edge = v["edge"] if v["edge"].real > 0 else 1
        alpha = alpha + sign * np.where(within, 0.5 - radius / edge, offset > 0)
        beta = beta + sign * np.where(within, 1 / edge, 0)

    def length_moment(t: Array) -> Array:
        """∫ r dt."""
        u, b_ = t - middle, np.sqrt(b2 + 1e-300)
        return 0.5 * (u * np.sqrt(b2 + u * u) + b2 * np.arcsinh(u / b_))

    return v["density"] * (alpha * (b - a) + beta * (length_moment(b) - length_moment(a)))


FORMULAS = {
    "slab": Formula(constant, smooth),
    "two_color": Formula(constant, smooth),
    "fog": Formula(fog, smooth, fog_thickness),
    "ramp": Formula(ramp, ramp_kinks),
    "step": Formula(step, step_kinks),
    "sheet": Formula(sheet, sheet_kinks),
    "gaussian": Formula(gaussian, smooth, gaussian_thickness),
    "shell": Formula(shell, shell_kinks, shell_thickness),
}


def density(kind: str, v: Values, p: Array) -> Array:
    """σ at points (…, 3)."""
    return FORMULAS[kind].density(v, p)


def radiance(kind: str, v: Values, d: Array) -> Array:
    """What is emitted along unit directions, (…, 3)."""
    if kind != "two_color":
        return v["radiance"] + 0 * d
    cosine = (d @ v["axis"] / np.sqrt(squared(v["axis"])))[..., None]
    return v["radiance"] * (1 + cosine) / 2 + v["opposite"] * (1 - cosine) / 2


# ---- What is seen -------------------------------------------------------------


def gauss_legendre(panels: int) -> tuple[Array, Array]:
    """Nodes in [0, 1] and their weights."""
    graded = np.concatenate([[0], 2.0 ** np.arange(1 - GRADES, 1)])[:-1]
    start = ((np.arange(panels)[:, None] + graded) / panels).ravel()
    size = np.diff(start, append=1)
    x, weight = np.polynomial.legendre.leggauss(NODES)
    return (
        (start[:, None] + size[:, None] * (0.5 + 0.5 * x)).ravel(),
        (0.5 * size[:, None] * weight).ravel(),
    )


def seen(kind: str, v: Values, rays: Rays, panels: int = PANELS) -> Array:
    """Radiance (three channels), opacity and depth of R rays: (R, 5); depth 0 of nothing."""
    formula = FORMULAS[kind]
    near, far = rays.near[:, None], rays.far[:, None]
    kinks = formula.kinks(v, rays)
    kinks = np.where(np.isfinite(np.real(kinks)), kinks, near)
    ends = np.concatenate([near, clip(kinks, near, far), far], axis=1)
    order = np.argsort(np.real(ends), axis=1, kind="stable")
    ends = np.take_along_axis(ends, order, axis=1)
    tau = np.cumsum(formula.optical_depth(v, rays, ends[:, :-1], ends[:, 1:]), axis=1)
    total = tau[:, -1]
    before = np.concatenate([0 * tau[:, :1], tau[:, :-1]], axis=1)[..., None]

    # ∫ (T − T(far)) dt, piece by piece, with T − T(far) = T · (1 − exp(τ − τ(far))).
    place, weight = gauss_legendre(panels)
    first, length = ends[:, :-1, None], np.diff(ends, axis=1)[..., None]
    t = first + place * length
    tau_t = before + formula.optical_depth(v, rays, first + 0 * t, t)
    excess = np.exp(-tau_t) * -np.expm1(tau_t - total[:, None, None])
    moment = np.sum(excess * weight * length, axis=(1, 2))

    opacity = -np.expm1(-total)
    visible = np.real(opacity) > 0
    depth = np.where(visible, rays.near + moment / np.where(visible, opacity, 1), 0)
    color = radiance(kind, v, rays.d) * opacity[:, None]
    return np.concatenate([color, opacity[:, None], depth[:, None]], axis=1)


def slopes(kind: str, v: Values, rays: Rays) -> dict[str, Array]:
    """Derivatives of :func:`seen`: (R, 5, entries) for each number; the box stays."""
    return {
        name: np.stack(
            [
                np.imag(seen(kind, {**v, name: value + 1j * STEP * entry}, rays)) / STEP
                for entry in np.eye(len(value))
            ],
            axis=-1,
        )
        for name, value in v.items()
    }


def marched(kind: str, v: Values, rays: Rays, samples: int) -> Array:
    """The same as :func:`seen` from densities alone, by brute force: slow and obvious."""
    place = (np.arange(samples) + 0.5) / samples
    length = (rays.far - rays.near)[:, None]
    t = rays.near[:, None] + place * length
    tau = density(kind, v, rays.at(t)) * length / samples
    through = np.exp(-(np.cumsum(tau, axis=1) - tau))
    weights = through * -np.expm1(-tau)
    opacity = weights.sum(axis=1)
    visible = opacity > 0
    depth = np.where(visible, (weights * t).sum(axis=1) / np.where(visible, opacity, 1), 0)
    color = radiance(kind, v, rays.d) * opacity[:, None]
    return np.concatenate([color, opacity[:, None], depth[:, None]], axis=1)
