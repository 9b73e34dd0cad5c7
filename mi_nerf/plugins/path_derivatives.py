"""Where the derivatives of light paths go: to parameters, or from them to an image.

Both modes are told the same: which arrays, or which fields along which rays, have brought light
to which camera rays. Each piece is differentiated and forgotten: at once, or with others that
are alike, for fields are asked at little more cost about many rays than about few.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Any

import drjit as dr
import mitsuba as mi

from ..base.arrays import joined
from .colors import Spectrum, emission, emission_adjoint
from .crossing import Crossing, crossings
from .integral import Integral, chunks
from .path_state import gather
from .sampled import Rays, SampledField

# Samples on rays that wait to be differentiated together; as many as are marched at once.
_WAITING = 1 << 18


class Derivatives(ABC):
    """Of the radiance that camera rays gather, piece by piece."""

    mode: dr.ADMode

    def __init__(self, fields: list[SampledField]) -> None:
        self._fields = fields
        moving = [field for field in fields if field.differentiable]
        self._seen = _Queue(fields, self._differentiate_seen) if moving else None
        self._passed = [_Queue([field], self._differentiate_passed) for field in moving]

    def finish(self) -> None:
        """Differentiates what has been waiting."""
        for queue in (self._seen, *self._passed):
            if queue is not None:
                queue.flush()

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
        if self._seen is not None:
            self._seen.add(slot, rays, weight, behind + dr.zeros(Spectrum, len(slot)))

    def pass_through(self, slot: Any, rays: Rays, light: Any) -> None:
        """Of what fields let pass: of N colours ``light``, which they have weakened already."""
        for queue in self._passed:
            queue.add(slot, rays, light)

    def _differentiate_seen(
        self, marched: list[SampledField], slot: Any, rays: Rays, weight: Any, behind: Any
    ) -> None:
        integral = Integral(marched, rays, self.mode)
        self._see(slot, weight, behind, integral, rays.wavelengths)

    def _differentiate_passed(
        self, marched: list[SampledField], slot: Any, rays: Rays, light: Any
    ) -> None:
        for crossing in crossings(marched, rays, self.mode, emission=False):
            with dr.resume_grad():
                crossing.prepare(self.mode)
                depth = crossing.optical_depth()
            self._weaken(slot, light, crossing, depth)

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


class _Queue:
    """Pieces of paths that cross fields, until there are enough to differentiate them."""

    def __init__(self, marched: list[SampledField], differentiate: Callable[..., None]) -> None:
        """
        Args:
            differentiate: takes the fields, and N camera rays, pieces and colours of each.
        """
        self._fields, self._differentiate = marched, differentiate
        samples = sum(field.march.samples + field.march.fine for field in marched)
        self._most = max(1, _WAITING // samples)
        self._waiting: list[tuple[Any, ...]] = []
        self._count = 0

    def add(self, slot: Any, rays: Rays, *colors: Any) -> None:
        """More of them; those that cross no field, or whose colours are all 0, are left out."""
        strength = sum((dr.max(dr.abs(color)) for color in colors), mi.Float(0))
        matters = mi.UInt32(dr.compress(strength != 0))
        if not len(matters):
            return
        part = rays.take(matters)
        for index, crossing in chunks(self._fields, part, whole=True):
            own = gather(matters, index)
            piece = (gather(slot, own), crossing, *(gather(color, own) for color in colors))
            dr.eval(piece)
            if self._count + len(index) > self._most:
                self.flush()
            self._waiting.append(piece)
            self._count += len(index)

    def flush(self) -> None:
        """Differentiates all that wait."""
        if not self._waiting:
            return
        slot, rays, *colors = (_joined(values) for values in zip(*self._waiting, strict=True))
        self._waiting, self._count = [], 0
        for index, part in chunks(self._fields, rays):
            own = [gather(color, index) for color in colors]
            self._differentiate(self._fields, gather(slot, index), part, *own)


def _joined(values: Sequence[Any]) -> Any:
    """Arrays, or rays, one after the other."""
    first = values[0]
    if len(values) == 1 or first is None or not dr.width(first):  # rgb has no wavelengths
        return first
    if isinstance(first, Rays):
        parts = {f.name: [getattr(value, f.name) for value in values] for f in fields(Rays)}
        return Rays(**{name: _joined(part) for name, part in parts.items()})
    return joined(type(first), values)
