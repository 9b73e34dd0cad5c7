"""Which field suits a dataset: its box, its encodings, and the cells that may hold something."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ..base.box import grid_shape
from ..data import Dataset, hull
from ..fields.fourier import FourierEncoding
from ..fields.neural import NeuralFieldConfig
from .config import TrainConfig
from .scaling import resolved, resolved_octaves


def field_config(config: TrainConfig, dataset: Dataset) -> NeuralFieldConfig:
    """The field that a run trains: the configured model over the dataset's box."""
    config = resolved(config, dataset)
    assert config.box is not None  # any more
    lower, upper = config.box[:3], config.box[3:]
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


def carved_cells(
    config: TrainConfig, dataset: Dataset, field: NeuralFieldConfig
) -> np.ndarray[Any, Any]:
    """The cells of the field's box that may hold something, (X, Y, Z) booleans."""
    options = resolved(replace(config, box=(*field.lower, *field.upper)), dataset).occupancy
    if options.hull:
        return hull.carve(dataset, field.lower, field.upper, options.resolution)
    return np.ones(grid_shape(field.lower, field.upper, options.resolution), bool)
