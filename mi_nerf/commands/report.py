"""``mi-nerf report``: tables and plots about a field."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from ..backend import choose_variant
from ..report import report
from ..report.profile import summary
from ..target import open_target
from .shared import Variant, progress_bar


@dataclass(frozen=True)
class Report:
    """Draws the colour of points over all directions, and where a training step's time goes.

    Examples:

    mi-nerf report runs/lego --out report/

    mi-nerf report runs/lego --out report/ --no-profile

    mi-nerf report lego.safetensors --out report/ --point 0.1 -0.3 0.2 --point 0 0 0.4
    """

    target: Positional[Annotated[Path, arg(metavar="TARGET")]]
    """A run folder, or a field file (then with --point)."""
    out: Path
    """Folder for report.md, report.json and the plots."""
    point: UseAppendAction[tuple[tuple[float, float, float], ...]] = ()
    """A point whose emission is drawn; repeatable. Default: three that the cameras see."""
    profile: bool = True
    """Train on for some steps, in memory only, to measure them; runs only."""
    variant: Variant = None

    def run(self, _started: float) -> None:
        """Reports."""
        with progress_bar("report", "training step") as bar:
            record = report(
                open_target(self.target),
                self.out,
                choose_variant(self.variant),
                self.point,
                profile=self.profile,
                on_step=bar.update,
            )
        for entry in record["view_dependence"]:
            where = ", ".join(f"{v:.3f}" for v in entry["point"])
            print(f"({where}): deviation over directions {entry['deviation']:.3f}")
        if record["step"] is not None:
            print(summary(record["step"]))
        elif self.profile:
            print(f"no profile of training steps: {record['step_left_out']}")
        print(f"{self.out / 'report.md'}")
