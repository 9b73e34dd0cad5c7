"""Field files: what XML scenes load. Weights, description, occupancy and how to sample."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError
from ..base.tensor_file import Arrays, prefixed, read_tensors, write_tensors
from ..cameras.ndc import Ndc
from ..fields.fourier import FourierEncoding
from ..fields.hash_grid import HashGridConfig
from ..fields.network import NetworkConfig
from ..fields.neural import NeuralField, NeuralFieldConfig
from ..march.occupancy import OccupancyGrid
from ..march.settings import MarchSettings

VERSION = 1


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


def save_field(path: str | Path, contents: FieldFile) -> None:
    """Writes a field file, atomically."""
    arrays = {f"weights.{name}": array for name, array in contents.weights.items()}
    if contents.coarse is not None:
        arrays |= {f"coarse.{name}": array for name, array in contents.coarse.items()}
    if contents.occupancy is not None:
        arrays["occupancy"] = np.packbits(contents.occupancy)
    names = ("samples", "fine", "near", "far", "rule", "stop")
    march = {name: getattr(contents.march, name) for name in names}
    description = {
        "field": {"kind": "neural", **dataclasses.asdict(contents.config)},
        "density_unit": "1/scene unit",
        "occupancy_shape": None if contents.occupancy is None else contents.occupancy.shape,
        "march": march,
        "provenance": contents.provenance,
    }
    write_tensors(path, arrays, kind="field", version=VERSION, description=description)


def load_field(path: str | Path) -> FieldFile:
    """Reads a field file.

    Raises:
        InputError: if it is missing, damaged, of another version, or its tensors do not
            fit its description.
    """
    arrays, description = read_tensors(path, kind="field", version=VERSION)
    try:
        config = _field_config(description["field"])
        weights, coarse = prefixed(arrays, "weights."), prefixed(arrays, "coarse.")
        occupancy = None
        if description["occupancy_shape"] is not None:
            occupancy = _unpack(arrays["occupancy"], tuple(description["occupancy_shape"]))
        march = MarchSettings(**description["march"])
        contents = FieldFile(
            config, weights, occupancy, march, description["provenance"], coarse or None
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
    values = dict(data)
    if (kind := values.pop("kind")) not in ("neural", "fourier"):  # the first one's old name
        raise ValueError(f"field kind '{kind}', expected 'neural'")
    for name in ("lower", "upper", "input_center"):
        values[name] = tuple(values[name])
    for name in ("position", "direction"):
        values[name] = FourierEncoding(**values[name])
    values["network"] = NetworkConfig(**values["network"])
    if values.get("grid") is not None:  # files of Fourier fields may not mention it
        values["grid"] = HashGridConfig(**values["grid"])
    if values.get("ndc") is not None:  # files of fields in scene space may not mention it
        values["ndc"] = Ndc(**values["ndc"])
    return NeuralFieldConfig(**values)


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
