"""The ``nerf2020`` protocol: held-out views, 8 bits, on white, PSNR and SSIM.

Each image is compared on its own and the results are averaged; a PSNR is never taken
of a mean error. Where the data has linear radiance or exact surfaces, these are compared, too.
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
from ..data import Dataset, ImageKind, evenly_spread_indices, load_dataset
from ..data.surfaces import Surfaces
from ..images.metrics import psnr, psnr_log, psnr_tone_mapped, ssim, to_8bit
from ..march.marched import MarchedField
from ..march.surfaces import field_surfaces
from ..march.view import View, display_image, linear_premultiplied, render_view
from ..training.run import Run
from .consistency import MOST_VIEWS, color_changes
from .geometry import OPAQUE, surface_figures
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
    truth: ImageKind | None = None,
    geometry: bool = True,
    on_image: Callable[[dict[str, Any], int], None] | None = None,
) -> dict[str, Any]:
    """Measures held-out views by the nerf2020 protocol, as ``mi-nerf eval``.

    Args:
        target: a run or its folder, or a field file (then with ``data``).
        data, downscale: dataset and scale; default: as the run was trained.
        split: which views.
        views: only so many, evenly spread.
        images: write the rendered views to this folder, as 8-bit PNG on white.
        truth: the files to compare with, ``"exr"`` for linear radiance or ``"png"``; default:
            those that the run was trained on.
        geometry: whether surfaces are compared where the data has exact ones.
        on_image: called with each image's result and the number of images.

    Returns:
        The record that ``mi-nerf eval --json`` writes: ``["mean"]["psnr"]`` in dB,
        ``["mean"]["ssim"]``, ``["images"]``, ``["seconds_per_view"]``, ``["queries_per_ray"]``.

    Raises:
        InputError: if there is no dataset to compare with, or it cannot be read.
    """
    target = open_target(target)
    dataset = held_out(target, data, split, downscale, views, truth)
    folder = None if images is None else make_folder(images)
    backend = array_module(active_variant(variant))
    marched = target.contents.marched(backend)
    comparison = _Comparison(dataset, marched, backend, geometry)
    seconds, queries = [], 0
    for k, name in enumerate(dataset.names):
        start = time.perf_counter()
        view = render_view(marched, dataset.intrinsics, dataset.cam_to_world[k], backend)
        seconds.append(time.perf_counter() - start)
        queries += view.queries
        picture = comparison.add(k, view)
        if folder is not None:
            with replacing(folder / f"{name}.png") as path:
                iio.imwrite(path, np.rint(picture * 255).astype(np.uint8), extension=".png")
        if on_image is not None:
            on_image(_result(name, comparison.figures[k]), len(dataset))
    comparison.finish()
    size = dataset.intrinsics
    return {
        "protocol": "nerf2020",
        "split": split,
        "size": [size.width, size.height],
        "background": "white",
        "views": len(dataset),
        "mean": _means(comparison.figures),
        "images": [_result(*pair) for pair in zip(dataset.names, comparison.figures, strict=True)],
        # The first view also compiles kernels; the median does not feel it.
        "seconds_per_view": float(np.median(seconds)),
        "queries_per_ray": queries / (len(dataset) * size.width * size.height),
        "train_seconds": target.train_seconds,
        "parameters": target.contents.parameter_count(),
    }


class _Comparison:
    """Views of a field, one after the other, against those of a dataset."""

    def __init__(
        self, dataset: Dataset, marched: MarchedField, backend: Any, geometry: bool
    ) -> None:
        self.figures: list[dict[str, float]] = []  # of every view so far
        self._dataset, self._marched, self._backend = dataset, marched, backend
        self._geometry = geometry and any(dataset.surface_files)
        some = evenly_spread_indices(len(dataset), MOST_VIEWS) if self._geometry else []
        # Of these views: picture and truth in 8 bits, exact surfaces.
        self._kept: dict[int, tuple[Image, Image, Surfaces | None]] = dict.fromkeys(
            some, (np.empty(0), np.empty(0), None)
        )

    def add(self, k: int, view: View) -> Image:
        """Compares view number ``k``, the next; returns its picture on white in 8 bits."""
        dataset, field = self._dataset, self._marched.field
        picture = to_8bit(display_image(view, field.color_space))
        truth = reference_image(dataset, k)
        figures = {"psnr": psnr(picture, truth), "ssim": ssim(picture, truth)}
        if dataset.color_space == "linear":
            radiance = linear_premultiplied(view.color, view.opacity, field.color_space)
            exact = dataset.image(k)[..., :3]
            figures["psnr_tone_mapped"] = psnr_tone_mapped(radiance, exact)
            figures["psnr_log"] = psnr_log(radiance, exact)
        surfaces = dataset.surfaces(k) if self._geometry else None
        if surfaces is not None:
            figures |= self._surface_figures(k, surfaces)
        if k in self._kept:
            # NaN is black here: the figures of pictures say that it is there.
            numbers = (np.nan_to_num(255 * image) for image in (picture, truth))
            whole = [np.rint(image).astype(np.uint8) for image in numbers]
            self._kept[k] = (whole[0], whole[1], surfaces)
        self.figures.append(figures)
        return picture

    def _surface_figures(self, k: int, surfaces: Surfaces) -> dict[str, float]:
        found = field_surfaces(
            self._marched,
            surfaces.camera,
            self._dataset.cam_to_world[k],
            self._backend,
            normals=surfaces.normal is not None,
        )
        covered = self._dataset.image(k)[..., 3] >= OPAQUE if self._dataset.has_alpha else None
        return surface_figures(found, surfaces, covered)

    def finish(self) -> None:
        """Compares all views with each other."""
        if not self._kept:
            return
        pictures, truths, surfaces = zip(*self._kept.values(), strict=True)
        poses = self._dataset.cam_to_world[list(self._kept)]
        changes = color_changes(pictures, truths, surfaces, self._dataset.intrinsics, poses)
        for k, change in zip(self._kept, changes, strict=True):
            self.figures[k] |= change or {}


def _result(name: str, figures: dict[str, float]) -> dict[str, Any]:
    return {"name": name, **{key: _finite(value) for key, value in figures.items()}}


def _means(figures: list[dict[str, float]]) -> dict[str, float | None]:
    """Of each figure, over the views that have it.

    Pictures that cannot be compared leave no mean; a view in which there is nothing to
    compare, no surface or none that another view sees, is left out.
    """
    names = dict.fromkeys(name for each in figures for name in each)
    means: dict[str, float | None] = {}
    for name in names:
        values = [each[name] for each in figures if name in each]
        if name not in _OF_PICTURES:
            values = [value for value in values if not math.isnan(value)]
        means[name] = _mean(values)
    return means


_OF_PICTURES = ("psnr", "ssim", "psnr_tone_mapped", "psnr_log")


def quality(record: dict[str, Any]) -> str:
    """The mean PSNR and SSIM of a record of :func:`evaluate`, for people."""
    psnr_mean, ssim_mean = record["mean"]["psnr"], record["mean"]["ssim"]
    return f"PSNR {number(psnr_mean, '.2f')} dB, SSIM {number(ssim_mean, '.4f')}"


def more_quality(record: dict[str, Any]) -> list[str]:
    """What a record says of radiance and of surfaces, a line each, where it does."""
    mean, lines = record["mean"], []
    if "psnr_log" in mean:
        lines.append(
            f"radiance: PSNR {number(mean['psnr_tone_mapped'], '.2f')} dB tone-mapped, "
            f"{number(mean['psnr_log'], '.2f')} dB of its logarithm"
        )
    if "depth_error" in mean:
        percent = [number(mean[name], ".2%") for name in ("depth_error", "depth_error_95")]
        said = [f"distance off by {percent[0]} in the median, by {percent[1]} at most in 95 %"]
        if "normal_error" in mean:
            said.append(f"normals by {number(mean['normal_error'], '.1f')} degrees")
        said.append(f"silhouettes IoU {number(mean['silhouette_iou'], '.4f')}")
        lines.append(f"surfaces: {', '.join(said)}")
    if "consistency" in mean:
        changes = [number(mean[n], ".4f") for n in ("color_change", "color_change_truth")]
        lines.append(
            f"colours of surface points over views change by {changes[0]}, in truth by "
            f"{changes[1]}; {number(mean['consistency'], '.4f')} of it the truth does not share"
        )
    return lines


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
    images: ImageKind | None = None,
) -> Dataset:
    """The views that a target is measured on; what is not given defaults to its own.

    Args:
        images: the kind of files to read.

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
    dataset = load_dataset(
        path, split, downscale=scale, limit=views, images=images or target.images
    )
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
