"""Speed against error: one field, rendered with many settings, against its reference.

One knob is turned at a time, away from the field's own settings. All settings see the same
rays, through :func:`mi_nerf.march.render.render_rays` as evaluation and Mitsuba do. Three
errors are told apart:

- *quadrature*: of a rendering against :func:`mi_nerf.estimators.reference.reference`, the same
  field marched in double precision behind its own occupancy grid until the error is known;
- *model*: of the reference against the images, what would remain with perfect quadrature;
- *both*: of a rendering against the images.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, get_args

import drjit as dr
import numpy as np

from ..base.machine import machine
from ..estimators.reference import Reference, reference
from ..march.marched import MarchedField
from ..march.render import render_rays
from ..march.rules import Rule
from ..march.settings import MarchSettings
from .grids import Grids
from .subject import Subject

Array = np.ndarray[Any, Any]

_RESOLUTION, _THRESHOLD = 64, 0.01  # of the grid that a knob departs from, as in training
_FEWEST_RAYS = 256
_PILOT_RAYS, _PILOT_INTERVALS = 64, 512  # by which the cost of the reference is judged
_VISIBLE = 0.5  # opacity from which on a depth counts


@dataclass(frozen=True)
class Knobs:
    """What is tried; an empty tuple leaves a knob alone.

    ``rules`` are combined with ``samples``, all others are turned alone.
    """

    samples: tuple[int, ...] = (16, 32, 64, 128, 256, 512)  # strata a ray
    rules: tuple[Rule, ...] = ("constant", "linear")  # of quadrature; without jitter, all there are
    splits: tuple[float, ...] = (0.0, 0.125, 0.25, 0.375)  # share of queries that place others
    stops: tuple[float, ...] = (0.0, 1e-4, 1e-3, 1e-2, 1e-1)  # transmittance that ends a ray
    resolutions: tuple[int, ...] = (16, 32, 64, 128)  # of an occupancy grid, longest side
    thresholds: tuple[float, ...] = (1e-3, 1e-2, 1e-1)  # optical thickness of an empty cell

    def __post_init__(self) -> None:
        if not any(asdict(self).values()):
            raise ValueError("nothing to sweep, expected a value of at least one setting")
        for name, least, below in (
            ("samples", 1, None),
            ("splits", 0, 0.5),
            ("stops", 0, 1),
            ("resolutions", 1, None),
            ("thresholds", 0, None),
        ):
            for value in getattr(self, name):
                if not (value >= least and (below is None or value < below)):
                    limit = f"{least} or more" + ("" if below is None else f", less than {below}")
                    raise ValueError(f"{name}: {value}, expected {limit}")
        for rule in self.rules:
            if rule not in get_args(Rule):
                raise ValueError(f"rules: {rule}, expected {' or '.join(get_args(Rule))}")


@dataclass(frozen=True)
class Seen:
    """What R rays saw."""

    color: Array  # (R, 3), premultiplied
    opacity: Array  # (R,)
    depth: Array  # (R,) scene units
    queries: float  # a ray


@dataclass(frozen=True)
class Setting:
    """One way to render the field."""

    march: MarchSettings
    grid: tuple[int, float] | None = None  # resolution and threshold; None: the field's own


def sweep(
    subject: Subject,
    knobs: Knobs | None = None,
    *,
    repeats: int = 7,
    seconds: float = 90.0,
    on_render: Callable[[int], object] | None = None,
) -> dict[str, Any]:
    """Renders the rays of a subject with every setting, and measures time and errors.

    Settings take turns, so that what else the machine does hits all of them. Each renders
    once before the clock is used, so that everything is compiled.

    Args:
        repeats: timed renderings with each setting.
        seconds: what all of it should take. If the field is too slow for that, only the
            first of the rays are used, but at least 256; the record says how many.
        on_render: called after every rendering with the number of them in all.

    Returns:
        Plain JSON values. ``points`` is a list, the field's own setting first, of
        ``knobs`` (which sweeps the point is part of), ``samples``, ``fine``, ``rule``,
        ``stop``, ``grid`` (``None`` or resolution and threshold), ``milliseconds`` (median
        for all ``rays``), ``fastest`` and ``slowest``, ``queries_per_ray``, ``error`` (root
        mean square against the reference: ``color``, ``opacity``, and ``depth`` in scene
        units where the reference is more than half opaque), ``psnr`` (against the images, or
        ``None``) and ``pareto`` (no other point is as fast and as exact, and better in one;
        errors count in two digits, and no less than the reference states of itself). ``by``
        names the error that counts: that of the colour; of formulas, in which colour tells of
        the optical depth alone, that of the depth. ``reference`` has the ``psnr`` of the
        reference and the ``error`` that it states.
    """
    settings = settings_of(subject, knobs or Knobs())
    total = (repeats + 1) * len(settings)
    notify = on_render or (lambda _: None)
    subject = subject.first(_affordable_rays(subject, settings, repeats, seconds))
    own = subject.marched
    grids = Grids(own.field, own.occupancy, subject.backend.Float)
    exact, record = _reference(subject, seconds)
    built = {
        s: replace(own, settings=s.march, occupancy=grids.at(*s.grid) if s.grid else own.occupancy)
        for s in settings
    }
    seen: dict[Setting, Seen] = {}
    times: dict[Setting, list[float]] = {s: [] for s in settings}
    for turn in range(repeats + 1):
        for setting in settings:
            elapsed, found = _render(subject, built[setting])
            if turn:
                times[setting].append(elapsed)
            else:
                seen[setting] = found
            notify(total)
    points = [
        {"knobs": names, **_description(s, times[s]), **_errors(subject, seen[s], exact)}
        for s, names in settings.items()
    ]
    by = "depth" if subject.formula and record["error"]["depth"] is not None else "color"
    _mark_front(points, by, record["error"][by])
    return {
        "field": subject.name,
        "formula": subject.formula,
        "unit": subject.unit,
        "by": by,
        "rays": subject.rays,
        "views": dict(subject.views),
        "repeats": repeats,
        "machine": machine(subject.variant),
        "near": own.settings.near,
        "far": own.settings.far,
        "own_grid": None if own.occupancy is None else list(own.occupancy.shape),
        "reference": record,
        "points": points,
    }


def settings_of(subject: Subject, knobs: Knobs) -> dict[Setting, list[str]]:
    """All that a sweep tries, once each, and the knobs that lead there; the own ones first."""
    march = subject.marched.settings
    both = march.fine > 0 and subject.field.coarse is not None
    march = march if both else replace(march, fine=0)
    found: dict[Setting, list[str]] = {Setting(march): ["own"]}

    def add(knob: str, setting: Setting) -> None:
        found.setdefault(setting, []).append(knob)

    counts = sorted({*knobs.samples, march.samples}) if knobs.samples else []
    for rule in knobs.rules or (march.rule,):
        for samples in counts or [march.samples]:
            fine = round(march.fine * samples / march.samples)
            knob = "samples" if counts else "rule"
            add(knob, Setting(replace(march, samples=samples, fine=fine, rule=rule)))
    queries = 2 * march.samples + march.fine  # a ray; the fine network sees coarse samples too
    for share in knobs.splits if both else ():
        samples = max(1, round(share * queries)) if share else queries
        fine = queries - 2 * samples if share else 0
        add("split", Setting(replace(march, samples=samples, fine=fine)))
    for stop in knobs.stops:
        add("stop", Setting(replace(march, stop=stop)))
    grid = subject.marched.occupancy
    middle = _RESOLUTION if grid is None else max(grid.shape)
    for resolution in knobs.resolutions:
        add("resolution", Setting(march, (resolution, _THRESHOLD)))
    for threshold in knobs.thresholds:
        add("threshold", Setting(march, (middle, threshold)))
    return found


# ---- One rendering ---------------------------------------------------------------


def _render(subject: Subject, marched: MarchedField) -> tuple[float, Seen]:
    """Seconds that it took, and what was seen."""
    start = time.perf_counter()
    found = render_rays(marched, subject.o, subject.d)
    dr.sync_thread()
    elapsed = time.perf_counter() - start
    color = np.transpose([np.array(c, np.float64) for c in found.color])
    opacity, depth = (np.array(v, np.float64) for v in (found.opacity, found.depth))
    return elapsed, Seen(color, opacity, depth, found.queries / subject.rays)


def _description(setting: Setting, seconds: list[float]) -> dict[str, Any]:
    """What was set, and how long it took."""
    march, grid = setting.march, setting.grid
    times = [1e3 * s for s in seconds]
    return {
        **{name: getattr(march, name) for name in ("samples", "fine", "rule", "stop")},
        "grid": None if grid is None else {"resolution": grid[0], "threshold": grid[1]},
        "milliseconds": float(np.median(times)),
        "fastest": min(times),
        "slowest": max(times),
    }


def _errors(subject: Subject, seen: Seen, exact: Reference) -> dict[str, Any]:
    shown = subject.shown(seen.color, seen.opacity)
    there = exact.opacity > _VISIBLE
    return {
        "queries_per_ray": seen.queries,
        "error": {
            "color": _rms(shown - subject.shown(exact.color, exact.opacity)),
            "opacity": _rms(seen.opacity - exact.opacity),
            "depth": _rms((seen.depth - exact.depth)[there]) if there.any() else None,
        },
        "psnr": subject.psnr(shown),
    }


def pareto_front(costs: Sequence[float], errors: Sequence[float]) -> list[bool]:
    """Marks the points for which no other is as cheap and as exact, and better in one of both.

    Equal points are marked alike. NaN in either number leaves a point out.

    >>> pareto_front([1, 2, 3, 3], [0.5, 0.2, 0.3, 0.1])
    [True, True, False, True]
    """
    pairs = enumerate(zip(costs, errors, strict=True))
    usable = [i for i, pair in pairs if not any(map(math.isnan, pair))]
    marked = [False] * len(costs)
    best = float("inf")  # least error among cheaper points
    cost_of_best = float("-inf")
    for i in sorted(usable, key=lambda i: (costs[i], errors[i])):
        if errors[i] < best:
            best, cost_of_best = errors[i], costs[i]
        marked[i] = errors[i] == best and costs[i] == cost_of_best
    return marked


def _mark_front(points: list[dict[str, Any]], by: str, floor: float) -> None:
    """Marks the Pareto front; errors below ``floor`` count as equal."""
    errors = [float(f"{max(p['error'][by], floor):.1e}") for p in points]
    marks = pareto_front([p["milliseconds"] for p in points], errors)
    for point, mark in zip(points, marks, strict=True):
        point["pareto"] = mark


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


# ---- Reference and budget --------------------------------------------------------


def _reference(subject: Subject, seconds: float) -> tuple[Reference, dict[str, Any]]:
    """The reference of all rays, as fine as half of the time allows, and what to record of it."""
    tolerance, most = (1e-6, 1 << 14) if subject.formula else (1e-4, 1 << 13)

    def ask(some: Subject, most: int) -> tuple[float, Reference]:
        start = time.perf_counter()
        found = reference(
            some.field,
            some.o,
            some.d,
            occupancy=some.marched.occupancy,
            bounds=(some.marched.settings.near, some.marched.settings.far),
            tolerance=tolerance,
            max_intervals=most,
        )
        return time.perf_counter() - start, found

    few = subject.first(_PILOT_RAYS)
    for _ in range(2):  # the first one compiles
        pilot, coarse = ask(few, _PILOT_INTERVALS)
    going = float(np.mean((coarse.error[:, :3] > tolerance).any(axis=1)))
    # Each of these marches takes as long as all before together.
    once = pilot / few.rays * subject.rays
    while most > _PILOT_INTERVALS and once * (1 + going * most / _PILOT_INTERVALS) > seconds / 2:
        most //= 2
    elapsed, exact = ask(subject, most)
    there = exact.opacity > _VISIBLE
    return exact, {
        "tolerance": tolerance,
        "max_intervals": most,
        "seconds": elapsed,
        "error": {
            "color": _rms(subject.shown_error(exact.color, exact.opacity, exact.error)),
            "opacity": _rms(exact.error[:, 3]),
            "depth": _rms(exact.error[there, 4]) if there.any() else None,
        },
        "psnr": subject.psnr(subject.shown(exact.color, exact.opacity)),
    }


def _affordable_rays(
    subject: Subject, settings: Mapping[Setting, object], repeats: int, seconds: float
) -> int:
    """How many of the rays can be rendered in time, judged by some of them."""
    few = subject.first(4 * _FEWEST_RAYS)
    own = next(iter(settings)).march
    for _ in range(2):  # the first one compiles
        elapsed, _ = _render(few, replace(few.marched, settings=own))
    size = [(s.march.samples + s.march.fine) / (own.samples + own.fine) for s in settings]
    whole = elapsed / few.rays * sum(size) * (repeats + 1)
    return max(_FEWEST_RAYS, min(subject.rays, int(seconds / whole)))
