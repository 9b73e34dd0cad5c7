"""``mi-nerf generate``: a dataset folder from a scene, resumable, with known noise."""

from __future__ import annotations

import json
import pickle
import platform
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError, Option
from ..base.files import check_folder, make_folder, read_json, remove_leftovers, write_json
from ..base.interrupts import interruptible
from ..base.machine import versions
from ..base.progress_bar import bars_are_seen, progress_bar
from ..base.variants import using_variant
from ..jobs import Job, Permit, open_executor, permitted, run_jobs, together
from ..scene_xml.parts import box_of, read_parts
from ..scene_xml.scene_file import Bounds, SceneFile, visible_bounds
from ..scene_xml.scene_file import quiet as _quiet
from ..scene_xml.sensors import separate_sensors
from ..scene_xml.substitutes import REPLACEABLE
from .emitters import ALL, Hidden
from .hints import with_hints
from .integrators import color_integrator, is_adjoint, require_choice
from .notes import memory_line, notes
from .output import is_intact, write_forward_capture, write_transforms, write_view
from .plan import Plan, View
from .plan_picture import PICTURE, draw
from .planning import make_plan, protocol_name, with_kept
from .protocol import SPLITS, Options
from .tracer import Tracer

RECORD = "dataset.json"
VERSION = 1

# Of a record: what must be the same for views to belong to one dataset.
_SAME = ("format", "version", "scene", "settings", "variant", "versions")

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
    workers: int = 0,
    executor: str | Executor | None = None,
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
        workers, executor: Who makes the views, as in :func:`mi_nerf.jobs.open_executor`;
            this process by default.

    Returns:
        The content of ``dataset.json``; its ``complete`` is false after Ctrl-C.

    Raises:
        InputError: if anything is not as expected; existing files are as they were.
        JobError: if the process that makes a view dies again and again.
    """
    if "_mono" in variant:
        raise InputError(
            f"variant '{variant}': knows no colours, expected one that can make images of them"
        )
    folder = Path(out)
    _check_output(folder, resume)
    source = _source(scene, variant, options or Options(), parameters)
    with _crew(folder, source, workers, executor) as others, using_variant(variant):
        with _quiet():
            file = SceneFile(scene, parameters)
            tracer, plan = prepare(file, options or Options())
            told = [*notes(plan), memory_line(plan, tracer.samples_at_once)]
        record = json.loads(json.dumps(_describe(file, plan, variant)))  # as it will be read
        if resume and (folder / RECORD).exists():
            record["views"] = _resumed_views(folder, record, plan)
        if show:
            print(*file.notes, plan, *told, sep="\n", flush=True)
        if others is None:
            return _trace_views(folder, tracer, plan, record, show)
        if show:
            print(f"views are traced by {others}", flush=True)
        return _hand_out_views(folder, others, source, plan, record, show)


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
            plan = _plan(file, options or Options())[1]
    if show:
        print(*file.notes, plan, sep="\n", flush=True)
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


def prepare(file: SceneFile, options: Options) -> tuple[Tracer, Plan]:
    """Loads the scene and decides what to make of it."""
    import mitsuba as mi

    loaded, plan = _plan(file, options)
    scene, hidden = loaded.scene, loaded.hidden
    integrator = color_integrator(scene.integrator(), file.path)
    require_choice(integrator, hidden, file.path)
    if hidden.chosen and not is_adjoint(integrator):
        integrator.hide_emitters = hidden.any and not hidden.partly
    has_sampler = bool(file.plugins("Sampler")) and bool(file.plugins("Sensor"))
    sampler = scene.sensors()[0].sampler() if has_sampler else mi.load_dict({"type": "independent"})
    return Tracer(scene, integrator, sampler, plan, hidden), plan


@dataclass(frozen=True, eq=False)
class _Loaded:
    """A scene as cameras of one protocol see it."""

    file: SceneFile
    scene: Any
    hidden: Hidden  # light sources
    box: Bounds  # of what is visible
    notes: list[str]  # what was changed


def _plan(file: SceneFile, options: Options) -> tuple[_Loaded, Plan]:
    """The scene, and what to make of it."""
    options = with_hints(file, options)
    hide = protocol_name(file, options) not in ("forward", "room")
    if options.keep_emitters and not hide:
        raise InputError(
            "{}: has no meaning for the protocols 'forward' and 'room', which show all",
            Option("keep_emitters", " ".join(options.keep_emitters)),
        )
    loaded = first = _load(file, options, hide)
    plan = make_plan(file, loaded.scene, loaded.box, options, loaded.hidden)
    if plan.hide_emitters != hide:  # it is a room: its lamps are part of it
        again = SceneFile(file.path, file.parameters)
        loaded = _load(again, replace(options, keep_emitters=()), plan.hide_emitters)
        plan = replace(plan, keep_emitters=())
    unseen = filter(None, [loaded.hidden.note])
    return loaded, replace(plan, notes=(*first.notes, *unseen, *plan.notes))


def _load(file: SceneFile, options: Options, hide: bool) -> _Loaded:
    """Loads a scene whose light sources are hidden, but for those that are kept."""
    file.substitute(*REPLACEABLE)
    file.complete()
    for properties in file.plugins("Integrator"):
        if hide:
            properties["hide_emitters"] = ALL not in options.keep_emitters
        if "samples_per_pass" in properties:  # which would have to divide every pass of ours
            del properties["samples_per_pass"]
    notes = separate_sensors(file.state)
    scene = file.load()
    media = (shape.interior_medium() for shape in scene.shapes())
    if not scene.emitters() and not any(hasattr(medium, "field") for medium in media):
        raise InputError(f"{file.path}: has no emitter, all images would be black")
    hidden = Hidden(scene, hide, options.keep_emitters)
    box = visible_bounds(scene, hidden.keeps)
    box = box or box_of(with_kept(read_parts(file), scene, hidden))
    if box is None or not np.ptp(np.array(box), axis=0).any():
        if hidden.any and visible_bounds(scene, lambda shape: True) is not None:
            raise InputError(
                "{}: all its shapes are light sources, which cameras do not see, expected {}",
                file.path,
                Option("keep_emitters", ALL),
            )
        raise InputError(f"{file.path}: its box is empty, expected shapes that can be seen")
    return _Loaded(file, scene, hidden, box, notes)


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
    if what := _difference(found, {key: record[key] for key in _SAME}):
        raise InputError(f"{path}: holds another dataset: {what}")
    views = found["views"]
    return {v.name: views[v.name] for v in plan.views if is_intact(folder, v, views.get(v.name))}


def _difference(found: Any, wanted: Any, name: str = "") -> str | None:
    """Where a record first differs from what is wanted of it, in words; ``None``: nowhere.

    Of the record itself, what is not wanted does not count.
    """
    if isinstance(found, dict) and isinstance(wanted, dict):
        for key, value in wanted.items():
            if what := _difference(found.get(key), value, f"{name}.{key}" if name else key):
                return what
        if not name:
            return None
    if found == wanted:
        return None
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
                remove_leftovers(make_folder(folder / split))
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
    return _finished(folder, plan, record, saver)


def _finished(folder: Path, plan: Plan, record: dict[str, Any], saver: _Saver) -> dict[str, Any]:
    """``record``, and all that describes the views once they are all there."""
    if len(record["views"]) < len(plan.views):
        saver.save()
        return record
    record["complete"] = True
    write_transforms(folder, plan)
    if plan.cameras == "forward":
        write_forward_capture(folder, plan, record["views"])
    saver.save()
    return record


# ---- Views by other processes ------------------------------------------------


def _hand_out_views(
    folder: Path,
    others: Executor,
    source: bytes,
    plan: Plan,
    record: dict[str, Any],
    show: bool,
) -> dict[str, Any]:
    """:func:`_trace_views` by other processes, which write the pictures themselves."""
    missing = [view for view in plan.views if view.name not in record["views"]]
    splits = [folder / split for split in SPLITS if plan.of_split(split)]
    described = {key: record[key] for key in _SAME}
    with interruptible() as interrupted, permitted(folder) as go:
        for place in splits:
            remove_leftovers(make_folder(place))
        saver = _Saver(folder, plan, record)
        size = together(others, len(missing))
        jobs = [
            Job(_name(views), _make_views, (source, folder.absolute(), go, described, views))
            for views in (missing[i : i + size] for i in range(0, len(missing), size))
        ]
        with _Progress(len(plan.views), len(record["views"]), show) as progress:

            def add(job: Job, entries: list[dict[str, Any]]) -> None:
                for view, entry in zip(job.arguments[-1], entries, strict=False):
                    saver.keep(view, entry)
                    progress.update()

            try:
                run_jobs(jobs, others, go, add, stop=interrupted)
            finally:
                if record["views"]:
                    saver.save()
        for place in splits:
            remove_leftovers(place)  # of workers that died
    return _finished(folder, plan, record, saver)


@contextmanager
def _crew(
    folder: Path, source: bytes, workers: int, executor: str | Executor | None
) -> Iterator[Executor | None]:
    """Who else traces views, if anybody; a failure before the first view leaves no new folder."""
    new = not folder.exists() or not any(folder.iterdir())
    try:
        first = (_get_ready, (source,))
        with open_executor(workers, executor, folder=folder, first=first) as others:
            yield others
    except Exception:
        record = folder / RECORD
        alone = executor is None and workers == 0
        if new and not alone and record.exists() and not read_json(record, "a record")["views"]:
            record.unlink()
            for split in SPLITS:
                shutil.rmtree(folder / split, ignore_errors=True)
            with suppress(OSError):  # there may be what somebody else has put there
                folder.rmdir()
        raise


def _source(
    scene: str | Path, variant: str, options: Options, parameters: Mapping[str, str] | None
) -> bytes:
    """All from which another process prepares the views, as one value that can be compared."""
    return pickle.dumps((Path(scene).absolute(), dict(parameters or {}), variant, options))


@lru_cache(maxsize=1)
def _prepared(source: bytes) -> tuple[Tracer, Plan, dict[str, Any]]:
    """A scene, loaded once for many views, its plan, and what the record says of it."""
    scene, parameters, variant, options = pickle.loads(source)
    with _quiet():
        file = SceneFile(scene, parameters)
        tracer, plan = prepare(file, options)
    return tracer, plan, json.loads(json.dumps(_describe(file, plan, variant)))


def _get_ready(source: bytes) -> None:
    """Where a worker begins: the scene is loaded while others still look at it."""
    with using_variant(pickle.loads(source)[2]):
        _prepared(source)


def _name(views: Sequence[View]) -> str:
    """Of a job, in messages."""
    if len(views) == 1:
        return f"view {views[0].name}"
    return f"views {views[0].name} to {views[-1].name}"


def _make_views(
    source: bytes, folder: Path, go: Permit, described: dict[str, Any], views: Sequence[View]
) -> list[dict[str, Any]]:
    """The job of a worker: traces views, writes their pictures; returns entries of the record.

    If the permit is withdrawn, these are the entries of the first views.

    Raises:
        InputError: if this machine sees another folder, another scene or other versions.
    """
    go.require()
    may_go_on, entries = go.watched(), []
    with using_variant(pickle.loads(source)[2]):
        tracer, plan, found = _prepared(source)
        if _difference(found, described):  # the scene may have been changed since it was loaded
            _prepared.cache_clear()
            tracer, plan, found = _prepared(source)
        if what := _difference(found, described):
            raise InputError(f"{folder}: the worker on {platform.node()} differs: {what}")
        for view in views:
            if may_go_on():
                entries.append(write_view(folder, view, tracer.trace(view), plan))
    return entries


class _Saver:
    """Writes views, and now and then the record of those that are there."""

    def __init__(self, folder: Path, plan: Plan, record: dict[str, Any]) -> None:
        self._folder, self._plan, self._record = folder, plan, record
        self.save()

    def add(self, view: View, traced: Any) -> None:
        self.keep(view, write_view(self._folder, view, traced, self._plan))

    def keep(self, view: View, entry: dict[str, Any]) -> None:
        self._record["views"][view.name] = entry
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
