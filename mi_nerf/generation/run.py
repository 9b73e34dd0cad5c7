"""``mi-nerf generate``: a dataset folder from a scene, resumable, with known noise."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError, Option
from ..base.files import check_folder, make_folder, read_json, write_json
from ..base.interrupts import interruptible
from ..base.machine import versions
from ..base.progress_bar import bars_are_seen, progress_bar
from ..base.variants import using_variant
from ..scene_xml.parts import box_of, read_parts
from ..scene_xml.scene_file import Bounds, SceneFile, visible_bounds
from ..scene_xml.sensors import separate_sensors
from .output import is_intact, write_forward_capture, write_transforms, write_view
from .plan import Plan, View
from .plan_picture import PICTURE, draw
from .planning import make_plan, protocol_name
from .protocol import SPLITS, Options
from .tracer import Tracer

RECORD = "dataset.json"
VERSION = 1

_SECONDS_BETWEEN_SAVES = 5.0
_SECONDS_BETWEEN_LINES = 10.0


def generate(
    scene: str | Path,
    out: str | Path,
    variant: str,
    options: Options | None = None,
    *,
    parameters: Mapping[str, str] | None = None,
    resume: bool = False,
    show: bool = True,
) -> dict[str, Any]:
    """Path-traces a dataset from a Mitsuba scene.

    Args:
        scene: An XML file.
        out: The dataset's folder: new, empty, or with ``resume`` one that this function
            began, whose missing and damaged views are made again.
        show: Say what is made, and how far it is.
        variant: Mitsuba variant.
        options: Views, size, samples, cameras.
        parameters: Values of the scene's ``$parameters``.

    Returns:
        The content of ``dataset.json``; its ``complete`` is false after Ctrl-C.

    Raises:
        InputError: if anything is not as expected; existing files are as they were.
    """
    if "_mono" in variant:
        raise InputError(
            f"variant '{variant}': knows no colours, expected one that can make images of them"
        )
    folder = Path(out)
    _check_output(folder, resume)
    with using_variant(variant):
        with _quiet():
            file = SceneFile(scene, parameters)
            tracer, plan = prepare(file, options or Options())
        record = json.loads(json.dumps(_describe(file, plan, variant)))  # as it will be read
        if resume and (folder / RECORD).exists():
            record["views"] = _resumed_views(folder, record, plan)
        if show:
            print(plan, flush=True)
        return _trace_views(folder, tracer, plan, record, show)


def preview(
    scene: str | Path,
    out: str | Path,
    variant: str,
    options: Options | None = None,
    *,
    parameters: Mapping[str, str] | None = None,
    show: bool = True,
) -> dict[str, Any]:
    """Draws the cameras that :func:`generate` would have, and renders nothing.

    Args:
        out: The dataset's folder, which gets ``cameras.png``, or the picture's own name. Nothing
            else is written.
        show: Say what would be made.

    Returns:
        The settings of ``dataset.json``, and ``coverage``, the share of pixels that the object
        covers, ``notes``, and ``picture``, where it is.

    Raises:
        InputError: if anything is not as expected.
    """
    out = Path(out)
    picture = out if out.suffix.lower() == ".png" else out / PICTURE
    check_folder(picture.parent)
    with using_variant(variant):
        with _quiet():
            file = SceneFile(scene, parameters)
            plan = _plan(file, options or Options())[-1]
    if show:
        print(plan, flush=True)
    make_folder(picture.parent)
    draw(plan, picture)
    return {
        **plan.record(),
        "coverage": plan.survey.coverage,
        "notes": list(plan.notes),
        "picture": str(picture),
    }


def summary(record: dict[str, Any]) -> str:
    """What a finished or interrupted dataset holds, in one line."""
    done, wanted = len(record["views"]), sum(record["settings"]["views"].values())
    size = "x".join(str(n) for n in record["settings"]["size"])
    if not record["complete"]:
        return f"{done} of {wanted} views; interrupted"
    known = ceilings(record)
    return f"{done} views of {size}, {f'PSNR ceiling {known}' if known else 'free of noise'}"


def ceilings(record: dict[str, Any]) -> str:
    """The PSNR ceiling of every split that has one, for people."""
    return ", ".join(
        f"{split} {noise['psnr_ceiling']:.2f} dB"
        for split, noise in record["noise"].items()
        if noise["psnr_ceiling"] is not None
    )


# ---- Before the first view ---------------------------------------------------


def _check_output(folder: Path, resume: bool) -> None:
    check_folder(folder)
    if not folder.exists() or {path.name for path in folder.iterdir()} <= {PICTURE}:
        return
    if not resume:
        message = "{}: holds files already, expected a new or empty folder"
        if (folder / RECORD).exists():
            raise InputError(message + ", or {}", folder, Option("resume", True))
        raise InputError(message, folder)
    if not (folder / RECORD).exists():
        raise InputError(f"{folder}: holds no {RECORD}, expected a dataset begun by generate")


@contextmanager
def _quiet() -> Iterator[None]:
    """Without Mitsuba's warnings about sensors and samplers that are replaced anyway."""
    import mitsuba as mi

    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        yield
    finally:
        mi.set_log_level(level)


def prepare(file: SceneFile, options: Options) -> tuple[Tracer, Plan]:
    """Loads the scene and decides what to make of it."""
    import mitsuba as mi

    file, scene, plan = _plan(file, options)
    integrator = scene.integrator()
    if not file.plugins("Integrator"):
        integrator = mi.load_dict({"type": "path", "hide_emitters": plan.hide_emitters})
    has_sampler = bool(file.plugins("Sampler")) and bool(file.plugins("Sensor"))
    sampler = scene.sensors()[0].sampler() if has_sampler else mi.load_dict({"type": "independent"})
    _check_sampler(sampler, plan)
    return Tracer(scene, integrator, sampler, plan), plan


def _plan(file: SceneFile, options: Options) -> tuple[SceneFile, Any, Plan]:
    """The file as it was loaded, its scene, and what to make of it."""
    hide = protocol_name(file, options) not in ("forward", "room")
    notes, scene, box = _load(file, hide)
    plan = make_plan(file, scene, box, options)
    if plan.hide_emitters != hide:  # it is a room: its lamps are part of it
        file = SceneFile(file.path, file.parameters)
        _, scene, _ = _load(file, plan.hide_emitters)
    return file, scene, replace(plan, notes=(*notes, *plan.notes))


def _load(file: SceneFile, hide_emitters: bool) -> tuple[list[str], Any, Bounds]:
    """What was changed of the scene, the scene, and the box of what is visible in it."""
    if hide_emitters:
        for properties in file.plugins("Integrator"):
            properties["hide_emitters"] = True
    notes = separate_sensors(file.state)
    scene = file.load()
    media = (shape.interior_medium() for shape in scene.shapes())
    if not scene.emitters() and not any(hasattr(medium, "field") for medium in media):
        raise InputError(f"{file.path}: has no emitter, all images would be black")
    box = visible_bounds(scene) or box_of(read_parts(file))
    if box is None or not np.ptp(np.array(box), axis=0).any():
        raise InputError(f"{file.path}: its box is empty, expected shapes that can be seen")
    return notes, scene, box


def _check_sampler(sampler: Any, plan: Plan) -> None:
    """Refuses numbers of samples that the sampler would quietly change."""
    for count in plan.halves:
        sampler.set_sample_count(count)
        if sampler.sample_count() != count:
            raise InputError(
                "{}: the scene's sampler '{}' cannot take half of them, {}, expected e.g. {}",
                Option("spp", plan.spp),
                sampler.class_name(),
                count,
                2 * sampler.sample_count(),
            )


def _describe(file: SceneFile, plan: Plan, variant: str) -> dict[str, Any]:
    """The record of a dataset without any view."""
    return {
        "format": "mi_nerf.dataset",
        "version": VERSION,
        "complete": False,
        "scene": {
            "file": file.path.name,
            "sha256": file.digest(),
            "parameters": file.parameters,
            "box": plan.box,
        },
        "settings": plan.record(),
        "variant": variant,
        "versions": {**versions(), "numpy": np.__version__},
        "noise": {},
        "views": {},
    }


def _resumed_views(folder: Path, record: dict[str, Any], plan: Plan) -> dict[str, Any]:
    """The views that are there and intact.

    Raises:
        InputError: if the folder holds another dataset.
    """
    path = folder / RECORD
    found = read_json(path, "the record of a dataset")
    if not isinstance(found, dict) or not isinstance(found.get("views"), dict):
        raise InputError(f"{path}: expected the record of a dataset")
    for key in ("format", "version", "scene", "settings", "variant", "versions"):
        if found.get(key) != record[key]:
            what = _difference(key, found.get(key), record[key])
            raise InputError(f"{path}: holds another dataset: {what}")
    views = found["views"]
    return {v.name: views[v.name] for v in plan.views if is_intact(folder, v, views.get(v.name))}


def _difference(name: str, found: Any, wanted: Any) -> str:
    """Where two records first differ."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        for key in wanted:
            if found.get(key) != wanted[key]:
                return _difference(f"{name}.{key}", found.get(key), wanted[key])
    return f"{name} is {json.dumps(found)}, expected {json.dumps(wanted)}"


# ---- View after view ---------------------------------------------------------


def _trace_views(
    folder: Path, tracer: Tracer, plan: Plan, record: dict[str, Any], show: bool
) -> dict[str, Any]:
    """Makes the views that ``record`` lacks, and then everything that describes them."""
    missing = [view for view in plan.views if view.name not in record["views"]]
    with interruptible() as interrupted, ThreadPoolExecutor(1) as writer:
        # Before any folder is made: this is where scenes fail.
        traced = tracer.trace(missing[0]) if missing else None
        for split in SPLITS:
            if plan.of_split(split):
                make_folder(folder / split)
        saver = _Saver(folder, plan, record)
        writing: Future[None] | None = None
        with _Progress(len(plan.views), len(record["views"]), show) as progress:
            for i, view in enumerate(missing):
                # Pictures of one view are written while the next one is traced.
                current = traced if i == 0 else tracer.trace(view)
                if writing is not None:
                    writing.result()
                    progress.update()
                writing = writer.submit(saver.add, view, current)
                if interrupted:
                    break
            if writing is not None:
                writing.result()
                progress.update()
    if len(record["views"]) < len(plan.views):
        saver.save()
        return record
    record["complete"] = True
    write_transforms(folder, plan)
    if plan.cameras == "forward":
        write_forward_capture(folder, plan, record["views"])
    saver.save()
    return record


class _Saver:
    """Writes views, and now and then the record of those that are there."""

    def __init__(self, folder: Path, plan: Plan, record: dict[str, Any]) -> None:
        self._folder, self._plan, self._record = folder, plan, record
        self.save()

    def add(self, view: View, traced: Any) -> None:
        self._record["views"][view.name] = write_view(self._folder, view, traced, self._plan)
        if time.monotonic() - self._saved > _SECONDS_BETWEEN_SAVES:
            self.save()

    def save(self) -> None:
        views = self._record["views"]
        self._record["views"] = {v.name: views[v.name] for v in self._plan.views if v.name in views}
        self._record["noise"] = _mean_noise(self._record["views"], self._plan)
        write_json(self._folder / RECORD, self._record)
        self._saved = time.monotonic()


def _mean_noise(views: dict[str, Any], plan: Plan) -> dict[str, dict[str, float | None]]:
    """Means over each split's views of the figures themselves, not of what they follow from."""
    result: dict[str, dict[str, float | None]] = {}
    for split in SPLITS:
        noises = [views[v.name]["noise"] for v in plan.of_split(split) if v.name in views]
        if noises:
            result[split] = {key: _mean([n[key] for n in noises]) for key in noises[0]}
    return result


def _mean(values: list[float | None]) -> float | None:
    """Without the views that are free of noise, whose PSNR is infinite."""
    numbers = [value for value in values if value is not None]
    return float(np.mean(numbers)) if numbers else None


class _Progress:
    """A bar with the time left on a terminal, a quiet line now and then elsewhere."""

    def __init__(self, total: int, done: int, show: bool) -> None:
        self._lines = show and not bars_are_seen()
        self._bar = progress_bar("generate", "view", total, show=show, initial=done)
        self._total, self._done, self._last = total, done, time.monotonic()

    def __enter__(self) -> _Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def update(self) -> None:
        self._bar.update()
        self._done += 1
        if self._lines and time.monotonic() - self._last > _SECONDS_BETWEEN_LINES:
            print(f"{self._done} of {self._total} views", flush=True)
            self._last = time.monotonic()
