"""A field together with how rays march through it."""

from __future__ import annotations

from dataclasses import dataclass

from ..fields.protocol import Field
from .occupancy import OccupancyGrid
from .settings import MarchSettings


@dataclass(frozen=True)
class MarchedField:
    """A field, how rays through it are sampled, and which cells they may pass over."""

    field: Field
    settings: MarchSettings
    occupancy: OccupancyGrid | None = None  # without it, samples are taken all over the box
