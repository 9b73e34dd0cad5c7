"""Renders the suite into one picture, as README shows it.

    python scenes/contact_sheet.py docs/scenes.jpg

Each scene from its own sensor, over white, five in a row.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import mitsuba as mi
import numpy as np
from tqdm import tqdm

import mi_nerf  # noqa: F401  (finds LLVM before Mitsuba looks for it)
from mi_nerf.base.variants import choose_variant
from mi_nerf.images.write import on_white
from mi_nerf.scene_xml.scene_file import SceneFile

GROUPS = ("realistic", "diffuse", "forward", "unbounded", "hard")
COLUMNS, TILE, SUPERSAMPLING, SPP = 5, 200, 2, 128


def main() -> None:
    """Renders and writes the sheet."""
    mi.set_variant(choose_variant())
    folder = Path(__file__).parent
    files = [file for group in GROUPS for file in sorted((folder / group).glob("*.xml"))]
    tiles = [_tile(file) for file in tqdm(files, unit="scene")]
    rows = [np.concatenate(tiles[i : i + COLUMNS], 1) for i in range(0, len(tiles), COLUMNS)]
    iio.imwrite(sys.argv[1], np.rint(np.concatenate(rows) * 255).astype(np.uint8), quality=88)


def _tile(file: Path) -> np.ndarray[Any, Any]:
    size = str(TILE * SUPERSAMPLING)
    scene = SceneFile(file, {"width": size, "height": size, "spp": str(SPP)}).load()
    image = on_white(np.array(mi.render(scene))[..., :4])
    blocks = image.reshape(TILE, SUPERSAMPLING, TILE, SUPERSAMPLING, 3)
    return np.asarray(blocks.mean(axis=(1, 3)))


if __name__ == "__main__":
    main()
