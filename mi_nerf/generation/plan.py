"""A plan: all that a dataset follows from, apart from the scene itself."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..cameras.pinhole import Intrinsics
from ..scene_xml.scene_file import Bounds
from .protocol import SPLITS, Cameras
from .sensors import Lens
from .subject import Subject
from .survey import Survey

Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class View:
    """One image to be made."""

    split: str
    index: int  # within the split
    pose: Array  # (4, 4) OpenGL camera-to-world
    seed: int  # of the dataset
    intrinsics: Intrinsics | None = None  # its own, where views differ; else the plan's
    lens: Lens | None = None

    @property
    def name(self) -> str:
        """Its files' common path in the dataset, such as ``train/r_0``."""
        return f"{self.split}/r_{self.index}"

    def render_seed(self, half: int, part: int) -> int:
        """A seed for each rendering, which does not depend on how many views there are."""
        sequence = np.random.SeedSequence(
            [self.seed, SPLITS.index(self.split), self.index, half, part]
        )
        return int(sequence.generate_state(1, np.uint32)[0])


@dataclass(frozen=True)
class Plan:
    """Everything that a dataset follows from, apart from the scene itself."""

    protocol: str
    cameras: Cameras
    intrinsics: Intrinsics  # of the views without their own
    spp: int
    seed: int
    views: tuple[View, ...]
    box: Bounds  # of all that is visible
    region: Bounds  # of it what a field should hold: the object's surroundings, or all
    up: tuple[float, float, float]
    center: tuple[float, float, float]  # what the cameras look at; forward: where they are
    radius: float  # their distance from it; forward: how far they move from it
    elevation: tuple[float, float] | None  # between which angles they stand; None: all of them
    hide_emitters: bool  # objects are seen before nothing, other scenes before their sky
    subject: Subject  # what of the scene is the object
    survey: Survey = field(compare=False, repr=False)  # what the cameras will see
    notes: tuple[str, ...] = ()  # what people should know, a line each
    keep_emitters: tuple[str, ...] = ()  # light sources that are seen all the same

    @property
    def halves(self) -> tuple[int, int]:
        """Samples a pixel of the two images from which the noise is estimated."""
        return halves(self.spp)

    def camera_of(self, view: View) -> Intrinsics:
        """A view's own intrinsics, or those that all share."""
        return view.intrinsics or self.intrinsics

    @property
    def pixels(self) -> int:
        """Of one image, the largest."""
        films = {(c.width, c.height) for c in map(self.camera_of, self.views)}
        return max(width * height for width, height in films)

    @property
    def scale(self) -> float:
        """A length that is typical of what the cameras look at."""
        return max(_diagonal(self.region), self.radius)

    @property
    def clips(self) -> tuple[float, float]:
        """z-depths between which all is that cameras see, by far."""
        near = min(1e-3 * self.scale, 0.1 * self.survey.nearest)
        return near, 1e3 * max(_diagonal(self.box), self.radius)

    def of_split(self, split: str) -> list[View]:
        """The views of one split."""
        return [view for view in self.views if view.split == split]

    def __str__(self) -> str:
        """The plan in some lines, for people."""
        corners = " to ".join(numbers(corner) for corner in self.box)
        counts = ", ".join(f"{len(self.of_split(s))} {s}" for s in SPLITS)
        films = {(c.width, c.height) for c in map(self.camera_of, self.views)}
        sizes = ", ".join(f"{width}x{height}" for width, height in sorted(films))
        return "\n".join(
            [
                f"{self.protocol}: {counts} views of {sizes}, {self.spp} samples a pixel",
                f"scene box {corners}; cameras {self._where()}, up {numbers(self.up)}",
                *self.notes,
            ]
        )

    def _where(self) -> str:
        center = numbers(self.center)
        return {
            "forward": f"beside {center}, up to {self.radius:.3g} from it",
            "room": f"within the room around {center}, {self.radius:.3g} or more from surfaces",
            "scene": "are the scene's own sensors",
        }.get(self.cameras, f"on a {self.cameras} of radius {self.radius:.4g} around {center}")

    def record(self) -> dict[str, Any]:
        """What ``dataset.json`` says of it."""
        record = {
            "protocol": self.protocol,
            "cameras": self.cameras,
            "views": {split: len(self.of_split(split)) for split in SPLITS},
            "size": [self.intrinsics.width, self.intrinsics.height],
            "spp": self.spp,
            "seed": self.seed,
            "camera_angle_x": round(math.radians(self.intrinsics.fov_x), 12),
            "up": list(self.up),
            "center": list(self.center),
            "radius": self.radius,
            **({} if self.elevation is None else {"elevation": list(self.elevation)}),
            **({"keep_emitters": list(self.keep_emitters)} if self.keep_emitters else {}),
        }
        return {**record, **self.subject.record()}


def halves(spp: int) -> tuple[int, int]:
    """Splits samples a pixel in two."""
    return spp // 2, spp - spp // 2


def numbers(values: tuple[float, ...]) -> str:
    """A point for people: (1.5, 0, -2)."""
    return "(" + ", ".join(f"{v:.3g}" for v in values) + ")"


def _diagonal(box: Bounds) -> float:
    return float(np.linalg.norm(np.subtract(*box)))
