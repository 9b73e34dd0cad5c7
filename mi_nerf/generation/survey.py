"""What the cameras of a plan will see, from a few rays through some of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from ..cameras.pinhole import Intrinsics
from .probes import Hides, camera_rays, first_hits
from .subject import Subject

Array = np.ndarray[Any, Any]

_CAMERAS, _GRID = 32, 40  # cameras at most that are asked, rays along each side of their films
_COARSE = 12  # rays along each side of the film of a camera that is asked what it sees at all
_ASKED, _LIGHTS = 2048, 4  # points at which it is asked for light, samples of it


@dataclass(frozen=True, eq=False)
class Survey:
    """What some cameras see, grid² rays each."""

    covered: Array  # (V,) share of each picture that the object covers, seen from its front
    dark: Array  # (V,) share of each picture that shows the back of one-sided surfaces
    points: Array  # (N, 3) float32, of surfaces that are seen
    of_object: Array  # (N,) bool: the object's
    lit: float  # share of what is met on which light falls without a detour
    nearest: float  # distance of what is met first, scene units; infinite if nothing is
    hide_emitters: bool  # light sources are not seen

    @property
    def coverage(self) -> float:
        """Share of all pixels that the object covers."""
        return float(self.covered.mean())

    @property
    def darkness(self) -> float:
        """Share of what is met, object or not, that is the black back of a surface."""
        met = len(self.points) / max(1, len(self.covered) * _GRID**2)
        return float(self.dark.mean()) / met if met else 0.0

    def __str__(self) -> str:
        """For people."""
        least, most = self.covered.min(), self.covered.max()
        return (
            f"the object covers {percent(self.coverage)} of the pixels"
            f" ({percent(least)} to {percent(most)} a view)"
        )


def look(
    scene: Any,
    subject: Subject,
    poses: Sequence[Array],
    intrinsics: Sequence[Intrinsics],
    *,
    hide_emitters: Hides,
) -> Survey:
    """Asks cameras, evenly spread over those given, what they see. A variant must be set."""
    count = min(_CAMERAS, len(poses))
    chosen = [i * len(poses) // count for i in range(count)]
    o, d = camera_rays([poses[i] for i in chosen], [intrinsics[i] for i in chosen], _GRID)
    shape = o.shape[:2]
    o, d = o.reshape(-1, 3), d.reshape(-1, 3)
    hits = first_hits(scene, o, d, hide_emitters=hide_emitters)
    seen = hits.something
    points = o[seen] + hits.nearest[seen, None].astype(np.float64) * d[seen]
    of_object = subject.holds(points)
    covered = np.zeros(len(o), bool)
    covered[np.flatnonzero(seen)[of_object]] = True
    covered &= ~hits.dark
    return Survey(
        covered=covered.reshape(shape).mean(axis=1),
        dark=(hits.dark & seen).reshape(shape).mean(axis=1),
        points=points.astype(np.float32),
        of_object=of_object,
        lit=_lit(scene, points - 1e-4 * hits.nearest[seen, None] * d[seen]),
        nearest=float(hits.nearest.min()),
        hide_emitters=hide_emitters is not False,
    )


def sees(
    scene: Any, subject: Subject, hide_emitters: Hides, poses: Array, intrinsics: Intrinsics
) -> Array:
    """Which cameras see the object from its front, (N,). ``poses`` are (N, 4, 4)."""
    o, d = camera_rays(list(poses), [intrinsics] * len(poses), _COARSE)
    shape = o.shape[:2]
    o, d = o.reshape(-1, 3), d.reshape(-1, 3)
    hits = first_hits(scene, o, d, hide_emitters=hide_emitters)
    front = hits.something & ~hits.dark
    points = o[front] + hits.nearest[front, None].astype(np.float64) * d[front]
    seen = np.zeros(len(o), bool)
    seen[np.flatnonzero(front)[subject.holds(points)]] = True
    return np.asarray(seen.reshape(shape).any(axis=1))


def _lit(scene: Any, points: Array) -> float:
    """Share of points at which light arrives that was not reflected; 1 without any point."""
    import mitsuba as mi

    if not len(points) or not scene.emitters():
        return 1.0
    points = np.repeat(points[:: -(-len(points) // _ASKED)], _LIGHTS, axis=0)
    random = np.random.default_rng(0).random((2, len(points)), np.float32)
    at = dr.zeros(mi.Interaction3f, len(points))
    at.p = mi.Point3f(np.ascontiguousarray(points.T, np.float32))
    if mi.is_spectral:  # no lamp shines at no wavelength
        spread = mi.sample_shifted(mi.Float(np.random.default_rng(1).random(len(points))))
        at.wavelengths, _ = mi.sample_rgb_spectrum(spread)
    # What lets light straight through does not count: Mitsuba's own test would take it for solid.
    way, light = scene.sample_emitter_direction(at, mi.Point2f(random), False)
    light = mi.unpolarized_spectrum(light) if mi.is_polarized else light
    distance, shines = np.array(way.dist), np.array(dr.max(light) > 0)
    hits = first_hits(scene, points, np.array(way.d).T, hide_emitters=True)
    arrives = shines & (hits.distance >= distance * (1 - 1e-3))
    return float(arrives.reshape(-1, _LIGHTS).any(axis=1).mean())


def percent(share: float) -> str:
    """A share for people: 12 %, 0.3 %."""
    return f"{100 * share:.2g} %" if share < 0.1 else f"{100 * share:.0f} %"
