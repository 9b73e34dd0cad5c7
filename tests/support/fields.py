"""Small fields and scenes for the tests of plugins and training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mi_nerf import FieldFile, NeuralFieldConfig, save_field
from mi_nerf.fields.fourier import FourierEncoding
from mi_nerf.fields.network import NetworkConfig, initial_weights
from mi_nerf.march.settings import MarchSettings

SMALL = NeuralFieldConfig(
    network=NetworkConfig(depth=2, width=16, skip=1, view_width=8),
    position=FourierEncoding(frequencies=3),
    direction=FourierEncoding(frequencies=2),
    density_scale=4.0,
)


def small_file(folder: Path, *, seed: int = 0, samples: int = 32, **changes: Any) -> Path:
    """Writes a field file with random weights; ``changes`` replace fields of the config."""
    from dataclasses import replace

    config = replace(SMALL, **changes)
    path = folder / f"field_{seed}.safetensors"
    contents = FieldFile(
        config, initial_weights(config.shapes(), seed), march=MarchSettings(samples=samples)
    )
    save_field(path, contents)
    return path


def scene_dict(
    field: Path,
    *,
    origin: tuple[float, float, float] = (1.5, -3.0, 1.0),
    to_world: Any = None,
    size: tuple[int, int] = (16, 12),
    integrator: dict[str, Any] | None = None,
    film: dict[str, Any] | None = None,
    spp: int = 2,
    **objects: Any,
) -> dict[str, Any]:
    """A scene of one field in a cube, seen by one perspective camera."""
    import mitsuba as mi

    transform = mi.ScalarTransform4f() if to_world is None else to_world
    # The camera moves along with the box; a scale only changes its distance.
    view = mi.ScalarTransform4f().look_at(
        origin=transform @ mi.ScalarPoint3f(origin),
        target=transform @ mi.ScalarPoint3f(0, 0, 0),
        up=transform @ mi.ScalarVector3f(0, 0, 1),
    )
    return {
        "type": "scene",
        "integrator": {"type": "nerf", **(integrator or {})},
        "sensor": camera_dict(view, size=size, film=film, spp=spp),
        "box": {
            "type": "cube",
            "to_world": transform,
            "bsdf": {"type": "null"},
            "interior": {"type": "nerfmedium", "filename": str(field)},
        },
        **objects,
    }


def camera_dict(
    view: Any, *, size: tuple[int, int], film: dict[str, Any] | None = None, spp: int = 1
) -> dict[str, Any]:
    """A perspective camera of 40 degrees with an RGBA film."""
    return {
        "type": "perspective",
        "fov": 40.0,
        "to_world": view,
        "film": {
            "type": "hdrfilm",
            "width": size[0],
            "height": size[1],
            "pixel_format": "rgba",
            "rfilter": {"type": "box"},
            **(film or {}),
        },
        "sampler": {"type": "independent", "sample_count": spp},
    }


def formula_dict(kind: str, to_world: Any = None, **numbers: Any) -> dict[str, Any]:
    """A cube that holds a field given by a formula."""
    import mitsuba as mi

    return {
        "type": "cube",
        "to_world": mi.ScalarTransform4f() if to_world is None else to_world,
        "bsdf": {"type": "null"},
        "interior": {"type": "nerfmedium", "field": kind, **numbers},
    }


def weight_keys(params: Any) -> list[str]:
    """The names of a field's tensors among a scene's parameters."""
    keys = [k for k in params.keys() if "interior_medium" in k]  # noqa: SIM118
    return [k for k in keys if not k.endswith(".to_world")]
