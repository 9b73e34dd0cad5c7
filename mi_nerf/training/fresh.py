"""Fields as files: as a trainer holds them, and before it has learnt anything."""

from __future__ import annotations

from typing import Any

from .._version import __version__
from ..data import Dataset
from ..formats.field_file import FieldFile
from ..march.settings import MarchSettings
from .config import TrainConfig
from .trainer import Trainer


def field_file(trainer: Trainer, provenance: dict[str, Any]) -> FieldFile:
    """The field as it is now, as XML scenes will load it.

    Args:
        provenance: what it says of where it comes from, besides version, preset and steps.
    """
    field, config = trainer.field, trainer.config
    return FieldFile(
        trainer.field_config,
        field.weights(),
        trainer.occupancy.mask() if trainer.occupancy is not None else None,
        render_settings(config),
        {
            "mi_nerf": __version__,
            "preset": config.preset,
            "steps": trainer.step_count,  # that these weights have seen
            **provenance,
        },
        None if field.coarse is None else field.coarse.weights(),
    )


def fresh_field(config: TrainConfig, dataset: Dataset, backend: Any) -> FieldFile:
    """The field with which a run begins.

    Args:
        backend: ``drjit.llvm.ad`` or ``drjit.cuda.ad``.
    """
    return field_file(Trainer(config, dataset, backend), {})


def render_settings(config: TrainConfig) -> MarchSettings:
    """How rays are sampled when nothing is trained."""
    sampling = config.sampling
    return MarchSettings(
        samples=sampling.render_samples,
        fine=sampling.fine if sampling.render_fine is None else sampling.render_fine,
        near=sampling.near,
        far=sampling.far,
        rule=sampling.rule,
        stop=sampling.render_stop,
    )
