"""``mi-nerf generate``: a dataset from a Mitsuba scene."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

from ..api import generate
from ..base.errors import InputError
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

    mi-nerf generate my_scene.xml data/mine --cameras scene

    mi-nerf generate my_scene.xml data/mine --object teapot --plan

    mi-nerf generate bonsai data/bonsai --resume

    mi-nerf generate bonsai data/bonsai --workers 4
    """

    scene: Positional[Annotated[str, arg(metavar="SCENE")]]
    """A Mitsuba XML file, or the name of a scene that comes with mi_nerf."""
    out: Positional[Annotated[Path, arg(metavar="OUT")]]
    """Folder of the dataset: new or empty, or with --resume one that was begun."""
    protocol: Literal["realistic360", "diffuse360", "forward", "room"] | None = None
    """Kind of dataset; default: the scene's own, or realistic360, or room where that sees walls."""
    train: int | None = None
    """Training views; default: the protocol's (100, 479, 28, 100)."""
    val: int | None = None
    """Validation views (10, 10, 0, 10)."""
    test: int | None = None
    """Test views (200, 1000, every eighth of all, 50); of the scene's sensors every eighth."""
    size: tuple[int, int] | None = None
    """Width and height (800 800, 512 512, 1008 756, 800 600); of sensors that of their film."""
    spp: int | None = None
    """Samples a pixel; default: those of the scene's sampler."""
    seed: int = 0
    """Seed of camera positions and of the noise."""
    resume: bool = False
    """Go on with the dataset in OUT; missing and damaged views are made again."""
    cameras: Literal["hemisphere", "sphere", "scene"] | None = None
    """Where cameras stand; default: as the scene says, or hemisphere; scene: its own sensors."""
    up: tuple[str, ...] | None = None
    """Vertical axis, x, y, z or --up=-y, or a direction; default: as sensor or base show."""
    object: UseAppendAction[tuple[str, ...]] = ()
    """Ids of the shapes that cameras look at; default: all but what surrounds them."""
    center: tuple[float, float, float] | None = None
    """What cameras look at; default: the origin, or the middle of objects beyond [-1, 1]^3."""
    radius: float | None = None
    """Distance from it (forward: how far cameras move); default: 4, or as the scene's size says."""
    elevation: tuple[float, float] | None = None
    """Lowest and highest angle of 360-degree cameras over its horizon, degrees; default: all."""
    plan: bool = False
    """Only draw the cameras: OUT/cameras.png, or OUT if it ends so; renders nothing."""
    keep_emitters: tuple[str, ...] = ()
    """IDs of light sources that are part of the object and seen, or all; default: none is seen."""
    set: UseAppendAction[tuple[str, ...]] = ()
    """Values of the scene's $parameters: name=value; repeatable."""
    workers: Workers = 0
    executor: ExecutorName = None
    variant: Variant = None

    def run(self, _started: float) -> None:
        """Generates."""
        options = {field.name: getattr(self, field.name) for field in fields(Options)}
        options["up"] = _direction(self.up)
        options["object"] = self.object or None
        record = generate(
            self.scene,
            self.out,
            **options,
            parameters=dict(name_and_value(text) for text in self.set),
            resume=self.resume,
            plan=self.plan,
            workers=self.workers,
            executor=self.executor,
            variant=choose_variant(self.variant),
        )
        if self.plan:
            print(f"{record['picture']}: the cameras, from above and from the side")
            return
        hint = "" if record["complete"] else ", go on with --resume"
        print(f"{self.out}: {summary(record)}{hint}")
        if not record["complete"]:
            raise KeyboardInterrupt


def _direction(up: tuple[str, ...] | None) -> str | tuple[float, float, float] | None:
    """The value of --up: one name of an axis, or three numbers."""
    if up is None or len(up) == 1:
        return up and up[0]
    try:
        x, y, z = (float(word) for word in up)
    except ValueError:
        message = f"--up {' '.join(up)}: expected x, y, z, -x, -y, -z or three numbers"
        raise InputError(message) from None
    return x, y, z
