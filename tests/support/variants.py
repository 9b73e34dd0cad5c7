"""Mitsuba's variants in tests: those that work here, and a way back from them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import mitsuba as mi
import pytest

from mi_nerf.base.variants import available_variants, using_variant

NAMES = [name for name in available_variants() if name.startswith("llvm")]
# For parametrize; the quick lane leaves out the polarised ones.
EVERY = [
    pytest.param(name, marks=pytest.mark.slow) if "_polarized" in name else name for name in NAMES
]
SPECTRAL = [p for p, name in zip(EVERY, NAMES, strict=True) if "_spectral" in name]
MONO = [p for p, name in zip(EVERY, NAMES, strict=True) if "_mono" in name]
USUAL = "llvm_ad_rgb"


@contextmanager
def variant(name: str) -> Iterator[None]:
    """Sets a variant, and afterwards the one that tests expect."""
    mi.set_variant(USUAL)
    with using_variant(name):
        yield


def plugin_module(name: str) -> Any:
    """A module of the plugins, as it is for the active variant."""
    return import_module(f"mi_nerf.plugins.{name}")
