"""``mi-nerf info``: the system, or what a file or folder holds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from ..tasks.describe import describe


@dataclass(frozen=True)
class Info:
    """Says what this machine offers, or what a run, checkpoint, field or dataset holds.

    Examples:

    mi-nerf info

    mi-nerf info runs/lego
    """

    target: Positional[Annotated[Path | None, arg(metavar="TARGET")]] = None
    """A run folder, a .safetensors file or a dataset folder."""

    def run(self, _started: float) -> None:
        """Prints a summary."""
        print(describe(self.target))
