"""The ``nerf_tracking`` integrator: shows a radiance field without bias."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..base.errors import InputError
from ..estimators.majorant import Majorants
from ..estimators.tracking import track
from ..march.intervals import ray_segments
from .backdrop import Environment
from .colors import Radiance, Spectrum, check_encoded
from .film import CameraRays, Channels, FieldIntegrator
from .placement import find_fields
from .sampled import SampledField


@dataclass(frozen=True)
class Tracked:
    """What camera rays see, by an estimate."""

    color: Radiance  # in front of the environment
    opacity: Any

    def channels(self) -> Channels:
        """Colour and opacity."""
        return {"color": self.color, "alpha": self.opacity, "opacity": self.opacity}


@dataclass(frozen=True)
class TrackedScene:
    """The field of a scene before its environment, for the time of one rendering."""

    marched: SampledField
    environment: Environment
    majorants: Majorants
    grow: bool  # whether rays may correct the majorants

    def trace(self, camera: CameraRays) -> Tracked:
        """Follows the rays of a pass."""
        marched, ray = self.marched, camera.ray
        o, d, scale = marched.placed.to_local(ray.o, ray.d)
        segments = ray_segments(marched.field, o, d, marched.bounds(ray.maxt, scale))
        seen = track(
            marched.field,
            segments,
            self.majorants,
            camera.random,
            grow=self.grow,
            block=marched.march.block,
        )
        hit = self.environment.intersect(ray)
        light = self.environment.shade(hit, ray, camera.sampler, seen.opacity)
        return Tracked(
            Radiance(seen.color, (1 - seen.opacity) * Spectrum(*light.radiance)), seen.opacity
        )


class NerfTrackingIntegrator(FieldIntegrator):
    r"""
    .. _integrator-nerf_tracking:

    Neural radiance field, unbiased (:monosp:`nerf_tracking`)
    ---------------------------------------------------------

    .. pluginparameters::

     * - majorant
       - |float|
       - Density that all of the field is compared with, in 1/scene unit of the field.
         Much too high a one costs time, one below half the field's density costs noise;
         neither changes the mean. (Default: one for every cell, of what is seen there)
     * - near, far
       - |float|
       - Fixed bounds of the distance along the ray, in world units, within the box.
         (Default: what the field file suggests)
     * - aovs
       - |string|
       - Extra channels: ``opacity``, perhaps with a channel name in front as in
         ``a:opacity``. (Default: none)
     * - hide_emitters
       - |bool|
       - Leave out the environment emitter behind the field. (Default: false)
     * - encoded
       - |bool|
       - Leave the colour of a field trained on sRGB images as it was composited, in sRGB,
         with the environment encoded likewise. Such fields need it. (Default: false)

    Estimates the same integral as :monosp:`nerf` (NeRF, Eq. 3), but its mean is the integral
    itself: there are no samples per ray, only noise that more samples per pixel reduce. It
    tells how large the error of a quadrature is.

    Ratio tracking with emission: a camera ray collides at random with a medium of the
    density of the majorant, and at each collision the field counts by σ/majorant. Weights
    take the place of a bound: where the field is denser than the majorant they become
    negative, so that pixels of few samples may have an alpha outside [0, 1], and the mean
    stays right. Without ``majorant``, the field is looked at in some points of every cell of
    the occupancy grid (of 32³ cells where there is none), and cells in which rays meet
    more are corrected on the way. As in :monosp:`nerf`, cells marked as empty are empty.

    Decoding sRGB is no linear map, and the mean of decoded estimates is not the decoded
    mean: fields trained on sRGB images are shown with ``encoded`` only. There are no
    derivatives; :monosp:`nerf` has them.

    .. tabs::
        .. code-tab:: xml

            <integrator type="nerf_tracking"/>

        .. code-tab:: python

            'type': 'nerf_tracking'
    """

    plugin = "nerf_tracking"
    known = ("opacity",)

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.encoded = bool(props.get("encoded", False))
        self.majorant = props.get("majorant", None)
        if self.majorant is not None and not 0 < self.majorant < math.inf:
            raise self._unlike("majorant", self.majorant, "a finite number above 0")

    def to_string(self) -> str:
        """Lists the settings."""
        return (
            "NerfTrackingIntegrator[\n"
            f"  majorant = {'seen in cells' if self.majorant is None else self.majorant},\n"
            f"  near = {self.near}, far = {self.far},\n"
            f"  encoded = {self.encoded},\n"
            f"  aovs = {self.aov_names()}\n"
            "]"
        )

    def _draw(self, sampler: mi.Sampler, rays: int, seed: Any) -> Any:
        """A random generator for each ray; samplers without randomness leave the seed."""
        bits = [dr.reinterpret_array(mi.UInt32, sampler.next_1d()) for _ in range(2)]
        first = mi.sample_tea_32(dr.arange(mi.UInt32, rays) ^ bits[0], bits[1])
        number = mi.UInt32(seed)
        dr.make_opaque(number)  # kernels must not depend on it
        second = mi.sample_tea_32(first[0], first[1] + number)
        # The state from both, the stream from the number of the ray: no two are alike.
        state = (mi.UInt64(second[0]) << 32) | mi.UInt64(second[1])
        return mi.PCG32(initstate=state, initseq=dr.arange(mi.UInt64, rays))

    def _scene(self, scene: mi.Scene) -> TrackedScene:
        """The scene as it is now."""
        placed = find_fields(scene)
        if len(placed) > 1:
            raise InputError(
                f"nerf_tracking: the scene holds {len(placed)} fields, expected one "
                "('nerf' shows several)"
            )
        marched = SampledField(placed[0], placed[0].medium.march, self.near, self.far)
        field, occupancy = marched.field, marched.placed.medium.occupancy
        if field.color_space == "srgb" and not self.encoded:
            raise InputError(
                "nerf_tracking: the field was trained on sRGB images, and decoding what is "
                "composited in sRGB would be biased, expected encoded=true"
            )
        if field.color_space == "srgb":
            check_encoded(self.plugin)
        environment = Environment(scene, self.show_background, field.color_space == "srgb")
        seen = self.majorant is None
        if seen:
            majorants = Majorants.seen(field, occupancy, mi.Float)
        else:
            majorants = Majorants.constant(field, self.majorant, occupancy, mi.Float)
        return TrackedScene(marched, environment, majorants, grow=seen)


mi.register_integrator("nerf_tracking", NerfTrackingIntegrator)
