"""Which field suits a dataset: its box, its encodings, and the cells that may hold something."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from ..base.box import Corner, grid_shape
from ..data import Dataset, hull
from ..fields.fourier import FourierEncoding
from ..fields.neural import NeuralFieldConfig
from .config import TrainConfig


def field_config(config: TrainConfig, dataset: Dataset) -> NeuralFieldConfig:
    """The field that a run trains: the configured model over the dataset's box."""
    if config.box is not None:
        lower, upper = config.box[:3], config.box[3:]
    else:
        lower, upper = hull.view_box(dataset)
        if config.occupancy.hull:
            lower, upper = hull.tighten(dataset, lower, upper)
    color = config.color_activation
    if color == "auto":
        color = "sigmoid" if dataset.color_space == "srgb" else "exp"
    grid = config.grid
    if grid is not None and grid.finest is None:
        finest = 2 ** (resolved_octaves(dataset, lower, upper) + 1)
        grid = replace(grid, finest=max(grid.coarsest, finest))
    model = NeuralFieldConfig(
        color_space=dataset.color_space,
        position=config.position
        or FourierEncoding(frequencies=resolved_octaves(dataset, lower, upper)),
        grid=grid,
        direction=config.direction,
        network=config.network,
        density_activation=config.density.activation,
        density_shift=config.density.shift,
        density_scale=config.density.gain,
        color_activation=color,
        ndc=dataset.ndc,
    )
    return model.in_box(lower, upper)


def resolved_octaves(dataset: Dataset, lower: Corner, upper: Corner) -> int:
    """The number of octaves L whose finest has a period of two pixels, seen from the middle.

    The box spans [−1, 1], so octave k has a period of 2^(1−k); finer ones would describe
    what no image shows.
    """
    center = (np.asarray(lower) + np.asarray(upper)) / 2
    distance = np.median(np.linalg.norm(dataset.cam_to_world[:, :3, 3] - center, axis=1))
    side = max(b - a for a, b in zip(lower, upper, strict=True))
    film = dataset.intrinsics
    pixels = side * film.fx / max(float(distance), 1e-9 * side)
    if dataset.ndc is not None:  # where the film spans [−1, 1] at any distance
        pixels = side * max(film.width, film.height) / 2
    return int(np.clip(round(math.log2(max(pixels, 2.0))), 1, 12))


def carved_cells(
    config: TrainConfig, dataset: Dataset, field: NeuralFieldConfig
) -> np.ndarray[Any, Any]:
    """The cells of the field's box that may hold something, (X, Y, Z) booleans."""
    options = config.occupancy
    if options.hull:
        return hull.carve(dataset, field.lower, field.upper, options.resolution)
    return np.ones(grid_shape(field.lower, field.upper, options.resolution), bool)
