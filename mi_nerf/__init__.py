"""Neural radiance fields as first-class citizens of Mitsuba 3.

Importing the package registers the plugins ``nerf``, ``nerf_tracking`` (integrators) and
``nerfmedium`` (medium) with the active Mitsuba variant, and again whenever the variant changes.
"""

from __future__ import annotations

from ._llvm import ensure_llvm

ensure_llvm()  # before Dr.Jit looks for its compiler

from .errors import InputError  # noqa: E402
from .field import Field, NeuralField, NeuralFieldConfig  # noqa: E402
from .field_file import FieldFile, load_field, save_field  # noqa: E402
from .plugins import register_always  # noqa: E402

register_always()

__version__ = "0.1.0"

__all__ = [
    "Field",
    "FieldFile",
    "InputError",
    "NeuralField",
    "NeuralFieldConfig",
    "load_field",
    "save_field",
]
