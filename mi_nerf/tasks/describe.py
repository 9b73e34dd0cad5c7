"""Summaries for people: the system, runs, field files, checkpoints, datasets."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from ..base.errors import InputError
from ..base.files import read_json
from ..base.machine import versions
from ..base.tensor_file import read_metadata
from ..base.variants import available_variants
from ..data import available_splits, load_dataset
from ..fields.hash_grid import HashGridConfig
from ..formats.field_file import FieldFile, load_field
from ..generation.run import RECORD, ceilings
from ..training.auto import Decision
from ..training.checkpoint import read_checkpoint
from ..training.run_folder import CHECKPOINT, CONFIG, FIELD, read_record


def system() -> str:
    """Versions, the compiler, and the variants that work here."""
    variants = available_variants()
    rows = {
        **versions(),
        "cores": str(os.cpu_count()),
        "LLVM library": os.environ.get("DRJIT_LIBLLVM_PATH", "left to Dr.Jit"),
        "variants": ", ".join(variants) or "none works on this machine",
        "default": variants[0] if variants else "none",
    }
    return _table(rows)


def describe(target: str | Path | None = None) -> str:
    """What this machine offers, or what a run, checkpoint, field or dataset holds.

    Raises:
        InputError: if the target is nothing that mi_nerf knows.
    """
    if target is None:
        return system()
    path = Path(target)
    if not path.exists():
        raise InputError(
            f"{path}: not found, expected a run, a .safetensors file or a dataset folder"
        )
    if path.is_dir():
        return _run(path) if (path / CONFIG).exists() else _dataset(path)
    kind = read_metadata(path).get("format", "")
    if kind == "mi_nerf.field":
        return _table(_field_rows(path, load_field(path)))
    if kind == "mi_nerf.checkpoint":
        return _table(_checkpoint_rows(path))
    raise InputError(f"{path}: format '{kind}', expected a field file or a checkpoint of mi_nerf")


def _run(folder: Path) -> str:
    record = read_record(folder)
    settings, data = record["settings"], record["data"]
    rows: dict[str, str] = {
        "run": str(folder),
        "preset": str(settings.get("preset", "unknown")),
        "data": f"{data['path']}, {data['views']} views of {data['size'][0]}x{data['size'][1]}",
        "variant": str(record.get("variant", "unknown")),
        "budget": ", ".join(
            f"{settings[name]:g} {unit}"
            for name, unit in (("steps", "steps"), ("max_seconds", "seconds"))
            if isinstance(settings.get(name), int | float)
        ),
    }
    if (folder / CHECKPOINT).exists():
        rows |= _checkpoint_rows(folder / CHECKPOINT)
    if (folder / FIELD).exists():
        rows |= _field_rows(folder / FIELD, load_field(folder / FIELD))
    return "\n".join([_table(rows), *_decisions(record)])


def _decisions(record: dict[str, Any]) -> list[str]:
    """Why preset ``auto`` chose what it did, a line for each setting."""
    try:
        return [f"auto: {Decision(**decision)}" for decision in record.get("auto", ())]
    except TypeError:  # written by another version: not worth a refusal
        return []


def _checkpoint_rows(path: Path) -> dict[str, str]:
    _, description = read_checkpoint(path)
    return {
        "checkpoint": str(path),
        "step": str(description.step),
        "seconds": f"{description.progress.seconds:.0f}",
        "restarts": str(description.attempt),
    }


def _field_rows(path: Path, contents: FieldFile) -> dict[str, str]:
    config, net = contents.config, contents.config.network
    march = contents.march
    filled = contents.occupancy
    return {
        "field": str(path),
        "network": f"{net.depth}x{net.width}, skip {net.skip}, view branch "
        f"{net.view_depth}x{net.view_width}, {config.parameter_count()} parameters",
        "encoding": f"L={config.position.frequencies} (position), "
        f"{config.direction.frequencies} (direction), convention {config.position.convention}",
        **({} if config.grid is None else {"hash grid": _grid(config.grid)}),
        "density": f"{config.density_activation}, scale {config.density_scale:.4g} 1/scene unit",
        "colour": f"{config.color_activation}, {config.color_space}",
        "box": f"{_corner(config.lower)} to {_corner(config.upper)}"
        + (", normalised device coordinates" if config.ndc is not None else ""),
        "sampling": f"{march.samples} strata a ray, rule {march.rule}, "
        f"near {march.near}, far {march.far}",
        "occupied": "no grid" if filled is None else f"{filled.mean():.1%} of {filled.shape}",
    }


def _grid(grid: HashGridConfig) -> str:
    return (
        f"{grid.levels} levels of {grid.coarsest} to {grid.finest} vertices, {grid.features} "
        f"features, at most 2^{grid.log2_entries} entries a level"
    )


def _dataset(folder: Path) -> str:
    rows = {"dataset": str(folder)}
    try:
        splits = available_splits(folder)
    except InputError:
        raise InputError(
            f"{folder}: expected a run with its {CONFIG}, or a dataset with "
            "transforms_{train,val,test}.json or poses_bounds.npy"
        ) from None
    rows |= _provenance(folder)
    for split in splits:
        dataset = load_dataset(folder, split)
        size = dataset.intrinsics
        alpha = "RGBA" if dataset.has_alpha else "RGB"
        rows[split] = (
            f"{len(dataset)} views of {size.width}x{size.height}, {dataset.color_space} {alpha}, "
            f"field of view {size.fov_x:.1f} degrees"
        )
    return _table(rows)


def _provenance(folder: Path) -> dict[str, str]:
    """What ``mi-nerf generate`` recorded, if it made this dataset."""
    if not (folder / RECORD).exists():
        return {}
    record = read_json(folder / RECORD, "the record of a dataset")
    try:
        settings = record["settings"]
        return {
            "scene": f"{record['scene']['file']}, SHA-256 {record['scene']['sha256'][:16]}...",
            "path-traced": f"{settings['spp']} samples a pixel, seed {settings['seed']}, "
            f"{record['variant']}, Mitsuba {record['versions']['mitsuba']}",
            "PSNR ceiling": ceilings(record) or "free of noise",
        }
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{folder / RECORD}: damaged record of a dataset: {error!r}") from error


def _corner(v: tuple[float, float, float]) -> str:
    return "(" + ", ".join(f"{x:.3f}" for x in v) + ")"


def _table(rows: dict[str, Any]) -> str:
    width = max(len(name) for name in rows)
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows.items())
