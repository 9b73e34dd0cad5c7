"""Neural radiance fields as first-class citizens of Mitsuba 3.

Importing the package registers the plugins ``nerf``, ``nerf_tracking`` (integrators) and
``nerfmedium`` (medium) with the active Mitsuba variant, and again whenever the variant changes.

The functions below do what the commands of ``mi-nerf`` do::

    mi_nerf.generate("bonsai", "data", size=(200, 200))        # path-trace a dataset
    run = mi_nerf.start("data", "run", max_seconds=120)        # open a run
    for report in run.reports():                               # train
        print(report["step"], report["loss"])
    mi_nerf.evaluate(run)["mean"]["psnr"]                      # measure held-out views
    pictures = mi_nerf.render(run, frames=24)                  # fly around
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from ._llvm import ensure_llvm

ensure_llvm()  # before Dr.Jit looks for its compiler

from .errors import InputError  # noqa: E402
from .field import Field, NeuralField, NeuralFieldConfig  # noqa: E402
from .field_file import FieldFile, load_field, save_field  # noqa: E402
from .plugins import register_always  # noqa: E402

if TYPE_CHECKING:
    from .backend import available_variants, choose_variant
    from .data import Dataset, load_dataset
    from .images import on_white, write_picture
    from .metrics import psnr, ssim
    from .scene_library import find_scene, scenes
    from .target import Target, open_target
    from .training.config import TrainConfig, setting_names
    from .training.run import Run, TrainingError
    from .workflow import describe, evaluate, generate, pictures, render, start

register_always()

__version__ = "0.1.0"

# Imported when first asked for: XML scenes need none of it.
_LATER = {
    "available_variants": "backend",
    "choose_variant": "backend",
    "Dataset": "data",
    "load_dataset": "data",
    "on_white": "images",
    "write_picture": "images",
    "psnr": "metrics",
    "ssim": "metrics",
    "find_scene": "scene_library",
    "scenes": "scene_library",
    "Target": "target",
    "open_target": "target",
    "TrainConfig": "training.config",
    "setting_names": "training.config",
    "Run": "training.run",
    "TrainingError": "training.run",
    "describe": "workflow",
    "evaluate": "workflow",
    "generate": "workflow",
    "render": "workflow",
    "start": "workflow",
    "pictures": "workflow",
}

__all__ = [
    "Dataset",
    "Field",
    "FieldFile",
    "InputError",
    "NeuralField",
    "NeuralFieldConfig",
    "Run",
    "Target",
    "TrainConfig",
    "TrainingError",
    "available_variants",
    "choose_variant",
    "describe",
    "evaluate",
    "find_scene",
    "generate",
    "load_dataset",
    "load_field",
    "on_white",
    "open_target",
    "pictures",
    "psnr",
    "render",
    "save_field",
    "scenes",
    "setting_names",
    "ssim",
    "start",
    "write_picture",
]


def __getattr__(name: str) -> Any:
    """What is imported late."""
    if name not in _LATER:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    value = getattr(importlib.import_module(f".{_LATER[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """All public names, those that are imported late included."""
    return sorted({*globals(), *__all__})
