"""``mi-nerf report``: tables and plots about a field."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from ..backend import choose_variant
from ..report import report
from ..target import open_target
from .shared import Variant


@dataclass(frozen=True)
class Report:
    """Draws what a field has learnt: so far, the colour of points over all directions.

    Examples:

    mi-nerf report runs/lego --out report/

    mi-nerf report lego.safetensors --out report/ --point 0.1 -0.3 0.2 --point 0 0 0.4
    """

    target: Positional[Annotated[Path, arg(metavar="TARGET")]]
    """A run folder, or a field file (then with --point)."""
    out: Path
    """Folder for report.md, report.json and the plots."""
    point: UseAppendAction[tuple[tuple[float, float, float], ...]] = ()
    """A point whose emission is drawn; repeatable. Default: three that the cameras see."""
    variant: Variant = None

    def run(self, _started: float) -> None:
        """Reports."""
        record = report(
            open_target(self.target), self.out, choose_variant(self.variant), self.point
        )
        for entry in record["view_dependence"]:
            where = ", ".join(f"{v:.3f}" for v in entry["point"])
            print(f"({where}): deviation over directions {entry['deviation']:.3f}")
        print(f"{self.out / 'report.md'}")
