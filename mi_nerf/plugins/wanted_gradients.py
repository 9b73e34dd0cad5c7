"""Which parameters of a scene pictures can be differentiated by; refuses the others."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..base.errors import InputError
from .placement import is_field

_EXPECTED = (
    "expected colours and textures of surfaces, the power of lights, weights of fields or their "
    "places"
)


def check_gradients(scene: mi.Scene, plugin: str) -> None:
    """Refuses gradients of what has none, and by what is no number.

    Raises:
        InputError: naming the parameter.
    """
    params = mi.traverse(scene)
    with dr.resume_grad():
        wanted = [(key, value) for key, value in params if dr.grad_enabled(value)]
    for key, _ in wanted:
        parent, flags = _parent(params, key), int(params.flags(key))
        if isinstance(parent, mi.Shape):
            refused = not is_field(parent.interior_medium())
            what = "of where a surface is"
        elif isinstance(parent, mi.Sensor | mi.Film):
            refused, what = True, "of a sensor"
        else:
            refused = bool(flags & int(mi.ParamFlags.NonDifferentiable))
            what = "of it in Mitsuba"
        if refused:
            raise InputError(
                f"{plugin}: the gradient of '{key}' is wanted, but there is no derivative {what}: "
                f"{_EXPECTED}"
            )
    # Those of fields have been looked at before.
    others = [(key, value) for key, value in wanted if not is_field(_parent(params, key))]
    for key, value in others:
        numbers = dr.detach(value.matrix if isinstance(value, mi.Transform4f) else value)
        if not np.isfinite(np.array(numbers)).all():
            raise InputError(
                f"{plugin}: '{key}' is NaN or infinite, expected finite numbers to differentiate by"
            )


def _parent(params: Any, key: str) -> Any:
    """The object that has the parameter."""
    return params.properties[key][2]
