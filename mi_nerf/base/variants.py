"""Chooses where to compute: the GPU where there is one, the CPU otherwise."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr

from .errors import InputError

_BACKENDS = {"cuda_ad_rgb": dr.JitBackend.CUDA, "llvm_ad_rgb": dr.JitBackend.LLVM}


def available_variants() -> list[str]:
    """The supported Mitsuba variants that work on this machine, best first."""
    return [name for name, backend in _BACKENDS.items() if dr.has_backend(backend)]


def choose_variant(requested: str | None = None) -> str:
    """``requested``, or the best variant of this machine.

    Raises:
        InputError: if it is not supported, or nothing is.
    """
    available = available_variants()
    if requested is not None and requested not in _BACKENDS:
        raise InputError(f"variant '{requested}': expected one of {', '.join(_BACKENDS)}")
    if not available:
        raise InputError(
            "no usable backend: expected an NVIDIA GPU, or an LLVM library (version 17 or newer) "
            "that DRJIT_LIBLLVM_PATH may point at"
        )
    if requested is not None and requested not in available:
        raise InputError(
            f"variant '{requested}': does not work on this machine, "
            f"expected {' or '.join(available)}"
        )
    return requested or available[0]


def active_variant(requested: str | None = None) -> str:
    """``requested``, the active Mitsuba variant, or the best one of this machine.

    Raises:
        InputError: if the requested one is not supported, or nothing is.
    """
    import mitsuba as mi

    active = mi.variant()
    if requested is None and active in available_variants():
        return str(active)
    return choose_variant(requested)


def has_cooperative_vectors(variant: str) -> bool:
    """Whether networks can run on tensor cores, as cooperative vectors in half precision.

    That takes an NVIDIA driver R570 or newer, with OptiX, through which Dr.Jit compiles them.
    """
    if not variant.startswith("cuda") or variant not in available_variants():
        return False
    from drjit import nn

    half = array_module(variant).Float16
    try:
        nn.CoopVec(half(0), half(0))
    except RuntimeError:
        return False
    return True


@contextmanager
def using_variant(variant: str) -> Iterator[None]:
    """Sets a Mitsuba variant, and at the end the one that was set before, if any was.

    Inside a generator it lasts until that is exhausted or closed.
    """
    import mitsuba as mi

    before = mi.variant()
    if before != variant:  # even to the same one a change runs the callbacks of plugins
        mi.set_variant(variant)
    try:
        yield
    finally:
        if before is not None and before != mi.variant():
            mi.set_variant(before)


def array_module(variant: str) -> Any:
    """The Dr.Jit module with the differentiable array types of a variant."""
    return importlib.import_module(f"drjit.{variant.split('_')[0]}.ad")
