"""A neural radiance field: features of position and direction into an MLP."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import numpy as np

from ..base.arrays import Floats, Tensor, Vectors, upload, vector3_type
from ..base.box import Corner
from ..base.color import ColorSpace
from ..base.kernel_stages import settled, stage
from ..cameras.ndc import Ndc
from . import network
from .activations import ColorActivation, DensityActivation, apply_activation
from .blas_network import network_product, worth_blas
from .fourier import FourierEncoding, stack_rows
from .frozen_features import FrozenFeatures
from .fused_network import FusedNetwork, HalfNetwork, worth_fusing
from .hash_grid import HashGrid, HashGridConfig
from .network import NetworkConfig, rows
from .noise import DensityNoise
from .protocol import Field


@dataclass(frozen=True)
class NeuralFieldConfig:
    """Everything that describes a neural field, apart from its weights."""

    lower: Corner = (-1.0, -1.0, -1.0)  # the box, in scene units
    upper: Corner = (1.0, 1.0, 1.0)
    color_space: ColorSpace = "srgb"
    position: FourierEncoding = field(default_factory=FourierEncoding)
    grid: HashGridConfig | None = None  # trained features of the position, besides the others
    direction: FourierEncoding = field(default_factory=lambda: FourierEncoding(frequencies=4))
    network: NetworkConfig = field(default_factory=NetworkConfig)
    density_activation: DensityActivation = "softplus"
    density_shift: float = -1.0  # added to the raw density before its activation
    density_scale: float = 1.0  # 1/scene unit: the density of activation output 1
    color_activation: ColorActivation = "sigmoid"
    input_center: Corner = (0.0, 0.0, 0.0)  # the network sees (p − center) · scale
    input_scale: float = 1.0
    ndc: Ndc | None = None  # forward-facing captures: box and positions are in its space

    def __post_init__(self) -> None:
        if not all(a < b for a, b in zip(self.lower, self.upper, strict=True)):
            raise ValueError(f"box: lower {self.lower} must lie below upper {self.upper}")
        for name, value, choices in (
            ("density_activation", self.density_activation, ("softplus", "relu", "exp")),
            ("color_activation", self.color_activation, ("sigmoid", "softplus", "exp")),
            ("color_space", self.color_space, ("srgb", "linear")),
        ):
            if value not in choices:
                raise ValueError(f"{name}={value!r}, expected one of {', '.join(choices)}")

    @property
    def position_size(self) -> int:
        """Number of features of a position."""
        return self.position.size + (0 if self.grid is None else self.grid.size)

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of all parameters."""
        shapes = self.network.shapes(self.position_size, self.direction.size)
        if self.grid is not None:
            shapes[network.GRID] = (self.grid.entries(), self.grid.features)
        return shapes

    def parameter_count(self) -> int:
        """Number of trainable scalars."""
        return sum(int(np.prod(shape)) for shape in self.shapes().values())

    def in_box(self, lower: Corner, upper: Corner) -> NeuralFieldConfig:
        """The same model over another box: inputs and densities scale with it.

        The longest side spans [−1, 1], so every axis has the same frequencies, and
        densities count per half of that side: what the network has to learn does not
        depend on the unit of the scene.
        """
        half = max(b - a for a, b in zip(lower, upper, strict=True)) / 2
        x, y, z = ((a + b) / 2 for a, b in zip(lower, upper, strict=True))
        return dataclasses.replace(
            self,
            lower=lower,
            upper=upper,
            input_center=(x, y, z),
            input_scale=1 / half,
            density_scale=self.density_scale * self._half_side() / half,
        )

    def _half_side(self) -> float:
        return max(b - a for a, b in zip(self.lower, self.upper, strict=True)) / 2


class NeuralField(Field):
    """Features of position and direction into an MLP (NeRF Sec. 4 and 5.1)."""

    coarse: NeuralField | None
    _noise: DensityNoise | None = None  # added to raw densities, in training
    level_weights: Any = None  # of the hash grid's levels, where they join one by one
    _loss_scale: Any = None  # one value, in training: the network runs in half precision

    def __init__(
        self,
        config: NeuralFieldConfig,
        weights: Mapping[str, np.ndarray[Any, Any]],
        tensor_type: Any,
        coarse: NeuralField | None = None,
    ) -> None:
        """Uploads ``weights`` as ``tensor_type`` (such as ``mi.TensorXf``).

        Raises:
            ValueError: if a tensor is missing, unexpected or of the wrong shape.
        """
        self.config = config
        self.lower, self.upper, self.color_space = config.lower, config.upper, config.color_space
        self.ndc, self.coarse = config.ndc, coarse
        shapes = config.shapes()
        if unknown := sorted(set(weights) - set(shapes)):
            raise ValueError(f"unexpected tensor '{unknown[0]}' for this architecture")
        for name, shape in shapes.items():
            if name not in weights:
                raise ValueError(f"tensor '{name}' is missing, expected shape {shape}")
            if weights[name].shape != shape:
                raise ValueError(f"tensor '{name}' is {weights[name].shape}, expected {shape}")
        self._weights = {name: upload(tensor_type, weights[name]) for name in shapes}
        self._on_host = worth_blas(config.network, tensor_type)
        self._grid = self._frozen = None
        if config.grid is not None:
            self._grid = HashGrid(config.grid, type(self._weights[network.GRID].array))
            self._frozen = FrozenFeatures(self._features_of)

    @classmethod
    def create(
        cls,
        config: NeuralFieldConfig,
        seed: int,
        tensor_type: Any,
        coarse: NeuralField | None = None,
    ) -> NeuralField:
        """A field with freshly initialised weights."""
        return cls(config, network.initial_weights(config.shapes(), seed), tensor_type, coarse)

    def for_training(
        self, noise: float = 0.0, seed: int = 0, loss_scale: Any = None
    ) -> NeuralField:
        """This field with the same weights, as one step of training looks at it.

        Args:
            noise: standard deviation of what is added to raw densities (NeRF, appendix A).
            seed: of the noise; the coarse field's is the next one.
            loss_scale: an array of one value, with which the network runs in half
                precision; see :class:`mi_nerf.fields.fused_network.HalfNetwork`.
        """
        view = copy.copy(self)
        view._noise = DensityNoise(noise, seed) if noise > 0 else None
        view._loss_scale = loss_scale
        if self.coarse is not None:
            view.coarse = self.coarse.for_training(noise, seed + 1, loss_scale)
        return view

    def parameters(self) -> dict[str, Any]:
        """The network's tensors by name; assign with ``tensor[:] = …`` or replace the entry."""
        return self._weights

    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """A copy of all tensors as NumPy arrays, of the grid as its levels count now."""
        found = {name: np.array(tensor) for name, tensor in self._weights.items()}
        if self.level_weights is not None and self.config.grid is not None:
            weights = np.repeat(np.array(self.level_weights), self.config.grid.level_entries())
            found[network.GRID] *= weights[:, None]
        return found

    def density(self, p: Vectors) -> Floats:
        if self._on_host and not _recorded():
            return self._density(self._product(p)[0], p)
        raw = network.density_head(self.config.network, self._weights, self._trunk(p))
        return self._density(raw, p)

    def density_emission(self, p: Vectors, d: Vectors) -> tuple[Floats, list[Floats]]:
        """σ in 1/scene unit and the colour emitted along ``d``, in ``color_space``."""
        config = self.config
        if self._loss_scale is not None:
            return self._answer(HalfNetwork(config.network, self._weights, self._loss_scale), p, d)
        if self._on_host and not _recorded():
            density, *color = self._product(p, d)
            return self._density(density, p), self._color(color)
        h, direction = self._trunk(p), self._direction(d)
        raw = network.color_head(config.network, self._weights, h, direction)
        density = network.density_head(config.network, self._weights, h)
        return self._density(density, p), self._color(raw)

    def fused(self, emission: bool = True) -> Callable[..., Any] | None:
        """See :meth:`Field.fused`; ``None`` where that would be slower."""
        config = self.config
        if not worth_fusing(config.network, type(next(iter(self._weights.values())).array)):
            return None
        fused = FusedNetwork(config.network, self._weights)

        def density_emission(p: Vectors, d: Vectors) -> tuple[Floats, list[Floats]]:
            return self._answer(fused, p, d)

        def density(p: Vectors) -> Floats:
            return self._density(fused.density(self._features(p)), p)

        return density_emission if emission else density

    def fused_along(self, d: Vectors) -> Callable[..., Any] | None:
        """See :meth:`Field.fused_along`; the first layer's share of the direction is hoisted."""
        config = self.config
        if not worth_fusing(config.network, type(next(iter(self._weights.values())).array)):
            return None
        fused, seen = FusedNetwork(config.network, self._weights), None
        if config.network.view_dependent:
            seen = fused.seen(config.direction.features(d))

        def density_emission(p: Vectors) -> tuple[Floats, list[Floats]]:
            density, color = fused.answer(self._features(p), seen)
            return self._density(density, p), self._color(color)

        return density_emission

    def _answer(self, fused: FusedNetwork, p: Vectors, d: Vectors) -> tuple[Floats, list[Floats]]:
        config = self.config
        direction = config.direction.features(d) if config.network.view_dependent else None
        density, color = fused(self._features(p), direction)
        return self._density(density, p), self._color(color)

    def _trunk(self, p: Vectors) -> Tensor:
        with stage("encoding"):
            position = settled(self._position(p))
        return network.trunk(self.config.network, self._weights, position)

    def _product(self, p: Vectors, d: Vectors | None = None) -> list[Floats]:
        """Raw density, and raw colours with ``d``, by matrix products of the host's."""
        weights = {n: w for n, w in self._weights.items() if n != network.GRID}
        emission = d is not None
        with stage("encoding"):
            features = {"position": self._position(p)}
            if emission and self.config.network.view_dependent:
                features["direction"] = self.config.direction(d)
            features = settled(features)  # together, as the product takes them
        raw = network_product(self.config.network, weights, features, emission=emission)
        return rows(raw)

    def _position(self, p: Vectors) -> Tensor:
        if self._frozen is None or dr.grad_enabled(p) or _recorded():
            return stack_rows(self._features(p))
        return self._frozen(self._unit(p), self._weights[network.GRID], self.level_weights)

    def _direction(self, d: Vectors) -> Tensor | None:
        if not self.config.network.view_dependent:
            return None
        with stage("encoding"):
            return settled(self.config.direction(d))

    def _unit(self, p: Vectors) -> Vectors:
        config = self.config
        return vector3_type(type(p[0]))(
            *((p[i] - config.input_center[i]) * config.input_scale for i in range(3))
        )

    def _features(self, p: Vectors) -> list[Floats]:
        table = None if self._grid is None else self._weights[network.GRID]
        return self._features_of(self._unit(p), table, self.level_weights)

    def _features_of(self, unit: Vectors, table: Tensor, level_weights: Floats) -> list[Floats]:
        features = self.config.position.features(unit)
        if self._grid is not None:
            features += self._grid.features(unit, table, level_weights)
        return features

    def _color(self, raw: list[Floats]) -> list[Floats]:
        return [apply_activation(self.config.color_activation, c) for c in raw]

    def _density(self, raw: Floats, p: Vectors) -> Floats:
        config = self.config
        raw = raw + config.density_shift
        if self._noise is not None:
            raw = raw + self._noise.at(p)
        return apply_activation(config.density_activation, raw) * config.density_scale


def _recorded() -> bool:
    """Whether ``dr.freeze`` of a caller records: it sees no work of the host."""
    return bool(dr.flag(dr.JitFlag.FreezingScope))
