"""Radiance fields: density from position alone, emission from position and direction."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

from ..base.arrays import Floats, Vectors
from ..base.box import Corner
from ..base.color import ColorSpace
from ..cameras.ndc import Ndc


class Field(ABC):
    """What quadrature, plugins and training need of any radiance field.

    Positions are 3-vectors in the field's own coordinates (scene units), directions
    are unit 3-vectors of travel along the ray; N of each give N results.

    With ``ndc``, the box, positions and the unit of density are those of normalised
    device coordinates; directions are still the ones before projection.
    """

    lower: Corner  # corners of the box outside which the field is empty
    upper: Corner
    color_space: ColorSpace  # in which emission is expressed and composited
    ndc: Ndc | None = None  # the projection in whose space the field lives; None: scene space
    coarse: Field | None = None  # says where this one is worth sampling (NeRF Sec. 5.2)

    @abstractmethod
    def density(self, p: Vectors) -> Floats:
        """σ ≥ 0 at N points, in 1/scene unit."""

    @abstractmethod
    def density_emission(self, p: Vectors, d: Vectors) -> tuple[Floats, list[Floats]]:
        """σ and the three channels of the emitted colour at N points along ``d``."""

    @abstractmethod
    def parameters(self) -> Mapping[str, Any]:
        """Differentiable parameters by name; tensors that may be updated in place."""

    def fused(self, emission: bool = True) -> Callable[..., Any] | None:
        """:meth:`density_emission` of the parameters as they are, as one kernel without gradients.

        Without ``emission``, :meth:`density`. ``None`` where there is no faster way.
        """
        return None

    def fused_along(self, d: Vectors) -> Callable[..., Any] | None:
        """:meth:`fused` as a function of positions alone, for many along the same directions."""
        ask = self.fused()
        return None if ask is None else lambda p: ask(p, d)
