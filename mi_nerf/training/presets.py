"""Named starting points for :class:`TrainConfig`."""

from __future__ import annotations

from dataclasses import replace

from ..base.errors import InputError
from ..fields.fourier import FourierEncoding
from ..fields.hash_grid import HashGridConfig
from ..fields.network import NetworkConfig
from .config import (
    FROM_DATA,
    DensityConfig,
    OccupancyConfig,
    OptimizerConfig,
    PyramidConfig,
    SamplingConfig,
    TrainConfig,
)

# Sizes that follow the images: mi_nerf.training.scaling.
_OCCUPANCY = OccupancyConfig(resolution=FROM_DATA, queries=FROM_DATA)
_SAMPLING = SamplingConfig(samples=FROM_DATA, render_samples=FROM_DATA, batch=FROM_DATA)
_PYRAMID = PyramidConfig(levels=None)


def nerf() -> TrainConfig:
    """A Fourier-feature MLP made fast on the machine at hand (the default)."""
    return TrainConfig(
        preset="nerf",
        network=NetworkConfig(depth=2, width=256, skip=-1, feature_layer=False, view_width=32),
        direction=FourierEncoding(frequencies=2),
        density=DensityConfig(gain=10.0),
        occupancy=_OCCUPANCY,
        sampling=_SAMPLING,
        pyramid=_PYRAMID,
        optimizer=OptimizerConfig(lr=1e-2, lr_final=1e-3, muon=True),
    )


def fast() -> TrainConfig:
    """Features of a hash grid into a small network (Müller et al. 2022)."""
    return TrainConfig(
        preset="fast",
        network=NetworkConfig(depth=1, width=64, skip=-1, feature_layer=False, view_width=64),
        position=FourierEncoding(frequencies=0),
        grid=HashGridConfig(log2_entries=None),
        direction=FourierEncoding(frequencies=2),
        density=DensityConfig(gain=10.0),
        occupancy=_OCCUPANCY,
        sampling=replace(_SAMPLING, hidden=10.0),
        pyramid=_PYRAMID,
        optimizer=OptimizerConfig(lr=1e-2, lr_final=1e-3, epsilon=1e-15),
    )


def paper() -> TrainConfig:
    """The published model and schedule: coarse and fine network (NeRF Sec. 5.2 and 5.3)."""
    return TrainConfig(
        preset="paper",
        background="white",
        position=FourierEncoding(frequencies=10),
        density=DensityConfig(activation="relu", shift=0.0, noise=1.0),
        occupancy=OccupancyConfig(enabled=False, hull=False),
        sampling=SamplingConfig(
            samples=64, fine=128, render_samples=64, render_stop=0.0, rays=4096, batch=1 << 21
        ),
        optimizer=OptimizerConfig(warmup=0, beta2=0.999, epsilon=1e-7),
    )


def auto() -> TrainConfig:
    """Where :mod:`mi_nerf.training.auto` starts from when a run chooses its own model."""
    return replace(fast(), preset="auto")


PRESETS = {"nerf": nerf, "fast": fast, "paper": paper, "auto": auto}


def preset(name: str) -> TrainConfig:
    """The preset called ``name``.

    Raises:
        InputError: if there is none, with the names there are.
    """
    if name not in PRESETS:
        raise InputError(f"preset '{name}': unknown, expected one of {', '.join(PRESETS)}")
    return PRESETS[name]()


__all__ = ["PRESETS", "preset"]
