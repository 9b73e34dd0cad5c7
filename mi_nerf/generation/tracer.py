"""Path-traces the views of a plan: one scene, one sensor that moves, no recompilation."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..base.arrays import Image
from ..base.errors import InputError
from ..cameras.pinhole import Intrinsics, sensor_dict
from ..cameras.poses import mitsuba_from_opengl
from . import invalid
from .emitters import Hidden
from .integrators import is_adjoint, kind, needs_help_hiding, needs_own_alpha, samples_rays
from .noise import Samples
from .passes import Tile, fits, passes, tiles
from .plan import Plan, View
from .surfaces import trace_surfaces
from .wrapped import choosing, coverage_integrator, guarded


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
        self._cameras: dict[tuple[int, int, bool], _Camera] = {}

    @property
    def samples_at_once(self) -> int:
        """Paths that are traced at a time, at most."""
        part = self._parts(max(self._plan.halves))[0]
        pixels = self._plan.pixels if part.tile is None else part.tile.pixels
        return part.samples * pixels

    def trace(self, view: View) -> TracedView:
        """Renders one view.

        Raises:
            InputError: if too many samples are NaN or infinite.
        """
        (a, b), (count_a, count_b) = zip(
            *(self._half(view, half, n) for half, n in enumerate(self._plan.halves)), strict=True
        )
        dropped = self._plan.spp * self._plan.pixels - self._taken(count_a) - self._taken(count_b)
        share = dropped / (self._plan.spp * self._plan.pixels)
        if share > invalid.SHARE:
            raise InputError(
                f"view {view.name}: {share:.1%} of its samples are NaN or infinite, "
                f"expected at most {invalid.SHARE:.0%}"
            )
        depth, normal = trace_surfaces(
            self._scene, self._plan.intrinsics, view.pose, hide_emitters=self._hidden
        )
        return TracedView((a, b), (count_a, count_b), dropped, depth, normal)

    def _taken(self, samples: Samples) -> int:
        """How many samples a picture is made of."""
        if isinstance(samples, int):
            return samples * self._plan.pixels
        return int(samples.sum(dtype=np.float64))

    def _parts(self, samples: int) -> list[_Part]:
        """What is traced at a time of a picture of so many samples a pixel."""
        if self._in_passes:
            return [_Part(n) for n in passes(samples, self._plan.pixels)]
        if fits(samples, self._plan.pixels):
            return [_Part(samples)]
        return [_Part(samples, tile) for tile in tiles(self._plan.intrinsics, samples)]

    def _half(self, view: View, half: int, samples: int) -> tuple[Image, Samples]:
        """One of the two independent images of a view, and of how many samples a pixel it is."""
        parts = self._parts(samples)
        drawn = (self._part(view, part, view.render_seed(half, i)) for i, part in enumerate(parts))
        if parts[0].tile is not None:
            return self._joined(parts, drawn, samples)
        total: Any = 0.0
        taken: Any = 0
        for image, good in drawn:
            total = total + image * np.float32(good)
            taken = taken + good
        if not isinstance(taken, int):
            taken = taken.astype(np.float32)
            return (total / np.maximum(taken, 1)).astype(np.float32), taken
        return total / np.float32(samples), taken

    def _joined(
        self, parts: list[_Part], drawn: Iterable[tuple[Image, Samples]], samples: int
    ) -> tuple[Image, Samples]:
        """A picture of its tiles."""
        size = self._plan.intrinsics.height, self._plan.intrinsics.width
        image = np.zeros((*size, 4), np.float32)
        taken = np.full((*size, 1), samples, np.float32)
        for part, (piece, good) in zip(parts, drawn, strict=True):
            assert part.tile is not None
            image[part.tile.place] = piece
            taken[part.tile.place] = good
        return image, samples if (taken == samples).all() else taken

    def _part(self, view: View, part: _Part, seed: int) -> tuple[Image, Samples]:
        """Linear premultiplied RGBA of a part, and of how many samples a pixel it is."""
        camera = self._camera(view, part.tile)
        image, good = self._color(camera, part.samples, seed)
        if self._coverage is not None:
            image = image.copy()
            image[..., 3] = self._render(camera, self._coverage, part.samples, seed)[..., 4]
        return image, good

    def _color(self, camera: _Camera, spp: int, seed: int) -> tuple[Image, Samples]:
        if self._guarded is None:
            image = self._render(camera, self._integrator, spp, seed)
            if image.shape[-1] != self._channels:
                raise InputError(
                    f"the integrator '{kind(self._integrator)}' gives {image.shape[-1]} channels, "
                    f"expected RGBA and its own {self._channels - 4}"
                )
            image = image[..., :4]  # what follows are AOVs
            if np.isfinite(image).all():
                return image, spp
        if not self._can_guard:
            return self._one_by_one(camera, spp, seed)
        # From now on at once: samples that are numbers give the same picture either way.
        self._guarded = self._guarded or guarded(self._integrator)
        image = self._render(camera, self._guarded, spp, seed)
        if not image[..., 4].any():
            return image[..., :4], spp
        return invalid.without_invalid(image, spp)

    def _one_by_one(self, camera: _Camera, spp: int, seed: int) -> tuple[Image, Samples]:
        """From pictures of one sample a pixel each."""
        seeds = np.random.SeedSequence(seed).generate_state(spp, np.uint32)
        plain = camera.with_sampler(_independent())
        return invalid.one_by_one(
            lambda i: self._render(plain, self._integrator, 1, int(seeds[i])), spp
        )

    def _camera(self, view: View, tile: Tile | None) -> _Camera:
        """The camera of a view, or of a tile of it; one for all of a size."""
        intrinsics = self._plan.intrinsics if tile is None else tile.intrinsics
        size = intrinsics.width, intrinsics.height, tile is not None
        if size not in self._cameras:
            self._cameras[size] = _Camera(intrinsics, self._plan.scale, self._sampler)
        camera = self._cameras[size]
        camera.move(view.pose, None if tile is None else intrinsics)
        return camera

    def _render(self, camera: _Camera, integrator: Any, spp: int, seed: int) -> Image:
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
            raise


@dataclass(frozen=True)
class _Part:
    """What one call of ``mi.render`` traces."""

    samples: int  # a pixel
    tile: Tile | None = None  # where; None: the whole picture


class _Camera:
    """A sensor that moves."""

    def __init__(self, intrinsics: Intrinsics, scale: float, sampler: Any) -> None:
        import mitsuba as mi

        self._intrinsics, self._scale = intrinsics, scale
        description = sensor_dict(
            intrinsics, np.eye(4), near_clip=1e-3 * scale, far_clip=1e3 * scale
        )
        self.sensor = mi.load_dict({**description, "sampler": sampler})
        self._parameters = mi.traverse(self.sensor)
        self._pose: Any = None

    def move(self, pose: Image, intrinsics: Intrinsics | None = None) -> None:
        """Moves the camera, and with ``intrinsics``, of the same size, its principal point."""
        import mitsuba as mi

        self._pose = pose
        to_world = mi.ScalarTransform4f(mitsuba_from_opengl(pose).tolist())
        self._parameters["to_world"] = mi.Transform4f(to_world)
        if intrinsics is not None:
            self._intrinsics = intrinsics
            x, y = intrinsics.principal_point_offset
            self._parameters["principal_point_offset_x"] = x
            self._parameters["principal_point_offset_y"] = y
        self._parameters.update()

    def with_sampler(self, sampler: Any) -> _Camera:
        """The same camera with another sampler."""
        other = _Camera(self._intrinsics, self._scale, sampler)
        other.move(self._pose)
        return other


def _independent() -> Any:
    import mitsuba as mi

    return mi.load_dict({"type": "independent"})
