"""OpenEXR files: colours, distances and normals, by the names of their channels.

A name is a layer and a channel, ``ViewLayer.Combined.R``; most files have one layer
without a name. Files may have several parts; what is looked for is in one of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.errors import InputError
from .damage import corruption_as_input_error

_MAIN_LAYERS = ("", "combined", "rgba", "beauty", "color")  # what is meant among several
_DISTANCES = ("Z", "Y", "V", "R")  # names of a single channel, the likeliest first
_VECTORS = (("R", "G", "B"), ("X", "Y", "Z"))


class _Layer(NamedTuple):
    """The channels of one layer of one part."""

    part: int
    name: str
    whole: bool  # whether the file holds all of the image's pixels
    planes: Mapping[str, NDArray[Any]]  # (H, W) each, by the last part of their name


def read_color(path: Path) -> tuple[NDArray[Any], bool]:
    """Premultiplied linear RGBA, (H, W, 4) halves or floats, and whether there is alpha.

    Of several layers that one is taken which has no name, or a usual one.

    Raises:
        InputError: The file is corrupt, has no channels R, G and B or cannot say which, is
            cropped, or holds a value that is not finite.
    """
    layer = _layer_with(path, ("R", "G", "B"), "channels R, G, B and perhaps A")
    _require_whole(path, layer)
    has_alpha = "A" in layer.planes
    names = "RGBA" if has_alpha else "RGB"
    planes = [layer.planes[name] for name in names]
    halves = all(plane.dtype == np.float16 for plane in planes)
    height, width = planes[0].shape
    pixels = np.ones((height, width, 4), np.float16 if halves else np.float32)
    for i, (name, plane) in enumerate(zip(names, planes, strict=True)):
        _require_shape(path, name, plane, (height, width))
        pixels[..., i] = plane
    _require_finite(path, pixels)
    return pixels, has_alpha


def read_distance(path: Path) -> NDArray[np.float32]:
    """Distances, (H, W): one channel of any name, or Z, Y, V or R among others. ∞ becomes 0.

    Raises:
        InputError: The file is missing, corrupt or cropped, has no such channel, or holds a
            value that is NaN or negative.
    """
    _require_file(path)
    layers = _layers(path)
    planes = [(name, layer) for layer in layers for name in layer.planes]
    found = planes if len(planes) == 1 else []
    for wanted in () if found else _DISTANCES:
        found = [(name, layer) for name, layer in planes if name == wanted]
        if found:
            break
    if len(found) != 1:
        raise InputError(f"{path}: expected one channel of distances, got {_listed(layers)}")
    ((name, layer),) = found
    _require_whole(path, layer)
    distance = layer.planes[name].astype(np.float32)
    broken = int(np.count_nonzero(np.isnan(distance) | (distance < 0)))
    if broken:
        raise InputError(
            f"{path}: expected distances of 0 or more, {broken} pixel(s) are NaN or negative"
        )
    return np.where(np.isinf(distance), np.float32(0), distance)


def read_normals(path: Path) -> NDArray[np.float32]:
    """Unit normals, (H, W, 3) from channels R, G, B or X, Y, Z; 0 where there is none.

    Raises:
        InputError: The file is missing, corrupt or cropped, has no such channels, or holds a
            vector that is neither 0 nor of length 1.
    """
    _require_file(path)
    layers = _layers(path)
    names = next((n for n in _VECTORS if any(set(n) <= set(x.planes) for x in layers)), None)
    if names is None:
        raise InputError(f"{path}: expected channels R, G, B of normals, got {_listed(layers)}")
    layer = next(layer for layer in layers if set(names) <= set(layer.planes))
    _require_whole(path, layer)
    shape = layer.planes[names[0]].shape
    for name in names:
        _require_shape(path, name, layer.planes[name], shape)
    normals = np.stack([layer.planes[name] for name in names], axis=-1).astype(np.float32)
    _require_finite(path, normals)
    length = np.linalg.norm(normals, axis=-1)
    wrong = int(np.count_nonzero((length > 0) & (np.abs(length - 1) > 0.01)))
    if wrong:
        raise InputError(f"{path}: expected normals of length 1 or 0, {wrong} pixel(s) have others")
    return normals


# ---- Parts, layers, channels ------------------------------------------------------


def _layers(path: Path) -> list[_Layer]:
    """All layers of all parts.

    Raises:
        InputError: The file is corrupt, or holds deep pixels.
    """
    import OpenEXR  # here: most datasets do without

    with corruption_as_input_error(path):
        # No threads of its own: the caller already has one for each core.
        file = OpenEXR.File(str(path), separate_channels=True, num_threads=0)
        parts = [(part.header, part.channels) for part in file.parts]
        if not parts:  # of a header that was cut short
            raise ValueError("it holds no image")
    whole: dict[int, bool] = {}
    layers: dict[tuple[int, str], dict[str, NDArray[Any]]] = {}
    for number, (header, channels) in enumerate(parts):
        whole[number] = np.array_equal(header["dataWindow"], header["displayWindow"])
        for name, channel in channels.items():
            layer, _, last = name.rpartition(".")
            pixels = np.asarray(channel.pixels)
            if pixels.ndim != 2 or pixels.dtype.kind not in "fu":  # deep data
                raise InputError(f"{path}: expected flat pixels, channel {name} has others")
            layers.setdefault((number, layer), {})[last] = pixels
    return [_Layer(part, name, whole[part], planes) for (part, name), planes in layers.items()]


def _layer_with(path: Path, names: tuple[str, ...], expected: str) -> _Layer:
    """The one layer that has these channels, or the main one of several."""
    layers = _layers(path)
    found = [layer for layer in layers if set(names) <= layer.planes.keys()]
    if not found:
        raise InputError(f"{path}: expected {expected}, got {_listed(layers)}")
    if len(found) == 1:
        return found[0]
    for usual in _MAIN_LAYERS:
        for layer in found:  # of several parts, the first
            if layer.name.rpartition(".")[2].lower() == usual:
                return layer
    several = ", ".join(layer.name or f"part {layer.part}" for layer in found)
    raise InputError(f"{path}: expected {expected} in one layer, got the layers {several}")


def _listed(layers: list[_Layer]) -> str:
    """The names of all channels."""
    names = [
        f"{layer.name}.{name}" if layer.name else name for layer in layers for name in layer.planes
    ]
    return ", ".join(sorted(names)) or "none"


# ---- What is refused --------------------------------------------------------------


def _require_file(path: Path) -> None:
    if not path.is_file():
        raise InputError(f"{path}: no such image")


def _require_whole(path: Path, layer: _Layer) -> None:
    if not layer.whole:
        raise InputError(f"{path}: expected a whole image, but its data window is cropped")


def _require_shape(path: Path, name: str, plane: NDArray[Any], shape: tuple[int, ...]) -> None:
    if plane.shape != shape:
        raise InputError(
            f"{path}: expected channels of one size, {name} has {plane.shape[1]}x{plane.shape[0]} "
            f"of {shape[1]}x{shape[0]} pixels"
        )


def _require_finite(path: Path, pixels: NDArray[Any]) -> None:
    broken = int(np.count_nonzero(~np.isfinite(pixels).all(axis=-1)))
    if broken:
        raise InputError(f"{path}: expected finite values, {broken} pixel(s) are NaN or infinite")
