"""What decoders raise for damaged files, as the one error that users see."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image

from ..base.errors import InputError

# What Pillow and OpenEXR raise for damaged files. Others are faults of the program.
_DAMAGE = (
    OSError,
    EOFError,
    SyntaxError,
    ValueError,
    RuntimeError,
    struct.error,
    Image.DecompressionBombError,
)


@contextmanager
def corruption_as_input_error(path: Path) -> Iterator[None]:
    """Decoders raise exceptions of many types for damaged files; users see one."""
    try:
        yield
    except _DAMAGE as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: corrupt or unreadable image ({reason})") from error
