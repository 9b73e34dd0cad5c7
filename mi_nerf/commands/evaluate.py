"""``mi-nerf eval``: a run or a field against held-out views."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from ..base.files import check_file, check_folder, make_folder, write_json
from ..base.variants import choose_variant
from ..tasks.evaluate import evaluate, quality
from .shared import Variant, progress_bar


@dataclass(frozen=True)
class Eval:
    """Measures held-out views by the nerf2020 protocol: 8 bits, on white, PSNR and SSIM.

    Examples:

    mi-nerf eval runs/lego

    mi-nerf eval runs/lego --split val --views 10 --json result.json --images pictures/

    mi-nerf eval lego.safetensors --data lego/ --downscale 2
    """

    target: Positional[Annotated[Path, arg(metavar="TARGET")]]
    """A run folder, or a field file (then with --data)."""
    data: Path | None = None
    """Dataset; default: the run's own."""
    split: str = "test"
    """Which views."""
    downscale: int | None = None
    """Average images over blocks of K×K pixels; default: as the run was trained."""
    views: int | None = None
    """Only so many views, evenly spread."""
    json: Path | None = None
    """Write the results to this file."""
    images: Path | None = None
    """Write the rendered views to this folder."""
    variant: Variant = None

    def run(self, _started: float) -> None:
        """Evaluates."""
        bar = progress_bar("eval", "view")

        def show(_result: dict[str, Any], total: int) -> None:
            bar.total = total
            bar.update()

        if self.json is not None:
            check_file(self.json)
        if self.images is not None:
            check_folder(self.images)
        with bar:
            record = evaluate(
                self.target,
                data=self.data,
                split=self.split,
                downscale=self.downscale,
                views=self.views,
                images=self.images,
                variant=choose_variant(self.variant),
                on_image=show,
            )
        if self.json is not None:
            make_folder(self.json.parent)
            write_json(self.json, record)
        print(
            f"{record['split']}, {record['views']} views of {record['size'][0]}x"
            f"{record['size'][1]}: {quality(record)}, "
            f"{record['seconds_per_view']:.2f} s and {record['queries_per_ray']:.1f} queries a ray"
        )
