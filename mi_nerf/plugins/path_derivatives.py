"""Where the derivatives of light paths go: to parameters, or from them to an image.

Both modes are told the same: which arrays, or which fields along which rays, have brought light
to which camera rays. Each piece is differentiated at once and forgotten.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import drjit as dr
import mitsuba as mi

from .colors import Spectrum, emission, emission_adjoint
from .crossing import Crossing, crossings
from .integral import Integral, chunks
from .path_state import gather
from .sampled import Rays, SampledField


class Derivatives(ABC):
    """Of the radiance that camera rays gather, piece by piece."""

    mode: dr.ADMode

    def __init__(self, fields: list[SampledField]) -> None:
        self._fields = fields
        self._moving = [field for field in fields if field.differentiable]

    @abstractmethod
    def carry(self, slot: Any, value: Any, leaves: list[Any]) -> None:
        """Of N colours with history, gathered by some of the camera rays.

        Args:
            leaves: the parameters on which they may depend.
        """

    def see(self, slot: Any, rays: Rays, weight: Any, behind: Any) -> None:
        """Of what N rays see of the fields: ``weight · C + behind · T``.

        Args:
            weight, behind: N colours.
        """
        if not self._moving:
            return
        behind = behind + dr.zeros(Spectrum, len(slot))
        for index, part in chunks(self._fields, rays):
            integral = Integral(self._fields, part, self.mode)
            own = gather(slot, index)
            own_weight, own_behind = gather(weight, index), gather(behind, index)
            self._see(own, own_weight, own_behind, integral, part.wavelengths)

    def pass_through(self, slot: Any, rays: Rays, light: Any) -> None:
        """Of what fields let pass: of N colours ``light``, which they have weakened already."""
        for field in self._moving:
            for index, part in chunks([field], rays):
                for crossing in crossings([field], part, self.mode, emission=False):
                    with dr.resume_grad():
                        crossing.prepare(self.mode)
                        depth = crossing.optical_depth()
                    self._weaken(gather(slot, index), gather(light, index), crossing, depth)

    @abstractmethod
    def _see(
        self, slot: Any, weight: Any, behind: Any, integral: Integral, wavelengths: Any
    ) -> None:
        """The same for rays that all cross fields."""

    @abstractmethod
    def _weaken(self, slot: Any, light: Any, crossing: Crossing, depth: Any) -> None:
        """Of ``light`` with regard to the optical depth of a field."""


class Pull(Derivatives):
    """Backward mode: carries the gradient of the radiance to the parameters."""

    mode = dr.ADMode.Backward

    def __init__(self, fields: list[SampledField], gradient: Any) -> None:
        """
        Args:
            gradient: of each camera ray's radiance, R colours.
        """
        super().__init__(fields)
        self._gradient = gradient
        dr.eval(gradient)

    def carry(self, slot: Any, value: Any, leaves: list[Any]) -> None:
        with dr.resume_grad():
            for channel, gradient in zip(value, gather(self._gradient, slot), strict=True):
                if dr.grad_enabled(channel):
                    dr.accum_grad(channel, gradient)
                    dr.enqueue(dr.ADMode.Backward, channel)
            dr.traverse(dr.ADMode.Backward)
            dr.eval([dr.grad(leaf) for leaf in leaves])

    def _see(
        self, slot: Any, weight: Any, behind: Any, integral: Integral, wavelengths: Any
    ) -> None:
        gradient = gather(self._gradient, slot)
        opacity = -dr.sum(gradient * behind)
        color = emission_adjoint(gradient * weight, wavelengths)
        integral.backward([*color, opacity, dr.zeros(mi.Float, len(slot))])

    def _weaken(self, slot: Any, light: Any, crossing: Crossing, depth: Any) -> None:
        with dr.resume_grad():
            dr.set_grad(depth, -dr.sum(gather(self._gradient, slot) * light))
            dr.enqueue(dr.ADMode.Backward, depth)
            dr.traverse(dr.ADMode.Backward)
            crossing.backward()


class Push(Derivatives):
    """Forward mode: sums up how the radiance follows the gradients of the parameters."""

    mode = dr.ADMode.Forward

    def __init__(self, fields: list[SampledField], rays: int) -> None:
        super().__init__(fields)
        self.tangent = dr.zeros(Spectrum, rays)
        dr.make_opaque(self.tangent)

    def carry(self, slot: Any, value: Any, leaves: list[Any]) -> None:
        with dr.resume_grad():
            dr.forward_to(list(value), flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad)
            tangent = Spectrum(*(dr.grad(channel) for channel in value))
        self._add(slot, tangent)

    def _see(
        self, slot: Any, weight: Any, behind: Any, integral: Integral, wavelengths: Any
    ) -> None:
        *color, opacity, _ = integral.forward()
        self._add(slot, weight * emission(color, wavelengths) - behind * opacity)

    def _weaken(self, slot: Any, light: Any, crossing: Crossing, depth: Any) -> None:
        with dr.resume_grad():
            dr.forward_to(depth, flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad)
            slope = dr.grad(depth)
        self._add(slot, -light * slope)

    def _add(self, slot: Any, tangent: Any) -> None:
        dr.scatter_add(self.tangent, tangent, slot)
        dr.eval(self.tangent)
