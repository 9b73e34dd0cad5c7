"""Pictures and videos of trained runs and of Mitsuba scenes."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Generator, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar

import imageio.v2 as imageio
import numpy as np

from ..base.arrays import Image
from ..base.checks import valid_size
from ..base.errors import InputError, Option
from ..base.files import check_file, check_folder, make_folder, replacing
from ..base.variants import array_module, using_variant
from ..cameras.pinhole import Intrinsics
from ..cameras.poses import mitsuba_from_opengl, opengl_from_mitsuba
from ..cameras.trajectory import Poses, forward_spiral, orbit, orbit_like, spiral_like
from ..data import Dataset, held_out_split, load_dataset
from ..images.denoise import denoised_frames, denoiser
from ..images.write import on_white, write_picture
from ..march.view import linear_premultiplied, render_view
from ..scene_xml.refusals import refused_rendering
from ..scene_xml.scene_file import SceneFile
from .target import Target, open_target

T = TypeVar("T")
Path_ = Literal["orbit", "spiral", "test"]
Frames = Generator[tuple[str, Image], None, None]  # name and (H, W, 4) linear premultiplied RGBA

_MOVING = (Option("path", "orbit"), Option("path", "spiral"))

Output = Literal["picture", "video", "folder"]

_KINDS: dict[str, Output] = {"": "folder", ".png": "picture", ".exr": "picture", ".mp4": "video"}


def frames_of(
    source: str | Path | Target,
    variant: str,
    *,
    path: Path_ | None = None,
    frames: int | None = None,
    still: bool = False,
    size: tuple[int, int] | None = None,
    spp: int | None = None,
    only: range | None = None,
    denoise: bool = False,
) -> tuple[int, Frames]:
    """Renders a run along a camera path, or a Mitsuba XML scene.

    Args:
        path: default: the run's (:func:`default_path`), or the scene's own sensors.
        frames: along the path; default: 60, or all test views; with ``still``, one.
        size: width and height; default: those of the run's images or the scene's film.
        spp: samples a pixel; default: 1 for runs, the scene's own for XML.
        only: numbers of the frames to render; default: all.
        denoise: take noise out of the frames.

    Returns:
        The number of frames in all and an iterator over those that are rendered.

    Raises:
        InputError: if there is neither, what was asked for does not suit it, or the denoiser is
            not installed.
    """
    if denoise:
        denoiser()  # may be missing: said before anything is rendered
        count, noisy = _frames_of(source, variant, path, frames, still, size, spp, only, apart=True)
        return count, denoised_frames(noisy)
    return _frames_of(source, variant, path, frames, still, size, spp, only)


def _frames_of(
    source: str | Path | Target,
    variant: str,
    path: Path_ | None,
    frames: int | None,
    still: bool,
    size: tuple[int, int] | None,
    spp: int | None,
    only: range | None,
    apart: bool = False,
) -> tuple[int, Frames]:
    """The same; ``apart`` as of :func:`scene_frames`."""
    if not isinstance(source, Target):
        source = Path(source)
        if not source.exists():
            raise InputError(f"{source}: not found, expected a run folder or a Mitsuba XML scene")
        if source.suffix.lower() == ".xml":
            if frames is not None and path is None:
                raise InputError(
                    "{}: the sensors of a scene give one frame each, expected {} or {} too",
                    Option("frames", frames),
                    *_MOVING,
                )
            return scene_frames(
                source,
                variant,
                path=path,
                frames=frames or (1 if still else 60),
                size=size,
                spp=spp or 0,
                only=only,
                apart=apart,
            )
        source = open_target(source)
    path = path or default_path(source)
    usual = 1 if still else (0 if path == "test" else 60)
    return run_frames(
        source, variant, path=path, frames=frames or usual, size=size, spp=spp or 1, only=only
    )


def run_frames(
    target: Target,
    variant: str,
    *,
    path: Path_ = "orbit",
    frames: int = 1,
    size: tuple[int, int] | None = None,
    spp: int = 1,
    only: range | None = None,
) -> tuple[int, Frames]:
    """Renders a run along a camera path.

    Returns:
        The number of frames in all and an iterator over those that are rendered.

    Raises:
        InputError: if the run's dataset cannot be read.
    """
    if target.data is None:
        raise InputError(f"{target.path}: a field file knows no cameras, expected a run or an XML")
    dataset = _cameras(target, path)
    intrinsics = _resized(dataset.intrinsics, size)
    poses = _path_poses(target, dataset, path, frames)
    backend = array_module(variant)
    marched = target.contents.marched(backend)
    space = marched.field.color_space

    def generate() -> Frames:
        for i, pose in _chosen(poses, only):
            view = render_view(marched, intrinsics, pose, backend, spp=spp)
            yield f"{path}_{i:03d}", _linear_rgba(view.color, view.opacity, space)

    return len(poses), generate()


def scene_frames(
    scene_path: str | Path,
    variant: str,
    *,
    path: Path_ | None = None,
    frames: int = 1,
    size: tuple[int, int] | None = None,
    spp: int = 0,
    only: range | None = None,
    apart: bool = False,
) -> tuple[int, Frames]:
    """Renders a Mitsuba scene: all of its sensors, or the first one moved along a path.

    The variant is set until the frames are exhausted or closed.

    Args:
        apart: no sample counts for more than one pixel, whatever filter the film has: to a
            denoiser, noise that pixels share looks like what they show.

    Raises:
        InputError: if the scene cannot be loaded or has no sensor.
    """

    import mitsuba as mi

    def render(scene: Any, samples: int, sensor: Any, seed: int = 0) -> Image:
        try:
            return _picture(scene, sensor, samples, seed)
        except RuntimeError as error:  # Dr.Jit wraps what happens inside a custom operation
            if isinstance(error.__cause__, InputError):
                raise InputError(f"{scene_path}: {error.__cause__}") from error
            if (said := refused_rendering(error)) is not None:
                raise InputError(f"{scene_path}: {said}") from error
            raise

    def produce() -> Generator[Any, None, None]:
        """The number of frames, and then these."""
        with using_variant(variant):
            file = SceneFile(scene_path)
            file.substitute("Film")  # whose files are not written
            file.complete()
            if apart:
                _keep_apart(file)
            scene = file.load()
            sensors = scene.sensors()
            if not sensors:
                raise InputError(f"{scene_path}: has no sensor, expected at least one")
            if path == "test":
                expected = "{}: a scene has no test views, expected {} or {}"
                raise InputError(expected, scene_path, *_MOVING)
            for note in file.notes:
                print(note, flush=True)
            if size is not None:
                for sensor in sensors:
                    film = mi.traverse(sensor)
                    film["film.size"] = list(size)
                    film.update()
            if path is not None:
                draw = partial(render, scene, spp or sensors[0].sampler().sample_count())
                yield frames
                yield from _moving(scene, sensors[0], path, frames, draw, only)
                return
            yield len(sensors)
            for i, sensor in _chosen(sensors, only):
                count = spp or sensor.sampler().sample_count()
                yield f"sensor_{i:03d}", render(scene, count, sensor)

    produced = produce()
    return next(produced), produced


def _keep_apart(file: SceneFile) -> None:
    """Gives all films a box as their reconstruction filter."""
    import mitsuba as mi

    for rfilter in file.plugins("ReconstructionFilter"):
        for name in list(rfilter.keys()):
            del rfilter[name]
        rfilter.set_plugin_name("box")
    if not file.plugins("ReconstructionFilter"):
        for film in file.plugins("Film"):
            film["rfilter"] = mi.load_dict({"type": "box"})


def write_frames(
    out: str | Path,
    count: int,
    frames: Frames,
    *,
    fps: int = 24,
    on_frame: Callable[[], None] | None = None,
) -> None:
    """Writes frames as one picture, a video, or pictures in a folder, by the name of ``out``.

    Pictures keep alpha: ``.exr`` linear and premultiplied, ``.png`` sRGB and straight.
    Videos are on white.

    Raises:
        InputError: if the name does not suit the number of frames, or cannot be written.
    """
    target = Path(out)
    check_output(target, count)

    first = next(frames)  # before the folder is made: this is where scenes fail

    def counted() -> Frames:
        for item in itertools.chain([first], frames):
            yield item
            if on_frame is not None:
                on_frame()

    kind = output_kind(target)
    folder = make_folder(target if kind == "folder" else target.parent)
    if kind == "video":
        _write_video(target, counted(), fps)
        return
    for name, image in counted():
        write_picture(target if kind == "picture" else folder / f"{name}.png", image)


def output_kind(out: Path) -> Output:
    """What to write, by the name.

    Raises:
        InputError: for names that end like files of another kind.
    """
    if out.is_dir():
        return "folder"
    if out.suffix.lower() not in _KINDS:
        raise InputError(
            f"{out}: expected an .exr, .png or .mp4 file, or a folder without a dot in its name"
        )
    return _KINDS[out.suffix.lower()]


def check_output(target: Path, count: int) -> None:
    """Refuses names that cannot hold ``count`` frames or cannot be written to."""
    kind = output_kind(target)
    if kind == "picture" and count != 1:
        raise InputError(f"{target}: one picture for {count} frames, expected an .mp4 or a folder")
    if kind == "folder":
        check_folder(target)
    else:
        check_file(target)


def _write_video(target: Path, frames: Frames, fps: int) -> None:
    with replacing(target) as temporary:
        writer = imageio.get_writer(
            temporary, format="FFMPEG", fps=fps, macro_block_size=1, quality=8
        )
        with writer:
            for _, image in frames:
                # Players want even sizes: an odd one grows by a copy of its last row or column.
                height, width = image.shape[:2]
                image = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
                writer.append_data(np.rint(on_white(image) * 255).astype(np.uint8))


def _cameras(target: Target, path: Path_) -> Dataset:
    """The views whose cameras a path follows."""
    assert target.data is not None
    if path != "test":
        return load_dataset(target.data, "train", downscale=target.downscale, images=target.images)
    split = held_out_split(target.data)
    if split is None:
        raise InputError("{}: has no test views, expected {} or {}", target.data, *_MOVING)
    return load_dataset(target.data, split, downscale=target.downscale, images=target.images)


def default_path(target: Target) -> Path_:
    """The path that suits a run: a forward-facing capture has no other side."""
    return "orbit" if target.contents.config.ndc is None else "spiral"


def _path_poses(target: Target, dataset: Dataset, path: Path_, frames: int) -> Poses:
    """The cameras of a path."""
    poses = dataset.cam_to_world
    if path == "test":
        return dataset.evenly_spread(frames).cam_to_world if frames else poses
    if dataset.ndc is None:
        return (orbit_like if path == "orbit" else spiral_like)(poses, frames)
    if path == "orbit":
        raise InputError(
            "{}: trained on a forward-facing capture, expected {} or {}",
            target.path,
            Option("path", "spiral"),
            Option("path", "test"),
        )
    assert dataset.near is not None and dataset.far is not None  # LLFF always says so
    return forward_spiral(poses, dataset.near, dataset.far, frames)


def _resized(intrinsics: Intrinsics, size: tuple[int, int] | None) -> Intrinsics:
    """The same horizontal field of view on a film of another size."""
    if size is None:
        return intrinsics
    width, height = valid_size(size)
    scale = width / intrinsics.width
    return replace(
        intrinsics,
        width=width,
        height=height,
        fx=intrinsics.fx * scale,
        fy=intrinsics.fy * scale,
        cx=intrinsics.cx * scale,
        cy=intrinsics.cy * height / intrinsics.height,
    )


def _linear_rgba(color: Image, opacity: Image, color_space: str) -> Image:
    radiance = linear_premultiplied(color, opacity, color_space)
    return np.concatenate([radiance, opacity[..., None]], axis=-1).astype(np.float32)


def _picture(scene: Any, sensor: Any, spp: int, seed: int) -> Image:
    """A picture of a Mitsuba scene, in sets of samples whose memory is bounded.

    Integrators of fields divide their work themselves, and keep the sampler's pattern.
    """
    import mitsuba as mi

    from ..generation.passes import sets

    film, sampler = sensor.film(), sensor.sampler()
    pixels = int(np.prod(np.array(film.crop_size(), np.int64)))
    ours = type(scene.integrator()).__module__.startswith("mi_nerf.")
    parts = [spp] if ours else sets(spp, pixels, sampler)
    if len(parts) == 1:
        return _rgba(mi.render(scene, sensor=sensor, spp=spp, seed=seed), film)
    seeds = [seed, *np.random.SeedSequence(seed).generate_state(len(parts) - 1, np.uint32)]
    total: Any = 0.0
    for count, own in zip(parts, seeds, strict=True):
        # Read at once, so that sets do not pile up in memory.
        total = total + _rgba(mi.render(scene, sensor=sensor, spp=count, seed=int(own)), film)
    picture: Image = total / np.float32(len(parts))
    return picture


def _rgba(image: Any, film: Any) -> Image:
    """The colour channels of a Mitsuba image, opaque where the film has no alpha."""
    import mitsuba as mi

    pixels = np.array(image).reshape(*image.shape[:2], -1)
    base = film.base_channels_count()  # what follows are AOVs
    has_alpha = mi.has_flag(film.flags(), mi.FilmFlags.Alpha)
    alpha = pixels[..., base - 1 : base] if has_alpha else np.ones_like(pixels[..., :1])
    color = pixels[..., : base - has_alpha]
    return np.concatenate([np.broadcast_to(color, (*color.shape[:2], 3)), alpha], axis=-1)


def _chosen(items: Iterable[T], only: range | None) -> list[tuple[int, T]]:
    """Those of some items whose numbers are wanted, with these."""
    return [pair for pair in enumerate(items) if only is None or pair[0] in only]


def _moving(
    scene: Any,
    sensor: Any,
    path: Path_,
    frames: int,
    render: Callable[[Any, int], Image],
    only: range | None,
) -> Frames:
    """Moves a sensor around the scene's box, at its own distance and height."""
    import mitsuba as mi

    parameters = mi.traverse(sensor)
    start = opengl_from_mitsuba(np.array(parameters["to_world"].matrix, np.float64).reshape(4, 4))
    center = np.array(scene.bbox().center(), np.float64).ravel()
    aimed = _aim(start, center)
    poses = (orbit_like if path == "orbit" else spiral_like)(aimed, frames)
    for i, pose in _chosen(poses, only):
        matrix = mi.ScalarTransform4f(mitsuba_from_opengl(pose))
        parameters["to_world"] = mi.Transform4f(matrix)
        parameters.update()
        yield f"{path}_{i:03d}", render(sensor, i)


def _aim(pose: Image, center: Image) -> Image:
    """A ring of cameras like ``pose`` that all look at ``center``."""
    offset = pose[:3, 3] - center
    radius = float(np.linalg.norm(offset))
    strongest = int(np.argmax(np.abs(pose[:3, 1])))
    up = np.zeros(3)
    up[strongest] = np.sign(pose[strongest, 1])
    return orbit(center, up, radius, float(np.clip(offset @ up / radius, -0.95, 0.95)), 8)
