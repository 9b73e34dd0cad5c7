"""How a picture is divided into parts of bounded memory.

Samplers whose samples know nothing of each other (``independent``) are divided into passes over
the whole picture. The others spread the points of a pixel over all of its samples: they keep them
all, and the picture is divided into tiles instead. Where neither is possible, because light comes
from anywhere (``ptracer``) or the camera is not ours, a pass is a smaller set of its own, as large
as the sampler can make it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from ..cameras.pinhole import Intrinsics

# Samples that one call of mi.render traces at most: bounds its memory, and the time
# until Ctrl-C is heard.
SAMPLES_PER_PASS = 1 << 24

# Bytes that generating takes: program, scene and kernels; for each pixel, films, the two images of
# a view and of the one before, which is being written. Samples are traced in one kernel, and take
# next to nothing.
_BYTES, _BYTES_PER_PIXEL = 350_000_000, 300


@dataclass(frozen=True)
class Tile:
    """A part of a picture: its left top pixel, and a camera that sees no more than it."""

    x: int
    y: int
    intrinsics: Intrinsics

    @property
    def pixels(self) -> int:
        """Of the tile."""
        return self.intrinsics.width * self.intrinsics.height

    @property
    def place(self) -> tuple[slice, slice]:
        """Its rows and columns in the picture."""
        camera = self.intrinsics
        return slice(self.y, self.y + camera.height), slice(self.x, self.x + camera.width)


def memory(pixels: int) -> int:
    """About how many bytes generating pictures of so many pixels takes, beside a large scene."""
    return _BYTES + _BYTES_PER_PIXEL * pixels


def fits(samples: int, pixels: int) -> bool:
    """Whether a picture can be traced at once."""
    return samples * pixels <= SAMPLES_PER_PASS


def passes(samples: int, pixels: int, limit: int | None = None) -> list[int]:
    """``samples`` a pixel in parts that each trace a bounded number of paths."""
    count = -(-samples * pixels // (limit or SAMPLES_PER_PASS))
    count = min(samples, max(1, count))
    return [samples // count + (i < samples % count) for i in range(count)]


def tiles(intrinsics: Intrinsics, samples: int, limit: int | None = None) -> list[Tile]:
    """A picture in parts of one size that each trace at most ``limit`` paths, or one pixel.

    Rows of whole width where they are short enough. The last ones move back to stay inside the
    picture, so some pixels belong to two tiles.
    """
    limit = limit or SAMPLES_PER_PASS
    size = intrinsics.width, intrinsics.height
    width = min(size[0], max(1, limit // samples))
    height = min(size[1], max(1, limit // (samples * width))) if width == size[0] else 1
    return [
        Tile(
            x,
            y,
            replace(
                intrinsics,
                width=width,
                height=height,
                cx=intrinsics.cx - x,
                cy=intrinsics.cy - y,
            ),
        )
        for y in _starts(size[1], height)
        for x in _starts(size[0], width)
    ]


def sets(samples: int, pixels: int, sampler: Any, limit: int | None = None) -> list[int]:
    """At least ``samples`` a pixel, in equal sets as large as ``sampler`` can make them.

    Args:
        sampler: A Mitsuba sampler; its number of samples is changed.
    """
    limit = limit or SAMPLES_PER_PASS
    if samples * pixels <= limit:
        return [samples]
    size = _largest_set(max(1, limit // pixels), sampler)
    count = math.ceil(samples / size)
    even = math.ceil(samples / count)
    return [even if taken(even, sampler) == even else size] * count


def _largest_set(most: int, sampler: Any) -> int:
    """The largest number of samples up to ``most`` that a sampler takes, or its smallest."""
    for wanted in range(most, 0, -1):
        if taken(wanted, sampler) == wanted:
            return wanted
    return taken(1, sampler)


def taken(count: int, sampler: Any) -> int:
    """The number of samples that a sampler makes of ``count``."""
    sampler.set_sample_count(count)
    return int(sampler.sample_count())


def _starts(length: int, part: int) -> list[int]:
    return [min(i, length - part) for i in range(0, length, part)]
