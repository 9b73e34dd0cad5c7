"""Finds the scenes that come with mi_nerf."""

from __future__ import annotations

import os
from pathlib import Path

from ..base.errors import InputError

_PACKAGE = Path(__file__).parents[1]


def scene_folder() -> Path:
    """``scenes/``: beside the package in a checkout, inside it once installed."""
    for folder in (_PACKAGE.parent / "scenes", _PACKAGE / "scenes"):
        if (folder / "spheres.xml").exists():
            return folder
    raise InputError(f"{_PACKAGE / 'scenes'}: not found, the installation is incomplete")


def find_scene(name: str) -> Path:
    """The path of a scene given by name, such as ``spheres``, or by path.

    Raises:
        InputError: if there is neither, with the names there are.
    """
    known = scenes()
    if os.path.isfile(name):
        return Path(name)
    if name in known:
        return known[name]
    if os.path.isdir(name):
        raise InputError(f"{name}: is a folder, expected a Mitsuba XML scene")
    if Path(name).suffix.lower() == ".xml":
        raise InputError(f"{name}: not found, expected a Mitsuba XML scene")
    raise InputError(f"scene '{name}': unknown, expected an .xml file or {', '.join(known)}")


def scenes() -> dict[str, Path]:
    """The scenes that come with mi_nerf, by name. ``assets`` holds parts of them only."""
    files = (p for p in scene_folder().rglob("*.xml") if p.parent.name != "assets")
    return {path.stem: path for path in sorted(files)}
