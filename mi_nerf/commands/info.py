"""``mi-nerf info``: the system, or what a file or folder holds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from ..scene_xml.library import scenes
from ..tasks.describe import describe


@dataclass(frozen=True)
class Info:
    """Says what this machine offers, or what a run, checkpoint, field, dataset or scene holds.

    Examples:

    mi-nerf info

    mi-nerf info runs/lego

    mi-nerf info scene.xml
    """

    target: Positional[Annotated[Path | None, arg(metavar="TARGET")]] = None
    """A run folder, a .safetensors file, a dataset folder, a Mitsuba XML scene, or the name of a
    scene that comes with mi_nerf."""

    def run(self, _started: float) -> None:
        """Prints a summary."""
        target = self.target
        if target is not None and not target.exists():
            target = scenes().get(str(target), target)
        print(describe(target))
