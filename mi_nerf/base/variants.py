"""Chooses where to compute: the GPU where there is one, the CPU otherwise.

A Mitsuba variant is named backend, derivatives, colours and perhaps precision, as in
``llvm_ad_spectral_polarized``. What is accepted is what has derivatives (``_ad_``) in single
precision, in any colours: fields and their training know RGB only, and the plugins turn it into
the colours of the variant (:mod:`mi_nerf.plugins.colors`).
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import drjit as dr

from .._llvm import SOUND, where_llvm_is
from .errors import InputError

_BEST = ("cuda", "llvm")  # backends; any other, as Metal, comes after what has been measured


def unsuitable(variant: str) -> str | None:
    """What keeps fields out of a variant, in words that go on after its name; or ``None``."""
    if variant.endswith("_double"):
        return "computes in double precision, expected a variant of single precision"
    if "_ad_" not in variant:
        return "has no derivatives, expected a variant with '_ad_' in its name"
    return None


def available_variants() -> list[str]:
    """The variants of this Mitsuba that work on this machine, best first."""
    import mitsuba as mi

    names = [name for name in mi.variants() if unsuitable(name) is None and _works(name)]
    return sorted(names, key=lambda name: (not name.endswith("_rgb"), _rank(name)))


def choose_variant(requested: str | None = None) -> str:
    """``requested``, or the best variant of this machine.

    Raises:
        InputError: if it is not supported, or nothing is.
    """
    available = available_variants()
    if requested is not None and (why := unsuitable(requested)) is not None:
        raise InputError(f"variant '{requested}': {why}{_such_as(available)}")
    if not available:
        raise InputError(f"no usable backend: expected an NVIDIA GPU, or {_an_llvm()}")
    if requested is not None and requested not in available:
        lacking = "expected one" + _such_as(available)
        if _prefix(requested) == "llvm" and not _works(requested):
            lacking = f"expected {_an_llvm()}"
        raise InputError(f"variant '{requested}': does not work on this machine, {lacking}")
    return requested or available[0]


def _such_as(available: list[str]) -> str:
    return f" such as '{available[0]}'" if available else ""


def _an_llvm() -> str:
    return (
        f"an LLVM library (version {SOUND} or newer) that DRJIT_LIBLLVM_PATH may point at, "
        f"{where_llvm_is()}"
    )


def _prefix(variant: str) -> str:
    return variant.partition("_")[0]


def _rank(variant: str) -> int:
    return _BEST.index(_prefix(variant)) if _prefix(variant) in _BEST else len(_BEST)


def _works(variant: str) -> bool:
    """Whether Dr.Jit can compute with the backend of a variant here, if it knows it at all."""
    named = {name.lower(): name for name in dir(dr.JitBackend) if not name.startswith("_")}
    title = named.get(_prefix(variant))
    return title is not None and bool(dr.has_backend(getattr(dr.JitBackend, title)))


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
    return multiplies_in_half(array_module(variant).Float16)


@cache
def multiplies_in_half(half: Any) -> bool:
    """Whether products of cooperative vectors of this array type work; tried out once.

    A driver may be new enough and OptiX missing, so that only a product itself tells.
    """
    from drjit import nn

    tensor = dr.tensor_t(half)
    try:
        with dr.suspend_grad():
            views = nn.pack({"two": tensor(half([2.0] * 256), (16, 16))}, layout="inference")
            first = next(iter(nn.matvec(views["two"], nn.CoopVec(*[half([1.0, 0.5])] * 16))))
            return bool(dr.all(first == half([32.0, 16.0])))
    except RuntimeError:
        return False


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
