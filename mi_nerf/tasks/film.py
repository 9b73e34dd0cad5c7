"""Frames of a film by other processes."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..base.files import replacing
from ..jobs import Job, Permit, permitted, run_jobs
from .render import Frames, frames_of

_FRAMES_EACH = 4  # at most in a job, which loads what it renders


class FramesOf(NamedTuple):
    """A call of :func:`mi_nerf.tasks.render.frames_of`."""

    source: Path
    variant: str
    options: Mapping[str, Any]


@contextmanager
def frames_by_others(
    call: FramesOf,
    count: int,
    others: Executor,
    out: Path,
    on_frame: Callable[[], object],
) -> Iterator[Frames]:
    """The frames of a call, rendered by the workers of an executor.

    Args:
        count: of the frames.
        out: where the film will be; frames lie in a folder near it until the block ends.
        on_frame: called for each frame that is there.

    Raises:
        InputError: if they cannot be rendered, or no folder can be made there.
        JobError: if the process that renders a frame dies again and again.
    """
    parent = next(folder for folder in out.absolute().parents if folder.is_dir())
    call = call._replace(source=call.source.absolute())
    folder = Path(tempfile.mkdtemp(prefix=f".{out.stem}-", dir=parent))
    names: dict[int, str] = {}
    try:
        with permitted(folder) as permit:
            jobs = [
                Job(f"frames {only[0]} to {only[-1]}", _draw, (call, only, permit))
                for only in _parts(range(count))
            ]

            def add(job: Job, drawn: dict[int, str]) -> None:
                names.update(drawn)
                for _ in drawn:
                    on_frame()

            run_jobs(jobs, others, permit, add)
        yield _read(folder, names)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _parts(numbers: range) -> list[range]:
    """Numbers in parts, which do not depend on who does them."""
    return [numbers[i : i + _FRAMES_EACH] for i in range(0, len(numbers), _FRAMES_EACH)]


def _draw(call: FramesOf, only: range, permit: Permit) -> dict[int, str]:
    """The job of a worker: renders some frames into files; returns their names."""
    permit.require()
    _, images = frames_of(call.source, call.variant, **call.options, only=only)
    names = {}
    with closing(images):
        for number, (name, image) in zip(only, images, strict=True):
            with replacing(_file(permit.path.parent, number)) as temporary:
                np.save(temporary, image)
            names[number] = name
    return names


def _read(folder: Path, names: Mapping[int, str]) -> Frames:
    """Frames in their order."""
    for number in sorted(names):
        yield names[number], np.load(_file(folder, number))


def _file(folder: Path, number: int) -> Path:
    return folder / f"{number:06d}.npy"
