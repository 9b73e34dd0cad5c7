"""``mi-nerf render``: pictures and films of a run or a Mitsuba scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from ..backend import choose_variant
from ..errors import InputError
from ..rendering import (
    check_output,
    default_path,
    output_kind,
    run_frames,
    scene_frames,
    write_frames,
)
from ..scene_library import scenes
from ..target import open_target
from .shared import Variant, positive, progress_bar


@dataclass(frozen=True)
class Render:
    """Renders a run along a camera path, or a Mitsuba XML scene.

    Examples:

    mi-nerf render runs/lego -o orbit.mp4

    mi-nerf render runs/lego -o test_views/ --path test

    mi-nerf render scene.xml -o scene.exr --spp 64

    mi-nerf render table -o table.png
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
    variant: Variant = None

    def run(self, _started: float) -> None:
        """Renders."""
        for name in ("frames", "spp"):
            if getattr(self, name) is not None:
                positive(name, getattr(self, name))
        if self.size is not None and min(self.size) < 1:
            raise InputError(
                f"--size {self.size[0]} {self.size[1]}: expected two numbers of at least 1"
            )
        place = self._target()
        picture = output_kind(self.out) == "picture"
        check_output(self.out, self.frames or 1)
        variant = choose_variant(self.variant)
        if place.suffix.lower() == ".xml":
            if self.frames is not None and self.path is None:
                raise InputError(
                    f"--frames {self.frames}: the sensors of a scene give one frame each, "
                    "expected --path orbit or --path spiral too"
                )
            frames = 1 if picture else 60
            count, images = scene_frames(
                place,
                variant,
                path=self.path,
                frames=self.frames or frames,
                size=self.size,
                spp=self.spp or 0,
            )
        else:
            target = open_target(place)
            path = self.path or default_path(target)
            frames = 1 if picture else (0 if path == "test" else 60)
            count, images = run_frames(
                target,
                variant,
                path=path,
                frames=self.frames or frames,
                size=self.size,
                spp=self.spp or 1,
            )
        with progress_bar("render", "frame", count) as bar:
            write_frames(self.out, count, images, on_frame=bar.update)
        print(f"{self.out}: {count} frame{'s' if count != 1 else ''}")

    def _target(self) -> Path:
        """What to render: something at a path, or else a scene by name."""
        if self.target.exists():
            return self.target
        found = scenes().get(str(self.target))
        if found is None:
            raise InputError(
                f"{self.target}: not found, expected a run folder or a Mitsuba XML scene, or "
                "the name of one that comes with mi_nerf"
            )
        return found
