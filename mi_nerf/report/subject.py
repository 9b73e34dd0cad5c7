"""What a sweep is about: a field, rays through it, and what they ought to see."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import drjit as dr
import numpy as np

from ..base.arrays import upload, vector3_type
from ..base.checks import at_least_one
from ..base.color import linear_to_srgb
from ..base.errors import InputError, Option
from ..base.variants import array_module
from ..cameras.pinhole import Intrinsics, pack_poses, pixel_rays
from ..cameras.trajectory import orbit
from ..data import split_to_measure
from ..fields.closed_form import CLOSED_FORMS, closed_form
from ..fields.protocol import Field
from ..images.metrics import to_8bit
from ..march.marched import MarchedField
from ..march.settings import MarchSettings
from ..tasks.evaluate import held_out, reference_image
from ..tasks.target import Target, open_target

Array = np.ndarray[Any, Any]

RAYS = 10_000  # a view of 100x100 pixels has as many

# Cameras around fields that come without any: pixels across, angle in radians, and the sine
# of their elevation.
_SIZE, _ANGLE, _HEIGHT = 100, 0.7, 0.4


@dataclass(frozen=True)
class Subject:
    """A field, and R rays through pixel centres of some views, in random order."""

    name: str
    formula: bool  # the field is one of mi_nerf.fields.closed_form
    marched: MarchedField  # with its own settings and grid
    backend: Any  # e.g. drjit.llvm.ad
    variant: str
    o: Any = None  # R origins
    d: Any = None  # R unit directions
    truth: Array | None = None  # (R, 3) what images show there: sRGB, on white, 8 bits
    views: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # where rays come from

    @property
    def field(self) -> Field:
        """The field alone."""
        return self.marched.field

    @property
    def rays(self) -> int:
        """R."""
        return len(self.d[0])

    @property
    def unit(self) -> str:
        """What :meth:`shown` holds, in words."""
        return "radiance" if self.formula else "display values, 0 to 1"

    def shown(self, color: Array, opacity: Array) -> Array:
        """(R, 3) values of which errors are taken, of premultiplied (R, 3) colours.

        Of trained fields, display values: sRGB, on white. Of formulas the radiance itself,
        which white might hide.
        """
        if self.formula:
            return color
        image = color + (1 - opacity[:, None])
        return np.clip(linear_to_srgb(image) if self.field.color_space == "linear" else image, 0, 1)

    def shown_error(self, color: Array, opacity: Array, error: Array) -> Array:
        """(R, 3): what :meth:`shown` may be off by, if colours and opacities are by (R, 4)."""
        if self.formula:
            return error[:, :3]
        off = error[:, :3] + error[:, 3:4]  # the background shows through by the opacity
        here = self.shown(color, opacity)
        ends = (self.shown(color + sign * off, opacity) for sign in (-1, 1))
        result: Array = np.maximum(*(np.abs(end - here) for end in ends))
        return result

    def psnr(self, shown: Array) -> float | None:
        """PSNR in dB of all R pixels together, in 8 bits, against the images, if there are any."""
        if self.truth is None:
            return None
        mse = float(np.mean((to_8bit(shown) - self.truth) ** 2))
        return -10 * math.log10(mse) if mse > 0 else None

    def first(self, rays: int) -> Subject:
        """The same with no more than the first ``rays`` of its rays."""
        if rays >= self.rays:
            return self
        float_type = self.backend.Float
        o, d = (
            vector3_type(float_type)(*(upload(float_type, np.array(x)[:rays]) for x in v))
            for v in (self.o, self.d)
        )
        truth = None if self.truth is None else self.truth[:rays]
        return replace(self, o=o, d=d, truth=truth)


def open_subject(
    target: Target | str | Path,
    variant: str,
    *,
    values: Mapping[str, Any] | None = None,
    data: str | Path | None = None,
    split: str | None = None,
    downscale: int | None = None,
    views: int = 10,
    rays: int = RAYS,
    seed: int = 0,
) -> Subject:
    """Rays of held-out views through a trained field, or of cameras around a formula.

    Args:
        target: a run folder, a field file, or the name of a formula such as ``"shell"``
            (:mod:`mi_nerf.fields.closed_form`), unless a file is called so.
        values: parameters of the formula, the others by default.
        data, split, downscale: the images; by default those of a run at its own scale, of the
            split ``test`` or whatever there is beside ``train``. A field file without ``data``
            is looked at from around its box, and compared with no images.
        views: so many of them, evenly spread.
        rays: drawn from all their pixels; all pixels if there are no more.
        seed: of the draw.

    Raises:
        InputError: if the target is none of these, or its images cannot be read.
    """
    at_least_one(rays=rays, views=views)
    opened = _opened(target)
    subject = open_field(opened, variant, values=values)
    if isinstance(opened, str):
        cameras = _around(subject.field, views)
    else:
        cameras = _cameras(opened, subject.field, data, split, downscale, views)
    return _with_rays(subject, cameras, rays, seed)


def open_field(
    target: Target | str | Path, variant: str, *, values: Mapping[str, Any] | None = None
) -> Subject:
    """The same without rays, whatever has become of the images.

    Raises:
        InputError: if the target is none, or has no such parameters.
    """
    backend = array_module(variant)
    opened = _opened(target)
    if isinstance(opened, str):
        try:
            field = closed_form(opened, values or {}, backend.TensorXf)
        except ValueError as error:
            raise InputError(f"{opened}: {error}") from error
        return Subject(opened, True, MarchedField(field, MarchSettings()), backend, variant)
    if values:
        raise InputError("{}: {} is no formula", Option("values", next(iter(values))), opened.path)
    return Subject(str(opened.path), False, opened.contents.marched(backend), backend, variant)


def _opened(target: Target | str | Path) -> Target | str:
    """A run or field file, or the name of a formula."""
    if isinstance(target, Target):
        return target
    if str(target) in CLOSED_FORMS and not Path(target).exists():
        return str(target)
    if not Path(target).exists():
        raise InputError(
            f"{target}: not found, expected a run folder, a field file or one of "
            f"{', '.join(CLOSED_FORMS)}"
        )
    return open_target(target)


class _Cameras(NamedTuple):
    film: Intrinsics
    poses: Array  # (V, 4, 4)
    truth: Array | None  # (V, H, W, 3)
    origin: dict[str, Any]


def _cameras(
    target: Target,
    field: Field,
    data: str | Path | None,
    split: str | None,
    downscale: int | None,
    views: int,
) -> _Cameras:
    """The held-out views of a dataset, or cameras around a field that knows none."""
    folder = target.data if data is None else Path(data)
    if folder is None:
        return _around(field, views)
    split = split_to_measure(folder, split)
    images = held_out(target, data, split, downscale, views)
    truth = np.stack([reference_image(images, k) for k in range(len(images))])
    origin = {"data": str(folder), "split": images.split}
    return _Cameras(images.intrinsics, images.cam_to_world, truth, origin)


def _around(field: Field, views: int) -> _Cameras:
    """Cameras on a circle that see the whole box."""
    if field.ndc is not None:
        raise InputError(
            "a field for forward-facing cameras, expected {} with their views", Option("data")
        )
    lower, upper = np.array(field.lower, float), np.array(field.upper, float)
    radius = float(np.linalg.norm(upper - lower)) / 2 / math.sin(_ANGLE / 2)
    poses = orbit((lower + upper) / 2, np.array([0.0, 0, 1]), radius, _HEIGHT, views)
    return _Cameras(Intrinsics.from_angle_x(_SIZE, _SIZE, _ANGLE), poses, None, {"data": None})


def _with_rays(subject: Subject, cameras: _Cameras, rays: int, seed: int) -> Subject:
    """Draws pixels of the cameras, each at most once."""
    film, float_type = cameras.film, subject.backend.Float
    shape = (len(cameras.poses), film.height, film.width)
    chosen = np.random.default_rng(seed).permutation(math.prod(shape))[:rays]
    camera, row, column = np.unravel_index(chosen, shape)
    o, d = pixel_rays(
        upload(float_type, pack_poses(cameras.poses)),
        film,
        upload(subject.backend.UInt32, camera.astype(np.uint32)),
        *(upload(float_type, (v + 0.5).astype(np.float32)) for v in (column, row)),
    )
    dr.eval(o, d)
    record = {**cameras.origin, "views": shape[0], "size": [film.width, film.height], "seed": seed}
    truth = None if cameras.truth is None else cameras.truth.reshape(-1, 3)[chosen]
    return replace(subject, o=o, d=d, truth=truth, views=record)
