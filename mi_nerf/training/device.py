"""What of a configuration depends on the device: a GPU is idle in steps made for two cores.

A step of a few thousand queries takes a CPU some 20 ms of arithmetic, beside which the launches
do not count. On a GPU launches are all that it takes, so there the steps are larger, and the
network sees all of their queries at once.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any

from ..base.errors import InputError, Option
from ..base.variants import has_cooperative_vectors
from .config import HALF_BLOCK, TrainConfig
from .presets import PRESETS
from .scaling import usual_batch

_LARGER = 16  # times as many queries a step on a GPU
_MORE_RAYS = 4  # times as many rays at most
_BLOCK = 1 << 18  # queries that a network evaluates at a time there


def for_device(config: TrainConfig, variant: str, given: Collection[str] = ()) -> TrainConfig:
    """The configuration of a new run for the device of a variant; on a CPU it is the same.

    Args:
        given: names of settings that are as the user wants them, besides those that are not
            what the preset says.

    Raises:
        InputError: for half precision that the device's driver does not know.
    """
    if not variant.startswith("cuda") or config.preset not in PRESETS:
        return config
    if config.half_precision and not has_cooperative_vectors(variant):
        raise InputError(
            "{}: not on this device, expected an NVIDIA driver R570 or newer with OptiX",
            Option("settings", "half_precision=true"),
        )
    usual, sampling = PRESETS[config.preset]().sampling, config.sampling
    batch = usual_batch(config.grid is not None) if sampling.batch is None else sampling.batch
    larger: dict[str, Any] = {
        "batch": sampling.batch if sampling.rays else _LARGER * batch,
        "max_rays": _MORE_RAYS * sampling.max_rays,
        "block": HALF_BLOCK if config.half_precision else max(sampling.block, _BLOCK),
    }
    for name in list(larger):
        chosen = getattr(sampling, name) != getattr(usual, name)
        if chosen or f"sampling.{name}" in given:
            del larger[name]
    return replace(config, sampling=replace(sampling, **larger))
