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
from ._version import __version__ as __version__

ensure_llvm()  # before Dr.Jit looks for its compiler

from .base.errors import InputError  # noqa: E402
from .base.work_items import LANES, set_work_item  # noqa: E402
from .fields.neural import NeuralField, NeuralFieldConfig  # noqa: E402
from .fields.protocol import Field  # noqa: E402
from .formats.field_file import FieldFile, load_field, save_field  # noqa: E402
from .plugins import register_always  # noqa: E402

if TYPE_CHECKING:
    from .api import generate, pictures, render, start
    from .base.variants import available_variants, choose_variant
    from .data import Dataset, load_dataset
    from .images.metrics import psnr, ssim
    from .images.write import on_white, write_picture
    from .scene_xml.library import find_scene, scenes
    from .tasks.describe import describe
    from .tasks.evaluate import evaluate
    from .tasks.target import Target, open_target
    from .training.config import TrainConfig, setting_names
    from .training.run import Run, TrainingError

set_work_item(LANES)
register_always()

# Imported when first asked for: XML scenes need none of it.
_LATER = {
    "base.variants": ("available_variants", "choose_variant"),
    "data": ("Dataset", "load_dataset"),
    "images.metrics": ("psnr", "ssim"),
    "images.write": ("on_white", "write_picture"),
    "scene_xml.library": ("find_scene", "scenes"),
    "tasks.describe": ("describe",),
    "tasks.evaluate": ("evaluate",),
    "tasks.target": ("Target", "open_target"),
    "training.config": ("TrainConfig", "setting_names"),
    "training.run": ("Run", "TrainingError"),
    "api": ("generate", "pictures", "render", "start"),
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
    module = next((module for module, names in _LATER.items() if name in names), None)
    if module is None:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    value = getattr(importlib.import_module(f".{module}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """All public names, those that are imported late included."""
    return sorted({*globals(), *__all__})
