"""What a model of the scene needs at the resolution of its images.

Settings that are ``None`` are found here. The measure is the number of pixels that the
longest side of the box spans in a typical view: up to :data:`USUAL` of them, presets were
measured and keep their sizes; from there on these grow with x, the octaves beyond:

- a table of 2^x as many entries: pixels see 4^x as many vertices near a surface, but more entries
  cost a step more than they bring within minutes;
- a ray through twice as many cells needs more strata, but fewer of them are evaluated:
  2^(0.6 x) as many, and as many cells along the box;
- a refresh of the occupancy looks at as many cells more as there are cells along the box.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..base.box import Corner
from ..base.errors import InputError, Option
from ..base.machine import available_memory
from ..data import Dataset, hull
from ..fields.neural import NeuralFieldConfig
from .config import PyramidConfig, SamplingConfig, TrainConfig

USUAL = 220.0  # pixels across the box; images of 200×200 that the scene fills
_EXPONENT = 0.6  # of strata and cells
_LARGEST = 22  # log2 of the entries of a level
_TABLE_SHARE = 0.05  # of the machine's memory that a table may take, without its moments
_COARSEST_PIXELS = 100  # across the images of the coarsest level of a pyramid
_PYRAMID_FROM = 400  # pixels across images for which coarser ones come first
MEMORY_SHARE = 0.125  # of the machine's, for what one step keeps
BYTES_PER_QUERY = 8192  # activations, their gradients, samples: generous for a narrow network


@dataclass(frozen=True)
class Sizes:
    """What depends on the number of pixels across the box."""

    log2_entries: int  # of a level of the hash grid
    cells: int  # of the occupancy grid along the box
    queries: int  # in one refresh of it
    samples: int  # strata a ray in training
    render_samples: int  # and in evaluation


def sizes(pixels: float, features: bool) -> Sizes:
    """The sizes for so many pixels across the box.

    Args:
        features: whether the field has trained features, a hash grid; else Fourier features
            alone, whose queries cost more and are spared by finer cells (docs/training.md).
    """
    octaves = max(0.0, math.log2(max(pixels, 1.0) / USUAL))
    more = 2 ** (_EXPONENT * octaves)
    cells = _sixteens((64 if features else 96) * more)
    return Sizes(
        log2_entries=min(_LARGEST, 16 + math.floor(octaves)),
        cells=cells,
        queries=(8192 if features else 16384) * cells // (64 if features else 96),
        samples=_sixteens(64 * more),
        render_samples=_sixteens(128 * more),
    )


def _sixteens(value: float) -> int:
    """The multiple of 16 nearest to ``value``."""
    return 16 * round(value / 16)


def fitting_batch(wanted: int, samples: int, memory: int) -> int:
    """Queries a step that keep no more than a fair part of ``memory`` bytes; a ray's at least."""
    while wanted > samples and wanted * BYTES_PER_QUERY > MEMORY_SHARE * memory:
        wanted //= 2
    return max(wanted, samples)


def fitting_entries(log2_entries: int, levels: int, features: int, memory: int) -> int:
    """The logarithm of a table's entries a level, smaller where memory (bytes) is scarce."""
    most = _TABLE_SHARE * memory / (4 * levels * features)
    return max(12, min(log2_entries, int(math.log2(max(most, 1)))))


def pyramid_levels(dataset: Dataset) -> int:
    """Coarser levels for the images: down to about 100 pixels; none for small ones."""
    side = min(dataset.intrinsics.width, dataset.intrinsics.height)
    return 0 if side < _PYRAMID_FROM else int(math.log2(side / _COARSEST_PIXELS))


def resolved(config: TrainConfig, dataset: Dataset) -> TrainConfig:
    """The configuration with all settings that follow from the data: box, sizes, pyramid.

    Raises:
        InputError: for more levels of a pyramid than the images have pixels for.
    """
    box = config.box or _box(config, dataset)
    grid, occupancy = config.grid, config.occupancy
    found = sizes(pixels_across(dataset, box[:3], box[3:]), grid is not None)
    if grid is not None and grid.log2_entries is None:
        entries = fitting_entries(
            found.log2_entries, grid.levels, grid.features, available_memory()
        )
        grid = replace(grid, log2_entries=entries)
    occupancy = replace(
        occupancy,
        resolution=_given(occupancy.resolution, found.cells),
        queries=_given(occupancy.queries, found.queries),
    )
    return replace(
        config,
        box=box,
        grid=grid,
        sampling=_sampling(config.sampling, found, grid is not None),
        occupancy=occupancy,
        pyramid=_pyramid(config.pyramid, config, dataset),
    )


def _sampling(given: SamplingConfig, found: Sizes, features: bool) -> SamplingConfig:
    """A batch that is given limits strata that are found, and the other way round."""
    samples = _given(given.samples, min(found.samples, _given(given.batch, found.samples)))
    usual = max(usual_batch(features), samples)
    return replace(
        given,
        samples=samples,
        render_samples=_given(given.render_samples, found.render_samples),
        batch=_given(given.batch, fitting_batch(usual, samples, available_memory())),
    )


def _given(value: int | None, found: int) -> int:
    return found if value is None else value


def usual_batch(features: bool) -> int:
    """Queries a step where memory allows: those of Fourier features alone cost more."""
    return 16384 if features else 4096


def _box(config: TrainConfig, dataset: Dataset) -> tuple[float, float, float, float, float, float]:
    """What the cameras see, tightened to the silhouettes: lower and upper corner."""
    lower, upper = hull.view_box(dataset)
    if config.occupancy.hull:
        lower, upper = hull.tighten(dataset, lower, upper)
    return (*lower, *upper)


def _pyramid(given: PyramidConfig, config: TrainConfig, dataset: Dataset) -> PyramidConfig:
    levels = pyramid_levels(dataset) if given.levels is None else given.levels
    film, crop = dataset.intrinsics, config.crop if config.crop_steps else 1.0
    smallest = max(1, round(crop * min(film.width, film.height)))
    if 1 << levels > smallest:
        option = Option("settings", f"pyramid.levels={levels}")
        most = int(math.log2(smallest))
        raise InputError(
            "{}: expected {} at most, for images of {}x{}", option, most, film.width, film.height
        )
    return replace(given, levels=levels)


def pixels_across(dataset: Dataset, lower: Corner, upper: Corner) -> float:
    """Pixels that the longest side of the box spans, seen from the cameras' usual distance."""
    center = (np.asarray(lower) + np.asarray(upper)) / 2
    distance = np.median(np.linalg.norm(dataset.cam_to_world[:, :3, 3] - center, axis=1))
    side = max(b - a for a, b in zip(lower, upper, strict=True))
    film = dataset.intrinsics
    if dataset.ndc is not None:  # where the film spans [−1, 1] at any distance
        return side * max(film.width, film.height) / 2
    return side * film.fx / max(float(distance), 1e-9 * side)


def resolved_octaves(dataset: Dataset, lower: Corner, upper: Corner) -> int:
    """The number of octaves L whose finest has a period of two pixels, seen from the middle.

    The box spans [−1, 1], so octave k has a period of 2^(1−k); finer ones would describe
    what no image shows.
    """
    pixels = pixels_across(dataset, lower, upper)
    return int(np.clip(round(math.log2(max(pixels, 2.0))), 1, 12))


def summary(config: TrainConfig, field: NeuralFieldConfig, image_bytes: int) -> str:
    """One line on the sizes of a resolved configuration."""
    said: list[Any] = []
    if field.grid is not None:
        grid = field.grid
        finest = f"{grid.coarsest} to {grid.finest}"
        said.append(f"{grid.levels} levels of {finest} vertices, 2^{grid.log2_entries} entries")
    else:
        said.append(f"{field.position.frequencies} octaves")
    said.append(f"field of {4 * field.parameter_count() / 2**20:.1f} MiB")
    if config.occupancy.enabled:
        said.append(f"{config.occupancy.resolution} cells along the box")
    sampling = config.sampling
    said.append(f"{sampling.samples} strata ({sampling.render_samples} in evaluation)")
    said.append(f"{sampling.batch} queries a step")
    if config.pyramid.levels:
        said.append(f"images from 1/{1 << config.pyramid.levels} size on")
    return ", ".join([*said, f"images of {image_bytes / 2**20:.0f} MiB"])
