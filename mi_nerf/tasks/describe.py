"""Summaries for people: the system, runs, field files, checkpoints, datasets, scenes."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path
from typing import Any

from ..base.errors import InputError
from ..base.files import read_json
from ..base.machine import versions
from ..base.tensor_file import read_metadata
from ..base.variants import available_variants, choose_variant, using_variant
from ..data import available_splits, load_dataset
from ..fields.hash_grid import HashGridConfig
from ..formats.field_file import FieldFile, load_field
from ..generation.run import RECORD, ceilings
from ..scene_xml.scene_file import SceneFile, quiet, visible_bounds
from ..scene_xml.substitutes import REPLACEABLE
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
    """What this machine offers, or what a run, checkpoint, field, dataset or scene holds.

    Raises:
        InputError: if the target is nothing that mi_nerf knows.
    """
    if target is None:
        return system()
    path = Path(target)
    if not path.exists():
        raise InputError(
            f"{path}: not found, expected a run, a .safetensors file, a dataset folder "
            "or an XML scene"
        )
    if path.is_dir():
        return _run(path) if (path / CONFIG).exists() else _dataset(path)
    if path.suffix.lower() == ".xml":
        return _scene(path)
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


def _scene(path: Path) -> str:
    """A Mitsuba scene, as ``generate`` would take it."""
    with using_variant(choose_variant()), quiet():
        file = SceneFile(path)
        file.substitute(*REPLACEABLE)
        scene = file.load()
        box = visible_bounds(scene)
        sensors = Counter(_sensor(sensor) for sensor in scene.sensors())
        rows = {
            "scene": f"{path}, SHA-256 {file.digest()[:16]}...",
            "files": ", ".join(dict.fromkeys(found.name for found in file.files())),
            "integrator": _plugins(file, "Integrator") or "none",
            "sensors": _counted(sensors) if file.plugins("Sensor") else "none",
            "emitters": _plugins(file, "Emitter") or "none",
            "shapes": _plugins(file, "Shape") or "none",
            "media": _plugins(file, "Medium"),
            "box": "nothing to be seen"
            if box is None
            else f"{_corner(box[0])} to {_corner(box[1])}",
            "asks for": ", ".join(
                f"{name} {value}"
                for name in ("protocol", "cameras")
                if (value := file.default(name)) is not None
            ),
        }
        return "\n".join([_table({k: v for k, v in rows.items() if v}), *file.notes])


def _plugins(file: SceneFile, kind: str) -> str:
    return _counted(Counter(props.plugin_name() for props in file.plugins(kind)))


def _counted(names: Counter[str]) -> str:
    return ", ".join(f"{count} {name}" if count > 1 else name for name, count in names.items())


def _sensor(sensor: Any) -> str:
    width, height = sensor.film().size()
    return f"{sensor.class_name()} of {width}x{height}, {sensor.sampler().sample_count()} samples"


def _corner(v: tuple[float, float, float]) -> str:
    return "(" + ", ".join(f"{x:.3f}" for x in v) + ")"


def _table(rows: dict[str, Any]) -> str:
    width = max(len(name) for name in rows)
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows.items())
