"""Everything a run needs to go on exactly where it stopped."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..base.arrays import upload
from ..base.errors import InputError
from ..base.tensor_file import prefixed, read_tensors, write_tensors
from .trainer import Trainer

VERSION = 2  # 2: the occupancy grid's floor


def save_checkpoint(path: str | Path, trainer: Trainer, progress: dict[str, Any]) -> None:
    """Writes weights, moments, occupancy and counters; atomic.

    All randomness of a step follows from the seed and the step number, so no random
    state has to be kept besides them.

    Args:
        progress: what the loop around the trainer has to remember, as JSON values.
    """
    arrays = {f"weights.{n}": np.array(t) for n, t in trainer.parameters.items()}
    arrays |= {f"adam.{n}": a for n, a in trainer.optimizer.state().items()}
    if trainer.occupancy is not None:
        arrays |= {f"occupancy.{n}": a for n, a in trainer.occupancy.state().items()}
    if trainer.loss_scale is not None:
        arrays["loss_scale"] = trainer.loss_scale.state()
    description = {
        "step": trainer.step_count,
        "attempt": trainer.attempt,
        "rays_per_step": trainer.rays_per_step,
        "seed": trainer.config.seed,
        "progress": progress,
    }
    write_tensors(path, arrays, kind="checkpoint", version=VERSION, description=description)


def load_checkpoint(path: str | Path, trainer: Trainer) -> dict[str, Any]:
    """Puts ``trainer`` back where :func:`save_checkpoint` left it.

    Returns:
        The ``progress`` that was saved.

    Raises:
        InputError: if the file is damaged, of another version, or of another model.
    """
    arrays, description = read_tensors(path, kind="checkpoint", version=VERSION)
    try:
        trainer.attempt = description["attempt"]
        trainer.reset()
        for name, tensor in trainer.parameters.items():
            saved = arrays[f"weights.{name}"]
            if saved.shape != tensor.shape:
                raise ValueError(f"tensor '{name}' is {saved.shape}, expected {tensor.shape}")
            trainer.optimizer.assign(name, upload(type(tensor), saved))
        trainer.optimizer.restore(prefixed(arrays, "adam."))
        if trainer.occupancy is not None:
            trainer.occupancy.restore(prefixed(arrays, "occupancy."))
        if trainer.loss_scale is not None:
            trainer.loss_scale.restore(arrays["loss_scale"])
        trainer.step_count = description["step"]
        trainer.rays_per_step = description["rays_per_step"]
        progress: dict[str, Any] = description["progress"]
    except KeyError as error:
        raise InputError(f"{path}: does not fit this run: {error} is missing") from error
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: does not fit this run: {error}") from error
    return progress
