"""Every setting of a training run, with its default: one frozen dataclass a concern."""

from __future__ import annotations

import dataclasses
import json
import types
import typing
from dataclasses import dataclass, field
from typing import Any, Literal

from ..activations import ColorActivation, DensityActivation
from ..encoding import FourierEncoding
from ..errors import InputError
from ..network import NetworkConfig


@dataclass(frozen=True)
class DensityConfig:
    """How raw network outputs become densities."""

    activation: DensityActivation = "softplus"
    shift: float = -1.0  # added before the activation (softplus(x − 1): mip-NeRF)
    gain: float = 1.0  # density of activation output 1, per half side of the box


@dataclass(frozen=True)
class OccupancyConfig:
    """The grid that spares the field's evaluation in empty space."""

    enabled: bool = True
    hull: bool = True  # start from the silhouettes, where images have alpha
    resolution: int = 64  # cells along the longest side of the box
    threshold: float = 0.01  # optical thickness of a cell below which it counts as empty
    decay: float = 0.9  # of remembered densities, at each refresh of a cell
    every: int = 16  # steps between refreshes
    queries: int = 8192  # cells looked at in one refresh
    start: int = 256  # steps before the first refresh


@dataclass(frozen=True)
class SamplingConfig:
    """Rays and the samples on them."""

    samples: int = 64  # strata a ray in training
    render_samples: int = 128  # strata a ray in evaluation, and what the field file suggests
    batch: int = 32768  # field queries a step, at most
    max_rays: int = 16384  # rays a step, at most
    rays: int | None = None  # rays a step; none: as many as fill the batch
    near: float | None = None  # fixed bounds instead of the box alone, scene units
    far: float | None = None
    block: int = 16384  # queries the network evaluates at a time


@dataclass(frozen=True)
class OptimizerConfig:
    """Adam with warm-up and exponential decay."""

    lr: float = 5e-4  # learning rate after warm-up
    lr_final: float = 5e-5  # learning rate at the end of the schedule
    warmup: int = 100  # steps of linear increase
    beta1: float = 0.9
    beta2: float = 0.99
    epsilon: float = 1e-8


@dataclass(frozen=True)
class TrainConfig:
    """A training run, resolved: what ``config.json`` records."""

    preset: str = "nerf"
    seed: int = 0
    steps: int | None = None  # stop after so many steps
    max_seconds: float | None = None  # stop after so much wall-clock time
    downscale: int = 1  # images are averaged over blocks of K×K pixels
    box: tuple[float, float, float, float, float, float] | None = None  # min, max; none: found
    background: Literal["auto", "white", "black", "random"] = "auto"
    loss: Literal["auto", "mse", "relative"] = "auto"
    color_activation: Literal["auto"] | ColorActivation = "auto"
    network: NetworkConfig = field(default_factory=NetworkConfig)
    position: FourierEncoding | None = None  # none: as many octaves as the images resolve
    direction: FourierEncoding = field(default_factory=lambda: FourierEncoding(frequencies=4))
    density: DensityConfig = field(default_factory=DensityConfig)
    occupancy: OccupancyConfig = field(default_factory=OccupancyConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    report_every: float = 2.0  # seconds between lines of the log
    checkpoint_every: float = 60.0  # seconds between checkpoints
    collapse_check: int = 400  # steps after which a run that learnt nothing restarts
    max_restarts: int = 3
    max_skipped: int = 20  # non-finite steps in a row that end the run
    store_activations: float = 6.0  # GiB of activations kept for the backward pass


def to_json(config: TrainConfig) -> dict[str, Any]:
    """The configuration as plain JSON values."""
    result: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(config)))
    return result


def from_json(data: dict[str, Any], source: str) -> TrainConfig:
    """Rebuilds a configuration; ``source`` names the file in error messages."""
    try:
        config: TrainConfig = _build(TrainConfig, data)
    except (TypeError, ValueError, KeyError) as error:
        raise InputError(
            f"{source}: not a training configuration of this version: {error}"
        ) from error
    return config


def _build(cls: Any, data: dict[str, Any]) -> Any:
    hints = typing.get_type_hints(cls)
    values = {}
    for key, value in data.items():
        nested = _nested(hints[key])
        if nested is not None and value is not None:
            value = _build(nested, value)
        elif isinstance(value, list):
            value = tuple(value)
        values[key] = value
    return cls(**values)


def with_settings(config: TrainConfig, assignments: list[str]) -> TrainConfig:
    """Applies ``key=value`` assignments; nested settings as ``network.width=128``.

    Raises:
        InputError: for an unknown key, a value of the wrong kind or out of range.
    """
    for assignment in assignments:
        key, separator, text = assignment.partition("=")
        if not separator:
            raise InputError(f"--set {assignment}: expected key=value")
        config = _assign(config, key.split("."), text, assignment)
    return config


def setting_names(config: Any = None, prefix: str = "") -> list[str]:
    """All keys that ``--set`` accepts."""
    config = TrainConfig() if config is None else config
    names = []
    for f in dataclasses.fields(config):
        nested = _nested(typing.get_type_hints(type(config))[f.name])
        if nested is not None:
            names += setting_names(nested(), f"{prefix}{f.name}.")
        else:
            names.append(prefix + f.name)
    return names


def _assign(config: Any, path: list[str], text: str, assignment: str) -> Any:
    name, rest = path[0], path[1:]
    hints = typing.get_type_hints(type(config))
    nested = _nested(hints[name]) if name in hints else None
    if name not in hints or bool(rest) != (nested is not None):
        raise InputError(
            f"--set {assignment}: unknown setting, expected one of {', '.join(setting_names())}"
        )
    if nested is not None:
        value = _assign(getattr(config, name) or nested(), rest, text, assignment)
    else:
        value = _parse(text, hints[name], assignment)
    try:
        return dataclasses.replace(config, **{name: value})
    except ValueError as error:
        raise InputError(f"--set {assignment}: {error}") from error


def _nested(hint: Any) -> Any:
    """The dataclass that a setting holds, or may hold; ``None`` for plain values."""
    for option in (hint, *typing.get_args(hint)):
        if dataclasses.is_dataclass(option):
            return option
    return None


def _parse(text: str, hint: Any, assignment: str) -> Any:
    """Reads ``text`` as the type ``hint``."""
    options = typing.get_args(hint)
    origin = typing.get_origin(hint)
    if origin is Literal:
        if text in options:
            return text
        raise InputError(f"--set {assignment}: expected one of {', '.join(options)}")
    if origin in (typing.Union, types.UnionType):
        if type(None) in options and text.lower() in ("none", "null"):
            return None
        for option in options:
            if option is type(None):
                continue
            try:
                return _parse(text, option, assignment)
            except InputError as error:
                failure = error
        raise failure
    try:
        if hint is bool:
            return {"true": True, "1": True, "false": False, "0": False}[text.lower()]
        if origin is tuple:
            values = tuple(float(part) for part in text.split(","))
            if len(values) != len(options):
                raise ValueError
            return values
        return hint(text)
    except (ValueError, KeyError):
        name = getattr(hint, "__name__", str(hint))
        if origin is tuple:
            name = f"{len(options)} numbers separated by commas"
        raise InputError(f"--set {assignment}: expected {name}") from None
