"""The exact surfaces of a view, as ``mi-nerf generate`` writes them beside its picture.

``r_0_depth.exr`` holds distances from the camera along the unit rays through the centres of
pixels, 0 where nothing is met; ``r_0_normal.exr`` unit normals in world space. Of an image
that is read downscaled, one pixel of each block is taken: distances are not averaged.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.errors import InputError
from ..cameras.pinhole import Intrinsics
from ..images.exr import read_distance, read_normals


@dataclass(frozen=True)
class SurfaceFiles:
    """Where the surfaces of a view are, and how their pixels belong to the view's."""

    depth: Path
    normal: Path | None  # none: not there, or of no use in the dataset's frame
    width: int  # of the view's file, and of these
    height: int
    downscale: int = 1  # of the view
    scale: float = 1.0  # the dataset's lengths, where its frame is not that of the files

    @classmethod
    def beside(cls, image: Path, width: int, height: int, downscale: int) -> SurfaceFiles | None:
        """Those of an image file; ``None`` if there are none."""
        depth, normal = (image.with_name(image.stem + end) for end in _ENDS)
        if not depth.is_file():
            return None
        return cls(depth, normal if normal.is_file() else None, width, height, downscale)

    def read(self, view: Intrinsics) -> Surfaces:
        """The surfaces of a view by this camera.

        Raises:
            InputError: A file is damaged, of another size than the view's, or holds what
                no distances or normals are.
        """
        depth = self._taken(self.depth, read_distance(self.depth), view) * np.float32(self.scale)
        normal = None
        if self.normal is not None:
            normal = self._taken(self.normal, read_normals(self.normal), view)
        k = self.downscale
        shift = (k // 2 + 0.5) / k - 0.5  # from the middle of a block to that of the pixel taken
        return Surfaces(replace(view, cx=view.cx - shift, cy=view.cy - shift), depth, normal)

    def _taken(self, path: Path, values: NDArray[Any], view: Intrinsics) -> NDArray[Any]:
        """One pixel of each block, the middle one or, of an even number, the one behind it."""
        if values.shape[:2] != (self.height, self.width):
            raise InputError(
                f"{path}: expected {self.width}x{self.height} pixels as in the view, "
                f"got {values.shape[1]}x{values.shape[0]}"
            )
        k = self.downscale
        return values[k // 2 :: k, k // 2 :: k][: view.height, : view.width]


_ENDS = ("_depth.exr", "_normal.exr")


@dataclass(frozen=True)
class Surfaces:
    """What the rays through the centres of a camera's pixels meet first."""

    camera: Intrinsics  # of these pixels: the view's, by less than a pixel shifted
    depth: NDArray[np.float32]  # (H, W) distance along the unit ray, scene units; 0: nothing
    normal: NDArray[np.float32] | None  # (H, W, 3) unit vectors in world space; 0: nothing
