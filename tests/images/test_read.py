"""Damaged images are the user's fault; faults of the program are not."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from mi_nerf.base.errors import InputError
from mi_nerf.images.read import read_image
from tests.support.datasets import write_exr

DAMAGE = [
    OSError("truncated"),
    SyntaxError("broken PNG file"),
    ValueError("Truncated IHDR chunk"),
    EOFError(),
    struct.error("unpack requires 4 bytes"),
    Image.DecompressionBombError("too many pixels"),
]
FAULTS = [AttributeError("fault"), TypeError("fault"), KeyError("fault"), MemoryError()]


def raises(error: BaseException) -> Any:
    def fail(*_: Any, **__: Any) -> None:
        raise error

    return fail


@pytest.fixture
def png(tmp_path: Path) -> Path:
    path = tmp_path / "image.png"
    Image.fromarray(np.zeros((4, 5, 3), np.uint8)).save(path)
    return path


@pytest.mark.parametrize("error", DAMAGE, ids=lambda error: type(error).__name__)
def test_what_decoders_say_of_damaged_files(
    png: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    monkeypatch.setattr(Image, "open", raises(error))
    with pytest.raises(InputError, match=r"image\.png: corrupt or unreadable image \(\w"):
        read_image(png)


@pytest.mark.parametrize("error", FAULTS, ids=lambda error: type(error).__name__)
@pytest.mark.parametrize("suffix", [".png", ".exr"])
def test_faults_of_the_program_come_through(
    png: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException, suffix: str
) -> None:
    plane = np.zeros((4, 5), np.float32)
    write_exr(png.with_suffix(".exr"), R=plane, G=plane, B=plane)
    monkeypatch.setattr(Image, "open", raises(error))
    monkeypatch.setattr(OpenEXR, "File", raises(error))
    with pytest.raises(type(error)) as raised:
        read_image(png.with_suffix(suffix))
    assert raised.value is error
