"""Posed images: what every reader returns and everything else consumes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.box import Box
from ..base.color import ColorSpace
from ..base.errors import InputError
from ..cameras.ndc import Ndc
from ..cameras.pinhole import Intrinsics
from ..images.stored import is_stored, premultiplied
from .surfaces import SurfaceFiles, Surfaces


# Compared by identity: equality of arrays has no single truth value.
@dataclass(frozen=True, eq=False)
class Dataset:
    """One split of a dataset, N views by one camera, in memory.

    Raises:
        ValueError: The fields disagree about the number or the size of the views.
    """

    path: Path  # the dataset's folder
    split: str  # "train", "val", "test" or another name that the folder knows
    names: tuple[str, ...]  # of the views, e.g. "r_0"
    # (N, H, W, 4) RGBA in `color_space`: premultiplied floats, or straight 8 or 16 bits as
    # the files hold them; see mi_nerf.images.stored. `image(i)` and `premultiplied()` are floats.
    images: NDArray[Any]
    color_space: ColorSpace  # "srgb" for 8- and 16-bit files, "linear" for EXR
    has_alpha: bool  # False: the files have no alpha channel and alpha is 1
    cam_to_world: NDArray[np.float64]  # (N, 4, 4), OpenGL axes
    intrinsics: Intrinsics  # shared by all views, of the images as they are here
    near: float | None = None  # z-depths between which the scene lies, scene units,
    far: float | None = None  # where the dataset says so
    box: Box | None = None  # (min, max) corners of the scene, world space, likewise
    # Forward-facing captures: the projection that tames their depth; `box` is then in its space.
    ndc: Ndc | None = None
    # The exact surfaces of the views, where they are known: one a view, or none at all.
    surface_files: tuple[SurfaceFiles | None, ...] = ()

    def __post_init__(self) -> None:
        n, size = len(self.names), (self.intrinsics.height, self.intrinsics.width)
        if self.images.shape != (n, *size, 4):
            raise ValueError(f"{n} views of {size} pixels, but images have {self.images.shape}")
        if not is_stored(self.images.dtype):
            raise ValueError(f"images of type {self.images.dtype}, expected 8 or 16 bits or floats")
        if self.cam_to_world.shape != (n, 4, 4):
            raise ValueError(f"{n} views, but poses have shape {self.cam_to_world.shape}")
        if len(self.surface_files) not in (0, n):
            raise ValueError(f"{n} views, but surfaces of {len(self.surface_files)}")

    def __len__(self) -> int:
        """The number of views."""
        return len(self.names)

    def image(self, index: int) -> NDArray[np.float32]:
        """View number ``index``, (H, W, 4) premultiplied."""
        return premultiplied(self.images[index])

    def premultiplied(self) -> NDArray[np.float32]:
        """All views, (N, H, W, 4) premultiplied: four times the memory of 8-bit images."""
        return premultiplied(self.images)

    def surfaces(self, index: int) -> Surfaces | None:
        """The exact surfaces of view number ``index``, from its files; ``None``: not known.

        Raises:
            InputError: A file cannot be used.
        """
        files = self.surface_files[index] if self.surface_files else None
        return None if files is None else files.read(self.intrinsics)

    def composited(self, background: ArrayLike = 1.0) -> NDArray[np.float32]:
        """The images over a background: ``rgb + (1 - a)·background`` (Porter & Duff 1984).

        ``rgb`` is premultiplied and the sum is taken in the dataset's own colour
        space: for sRGB files this is what the published results on
        nerf_synthetic do, though light adds up in linear space only.

        Args:
            background: A colour in the same colour space: a number, (3,), or
                anything else that broadcasts to (N, H, W, 3).

        Returns:
            Opaque images, (N, H, W, 3).
        """
        images = self.premultiplied()
        return images[..., :3] + (1 - images[..., 3:]) * np.asarray(background, np.float32)

    def subset(self, indices: Sequence[int]) -> Dataset:
        """The views at ``indices``, in that order.

        Raises:
            IndexError: An index is out of range.
        """
        chosen = np.asarray(indices, np.intp).reshape(-1)
        return replace(
            self,
            names=tuple(self.names[i] for i in chosen),
            images=self.images[chosen],
            cam_to_world=self.cam_to_world[chosen],
            surface_files=tuple(self.surface_files[i] for i in chosen if self.surface_files),
        )

    def evenly_spread(self, n: int) -> Dataset:
        """``n`` views evenly spread over the split, or all if there are no more.

        Raises:
            InputError: ``n`` is below 1.
        """
        if n >= len(self):
            return self  # spares a copy of the images
        return self.subset(evenly_spread_indices(len(self), n))


def evenly_spread_indices(count: int, n: int) -> list[int]:
    """``floor(i·count/n)`` for i = 0 … n - 1, or all of ``range(count)`` if n ≥ count.

    >>> evenly_spread_indices(10, 4)
    [0, 2, 5, 7]

    Raises:
        InputError: ``n`` is below 1.
    """
    if n < 1:
        raise InputError(f"the number of views must be 1 or more, got {n}")
    n = min(n, count)
    return [i * count // n for i in range(n)]
