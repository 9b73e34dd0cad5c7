"""``mi-nerf render``: pictures and films of a run or a Mitsuba scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from ..base.checks import valid_size
from ..base.variants import choose_variant
from ..jobs import open_executor
from ..scene_xml.library import scenes
from ..tasks.film import FramesOf, frames_by_others
from ..tasks.render import check_output, frames_of, output_kind, write_frames
from .shared import ExecutorName, Variant, Workers, positive, progress_bar


@dataclass(frozen=True)
class Render:
    """Renders a run along a camera path, or a Mitsuba XML scene.

    Examples:

    mi-nerf render runs/lego -o orbit.mp4

    mi-nerf render runs/lego -o test_views/ --path test

    mi-nerf render scene.xml -o scene.exr --spp 64

    mi-nerf render table -o table.png --spp 16 --denoise

    mi-nerf render table -o film.mp4 --path orbit --workers 4
    """

    target: Positional[Annotated[Path, arg(metavar="TARGET")]]
    """A run folder, a Mitsuba XML scene, or the name of a scene that comes with mi_nerf."""
    out: Annotated[Path, arg(aliases=["-o"])]
    """An .exr, .png or .mp4 file, or a folder of pictures."""
    path: Literal["orbit", "spiral", "test"] | None = None
    """Camera path; default: orbit for runs (spiral for forward-facing captures), the scene's
    own sensors for XML."""
    frames: int | None = None
    """Frames along the path; default: 1 for a picture, 60 otherwise, all for --path test."""
    size: tuple[int, int] | None = None
    """Width and height; default: those of the run's images or the scene's film."""
    spp: int | None = None
    """Samples a pixel; default: 1 for runs, the scene's own for XML."""
    denoise: bool = False
    """Take the noise out of the pictures, by Open Image Denoise: pip install 'mi_nerf[denoise]'."""
    workers: Workers = 0
    executor: ExecutorName = None
    variant: Variant = None

    def run(self, _started: float) -> None:
        """Renders."""
        for name in ("frames", "spp"):
            if getattr(self, name) is not None:
                positive(name, getattr(self, name))
        if self.size is not None:
            valid_size(self.size)
        check_output(self.out, self.frames or 1)
        wanted: dict[str, Any] = {
            "path": self.path,
            "frames": self.frames,
            "still": output_kind(self.out) == "picture",
            "size": self.size,
            "spp": self.spp,
            "denoise": self.denoise,
        }
        variant = choose_variant(self.variant)
        with open_executor(self.workers, self.executor, folder=self.out) as others:
            count, images = frames_of(self._target(), variant, **wanted)
            check_output(self.out, count)
            with progress_bar("render", "frame", count) as bar:
                if others is None:
                    write_frames(self.out, count, images, on_frame=bar.update)
                else:
                    images.close()
                    call = FramesOf(self._target(), variant, wanted)
                    with frames_by_others(call, count, others, self.out, bar.update) as drawn:
                        write_frames(self.out, count, drawn)
        print(f"{self.out}: {count} frame{'s' if count != 1 else ''}")

    def _target(self) -> Path:
        """What lies at the path, or else the scene of that name."""
        return self.target if self.target.exists() else scenes().get(str(self.target), self.target)
