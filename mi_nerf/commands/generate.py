"""``mi-nerf generate``: a dataset from a Mitsuba scene."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

from ..api import generate
from ..base.variants import choose_variant
from ..generation import Options
from ..generation.run import summary
from .shared import ExecutorName, Variant, Workers, name_and_value


@dataclass(frozen=True)
class Generate:
    """Path-traces a dataset from a Mitsuba scene, with depth, normals and known noise.

    Examples:

    mi-nerf generate bonsai data/bonsai

    mi-nerf generate bonsai data/small --train 40 --test 10 --size 200 200 --spp 64

    mi-nerf generate my_scene.xml data/mine --up y --cameras sphere --seed 1

    mi-nerf generate bonsai data/bonsai --resume

    mi-nerf generate bonsai data/bonsai --workers 4
    """

    scene: Positional[Annotated[str, arg(metavar="SCENE")]]
    """A Mitsuba XML file, or the name of a scene that comes with mi_nerf."""
    out: Positional[Annotated[Path, arg(metavar="OUT")]]
    """Folder of the dataset: new or empty, or with --resume one that was begun."""
    protocol: Literal["realistic360", "diffuse360", "forward"] | None = None
    """The paper's kind of dataset; default: the scene's own, or realistic360."""
    train: int | None = None
    """Training views; default: the protocol's (100, 479, 28)."""
    val: int | None = None
    """Validation views (10, 10, 0)."""
    test: int | None = None
    """Test views (200, 1000, and for forward every eighth of all)."""
    size: tuple[int, int] | None = None
    """Width and height (800 800, 512 512, 1008 756)."""
    spp: int | None = None
    """Samples a pixel; default: those of the scene's sampler."""
    seed: int = 0
    """Seed of camera positions and of the noise."""
    resume: bool = False
    """Go on with the dataset in OUT; missing and damaged views are made again."""
    cameras: Literal["hemisphere", "sphere"] | None = None
    """Where 360-degree cameras stand; default: as the scene says, or hemisphere."""
    up: Literal["x", "y", "z"] | None = None
    """Vertical axis; default: that of the scene's sensor, or z."""
    center: tuple[float, float, float] | None = None
    """What cameras look at; default: the origin, or the middle of scenes beyond [-1, 1]^3."""
    radius: float | None = None
    """Distance from it (forward: how far cameras move); default: 4, or as the scene's size says."""
    set: UseAppendAction[tuple[str, ...]] = ()
    """Values of the scene's $parameters: name=value; repeatable."""
    workers: Workers = 0
    executor: ExecutorName = None
    variant: Variant = None

    def run(self, _started: float) -> None:
        """Generates."""
        options = {field.name: getattr(self, field.name) for field in fields(Options)}
        record = generate(
            self.scene,
            self.out,
            **options,
            parameters=dict(name_and_value(text) for text in self.set),
            resume=self.resume,
            workers=self.workers,
            executor=self.executor,
            variant=choose_variant(self.variant),
        )
        hint = "" if record["complete"] else ", go on with --resume"
        print(f"{self.out}: {summary(record)}{hint}")
        if not record["complete"]:
            raise KeyboardInterrupt
