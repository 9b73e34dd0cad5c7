"""Scenes of fields and surfaces for tests, and what is seen of them by other means."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from tests.support.fields import camera_dict, formula_dict

SIZE = (16, 12)
GLOW = (0.9, 0.5, 0.2)

# ---- Scenes ---------------------------------------------------------------------


def place() -> Any:
    return mi.ScalarTransform4f()


def nerf(nested: str | dict[str, Any] | None = "path", **options: Any) -> dict[str, Any]:
    """The integrator, with another one inside."""
    inside = {"type": nested} if isinstance(nested, str) else nested
    return {"type": "nerf", **options, **({} if inside is None else {"nested": inside})}


def scene_of(integrator: dict[str, Any], spp: int = 1, **objects: Any) -> dict[str, Any]:
    """Seen along +y from (0, −4, 0), a little from above and the side."""
    view = place().look_at(origin=[0.3, -4.0, 0.5], target=[0, 0, 0], up=[0, 0, 1])
    camera = camera_dict(view, size=SIZE, spp=spp)
    return {"type": "scene", "integrator": integrator, "sensor": camera, **objects}


def render(scene: Any, **options: Any) -> np.ndarray:
    loaded = mi.load_dict(scene) if isinstance(scene, dict) else scene
    return np.array(mi.render(loaded, **options), np.float64)


def wall(y: float, reflectance: Any = (0.6, 0.4, 0.2), half: float = 5.0) -> dict[str, Any]:
    """A diffuse rectangle across the view at a depth."""
    return {
        "type": "rectangle",
        "to_world": place().translate([0, y, 0]).rotate([1, 0, 0], 90).scale(half),
        "bsdf": {"type": "diffuse", "reflectance": rgb(reflectance)},
    }


def lamp(y: float, radiance: Any = GLOW, half: float = 5.0) -> dict[str, Any]:
    """A rectangle across the view that emits towards the camera."""
    shape = wall(y, (0.0, 0.0, 0.0), half)
    return {**shape, "emitter": {"type": "area", "radiance": rgb(radiance)}}


def sky() -> dict[str, Any]:
    return {"type": "constant", "radiance": rgb((0.5, 0.7, 1.0))}


def rgb(value: Any) -> dict[str, Any]:
    return {"type": "rgb", "value": list(value)}


def camera_rays(scene: Any, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions of the rays of ``render(scene, seed=seed)``, (R, 3)."""
    sensor, integrator = scene.sensors()[0], scene.integrator()
    sampler, _ = integrator.prepare(sensor, seed, 1, integrator.aov_names())
    ray, _, _ = integrator.sample_rays(scene, sensor, sampler)
    return np.array(ray.o, np.float64).T, np.array(ray.d, np.float64).T


def slab_interval(o: np.ndarray, d: np.ndarray, lower: Any, upper: Any) -> np.ndarray:
    """Entry and exit of rays through a box, (R, 2); equal where it is missed."""
    ends = np.stack([(np.asarray(c) - o) / d for c in (lower, upper)])
    near = np.maximum(ends.min(axis=0).max(axis=1), 0)
    return np.stack([near, np.maximum(ends.max(axis=0).min(axis=1), near)], axis=1)


# ---- Oracles --------------------------------------------------------------------


def boxes_seen(
    o: np.ndarray, d: np.ndarray, boxes: list[tuple[Any, float, Any]], reach: np.ndarray
) -> np.ndarray:
    """Constant fields in moved unit boxes up to ``reach``: R, G, B, opacity, depth, (R, 5).

    Each box is a matrix, a density per length of the field and a radiance. Exact: between
    all entries and exits of a ray, densities are constant.
    """
    spans, rates = [], []
    for matrix, density, _ in boxes:
        inverse = np.linalg.inv(matrix)
        local_o, local_d = o @ inverse[:3, :3].T + inverse[:3, 3], d @ inverse[:3, :3].T
        spans.append(np.minimum(slab_interval(local_o, local_d, [-1] * 3, [1] * 3), reach[:, None]))
        rates.append(density * np.linalg.norm(local_d, axis=1))
    ends = np.sort(np.concatenate(spans, axis=1), axis=1)
    result, through = np.zeros((len(o), 5)), np.ones(len(o))
    for a, b in zip(ends[:, :-1].T, ends[:, 1:].T, strict=True):
        inside = [(s[:, 0] <= a) & (b <= s[:, 1]) for s in spans]
        sigma = [np.where(i, r, 0) for i, r in zip(inside, rates, strict=True)]
        total = sum(sigma) + 1e-300
        weight = through * -np.expm1(-total * (b - a))
        for share, (_, _, color) in zip(sigma, boxes, strict=True):
            result[:, :3] += (weight * share / total)[:, None] * np.asarray(color)
        # ∫ t T σ dt by parts, from a to b.
        mean = a + 1 / total - (b - a) / np.expm1(np.clip(total * (b - a), 1e-12, 700))
        result[:, 4] += np.where(weight > 1e-100, weight * mean, 0)
        through = through * np.exp(-total * (b - a))
    result[:, 3] = 1 - through
    result[:, 4] /= np.where(result[:, 3] > 0, result[:, 3], 1)
    return result


def matrix_of(transform: Any) -> np.ndarray:
    return np.array(transform.matrix, np.float64).reshape(4, 4)


def slab(transform: Any, density: float, color: Any) -> dict[str, Any]:
    return formula_dict("slab", transform, density=density, radiance=mi.ScalarVector3f(color))


def distance_to_wall(o: np.ndarray, d: np.ndarray, y: float) -> np.ndarray:
    return (y - o[:, 1]) / d[:, 1]
