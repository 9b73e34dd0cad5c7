"""The sRGB transfer functions, for NumPy and Dr.Jit arrays alike.

Both follow IEC 61966-2-1: linear near zero, a power of 2.4 above. Outside [0, 1]
each branch simply goes on: negative values stay on the linear part and values
above one on the power law, so that the two functions are monotone and remain
inverse to each other on every real number, as HDR images need.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, TypeVar

import drjit as dr
import numpy as np

ColorSpace = Literal["srgb", "linear"]

ArrayT = TypeVar("ArrayT")

# Where the linear part ends, on the encoded and on the linear side.
_ENCODED_KNEE = 0.04045
_LINEAR_KNEE = 0.0031308


def srgb_to_linear(x: ArrayT) -> ArrayT:
    """Decodes sRGB values to linear ones, element by element.

    ``x/12.92`` up to 0.04045, ``((x + 0.055)/1.055)^2.4`` above
    (IEC 61966-2-1).

    Args:
        x: NumPy or Dr.Jit array of floating-point numbers, of any shape.

    Returns:
        The linear values, in the type, precision and shape of ``x``. Gradients
        of Dr.Jit arrays are finite everywhere.
    """
    select, maximum, power = _functions_for(x)
    # Both branches are evaluated. The clamp keeps the one that is not selected
    # away from 0, where the power's derivative could become NaN.
    bright = power((maximum(x, _ENCODED_KNEE) + 0.055) * (1 / 1.055), 2.4)
    return select(x <= _ENCODED_KNEE, x * (1 / 12.92), bright)  # type: ignore


def linear_to_srgb(x: ArrayT) -> ArrayT:
    """Encodes linear values as sRGB, element by element.

    ``12.92 x`` up to 0.0031308, ``1.055 x^(1/2.4) - 0.055`` above
    (IEC 61966-2-1). The inverse of :func:`srgb_to_linear`, up to the rounding of
    the standard's constants (3e-8).

    Args:
        x: NumPy or Dr.Jit array of floating-point numbers, of any shape.

    Returns:
        The encoded values, in the type, precision and shape of ``x``, not
        clipped. Gradients of Dr.Jit arrays are finite everywhere.
    """
    select, maximum, power = _functions_for(x)
    bright = power(maximum(x, _LINEAR_KNEE), 1 / 2.4) * 1.055 - 0.055
    return select(x <= _LINEAR_KNEE, x * 12.92, bright)  # type: ignore


def _functions_for(x: object) -> tuple[Callable[..., Any], ...]:
    """``(select, maximum, power)`` of the library that ``x`` belongs to."""
    if dr.is_array_v(x):
        return dr.select, dr.maximum, dr.power
    return np.where, np.maximum, np.power
