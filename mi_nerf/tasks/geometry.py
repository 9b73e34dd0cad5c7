"""A field's surfaces against the exact ones of a view: distance, normal, silhouette.

Of a pixel, the field's surface is where its ray ends in the mean, and counts where the field
is at least half opaque (:mod:`mi_nerf.march.surfaces`).
"""

from __future__ import annotations

import numpy as np

from ..base.arrays import Image
from ..data.surfaces import Surfaces
from ..march.surfaces import FieldSurfaces

OPAQUE = 0.5  # opacity from which there is something


def surface_figures(
    found: FieldSurfaces, true: Surfaces, covered: Image | None = None
) -> dict[str, float]:
    """How far the surfaces of one view are off; NaN where nothing can be compared.

    - ``depth_error``: the median of \\|d − D\\| / D over pixels where both have a surface;
      ``depth_error_95``: what 95 % of them do not exceed.
    - ``normal_error``: the mean angle to the exact normal there, in degrees; 90 where the
      field has no normal. Left out where either has none at all.
    - ``silhouette_iou``: the pixels in both silhouettes over those in either.

    Args:
        covered: (H, W) booleans, the exact silhouette; none: where there is a surface.
    """
    opaque, there = found.opacity >= OPAQUE, true.depth > 0
    both = opaque & there
    exact = true.depth[both].astype(np.float64)
    errors = np.abs(found.depth[both] - exact) / exact
    figures = {
        "depth_error": float(np.median(errors)) if errors.size else np.nan,
        "depth_error_95": float(np.quantile(errors, 0.95)) if errors.size else np.nan,
    }
    if found.normal is not None and true.normal is not None:
        angles = _angles(found.normal[both], true.normal[both])
        figures["normal_error"] = float(np.mean(angles)) if angles.size else np.nan
    figures["silhouette_iou"] = _iou(opaque, there if covered is None else covered)
    return figures


def _angles(a: Image, b: Image) -> Image:
    """Degrees between vectors, (N, 3); 90 where one is 0. Of vectors that are exact, exactly 0.

    By the arc tangent, as the cosine of small angles has lost their digits.
    """
    x, y = a.astype(np.float64), b.astype(np.float64)
    across = np.linalg.norm(np.cross(x, y), axis=-1)
    along = np.sum(x * y, axis=-1)
    angles: Image = np.degrees(np.arctan2(across, along))
    return np.where((across == 0) & (along == 0), 90.0, angles)


def _iou(a: Image, b: Image) -> float:
    """Intersection over union of two masks; NaN if both are empty."""
    union = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / union if union else float("nan")
