"""Everything a run needs to go on exactly where it stopped."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..base.arrays import upload
from ..base.errors import InputError
from ..base.schema import Key, Number, Record
from ..base.tensor_file import Arrays, prefixed, read_tensors, write_tensors
from .config import from_json, to_json
from .plain import as_text, leaves
from .trainer import Trainer

# Versions of the format. 2: the occupancy grid's floor; 3: settings.
NEWEST, OLDEST = 3, 2

# Settings that may differ when a run goes on: they change no step that is still to be taken.
_FREE = (
    *("preset", "steps", "max_seconds", "report_every", "checkpoint_every"),
    *("collapse_check", "max_restarts", "max_skipped", "store_activations"),
    *("sampling.render_samples", "sampling.render_fine", "sampling.render_stop"),
)


@dataclass(frozen=True)
class Progress:
    """What the loop around the trainer has to remember."""

    seconds: float  # of training
    skipped: int = 0  # steps that were not finite
    attempt_start: int = 0  # step at which training last began again
    begun: int = 0  # steps before the log began


@dataclass(frozen=True)
class Description:
    """What a checkpoint says besides its tensors."""

    step: int
    attempt: int
    rays_per_step: float
    seed: int
    progress: Progress
    settings: dict[str, Any] | None  # of training; unknown to version 2


_PROGRESS = Record(
    Progress,
    {
        "seconds": Key(Number),
        "skipped": Key(int),
        "attempt_start": Key(int),
        "begun": Key(int, absent=0),
    },
)
_DESCRIPTION = Record(
    Description,
    {
        "step": Key(int),
        "attempt": Key(int),
        "rays_per_step": Key(Number),
        "seed": Key(int),
        "progress": Key(_PROGRESS),
        "settings": Key(dict | None, absent=None, since=3),
    },
)


def save_checkpoint(path: str | Path, trainer: Trainer, progress: Progress) -> None:
    """Writes weights, moments, occupancy and counters; atomic.

    All randomness of a step follows from the seed and the step number, so no random
    state has to be kept besides them.
    """
    arrays = {f"weights.{n}": np.asarray(t) for n, t in trainer.parameters.items()}
    arrays |= {f"adam.{n}": a for n, a in trainer.optimizer.state().items()}
    if trainer.occupancy is not None:
        arrays |= {f"occupancy.{n}": a for n, a in trainer.occupancy.state().items()}
    if trainer.loss_scale is not None:
        arrays["loss_scale"] = trainer.loss_scale.state()
    description = Description(
        step=trainer.step_count,
        attempt=trainer.attempt,
        rays_per_step=trainer.rays_per_step,
        seed=trainer.config.seed,
        progress=progress,
        settings=to_json(trainer.config),
    )
    write_tensors(
        path,
        arrays,
        kind="checkpoint",
        version=_DESCRIPTION.version(description),
        description=_DESCRIPTION.write(description),
    )


def read_checkpoint(path: str | Path) -> tuple[Arrays, Description]:
    """The tensors of a checkpoint, and what it says.

    Raises:
        InputError: if it is missing, damaged, or of a version that cannot be read.
    """
    arrays, description = read_tensors(path, kind="checkpoint", newest=NEWEST, oldest=OLDEST)
    try:
        return arrays, _DESCRIPTION.read(description)
    except ValueError as error:
        raise InputError(f"{path}: damaged checkpoint: {error}") from error


def load_checkpoint(path: str | Path, trainer: Trainer) -> Progress:
    """Puts ``trainer`` back where :func:`save_checkpoint` left it.

    Raises:
        InputError: as :func:`read_checkpoint`, or if it is of another model or other settings.
    """
    arrays, description = read_checkpoint(path)
    _require_same_settings(path, description, trainer)
    try:
        trainer.attempt = description.attempt
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
    except KeyError as error:
        raise InputError(f"{path}: does not fit this run: {error} is missing") from error
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: does not fit this run: {error}") from error
    trainer.step_count = description.step
    trainer.rays_per_step = description.rays_per_step
    return description.progress


def _require_same_settings(path: str | Path, description: Description, trainer: Trainer) -> None:
    """Refuses to go on with other settings, as far as the checkpoint knows them."""
    now = to_json(trainer.config)
    before = {**now, "seed": description.seed}
    if description.settings is not None:  # what it does not mention yet is as by default
        before = to_json(from_json(description.settings, str(path)))
    found, wanted = dict(leaves(now)), dict(leaves(before))
    for name in sorted(found.keys() | wanted.keys()):
        older = name == "box" and wanted.get(name) is None  # was found, and not written down
        if name not in _FREE and found.get(name) != wanted.get(name) and not older:
            raise InputError(
                f"{path}: does not fit this run: it was trained with {name}="
                f"{as_text(wanted.get(name))}, expected {as_text(found.get(name))} as in the run"
            )
