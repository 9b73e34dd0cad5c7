"""``mi-nerf eval``: a run or a field against held-out views."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, get_args

from tyro.conf import Positional, UseAppendAction, arg

from ..base.errors import InputError, Option
from ..base.files import check_file, check_folder, make_folder, write_json
from ..base.variants import choose_variant
from ..data import ImageKind
from ..tasks.evaluate import evaluate, more_quality, quality
from .shared import Variant, progress_bar


@dataclass(frozen=True)
class Eval:
    """Measures held-out views by the nerf2020 protocol: 8 bits, on white, PSNR and SSIM.

    Where the data has linear radiance or exact surfaces, as from mi-nerf generate, errors of
    these, too: docs/datasets.md defines them.

    Examples:

    mi-nerf eval runs/lego

    mi-nerf eval runs/lego --split val --views 10 --json result.json --images pictures/

    mi-nerf eval lego.safetensors --data lego/ --downscale 2

    mi-nerf eval runs/hdr --images exr
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
    images: UseAppendAction[tuple[str, ...]] = ()
    """A folder: write the rendered views there. png or exr: compare with these files, pictures of 8
    bits or linear radiance; default: those that the run was trained on. May be given for both."""
    geometry: bool = True
    """Compare surfaces, where the data has exact ones."""
    variant: Variant = None

    def run(self, _started: float) -> None:
        """Evaluates."""
        bar = progress_bar("eval", "view")

        def show(_result: dict[str, Any], total: int) -> None:
            bar.total = total
            bar.update()

        if self.json is not None:
            check_file(self.json)
        folder, truth = self._images()
        if folder is not None:
            check_folder(folder)
        with bar:
            record = evaluate(
                self.target,
                data=self.data,
                split=self.split,
                downscale=self.downscale,
                views=self.views,
                images=folder,
                truth=truth,
                geometry=self.geometry,
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
        for line in more_quality(record):
            print(line)

    def _images(self) -> tuple[Path | None, ImageKind | None]:
        """The folder to write to, and the files to compare with."""
        kinds = [kind for kind in get_args(ImageKind) if kind in self.images]
        folders = [name for name in self.images if name not in kinds]
        if len(kinds) > 1 or len(folders) > 1:
            raise InputError(
                "{}: expected one of png and exr, and one folder",
                Option("images", tuple(self.images)),
            )
        return (Path(folders[0]) if folders else None), (kinds[0] if kinds else None)
