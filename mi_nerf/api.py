"""What the commands do, as functions: datasets, runs, measurements, pictures.

Options have the names and defaults of the command line's. Without a ``variant``, the active
Mitsuba variant holds if it is one that mi_nerf works with, otherwise the best of the machine.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from .base.arrays import Image
from .base.checks import positive, valid_seed
from .base.errors import InputError, Option
from .base.progress_bar import progress_bar
from .base.variants import active_variant, array_module
from .data import Dataset, ImageKind
from .formats.field_file import FieldFile
from .training import fresh
from .training import run as training
from .training.config import TrainConfig, with_settings
from .training.forecast import PUBLISHED_STEPS
from .training.plain import as_text
from .training.presets import preset as preset_config
from .training.run import Run
from .training.run_folder import CONFIG, read_config

if TYPE_CHECKING:
    from .tasks.target import Target

# Training begins sooner without what only the other functions need: they import it themselves.
__all__ = ["fresh_field", "generate", "pictures", "render", "start"]

Settings = Mapping[str, Any] | Sequence[str]


def generate(
    scene: str | Path,
    out: str | Path,
    *,
    protocol: Literal["realistic360", "diffuse360", "forward", "room"] | None = None,
    train: int | None = None,
    val: int | None = None,
    test: int | None = None,
    size: tuple[int, int] | None = None,
    spp: int | None = None,
    seed: int = 0,
    cameras: Literal["hemisphere", "sphere", "scene"] | None = None,
    up: str | tuple[float, float, float] | None = None,
    center: tuple[float, float, float] | None = None,
    radius: float | None = None,
    elevation: tuple[float, float] | None = None,
    object: str | Sequence[str] | None = None,
    keep_emitters: Sequence[str] = (),
    parameters: Mapping[str, str] | None = None,
    resume: bool = False,
    plan: bool = False,
    workers: int = 0,
    executor: str | Executor | None = None,
    variant: str | None = None,
    show: bool = True,
) -> dict[str, Any]:
    """Path-traces a dataset from a Mitsuba scene, as ``mi-nerf generate``.

    Args:
        scene: an XML file, or the name of a scene that comes with mi_nerf.
        out: folder of the dataset: new or empty, or with ``resume`` one that was begun.
        protocol: the paper's kind of dataset; default: the scene's own, or realistic360.
        train, val, test: numbers of views; default: the protocol's.
        size: width and height in pixels.
        spp: samples a pixel; default: those of the scene's sampler.
        seed: of camera positions and of the noise.
        cameras, center, radius: where 360-degree cameras stand, in scene units; ``"scene"``
            takes the scene's own sensors.
        elevation: between which angles over the horizon of ``center``, in degrees.
        up: vertical axis, ``"y"`` or ``"-z"``, or direction; default: as the scene's sensor or
            its base shows.
        object: ids of the shapes that cameras look at; default: all but what surrounds them.
        keep_emitters: IDs of light sources that 360-degree cameras see, or ``["all"]``.
        parameters: values of the scene's ``$parameters``.
        plan: only draw where the cameras would stand: ``cameras.png`` in ``out``, or ``out``
            itself where it is the name of a picture. Nothing is rendered.
        workers: so many processes of this machine make the views; default: this one alone.
        executor: a cluster makes them, ``"dask://HOST:PORT"`` or ``"slurm"``, or the workers of
            any ``concurrent.futures.Executor``. All see ``out`` and the scene by the same names.
        show: say what is made, and how far it is.

    Returns:
        The content of ``dataset.json``. ``complete`` is false after an interruption;
        ``["noise"]["test"]["psnr_ceiling"]`` is the PSNR in dB that the converged images
        themselves would get. With ``plan``: its settings, ``notes`` for people, ``coverage``,
        the share of pixels that the object covers, and ``picture``, where it is.

    Raises:
        InputError: if anything is not as expected; existing files are as they were.
        JobError: of :mod:`mi_nerf.jobs`, if the process that makes a view dies again and again.
    """
    from . import generation
    from .scene_xml.library import find_scene

    valid_seed(seed)
    options = generation.Options(
        protocol=protocol,
        train=train,
        val=val,
        test=test,
        size=size,
        spp=spp,
        seed=seed,
        cameras=cameras,
        up=up,
        center=center,
        radius=radius,
        elevation=elevation,
        object=(object,) if isinstance(object, str) else tuple(object or ()) or None,
        keep_emitters=tuple(keep_emitters),
    )
    path = find_scene(str(scene))
    if plan:
        return generation.preview(
            path, out, active_variant(variant), options, parameters=parameters, show=show
        )
    return generation.generate(
        path,
        out,
        active_variant(variant),
        options,
        parameters=parameters,
        resume=resume,
        workers=workers,
        executor=executor,
        show=show,
    )


def start(
    data: str | Path,
    out: str | Path,
    *,
    preset: str = "nerf",
    max_seconds: float | None = None,
    steps: int | None = None,
    downscale: int = 1,
    images: ImageKind | None = None,
    seed: int = 0,
    settings: Settings = (),
    resume: bool = False,
    variant: str | None = None,
    started: float | None = None,
) -> Run:
    """Opens a run, as ``mi-nerf train``; train it with ``run.train()`` or ``run.reports()``.

    Args:
        data: folder of a dataset.
        out: folder of the run; created.
        preset: ``nerf``, ``fast``, ``paper``, or ``auto``, which takes shape while it
            trains.
        max_seconds, steps: the budget, wall-clock seconds of training or steps, which the
            learning rate follows. If neither is given: 600 seconds; with ``paper`` its
            200,000 steps, if they take less than a day. ``run.forecast`` says what they would.
        downscale: average images over blocks of so many pixels squared.
        images: ``"exr"`` trains on the linear radiance beside the pictures, ``"png"`` on the
            pictures; default: the files that the dataset names.
        seed: of initial weights, rays and samples.
        settings: any other setting by its name, ``{"network.width": 128}``, or as ``--set``
            takes them, ``["network.width=128"]``.
        resume: go on with the run in ``out``, with its own settings.
        started: the value of ``time.monotonic()`` from which seconds count; default: they count
            while this function and training are at work.

    Raises:
        InputError: if the folder already holds a run, the data cannot be read, a setting is
            unknown or out of range, or ``paper`` would take days and has no budget.
    """
    assignments = _assignments(settings)
    config = replace(
        preset_config(preset), seed=valid_seed(seed), downscale=positive("downscale", downscale)
    )
    config = with_settings(config, assignments)
    if images is not None:
        config = replace(config, images=images)
    for name, value in (("steps", steps), ("max_seconds", max_seconds)):
        if value is not None:
            config = replace(config, **{name: positive(name, value)})
    recorded = resume and (Path(out) / CONFIG).exists()
    if not recorded and config.steps is None and config.max_seconds is None:
        if config.preset not in PUBLISHED_STEPS:
            config = replace(config, max_seconds=600.0)
    if recorded:
        _require_same_settings(Path(out), config, assignments)
    return training.start(
        data,
        out,
        config,
        active_variant(variant),
        resume=resume,
        started=started,
        given={assignment.partition("=")[0] for assignment in assignments},
    )


def fresh_field(
    dataset: Dataset,
    *,
    preset: str = "nerf",
    seed: int = 0,
    settings: Settings = (),
    variant: str | None = None,
) -> FieldFile:
    """The field with which a run on these views would begin, for a training loop of your own.

    Its box and sizes follow from the images, its weights from the seed, and its empty cells
    from the silhouettes, where images have alpha. :func:`mi_nerf.save_field` writes it to a
    file, which a medium ``nerfmedium`` with ``training`` loads.

    Args:
        dataset: training views, from :func:`mi_nerf.load_dataset`.
        preset, settings: as for :func:`start`.

    Raises:
        InputError: if the preset or a setting is unknown or out of range.
    """
    config = replace(preset_config(preset), seed=valid_seed(seed))
    config = with_settings(config, _assignments(settings))
    return fresh.fresh_field(config, dataset, array_module(active_variant(variant)))


def render(
    target: str | Path | Target | Run,
    *,
    path: Literal["orbit", "spiral", "test"] | None = None,
    frames: int | None = None,
    size: tuple[int, int] | None = None,
    spp: int | None = None,
    denoise: bool = False,
    variant: str | None = None,
    show: bool = True,
) -> list[Image]:
    """Renders a run along a camera path, or a Mitsuba XML scene, as ``mi-nerf render``.

    Args:
        target: a run or its folder, or an XML file.
        path: camera path; default: orbit for runs (spiral for forward-facing captures), the
            scene's own sensors for XML.
        frames: along the path; default: 60, all for ``test``.
        size: width and height in pixels.
        spp: samples a pixel.
        denoise: take noise out of the pictures; needs the extra ``mi_nerf[denoise]``.
        show: show a progress bar.

    Returns:
        Linear premultiplied RGBA, (H, W, 4) each; :func:`mi_nerf.on_white` makes them visible.

    Raises:
        InputError: if the target or its dataset cannot be read, or the extra is not installed.
    """
    from .tasks import render as rendering

    source = target.folder if isinstance(target, Run) else target
    count, images = rendering.frames_of(
        source,
        active_variant(variant),
        path=path,
        frames=frames,
        size=size,
        spp=spp,
        denoise=denoise,
    )
    result = []
    with closing(images), progress_bar("render", "frame", count, show=show) as bar:
        for _, image in images:
            result.append(image)
            bar.update()
    return result


def pictures(dataset: Dataset) -> list[Image]:
    """The views of a dataset as :func:`evaluate` sees them: (H, W, 3) sRGB on white, 8 bits."""
    from .tasks.evaluate import reference_image

    return [reference_image(dataset, k) for k in range(len(dataset))]


def _assignments(settings: Settings) -> list[str]:
    """Settings as ``key=value``."""
    if isinstance(settings, Mapping):
        return [f"{name}={as_text(value)}" for name, value in settings.items()]
    return list(settings)


def _require_same_settings(folder: Path, given: TrainConfig, assignments: list[str]) -> None:
    """Refuses options that a resumed run, which keeps its settings, would ignore."""
    recorded, _ = read_config(folder)
    wanted = with_settings(recorded, assignments)
    usual = TrainConfig()
    for name in ("preset", "seed", "downscale", "images"):
        if getattr(given, name) != getattr(usual, name):
            wanted = replace(wanted, **{name: getattr(given, name)})
    wanted = replace(wanted, steps=recorded.steps, max_seconds=recorded.max_seconds)
    if wanted != recorded:
        raise InputError(
            "{}: a resumed run keeps its settings, expected no other {}, {}, {}, {} or {} "
            "than it was started with",
            folder,
            *map(Option, ("preset", "seed", "downscale", "images", "settings")),
        )
