"""Datasets of posed images.

:func:`load_dataset` recognises the layout of a folder and hands it to the reader
of that layout, a module of this package.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

from ..base.box import Box
from ..base.color import ColorSpace
from ..base.errors import InputError, Option
from ..images.read import Progress
from . import blender, llff
from .dataset import Dataset, evenly_spread_indices

__all__ = [
    "Box",
    "ColorSpace",
    "Dataset",
    "ImageKind",
    "Progress",
    "available_splits",
    "evenly_spread_indices",
    "held_out_split",
    "load_dataset",
    "split_to_measure",
]

ImageKind = Literal["png", "exr"]  # of the files that hold a view: 8 or 16 bits, or radiance


def load_dataset(
    path: str | os.PathLike[str],
    split: str,
    *,
    downscale: int = 1,
    limit: int | None = None,
    images: ImageKind | None = None,
    progress: Progress | None = None,
) -> Dataset:
    """Reads one split of a dataset into memory.

    Args:
        path: The dataset's folder, in Blender/NeRF layout
            (:mod:`mi_nerf.data.blender`) or LLFF's (:mod:`mi_nerf.data.llff`). A folder
            in both is a forward-facing capture: LLFF's holds.
        split: Which views, e.g. ``"train"``.
        downscale: Averages blocks of this many pixels squared, premultiplied. A
            remainder is cropped at the right and the bottom, and the intrinsics
            follow.
        limit: Reads only this many views, the ones that
            :meth:`Dataset.evenly_spread` would choose of the whole split.
        images: ``"exr"`` reads the linear radiance beside the pictures (``r_0.exr``), ``"png"``
            the pictures; default: the files that the dataset names.
        progress: Called as ``progress(done, total)`` after each image.

    Raises:
        InputError: Something about the folder, its files or the arguments is
            not as expected; the message names it.
    """
    folder = _existing_folder(path)
    if downscale < 1 or downscale != int(downscale):
        raise InputError(f"downscale must be a whole number, 1 or more, got {downscale}")
    reader = llff if llff.recognises(folder) else blender
    if images not in (None, "png", "exr"):
        raise InputError("{}: expected png or exr", Option("images", images))
    return reader.load(
        folder, split, downscale=downscale, limit=limit, images=images, progress=progress
    )


def available_splits(path: str | os.PathLike[str]) -> tuple[str, ...]:
    """The names of a dataset's splits: train, val, test first, then any others.

    Raises:
        InputError: The folder does not exist or is no dataset.
    """
    folder = _existing_folder(path)
    if llff.recognises(folder):
        return llff.SPLITS
    splits = blender.splits(folder)
    if not splits:
        raise InputError(
            f"{folder}: expected a dataset with transforms_{{train,val,test}}.json or {llff.POSES}"
        )
    return splits


def split_to_measure(path: str | os.PathLike[str], split: str | None = None) -> str:
    """``split``, or else the split to measure on.

    Raises:
        InputError: The folder does not exist or is no dataset, or has training views alone.
    """
    found = split or held_out_split(path)
    if found is None:
        raise InputError(
            "{}: has training views alone, expected {}", path, Option("split", "train")
        )
    return found


def held_out_split(path: str | os.PathLike[str]) -> str | None:
    """The split to measure on: test, or the first one beside train; ``None`` if there is none.

    Raises:
        InputError: The folder does not exist or is no dataset.
    """
    splits = [s for s in available_splits(path) if s != "train"]
    return "test" if "test" in splits else next(iter(splits), None)


def _existing_folder(path: str | os.PathLike[str]) -> Path:
    folder = Path(path)
    if not folder.exists():
        raise InputError(f"{folder}: no such dataset folder")
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a dataset folder, this is a file")
    return folder
