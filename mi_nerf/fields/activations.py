"""Activations of the density and colour heads, safe at both ends of the float range."""

from __future__ import annotations

import math
from typing import Literal

import drjit as dr

from ..base.arrays import Floats

DensityActivation = Literal["softplus", "relu", "exp"]
ColorActivation = Literal["sigmoid", "softplus", "exp"]

# Beyond this exponent ``exp`` continues as its tangent: no overflow, no dead gradient.
_MAX_EXPONENT = 15.0
# Logits are bounded here; the sigmoid is 1e-9 from its ends and its adjoint still finite.
_MAX_LOGIT = 20.0


def relu(x: Floats) -> Floats:
    """max(x, 0) that lets NaN through, so that the trainer's guard can see it."""
    return dr.select(x < 0, 0, x)


def softplus(x: Floats) -> Floats:
    """log(1 + exp(x)), without overflow and without losing the tail of small values."""
    e = dr.exp(dr.select(x < 0, x, -x))  # unlike abs, it has a slope at 0
    small = e < 0.02
    tail = e * (1 - e * (0.5 - e * (1 / 3 - e * 0.25)))
    return relu(x) + dr.select(small, tail, dr.log(1 + dr.select(small, 1, e)))


def bounded_exp(x: Floats) -> Floats:
    """exp(x) up to x = 15, its tangent line beyond."""
    inside = dr.exp(dr.select(x < _MAX_EXPONENT, x, _MAX_EXPONENT))
    beyond = relu(x - _MAX_EXPONENT)
    value = inside * (1 + dr.detach(beyond))
    slope = beyond * math.exp(_MAX_EXPONENT)
    return value + (slope - dr.detach(slope))  # 0, which carries the slope of the tangent


def sigmoid(x: Floats) -> Floats:
    """1 / (1 + exp(−x)) on logits bounded to ±20; lets NaN through."""
    logit = dr.select(x < -_MAX_LOGIT, -_MAX_LOGIT, dr.select(x > _MAX_LOGIT, _MAX_LOGIT, x))
    return 1 / (1 + dr.exp(-logit))


def apply_activation(name: str, x: Floats) -> Floats:
    """Applies the activation called ``name`` to the raw output of a head."""
    return {"softplus": softplus, "relu": relu, "exp": bounded_exp, "sigmoid": sigmoid}[name](x)
