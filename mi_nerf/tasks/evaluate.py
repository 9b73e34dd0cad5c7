"""The ``nerf2020`` protocol: held-out views, 8 bits, on white, PSNR and SSIM.

Each image is compared on its own and the results are averaged; a PSNR is never taken
of a mean error.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np

from ..base.arrays import Image
from ..base.checks import at_least_one
from ..base.color import linear_to_srgb
from ..base.errors import InputError, Option
from ..base.files import make_folder, replacing
from ..base.variants import active_variant, array_module
from ..data import Dataset, load_dataset
from ..images.metrics import psnr, ssim, to_8bit
from ..march.view import display_image, render_view
from ..training.run import Run
from .tables import number
from .target import Target, open_target


def evaluate(
    target: str | Path | Target | Run,
    variant: str | None = None,
    *,
    data: str | Path | None = None,
    split: str = "test",
    downscale: int | None = None,
    views: int | None = None,
    images: str | Path | None = None,
    on_image: Callable[[dict[str, Any], int], None] | None = None,
) -> dict[str, Any]:
    """Measures held-out views by the nerf2020 protocol, as ``mi-nerf eval``.

    Args:
        target: a run or its folder, or a field file (then with ``data``).
        data, downscale: dataset and scale; default: as the run was trained.
        split: which views.
        views: only so many, evenly spread.
        images: write the rendered views to this folder, as 8-bit PNG on white.
        on_image: called with each image's result and the number of images.

    Returns:
        The record that ``mi-nerf eval --json`` writes: ``["mean"]["psnr"]`` in dB,
        ``["mean"]["ssim"]``, ``["images"]``, ``["seconds_per_view"]``, ``["queries_per_ray"]``.

    Raises:
        InputError: if there is no dataset to compare with, or it cannot be read.
    """
    target = open_target(target)
    dataset = held_out(target, data, split, downscale, views)
    folder = None if images is None else make_folder(images)
    backend = array_module(active_variant(variant))
    marched = target.contents.marched(backend)
    results: list[dict[str, Any]] = []
    qualities: list[dict[str, float]] = []
    seconds, queries = [], 0
    for k, name in enumerate(dataset.names):
        start = time.perf_counter()
        view = render_view(marched, dataset.intrinsics, dataset.cam_to_world[k], backend)
        seconds.append(time.perf_counter() - start)
        queries += view.queries
        predicted = to_8bit(display_image(view, marched.field.color_space))
        truth = reference_image(dataset, k)
        figures = {"psnr": psnr(predicted, truth), "ssim": ssim(predicted, truth)}
        qualities.append(figures)
        result = {"name": name, **{key: _finite(value) for key, value in figures.items()}}
        results.append(result)
        if folder is not None:
            with replacing(folder / f"{name}.png") as path:
                iio.imwrite(path, np.rint(predicted * 255).astype(np.uint8), extension=".png")
        if on_image is not None:
            on_image(result, len(dataset))
    size = dataset.intrinsics
    return {
        "protocol": "nerf2020",
        "split": split,
        "size": [size.width, size.height],
        "background": "white",
        "views": len(dataset),
        "mean": {key: _mean([q[key] for q in qualities]) for key in ("psnr", "ssim")},
        "images": results,
        # The first view also compiles kernels; the median does not feel it.
        "seconds_per_view": float(np.median(seconds)),
        "queries_per_ray": queries / (len(dataset) * size.width * size.height),
        "train_seconds": target.train_seconds,
        "parameters": target.contents.parameter_count(),
    }


def quality(record: dict[str, Any]) -> str:
    """The mean PSNR and SSIM of a record of :func:`evaluate`, for people."""
    psnr_mean, ssim_mean = record["mean"]["psnr"], record["mean"]["ssim"]
    return f"PSNR {number(psnr_mean, '.2f')} dB, SSIM {number(ssim_mean, '.4f')}"


def reference_image(dataset: Dataset, index: int) -> Image:
    """A dataset's view as the protocol sees it: sRGB, on white, in 8 bits."""
    image = dataset.subset([index]).composited(1.0)[0].astype(np.float64)
    return to_8bit(linear_to_srgb(image) if dataset.color_space == "linear" else image)


def held_out(
    target: Target,
    data: str | Path | None,
    split: str,
    downscale: int | None,
    views: int | None,
) -> Dataset:
    """The views that a target is measured on; ``data`` and ``downscale`` default to its own.

    Raises:
        InputError: if there are none, or they are not of the kind it was trained on.
    """
    scale = target.downscale if downscale is None else downscale
    at_least_one(views=1 if views is None else views, downscale=scale)
    path = Path(data) if data is not None else target.data
    if path is None:
        raise InputError(
            "{}: a field file knows no dataset, expected {} too", target.path, Option("data")
        )
    if data is None and not path.exists():
        raise InputError(
            "{}: the dataset of {} is gone, expected {}", path, target.path, Option("data")
        )
    dataset = load_dataset(path, split, downscale=scale, limit=views)
    _require_same_projection(target, dataset)
    return dataset


def _require_same_projection(target: Target, dataset: Dataset) -> None:
    """Refuses to look at a field of one capture with the cameras of another kind."""
    ours, theirs = target.contents.config.ndc, dataset.ndc
    if ours is None and theirs is None:
        return
    if ours is None or theirs is None:
        has, wants = ("a forward-facing capture", "posed images all around")
        raise InputError(
            f"{dataset.path}: {has if ours is None else wants}, expected "
            f"{wants if ours is None else has} as {target.path} was trained on"
        )
    # Cropping the remainder of a downscaled image changes the angle a little.
    scales = [(ours.scale_x, theirs.scale_x), (ours.scale_y, theirs.scale_y)]
    if any(abs(a / b - 1) > 0.05 for a, b in scales) or ours.near != theirs.near:
        raise InputError(
            f"{dataset.path}: {theirs}, expected about {ours} as {target.path} was trained with"
        )


def _mean(values: list[float]) -> float | None:
    """Without the infinite PSNR of identical images; ``None`` where any value is undefined."""
    numbers = [v for v in values if not math.isinf(v)]
    return _finite(float(np.mean(numbers))) if numbers else None


def _finite(value: float) -> float | None:
    """JSON knows neither infinity nor NaN."""
    return value if math.isfinite(value) else None
