"""Networks trained by two PyTorch ports of the original code, as fields of mi_nerf.

Depths, widths, the skip layer and the number of octaves follow from the shapes of the
tensors. What does not follow is what the two codes fix: rectified density, logistic
colour, sRGB, frequencies 2^k (without π), directions of length 1, no scaling of space.
Their densities are per unit of length of world space, as here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..base.box import Corner, grid_shape
from ..base.errors import InputError, Option
from ..base.tensor_file import Arrays
from ..base.variants import array_module
from ..fields.fourier import Convention, FourierEncoding
from ..fields.network import NetworkConfig
from ..fields.neural import NeuralFieldConfig
from ..march.occupancy import THRESHOLD, OccupancyGrid, greatest_around
from ..march.settings import MarchSettings
from .field_file import FieldFile
from .torch_file import Checkpoint, read_checkpoint
from .torch_pickle import StoredTensor

Which = Literal["fine", "coarse"]

_LOOKS = 4  # at random points of each cell, before it counts as empty


@dataclass(frozen=True)
class ImportSettings:
    """What a checkpoint does not say."""

    network: Which | None = None  # none: the fine one, the coarse one placing its samples
    # The objects of nerf_synthetic, which these codes are mostly trained on, lie within.
    lower: Corner = (-1.5, -1.5, -1.5)
    upper: Corner = (1.5, 1.5, 1.5)
    samples: int | None = None  # strata a ray; none: 64, or 256 of a single network
    fine: int | None = None  # more, where the coarse network sees something; none: 128
    convention: Convention = "one"  # frequencies 2^k, 2^k·π or 2^k·2π


def import_network(path: str | Path, settings: ImportSettings) -> FieldFile:
    """Reads a checkpoint of either layout as a field; runs nothing that it contains.

    With two networks of one architecture, the coarse one places the fine one's samples.

    Raises:
        InputError: if it is damaged, of another layout, or an architecture that a field
            cannot have.
    """
    checkpoint = read_checkpoint(path)
    layout, key = _find(checkpoint, settings.network)
    config, weights = _read_network(checkpoint, layout, key, settings)
    coarse, coarse_key = None, layout.keys["coarse"]
    if settings.network is None and key != coarse_key and coarse_key in checkpoint.content:
        coarse_config, coarse = _read_network(checkpoint, layout, coarse_key, settings)
        coarse = coarse if coarse_config == config else None
    samples, fine = (64, 128) if coarse is not None else (256, 0)
    march = MarchSettings(
        samples=samples if settings.samples is None else settings.samples,
        fine=fine if settings.fine is None or coarse is None else settings.fine,
    )
    provenance = {"imported_from": Path(path).name, "state_dict": key}
    return FieldFile(config, weights, march=march, provenance=provenance, coarse=coarse)


def _read_network(
    checkpoint: Checkpoint, layout: _Layout, key: str, settings: ImportSettings
) -> tuple[NeuralFieldConfig, Arrays]:
    """One network of a checkpoint: its architecture and its weights."""
    tensors = _Tensors(checkpoint, key)
    parts = layout.read(tensors)
    tensors.require_all_used()
    network, weights = _assemble(tensors, parts, layout)
    position = _encoding(tensors, parts.trunk[0].inputs, "position", settings.convention)
    direction = FourierEncoding(frequencies=4, convention=settings.convention)
    if network.view_dependent:
        size = parts.view[0].inputs - network.width
        direction = _encoding(tensors, size, "direction", settings.convention)
    config = NeuralFieldConfig(
        lower=settings.lower,
        upper=settings.upper,
        position=position,
        direction=direction,
        network=network,
        density_activation="relu",
        density_shift=0.0,
    )
    return config, weights


def occupied_cells(contents: FieldFile, variant: str, resolution: int) -> np.ndarray[Any, Any]:
    """(X, Y, Z) booleans: where the field was seen to be dense, and the cells around.

    Args:
        resolution: cells along the longest side of the box.
    """
    backend = array_module(variant)
    field, _ = contents.build(backend)
    cells = np.ones(grid_shape(field.lower, field.upper, resolution), bool)
    grid = OccupancyGrid.surveyed(field, cells, backend.Float, looks=_LOOKS)
    grid.draw_line(THRESHOLD)
    return greatest_around(grid.mask())  # what is thin and was missed lies beside what was seen


# --------------------------------------------------------------------------
#   Layouts
# --------------------------------------------------------------------------


@dataclass(frozen=True)
class _Linear:
    """One layer y = W·x + b; ``name`` as in the checkpoint."""

    name: str
    weight: np.ndarray[Any, Any]  # (outputs, inputs)
    bias: np.ndarray[Any, Any]

    @property
    def outputs(self) -> int:
        return int(self.weight.shape[0])

    @property
    def inputs(self) -> int:
        return int(self.weight.shape[1])


@dataclass(frozen=True)
class _Parts:
    """The layers of a network, by what they do."""

    trunk: list[_Linear]
    density: _Linear
    feature: _Linear | None
    view: list[_Linear]
    color: _Linear

    def layers(self) -> list[_Linear]:
        """All of them, in the order of :meth:`NetworkConfig.layers`."""
        feature = [] if self.feature is None else [self.feature]
        return [*self.trunk, self.density, *feature, *self.view, self.color]


@dataclass(frozen=True)
class _Layout:
    """How one code names its networks and orders what it concatenates."""

    keys: dict[Which, str]
    read: Callable[[_Tensors], _Parts]
    feature_relu: bool
    position_first: bool  # at the skip, γ(x) comes before the trunk's activations


class _Tensors:
    """One state dict of a checkpoint; keeps track of what was used."""

    def __init__(self, checkpoint: Checkpoint, key: str) -> None:
        self.where = f"{checkpoint.path}: {key}"
        state = checkpoint.content[key]
        if not isinstance(state, dict):
            raise InputError(f"{self.where}: holds no tensors, expected a state dict")
        # torch.nn.DataParallel puts 'module.' before every name.
        self._state = {str(name).removeprefix("module."): value for name, value in state.items()}
        self._checkpoint = checkpoint
        self._unused = set(self._state)

    def __contains__(self, layer: str) -> bool:
        return f"{layer}.weight" in self._state

    def linear(self, name: str) -> _Linear:
        """The layer ``name``, in double precision."""
        weight, bias = self._array(f"{name}.weight"), self._array(f"{name}.bias")
        if weight.ndim != 2 or bias.shape != weight.shape[:1] or not weight.size:
            raise InputError(
                f"{self.where}: '{name}' has weights {weight.shape} and biases {bias.shape}, "
                "expected (outputs, inputs) and (outputs,)"
            )
        return _Linear(name, weight, bias)

    def layers(self, name: str) -> list[_Linear]:
        """The layers ``name.0``, ``name.1``, …; at least one."""
        result = [self.linear(f"{name}.0")]
        while f"{name}.{len(result)}" in self:
            result.append(self.linear(f"{name}.{len(result)}"))
        return result

    def ignore(self, prefix: str) -> None:
        """Tensors that the code keeps without using them."""
        self._unused = {name for name in self._unused if not name.startswith(prefix)}

    def require_all_used(self) -> None:
        """Refuses networks with more layers than were asked for."""
        if self._unused:
            raise InputError(
                f"{self.where}: unexpected tensor '{min(self._unused)}' for this layout"
            )

    def _array(self, name: str) -> np.ndarray[Any, Any]:
        if name not in self._state:
            raise InputError(f"{self.where}: tensor '{name}' is missing")
        self._unused.discard(name)
        tensor = self._state[name]
        if not isinstance(tensor, StoredTensor):
            raise InputError(f"{self.where}: '{name}' is no tensor")
        array = self._checkpoint.array(tensor)
        if array.dtype.kind != "f" or not np.isfinite(array).all():
            what = "infinite or undefined" if array.dtype.kind == "f" else str(array.dtype)
            raise InputError(
                f"{self.where}: tensor '{name}' holds {what} numbers, "
                "expected finite ones of type float16, float32 or float64"
            )
        return array.astype(np.float64)


def _read_original(tensors: _Tensors) -> _Parts:
    """The port of the original code: pts_linears, views_linears, and heads."""
    trunk = tensors.layers("pts_linears")
    if "output_linear" in tensors:  # trained without directions
        tensors.ignore("views_linears.")
        density, color = _split_output(tensors, "output_linear")
        return _Parts(trunk, density, None, [], color)
    return _Parts(
        trunk,
        tensors.linear("alpha_linear"),
        tensors.linear("feature_linear"),
        tensors.layers("views_linears"),
        tensors.linear("rgb_linear"),
    )


def _read_flexible(tensors: _Tensors) -> _Parts:
    """The flexible model of the other code: layer1, layers_xyz, layers_dir, and heads.

    Nothing comes between layer1 and layers_xyz.0, so they are one layer: the product.
    """
    first, rest = tensors.linear("layer1"), tensors.layers("layers_xyz")
    second = _sized(tensors, rest[0], rest[0].outputs, first.outputs)
    product = _Linear(
        second.name, second.weight @ first.weight, second.weight @ first.bias + second.bias
    )
    trunk = [product, *rest[1:]]
    if "fc_out" in tensors:  # trained without directions
        density, color = _split_output(tensors, "fc_out")
        return _Parts(trunk, density, None, [], color)
    return _Parts(
        trunk,
        tensors.linear("fc_alpha"),
        tensors.linear("fc_feat"),
        tensors.layers("layers_dir"),
        tensors.linear("fc_rgb"),
    )


def _split_output(tensors: _Tensors, name: str) -> tuple[_Linear, _Linear]:
    """Density and colour from one layer of outputs r, g, b, σ and perhaps an unused one."""
    both = tensors.linear(name)
    if both.outputs not in (4, 5):
        raise InputError(f"{tensors.where}: '{name}' has {both.outputs} outputs, expected 4 or 5")
    color = _Linear(name, both.weight[:3], both.bias[:3])
    return _Linear(name, both.weight[3:4], both.bias[3:4]), color


_LAYOUTS = (
    _Layout(
        {"coarse": "network_fn_state_dict", "fine": "network_fine_state_dict"},
        _read_original,
        feature_relu=False,
        position_first=True,
    ),
    _Layout(
        {"coarse": "model_coarse_state_dict", "fine": "model_fine_state_dict"},
        _read_flexible,
        feature_relu=True,
        position_first=False,
    ),
)


def _find(checkpoint: Checkpoint, wanted: Which | None) -> tuple[_Layout, str]:
    """The layout, and the name of the state dict to read."""
    for layout in _LAYOUTS:
        present = [w for w, key in layout.keys.items() if checkpoint.content.get(key) is not None]
        if not present:
            continue
        which = wanted or ("fine" if "fine" in present else "coarse")
        if which not in present:
            raise InputError(
                "{}: holds no {} network, expected {}",
                checkpoint.path,
                which,
                Option("network", present[0]),
            )
        return layout, layout.keys[which]
    found = ", ".join(sorted(str(key) for key in checkpoint.content)[:5]) or "nothing"
    expected = " or ".join(layout.keys["coarse"] for layout in _LAYOUTS)
    raise InputError(f"{checkpoint.path}: holds {found}, expected {expected}")


# --------------------------------------------------------------------------
#   From layers to a network
# --------------------------------------------------------------------------


def _assemble(tensors: _Tensors, parts: _Parts, layout: _Layout) -> tuple[NetworkConfig, Arrays]:
    """The shape of the network, and its weights by the names of mi_nerf."""
    position, width = parts.trunk[0].inputs, parts.trunk[0].outputs
    seen = max(parts.view[0].inputs - width, 0) if parts.view else 0
    network = NetworkConfig(
        depth=len(parts.trunk),
        width=width,
        skip=_skip(tensors, parts.trunk),
        feature_layer=parts.feature is not None,
        feature_relu=parts.feature is not None and layout.feature_relu,
        view_depth=len(parts.view),
        view_width=parts.view[0].outputs if parts.view else 1,
        view_dependent=seen > 0,
    )
    shapes, weights = network.shapes(position, seen), {}
    for layer, linear in zip(network.layers(), parts.layers(), strict=True):
        names = list(layer.matrices())
        _sized(tensors, linear, layer.outputs, sum(shapes[name][1] for name in names))
        if layer.sees == "position" and layout.position_first:
            names.reverse()
        start = 0
        for name in names:
            weights[name] = linear.weight[:, start : start + shapes[name][1]]
            start += shapes[name][1]
        weights[layer.bias] = linear.bias
    return network, {name: array.astype(np.float32) for name, array in weights.items()}


def _skip(tensors: _Tensors, trunk: list[_Linear]) -> int:
    """The layer that sees the position again, −1 for none."""
    both = trunk[0].outputs + trunk[0].inputs
    skips = [i for i, layer in enumerate(trunk) if i and layer.inputs == both]
    if len(skips) > 1:
        raise InputError(
            f"{tensors.where}: '{trunk[skips[0]].name}' and '{trunk[skips[1]].name}' both see "
            "the position again, expected one such layer at most"
        )
    return skips[0] if skips else -1


def _sized(tensors: _Tensors, layer: _Linear, outputs: int, inputs: int) -> _Linear:
    """The layer itself, if it has these sizes."""
    if (layer.outputs, layer.inputs) != (outputs, inputs):
        raise InputError(
            f"{tensors.where}: '{layer.name}' has {layer.inputs} inputs and {layer.outputs} "
            f"outputs, expected {inputs} and {outputs}"
        )
    return layer


def _encoding(tensors: _Tensors, size: int, what: str, convention: Convention) -> FourierEncoding:
    """Six features an octave, and three more where the vector itself is one."""
    octaves, rest = divmod(size, 6)
    if rest not in (0, 3):
        raise InputError(
            f"{tensors.where}: {size} features of a {what}, expected 6 an octave, or 3 more"
        )
    try:
        return FourierEncoding(octaves, convention, include_input=rest == 3)
    except ValueError as error:
        raise InputError(f"{tensors.where}: {what} {error}") from error
