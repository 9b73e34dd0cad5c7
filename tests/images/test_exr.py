"""OpenEXR files of all kinds that renderers write, and one line for each that is of no use."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import OpenEXR
import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.images.exr import read_color, read_distance, read_normals
from tests.support.datasets import write_exr

HEADER = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}


def plane(value: float = 0.0, kind: Any = np.float32) -> np.ndarray:
    return np.linspace(value, value + 1, 30, dtype=kind).reshape(5, 6)


def rgb(layer: str = "", value: float = 0.0) -> dict[str, np.ndarray]:
    prefix = f"{layer}." if layer else ""
    return {f"{prefix}{name}": plane(value + i) for i, name in enumerate("RGB")}


def parts(path: Path, *content: dict[str, np.ndarray]) -> None:
    """A file of several parts, in this order."""
    OpenEXR.File(
        [OpenEXR.Part(dict(HEADER), channels, f"part {i}") for i, channels in enumerate(content)]
    ).write(str(path))


# ---- Colours ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("channels", "layer"),
    [
        (rgb(), 0.0),
        ({**rgb(), "Z": plane(9)}, 0.0),
        (rgb("ViewLayer.Combined", 3), 3.0),
        ({**rgb("ViewLayer.Combined", 3), **rgb("ViewLayer.DiffCol", 6)}, 3.0),
        ({**rgb("albedo", 6), **rgb()}, 0.0),
    ],
)
def test_colours_by_layer(channels: dict[str, np.ndarray], layer: float, tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", **channels)
    pixels, has_alpha = read_color(tmp_path / "a.exr")
    assert not has_alpha and pixels.dtype == np.float32
    expected = np.stack([plane(layer + i) for i in range(3)] + [np.ones((5, 6))], axis=-1)
    assert np.array_equal(pixels, expected.astype(np.float32))


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_colours_of_one_of_several_parts(order: tuple[int, int], tmp_path: Path) -> None:
    content = ({"Z": plane(5)}, {**rgb(value=2), "A": plane(0)})
    parts(tmp_path / "a.exr", *(content[i] for i in order))
    pixels, has_alpha = read_color(tmp_path / "a.exr")
    assert has_alpha
    assert np.array_equal(pixels[..., 0], plane(2)) and np.array_equal(pixels[..., 3], plane(0))


def test_of_several_parts_with_colours_the_first(tmp_path: Path) -> None:
    parts(tmp_path / "a.exr", rgb(value=2), rgb(value=4))
    assert np.array_equal(read_color(tmp_path / "a.exr")[0][..., 0], plane(2))


def test_halves_stay_halves_only_together(tmp_path: Path) -> None:
    halves = {name: plane(kind=np.float16) for name in "RGB"}
    write_exr(tmp_path / "a.exr", **halves)
    write_exr(tmp_path / "b.exr", **{**halves, "A": plane()})
    assert read_color(tmp_path / "a.exr")[0].dtype == np.float16
    assert read_color(tmp_path / "b.exr")[0].dtype == np.float32


@pytest.mark.parametrize(
    ("channels", "message"),
    [
        ({"Y": plane()}, "expected channels R, G, B and perhaps A, got Y"),
        ({"R": plane(), "G": plane()}, "expected channels R, G, B and perhaps A, got G, R"),
        ({**rgb("left"), **rgb("right")}, r"in one layer, got the layers left, right"),
        ({**rgb(), "A": plane() + np.nan}, r"30 pixel\(s\) are NaN or infinite"),
    ],
)
def test_colours_that_cannot_be_read(
    channels: dict[str, np.ndarray], message: str, tmp_path: Path
) -> None:
    write_exr(tmp_path / "a.exr", **channels)
    with pytest.raises(InputError, match=message) as error:
        read_color(tmp_path / "a.exr")
    assert str(error.value).startswith(f"{tmp_path / 'a.exr'}: ")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("blue", "message"),
    [
        (plane()[::2, ::2], "expected channels of one size, B has 3x3 of 6x5 pixels"),
        (np.array([[plane()]]), "expected flat pixels, channel B has others"),
    ],
)
def test_channels_that_our_writer_does_not_write(
    blue: np.ndarray, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Channels of fewer pixels, and deep ones."""
    planes = {"R": plane(), "G": plane(), "B": blue}
    channels = {name: SimpleNamespace(pixels=pixels) for name, pixels in planes.items()}
    header = {"dataWindow": (0, 0), "displayWindow": (0, 0)}
    part = SimpleNamespace(header=header, channels=channels)
    monkeypatch.setattr(OpenEXR, "File", lambda *_, **__: SimpleNamespace(parts=[part]))
    with pytest.raises(InputError, match=message):
        read_color(tmp_path / "a.exr")


# ---- Distances and normals ----------------------------------------------------


@pytest.mark.parametrize("name", ["Y", "Z", "V", "R", "depth.V", "anything"])
def test_distances_by_any_name(name: str, tmp_path: Path) -> None:
    write_exr(tmp_path / "d.exr", **{name: plane(2)})
    found = read_distance(tmp_path / "d.exr")
    assert found.dtype == np.float32 and np.array_equal(found, plane(2))


def test_distances_among_other_channels(tmp_path: Path) -> None:
    write_exr(tmp_path / "d.exr", **rgb(), Z=plane(2))
    assert np.array_equal(read_distance(tmp_path / "d.exr"), plane(2))


def test_what_is_infinitely_far_is_nothing(tmp_path: Path) -> None:
    far = plane(2)
    far[1, 2] = np.inf
    write_exr(tmp_path / "d.exr", Y=far)
    found = read_distance(tmp_path / "d.exr")
    assert found[1, 2] == 0 and np.count_nonzero(found) == 29


@pytest.mark.parametrize("value", [np.nan, -1.0, -np.inf])
def test_what_is_no_distance(value: float, tmp_path: Path) -> None:
    broken = plane(2)
    broken[0, :2] = value
    write_exr(tmp_path / "d.exr", Y=broken)
    with pytest.raises(InputError, match=r"d\.exr: .* 2 pixel\(s\) are NaN or negative"):
        read_distance(tmp_path / "d.exr")


def test_no_channel_of_distances(tmp_path: Path) -> None:
    write_exr(tmp_path / "d.exr", a=plane(), b=plane())
    with pytest.raises(InputError, match=r"d\.exr: expected one channel of distances, got a, b"):
        read_distance(tmp_path / "d.exr")


@pytest.mark.parametrize("names", ["RGB", "XYZ"])
@pytest.mark.parametrize("kind", [np.float16, np.float32])
def test_normals(names: str, kind: Any, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(5, 6, 3))
    vectors /= np.linalg.norm(vectors, axis=-1, keepdims=True)
    vectors[0] = 0
    planes = {n: np.ascontiguousarray(vectors[..., i], kind) for i, n in enumerate(names)}
    write_exr(tmp_path / "n.exr", **planes)
    assert read_normals(tmp_path / "n.exr") == pytest.approx(vectors, abs=1e-3)


@pytest.mark.parametrize(
    ("channels", "message"),
    [
        ({"Y": plane()}, "expected channels R, G, B of normals, got Y"),
        (dict.fromkeys("RGB", plane(2)), r"normals of length 1 or 0, 30 pixel\(s\)"),
        (dict.fromkeys("RGB", plane() * np.nan), r"30 pixel\(s\) are NaN"),
    ],
)
def test_normals_that_cannot_be_read(
    channels: dict[str, np.ndarray], message: str, tmp_path: Path
) -> None:
    write_exr(tmp_path / "n.exr", **channels)
    with pytest.raises(InputError, match=rf"n\.exr: .*{message}"):
        read_normals(tmp_path / "n.exr")


@pytest.mark.parametrize("read", [read_distance, read_normals, read_color])
def test_files_that_are_not_there_or_damaged(read: Any, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.exr: "):
        read(tmp_path / "none.exr")
    write_exr(tmp_path / "a.exr", **rgb())
    damaged = tmp_path / "b.exr"
    damaged.write_bytes((tmp_path / "a.exr").read_bytes()[:150])
    with pytest.raises(InputError, match=r"b\.exr: corrupt or unreadable image \(\w"):
        read(damaged)
