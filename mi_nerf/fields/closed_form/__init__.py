"""Radiance fields given by formulas, of which the integral along any ray is known.

They are ground truth: for tests, for measuring quadrature, and as scenes that show what
a reconstruction should find. In all of them emission depends on direction alone, so that
the radiance of a ray of optical depth τ along d is radiance(d) · (1 − exp(−τ)); each
formula says what τ is.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from .base import ClosedFormConfig, ClosedFormField
from .planar import (
    FogConfig,
    FogField,
    RampConfig,
    RampField,
    SheetConfig,
    SheetField,
    SlabConfig,
    SlabField,
    StepConfig,
    StepField,
    TwoColorConfig,
    TwoColorField,
)
from .radial import GaussianConfig, GaussianField, ShellConfig, ShellField

CLOSED_FORMS: dict[str, tuple[type[ClosedFormConfig], type[ClosedFormField]]] = {
    "slab": (SlabConfig, SlabField),
    "two_color": (TwoColorConfig, TwoColorField),
    "fog": (FogConfig, FogField),
    "ramp": (RampConfig, RampField),
    "step": (StepConfig, StepField),
    "sheet": (SheetConfig, SheetField),
    "gaussian": (GaussianConfig, GaussianField),
    "shell": (ShellConfig, ShellField),
}

__all__ = [
    "CLOSED_FORMS",
    "ClosedFormConfig",
    "ClosedFormField",
    "FogConfig",
    "FogField",
    "GaussianConfig",
    "GaussianField",
    "RampConfig",
    "RampField",
    "SheetConfig",
    "SheetField",
    "ShellConfig",
    "ShellField",
    "SlabConfig",
    "SlabField",
    "StepConfig",
    "StepField",
    "TwoColorConfig",
    "TwoColorField",
    "closed_form",
]


def closed_form(kind: str, values: Mapping[str, Any], tensor_type: Any) -> ClosedFormField:
    """The field of a kind with the given parameters, the others by default.

    Raises:
        ValueError: for an unknown kind or parameter, or a value that makes no sense.
    """
    if kind not in CLOSED_FORMS:
        raise ValueError(f"field='{kind}', expected {', '.join(CLOSED_FORMS)}")
    config_type, field_type = CLOSED_FORMS[kind]
    known = {f.name for f in dataclasses.fields(config_type)}
    if unknown := sorted(set(values) - known):
        raise ValueError(f"'{unknown[0]}' is no parameter of '{kind}', expected {sorted(known)}")
    return field_type(config_type(**values), tensor_type)
