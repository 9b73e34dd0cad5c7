"""Path-traces the views of a plan: one scene, one sensor that moves, no recompilation."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..base.arrays import Image
from ..base.errors import InputError
from ..cameras.pinhole import Intrinsics
from ..scene_xml.refusals import refused_rendering
from . import invalid
from .camera import Camera
from .emitters import Hidden
from .integrators import is_adjoint, kind, needs_help_hiding, needs_own_alpha, samples_rays
from .noise import Samples
from .passes import Tile, fits, passes, sets, tiles
from .plan import Plan, View
from .surfaces import trace_surfaces
from .wrapped import LARGEST, choosing, coverage_integrator, guarded


@dataclass(frozen=True)
class TracedView:
    """What was traced of one view."""

    halves: tuple[Image, Image]  # two (H, W, 4) linear premultiplied RGBA, independent
    samples: tuple[Samples, Samples]  # a pixel of each, without those that were dropped
    invalid: int  # samples that were dropped
    depth: Image  # (H, W, 1) distance along the ray, scene units, 0: nothing
    normal: Image  # (H, W, 3) world space, unit or 0


class Tracer:
    """Renders views of a loaded scene."""

    def __init__(
        self,
        scene: Any,
        integrator: Any,
        sampler: Any,
        plan: Plan,
        hidden: Hidden | None = None,
    ) -> None:
        """Prepares to trace.

        Args:
            integrator: What makes the colours (``integrators.color_integrator``); hides light
                sources itself unless some are hidden and some are not.
            sampler: Must take each of ``plan.halves``.
            hidden: Light sources that are not seen; default: all or none, as the plan says.
        """
        self._scene, self._plan = scene, plan
        self._hidden = hidden or Hidden(scene, plan.hide_emitters)
        own_alpha = needs_own_alpha(integrator, self._hidden)
        self._coverage = coverage_integrator(self._hidden) if own_alpha else None
        adjoint = is_adjoint(integrator)
        if needs_help_hiding(integrator, self._hidden):
            integrator = choosing(integrator, self._hidden)
        self._integrator, self._can_guard = integrator, samples_rays(integrator)
        self._channels = 4 + len(self._integrator.aov_names())
        if adjoint and not fits(max(plan.halves), plan.pixels):
            # Paths do not belong to pixels, for whose samples a sampler could spread its points.
            sampler = _independent()
        self._in_passes = adjoint or sampler.class_name() == "IndependentSampler"
        self._sampler = sampler
        self._guarded: Any = None
        self._cameras: dict[Any, Camera] = {}

    @property
    def samples_at_once(self) -> int:
        """Paths that are traced at a time, of the first view."""
        view = self._plan.views[0]
        part = self._parts(view, max(self._plan.halves))[0]
        pixels = self._pixels(view) if part.tile is None else part.tile.pixels
        return part.samples * pixels

    def trace(self, view: View) -> TracedView:
        """Renders one view.

        Raises:
            InputError: if too many samples are NaN or infinite.
        """
        a, b = (self._half(view, half, n) for half, n in enumerate(self._plan.halves))
        dropped = a.dropped + b.dropped
        share = dropped / (self._plan.spp * self._pixels(view))
        if share > invalid.SHARE:
            raise InputError(
                f"view {view.name}: {share:.1%} of its samples are NaN or infinite, "
                f"expected at most {invalid.SHARE:.0%}"
            )
        depth, normal = trace_surfaces(
            self._scene, self._intrinsics(view), view.pose, hide_emitters=self._hidden
        )
        return TracedView((a.image, b.image), (a.samples, b.samples), dropped, depth, normal)

    def _intrinsics(self, view: View) -> Intrinsics:
        return self._plan.camera_of(view)

    def _pixels(self, view: View) -> int:
        return self._intrinsics(view).width * self._intrinsics(view).height

    def _parts(self, view: View, samples: int) -> list[_Part]:
        """What is traced at a time of a picture of so many samples a pixel."""
        pixels = self._pixels(view)
        if self._in_passes:
            return [_Part(n) for n in passes(samples, pixels)]
        if fits(samples, pixels):
            return [_Part(samples)]
        if self._camera(view, None).can_shift:
            return [_Part(samples, tile) for tile in tiles(self._intrinsics(view), samples)]
        return [_Part(n) for n in sets(samples, pixels, self._sampler)]

    def _half(self, view: View, half: int, samples: int) -> _Half:
        """One of the two independent images of a view."""
        parts = self._parts(view, samples)
        drawn = (self._part(view, part, view.render_seed(half, i)) for i, part in enumerate(parts))
        if parts[0].tile is not None:
            return self._joined(view, parts, drawn)
        total: Any = 0.0
        taken: Any = 0
        for image, good in drawn:
            total = total + image * np.float32(good)
            taken = taken + good
        if isinstance(taken, int):
            return _Half(total / np.float32(taken), taken, 0)
        taken = taken.astype(np.float32)
        dropped = sum(part.samples for part in parts) * self._pixels(view) - _sum(taken)
        return _Half((total / np.maximum(taken, 1)).astype(np.float32), taken, dropped)

    def _joined(
        self, view: View, parts: list[_Part], drawn: Iterable[tuple[Image, Samples]]
    ) -> _Half:
        """A picture of its tiles."""
        size = self._intrinsics(view).height, self._intrinsics(view).width
        image = np.zeros((*size, 4), np.float32)
        taken = np.zeros((*size, 1), np.float32)
        for part, (piece, good) in zip(parts, drawn, strict=True):
            assert part.tile is not None
            image[part.tile.place] = piece
            taken[part.tile.place] = good
        samples = parts[0].samples
        dropped = samples * self._pixels(view) - _sum(taken)
        return _Half(image, taken if dropped else samples, dropped)

    def _part(self, view: View, part: _Part, seed: int) -> tuple[Image, Samples]:
        """Linear premultiplied RGBA of a part, and of how many samples a pixel it is."""
        camera = self._camera(view, part.tile)
        image, good = self._color(camera, part.samples, seed)
        if self._coverage is not None:
            image = image.copy()
            image[..., 3] = self._render(camera, self._coverage, part.samples, seed)[..., 4]
        return image, good

    def _color(self, camera: Camera, spp: int, seed: int) -> tuple[Image, Samples]:
        if self._guarded is None:
            image = self._render(camera, self._integrator, spp, seed)
            if image.shape[-1] != self._channels:
                raise InputError(
                    f"the integrator '{kind(self._integrator)}' gives {image.shape[-1]} channels, "
                    f"expected RGBA and its own {self._channels - 4}"
                )
            image = image[..., :4]  # what follows are AOVs
            if np.abs(image).max() * spp < LARGEST:  # so is every sample; not if any is NaN
                return image, spp
        if not self._can_guard:
            return self._one_by_one(camera, spp, seed)
        # From now on at once: samples that are numbers give the same picture either way.
        self._guarded = self._guarded or guarded(self._integrator)
        image = self._render(camera, self._guarded, spp, seed)
        if not image[..., 4].any():
            return image[..., :4], spp
        return invalid.without_invalid(image, spp)

    def _one_by_one(self, camera: Camera, spp: int, seed: int) -> tuple[Image, Samples]:
        """From pictures of one sample a pixel each."""
        seeds = np.random.SeedSequence(seed).generate_state(spp, np.uint32)
        plain = camera.with_sampler(_independent())
        return invalid.one_by_one(
            lambda i: self._render(plain, self._integrator, 1, int(seeds[i])), spp
        )

    def _camera(self, view: View, tile: Tile | None) -> Camera:
        """The camera of a view, or of a tile of it; one for all of a size."""
        intrinsics = self._intrinsics(view) if tile is None else tile.intrinsics
        # Tiles of one size differ in their principal points alone.
        kind = intrinsics if tile is None else replace(intrinsics, cx=0.0, cy=0.0), view.lens
        if kind not in self._cameras:
            self._cameras[kind] = Camera(intrinsics, view.lens, self._plan.clips, self._sampler)
        camera = self._cameras[kind]
        camera.move(view.pose, None if tile is None else intrinsics)
        return camera

    def _render(self, camera: Camera, integrator: Any, spp: int, seed: int) -> Image:
        import mitsuba as mi

        try:
            image = mi.render(
                self._scene,
                sensor=camera.sensor,
                integrator=integrator,
                spp=spp,
                seed=seed,
            )
            return np.array(image)  # waits, so that passes do not pile up in memory
        except RuntimeError as error:  # Dr.Jit wraps what happens inside a custom operation
            if isinstance(error.__cause__, InputError):
                raise error.__cause__ from error
            if (said := refused_rendering(error)) is not None:
                raise InputError(said) from error
            raise


@dataclass(frozen=True)
class _Part:
    """What one call of ``mi.render`` traces."""

    samples: int  # a pixel
    tile: Tile | None = None  # where; None: the whole picture


@dataclass(frozen=True)
class _Half:
    """One of the two images of a view."""

    image: Image
    samples: Samples  # a pixel, without those that were dropped
    dropped: int  # in all


def _sum(counts: Image) -> int:
    return int(counts.sum(dtype=np.float64))


def _independent() -> Any:
    import mitsuba as mi

    return mi.load_dict({"type": "independent"})
