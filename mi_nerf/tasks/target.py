"""What a command is pointed at: a run folder or a field file."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..base.errors import InputError
from ..data import ImageKind
from ..formats.field_file import FieldFile, load_field
from ..training.run import Run
from ..training.run_folder import CONFIG, FIELD, LOG, read_record


@dataclass(frozen=True)
class Target:
    """A trained field, and what is known of where it comes from."""

    path: Path
    contents: FieldFile
    record: dict[str, Any] | None  # config.json of the run; None for a lone field file
    downscale: int = 1  # the scale at which the run saw its images
    images: ImageKind | None = None  # the kind of files that it saw; None: as the data name them

    @property
    def data(self) -> Path | None:
        """The dataset of the run."""
        return None if self.record is None else Path(self.record["data"]["path"])

    @property
    def train_seconds(self) -> float | None:
        """Wall-clock seconds of training that the field has seen; ``None`` if nobody knows.

        Fields of runs up to version 0.1.0 do not say: the last line of the run's log does,
        which may be younger.
        """
        if self.record is None:
            return None
        seconds = self.contents.provenance.get("seconds")
        try:
            if seconds is None:
                seconds = json.loads((self.path / LOG).read_text().splitlines()[-1])["seconds"]
            return float(seconds)
        except (OSError, IndexError, KeyError, TypeError, ValueError):
            return None


def open_target(path: str | Path | Target | Run) -> Target:
    """Opens a run, given by its folder or as such, or a field file; a target is taken as it is.

    Raises:
        InputError: if it is neither, or has no field yet.
    """
    if isinstance(path, Target):
        return path
    target = path.folder if isinstance(path, Run) else Path(path)
    if target.is_dir():
        if not (target / CONFIG).exists():
            raise InputError(f"{target}: no {CONFIG} in it, expected the folder of a run")
        record = read_record(target)
        downscale = record["settings"].get("downscale", 1)  # nothing else need be known here
        if not isinstance(downscale, int) or downscale < 1:
            raise InputError(
                f"{target / CONFIG}: downscale={downscale!r}, expected a whole number above 0"
            )
        images = record["settings"].get("images")
        if images not in (None, "png", "exr"):
            raise InputError(f"{target / CONFIG}: images={images!r}, expected png, exr or null")
        if not (target / FIELD).exists():
            raise InputError(f"{target}: no {FIELD} yet, expected a run with a checkpoint")
        return Target(target, load_field(target / FIELD), record, downscale, images)
    if not target.exists():
        raise InputError(f"{target}: not found, expected a run folder or a field file")
    return Target(target, load_field(target), None)
