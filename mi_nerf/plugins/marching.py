"""What integrators that march through fields have in common: how rays are sampled."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, get_args

import mitsuba as mi

from ..base.errors import InputError
from ..march.rules import Rule
from .film import FieldIntegrator
from .placement import PlacedField
from .sampled import SampledField


class MarchingIntegrator(FieldIntegrator):
    """Shows fields by quadrature, before something else; what that is, is up to subclasses."""

    known = ("depth", "opacity", "normal", "index")

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.samples = self._integer(props, "samples", 0, least=1)
        self.fine = props.get("fine", None)
        if self.fine is not None and self.fine < 0:
            raise self._unlike("fine", self.fine, "0 or more")
        self.rule = props.get("rule", None)
        if self.rule not in (None, *get_args(Rule)):
            raise self._unlike("rule", f"'{self.rule}'", " or ".join(get_args(Rule)))
        self.stop = props.get("stop", None)
        if self.stop is not None and not 0 <= self.stop < 1:
            raise self._unlike("stop", self.stop, "0 to less than 1")
        self.jitter = bool(props.get("jitter", True))
        self.paths = self._integer(props, "paths", 1, least=1)

    def _integer(self, props: mi.Properties, name: str, default: int, least: int) -> int:
        """A property that is the default, or no less than a bound."""
        value = int(props.get(name, default))
        if value != default and value < least:
            raise self._unlike(name, value, f"{least} or more")
        return value

    def _settings(self) -> str:
        """For ``to_string``."""
        return (
            f"  samples = {self.samples or 'from field file'},\n"
            f"  fine = {'from field file' if self.fine is None else self.fine},\n"
            f"  near = {self.near}, far = {self.far},\n"
            f"  rule = {self.rule or 'from field file'},\n"
            f"  stop = {'from field file' if self.stop is None else self.stop},\n"
            f"  jitter = {self.jitter}, paths = {self.paths},\n"
            f"  aovs = {self.aov_names()},\n"
        )

    def _draw(self, sampler: mi.Sampler, rays: int, seed: Any) -> Any:
        """One offset a ray, or ``None``."""
        return sampler.next_1d() if self.jitter else None

    def _marched(
        self, found: list[PlacedField], encoded: bool = False, coarse: bool = False
    ) -> list[SampledField]:
        """The fields of the scene, and how they are sampled.

        Args:
            coarse: shows their coarse networks instead.
        """
        fields = []
        pairs = [placed for placed in found if placed.medium.field.coarse is not None]
        if self.fine and found and not pairs:
            raise self._unlike("fine", self.fine, "a field with a coarse network, that places them")
        for placed in found:
            if coarse and placed not in pairs:
                raise self._unlike(
                    "network", "coarse", f"a field with a coarse network in '{placed.shape.id()}'"
                )
            own = placed.medium.march
            march = replace(
                own,
                samples=self.samples or own.samples,
                near=None,
                far=None,
                fine=0 if coarse else own.fine if self.fine is None else self.fine,
                rule=self.rule or own.rule,
                stop=own.stop if self.stop is None else self.stop,
            )
            fields.append(SampledField(placed, march, self.near, self.far, encoded, coarse))
        return fields

    def _wants_normals(self, fields: list[SampledField]) -> bool:
        """Whether normals are among the channels."""
        normals = any(kind == "normal" for _, kind in self.aovs)
        if normals and any(marched.field.ndc is not None for marched in fields):
            raise InputError(
                f"{self.plugin}: aov 'normal' of a field in normalised device coordinates, "
                "expected none"
            )
        return normals
