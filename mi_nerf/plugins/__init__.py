"""The Mitsuba plugins of radiance fields.

Integrators ``nerf``, ``nerf_path`` and ``nerf_tracking``, and the medium ``nerfmedium``.

Plugin classes inherit from classes of the active Mitsuba variant, so the modules
that define them are imported again whenever the variant changes.
"""

from __future__ import annotations

import importlib
import sys

import mitsuba as mi

# Each before those that import it.
_MODULES = (
    "nerfmedium",
    "backdrop",
    "paths",
    "film",
    "stage",
    "marching",
    "nerf",
    "nerf_path",
    "nerf_tracking",
)
_loaded_for: str | None = None
_follows_variant = False


def register(*_: object) -> None:
    """Registers the plugins with the active variant; does nothing for scalar ones."""
    global _loaded_for
    variant = mi.variant()
    if variant is None or variant.startswith("scalar") or variant == _loaded_for:
        return
    for name in _MODULES:
        qualified = f"{__name__}.{name}"
        if qualified in sys.modules:
            importlib.reload(sys.modules[qualified])
        else:
            importlib.import_module(qualified)
    _loaded_for = variant


def register_always() -> None:
    """Registers now, and again after every change of variant.

    May be called again: newer versions of Mitsuba reload the package on their own.
    """
    global _follows_variant
    if not _follows_variant:
        mi.detail.add_variant_callback(register)
        _follows_variant = True
    register()
