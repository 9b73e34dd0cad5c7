"""Field files: what XML scenes load. Weights, description, occupancy and how to sample."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError
from ..base.schema import Key, Number, Record
from ..base.tensor_file import Arrays, prefixed, read_tensors, write_tensors
from ..cameras.ndc import Ndc
from ..fields.fourier import FourierEncoding
from ..fields.hash_grid import HashGridConfig
from ..fields.network import NetworkConfig
from ..fields.neural import NeuralField, NeuralFieldConfig
from ..march.marched import MarchedField
from ..march.occupancy import OccupancyGrid
from ..march.settings import MarchSettings

NEWEST = 1  # version of the format; a key that is added has ``since`` the next one

# What a file says. Files from before 0.1.0 may lack what has a meaning where it is absent.
_ENCODING = Record(
    FourierEncoding,
    {"frequencies": Key(int), "convention": Key(str), "include_input": Key(bool)},
)
_GRID = Record(
    HashGridConfig,
    {
        "levels": Key(int),
        "features": Key(int),
        "log2_entries": Key(int),
        "coarsest": Key(int),
        "finest": Key(int | None),
    },
)
_NETWORK = Record(
    NetworkConfig,
    {
        "depth": Key(int),
        "width": Key(int),
        "skip": Key(int),
        "feature_layer": Key(bool),
        "feature_relu": Key(bool, absent=False),
        "view_depth": Key(int),
        "view_width": Key(int),
        "view_dependent": Key(bool),
    },
)
_FIELD = Record(
    NeuralFieldConfig,
    {
        "lower": Key(list),
        "upper": Key(list),
        "color_space": Key(str),
        "position": Key(_ENCODING),
        "grid": Key(_GRID, absent=None),
        "direction": Key(_ENCODING),
        "network": Key(_NETWORK),
        "density_activation": Key(str),
        "density_shift": Key(Number),
        "density_scale": Key(Number),
        "color_activation": Key(str),
        "input_center": Key(list),
        "input_scale": Key(Number),
        "ndc": Key(
            Record(Ndc, {"scale_x": Key(Number), "scale_y": Key(Number), "near": Key(Number)}),
            absent=None,
        ),
    },
)
_MARCH = Record(
    MarchSettings,
    {
        "samples": Key(int),
        "fine": Key(int, absent=0),
        "near": Key(Number | None),
        "far": Key(Number | None),
        "rule": Key(str, absent="constant"),
        "stop": Key(Number, absent=0.0),
    },
)
_DESCRIPTION = Record(
    dict,
    {
        "field": Key(dict),  # a ``kind``, and the keys of _FIELD
        "density_unit": Key(str),
        "occupancy_shape": Key(list | None),
        "march": Key(_MARCH),
        "provenance": Key(dict),
    },
)


@dataclass(frozen=True)
class FieldFile:
    """The contents of a field file, on the host."""

    config: NeuralFieldConfig
    weights: Arrays
    occupancy: np.ndarray[Any, Any] | None = None  # (X, Y, Z) booleans over the box
    march: MarchSettings = field(default_factory=MarchSettings)  # sampling that suits the field
    provenance: dict[str, Any] = field(default_factory=dict)  # free-form, for people
    coarse: Arrays | None = None  # weights of the coarse network, of the same architecture

    def parameter_count(self) -> int:
        """Number of trainable scalars, of both networks if there are two."""
        return self.config.parameter_count() * (1 if self.coarse is None else 2)

    def build(self, backend: Any) -> tuple[NeuralField, OccupancyGrid | None]:
        """Uploads the field to a backend (``drjit.llvm.ad``, or ``mitsuba`` with a variant)."""
        tensors = backend.TensorXf
        coarse = None if self.coarse is None else NeuralField(self.config, self.coarse, tensors)
        neural = NeuralField(self.config, self.weights, tensors, coarse)
        if self.occupancy is None:
            return neural, None
        grid = OccupancyGrid(neural.lower, neural.upper, self.occupancy, backend.Float)
        return neural, grid

    def marched(self, backend: Any) -> MarchedField:
        """The same, with the sampling that suits it."""
        neural, grid = self.build(backend)
        return MarchedField(neural, self.march, grid)


def save_field(path: str | Path, contents: FieldFile) -> None:
    """Writes a field file, atomically."""
    arrays = {f"weights.{name}": array for name, array in contents.weights.items()}
    if contents.coarse is not None:
        arrays |= {f"coarse.{name}": array for name, array in contents.coarse.items()}
    if contents.occupancy is not None:
        arrays["occupancy"] = np.packbits(contents.occupancy)
    description = {
        "field": {"kind": "neural", **_FIELD.write(contents.config)},
        "density_unit": "1/scene unit",
        "occupancy_shape": None if contents.occupancy is None else contents.occupancy.shape,
        "march": _MARCH.write(contents.march),
        "provenance": contents.provenance,
    }
    version = max(_FIELD.version(contents.config), _MARCH.version(contents.march))
    write_tensors(path, arrays, kind="field", version=version, description=description)


def load_field(path: str | Path) -> FieldFile:
    """Reads a field file.

    Raises:
        InputError: if it is missing, damaged, newer than this program, or its tensors do not
            fit its description.
    """
    arrays, text = read_tensors(path, kind="field", newest=NEWEST)
    try:
        description = _DESCRIPTION.read(text)
        occupancy = None
        if description["occupancy_shape"] is not None:
            occupancy = _unpack(arrays["occupancy"], description["occupancy_shape"])
        contents = FieldFile(
            _field_config(description["field"]),
            prefixed(arrays, "weights."),
            occupancy,
            description["march"],
            description["provenance"],
            prefixed(arrays, "coarse.") or None,
        )
    except KeyError as error:
        raise InputError(f"{path}: damaged field description: {error} is missing") from error
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: damaged field description: {error}") from error
    for group in (contents.weights, contents.coarse):
        if group is not None:
            _check_weights(path, contents.config, group)
    return contents


def _unpack(packed: np.ndarray[Any, Any], shape: tuple[int, ...]) -> np.ndarray[Any, Any]:
    """(X, Y, Z) booleans from eight to a byte; NumPy would fill up what is missing."""
    count = int(np.prod(shape))
    if len(shape) != 3 or min(shape) < 1 or packed.size != -(-count // 8):
        raise ValueError(f"occupancy of {packed.size} bytes does not fit the shape {shape}")
    return np.unpackbits(packed, count=count).astype(bool).reshape(shape)


def _field_config(data: dict[str, Any]) -> NeuralFieldConfig:
    kind = data.get("kind")
    if kind not in ("neural", "fourier"):  # the first one's old name
        raise ValueError(f"field kind '{kind}', expected 'neural'")
    rest = {name: value for name, value in data.items() if name != "kind"}
    config: NeuralFieldConfig = _FIELD.read(rest, "field.")
    return config


def _check_weights(path: str | Path, config: NeuralFieldConfig, weights: Arrays) -> None:
    shapes = config.shapes()
    found = {name: array.shape for name, array in weights.items()}
    for name in sorted(shapes.keys() | found.keys()):
        if shapes.get(name) != found.get(name):
            raise InputError(
                f"{path}: tensor '{name}' is {found.get(name, 'missing')}, "
                f"expected {shapes.get(name, 'no such tensor')}"
            )
    for name, array in weights.items():
        if array.dtype.kind != "f":
            raise InputError(
                f"{path}: tensor '{name}' holds {array.dtype}, expected floating-point numbers"
            )
