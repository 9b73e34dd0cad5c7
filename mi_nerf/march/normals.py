"""Where density falls fastest: what stands for a surface's normal in a field."""

from __future__ import annotations

import drjit as dr

from ..base.arrays import Floats, Indices
from ..fields.protocol import Field
from .blocks import blocks
from .samples import Samples
from .strata import points_along


def density_gradient(field: Field, samples: Samples, index: Indices, block: int) -> list[Floats]:
    """∇σ at the samples ``index``, zero at the others: three arrays of R·S values.

    In the space where the field lives, 1/unit². It carries no gradient itself, and leaves
    those of the field's parameters alone.

    Args:
        block: queries the network evaluates at a time.
    """
    float_type = type(samples.t)
    result = [dr.zeros(float_type, len(samples.t)) for _ in range(3)]
    dr.make_opaque(result)
    for _, valid, where in blocks(index, block):
        t = dr.gather(float_type, dr.detach(samples.t), where)
        o, d = dr.detach(samples.o), dr.detach(samples.d)
        p = points_along(o, d, t, where // samples.count)
        dr.eval(p, where, valid)
        with dr.resume_grad(), dr.suspend_grad(*field.parameters().values()):
            dr.enable_grad(p)
            dr.backward(field.density(p), dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
            gradient = dr.grad(p)
        for channel, value in zip(result, gradient, strict=True):
            dr.scatter(channel, value, where, valid)
        dr.eval(result)
    return result
