"""What a point of a field emits in each direction (NeRF, Fig. 3 c)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..base.color import linear_to_srgb
from ..base.errors import InputError, Option
from ..base.variants import array_module
from ..cameras.pinhole import Intrinsics, pack_poses, pixel_rays
from ..fields.protocol import Field
from ..march.marched import MarchedField
from ..march.render import render_rays
from ..tasks.tables import save_figure

Array = np.ndarray[Any, Any]

_SIZE = 96  # pixels across a hemisphere
_STEP = 1e-3  # of central differences, relative to the box


def emission_over_hemisphere(
    field: Field, point: Sequence[float], normal: Array, backend: Any, size: int = _SIZE
) -> Array:
    """The colour that leaves a point towards each direction of a hemisphere.

    Args:
        point: in the coordinates of the field's rays.
        normal: unit vector in the middle of the hemisphere.
        size: pixels across the disc on which the hemisphere is projected from above.

    Returns:
        (size, size, 4) RGBA: the field's emission, and 1 inside the disc.
    """
    side, front = _frame(normal)
    y, x = (np.mgrid[:size, :size] + 0.5) / size * 2 - 1
    inside = x**2 + y**2 < 1
    height = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    towards = x[..., None] * side - y[..., None] * front + height[..., None] * normal
    towards = towards[inside]
    p = np.repeat(np.asarray(point, np.float64)[:, None], len(towards), axis=1)
    p = _vectors(backend, field_position(field, p))
    # Light that leaves towards ω is seen by rays that travel along −ω.
    _, color = field.density_emission(p, _vectors(backend, -towards.T))
    image = np.zeros((size, size, 4))
    image[inside, :3] = np.stack([np.array(c) for c in color], axis=-1)
    image[inside, 3] = 1
    return image


def field_position(field: Field, p: Array) -> Array:
    """Points (3, N) where the field is asked about them: projected, if it lives in NDC."""
    if field.ndc is None:
        return p
    x, y, z, w = field.ndc.matrix() @ np.concatenate([p, np.ones_like(p[:1])])
    return np.array([x, y, z]) / w


def surface_normal(field: Field, point: Sequence[float], backend: Any) -> Array:
    """The direction in which the density falls off, by central differences; unit length.

    Raises:
        InputError: if the density is even there.
    """
    extent = max(b - a for a, b in zip(field.lower, field.upper, strict=True))
    offsets = np.concatenate([np.eye(3), -np.eye(3)]) * _STEP * extent
    positions = field_position(field, (np.asarray(point) + offsets).T)
    density = np.array(field.density(_vectors(backend, positions)))
    slope = density[:3].astype(np.float64) - density[3:]
    length = np.linalg.norm(slope)
    if not length > 0:
        raise InputError(f"point {tuple(point)}: no surface there, expected one in the field")
    normal: Array = -slope / length
    return normal


def find_points(
    marched: MarchedField, intrinsics: Intrinsics, poses: Array, backend: Any, count: int = 3
) -> Array:
    """Points on surfaces, spread over what some cameras see, (count, 3).

    Raises:
        InputError: if the cameras see nothing opaque.
    """
    rng = np.random.default_rng(0)
    rays = 4096
    camera = rng.integers(len(poses), size=rays).astype(np.uint32)
    x, y = rng.random((2, rays)) * [[intrinsics.width], [intrinsics.height]]
    o, d = pixel_rays(
        backend.Float(pack_poses(poses)),
        intrinsics,
        backend.UInt32(camera),
        backend.Float(x.astype(np.float32)),
        backend.Float(y.astype(np.float32)),
    )
    seen = render_rays(marched, o, d)
    opaque = np.array(seen.opacity) > 0.95
    origin, direction = (np.array(v).reshape(3, -1).T[opaque] for v in (o, d))
    points = origin + np.array(seen.depth)[opaque, None] * direction
    if len(points) < count:
        raise InputError(
            "the cameras see no surface, expected {} with its position", Option("points")
        )
    chosen = [0]
    while len(chosen) < count:  # each as far as possible from those before
        distance = np.linalg.norm(points[:, None] - points[chosen], axis=-1).min(axis=1)
        chosen.append(int(np.argmax(distance)))
    result: Array = points[chosen]
    return result


def draw_view_dependence(
    path: Path, field: Field, points: Array, variant: str
) -> list[dict[str, Any]]:
    """Draws every point's emission over its hemisphere into one picture.

    Returns:
        For each point its position, normal, mean colour and how far colours deviate from it
        (root mean square over the hemisphere, display values).
    """
    from matplotlib.figure import Figure

    backend = array_module(variant)
    figure = Figure(figsize=(2.6 * len(points), 3.1), layout="constrained")
    axes = figure.subplots(1, len(points), squeeze=False)[0]
    records = []
    for axis, point in zip(axes, points, strict=True):
        normal = surface_normal(field, point, backend)
        image = emission_over_hemisphere(field, point, normal, backend)
        color = linear_to_srgb(image[..., :3]) if field.color_space == "linear" else image[..., :3]
        inside = image[..., 3] > 0
        shown = np.concatenate([np.clip(color, 0, 1), image[..., 3:]], axis=-1)
        axis.imshow(shown, extent=(-1, 1, -1, 1))
        deviation = float(color[inside].std(axis=0).mean())
        where = ", ".join(f"{v:.2f}" for v in point)
        axis.set_title(f"({where})\ndeviation {deviation:.3f}", fontsize=9)
        axis.set_axis_off()
        records.append(
            {
                "point": [float(v) for v in point],
                "normal": normal.tolist(),
                "color": color[inside].mean(axis=0).tolist(),
                "deviation": deviation,
            }
        )
    save_figure(path, figure)
    return records


def _vectors(backend: Any, values: Array) -> Any:
    return backend.Array3f(np.ascontiguousarray(values, np.float32))


def _frame(normal: Array) -> tuple[Array, Array]:
    """Two unit vectors that make a right-handed frame with ``normal``."""
    helper = np.eye(3)[int(np.argmin(np.abs(normal)))]
    side = np.cross(helper, normal)
    side /= np.linalg.norm(side)
    return side, np.cross(normal, side)
