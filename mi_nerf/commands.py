"""The sub-commands of ``mi-nerf``: their options, and what they call."""

from __future__ import annotations

import inspect
import math
import sys
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Union

from tqdm.auto import tqdm
from tyro.conf import Positional, UseAppendAction, arg, subcommand

from . import info
from .ablation import ROWS, ablate, table
from .backend import choose_variant
from .demo import run_demo
from .encoding import Convention
from .errors import InputError
from .evaluation import evaluate, quality
from .field_file import save_field
from .files import check_file, check_folder, make_folder, write_json
from .generation import Options, generate
from .generation.run import summary
from .importing import ImportSettings, import_network, occupied_cells
from .rendering import (
    check_output,
    default_path,
    output_kind,
    run_frames,
    scene_frames,
    write_frames,
)
from .report import report
from .scene_library import find_scene
from .target import open_target
from .training import run as training
from .training.config import with_settings
from .training.presets import preset

Variant = Annotated[
    str | None, arg(help="Mitsuba variant; default: CUDA where it works, LLVM otherwise.")
]


@dataclass(frozen=True)
class Generate:
    """Path-traces a dataset from a Mitsuba scene, with depth, normals and known noise.

    Examples:

    mi-nerf generate bonsai data/bonsai

    mi-nerf generate bonsai data/small --train 40 --test 10 --size 200 200 --spp 64

    mi-nerf generate my_scene.xml data/mine --up y --cameras sphere --seed 1

    mi-nerf generate bonsai data/bonsai --resume
    """

    scene: Positional[Annotated[str, arg(metavar="SCENE")]]
    """A Mitsuba XML file, or the name of a scene that comes with mi_nerf."""
    out: Positional[Annotated[Path, arg(metavar="OUT")]]
    """Folder of the dataset: new or empty, or with --resume one that was begun."""
    protocol: Literal["realistic360", "diffuse360", "forward"] | None = None
    """The paper's kind of dataset; default: the scene's own, or realistic360."""
    train: int | None = None
    """Training views; default: the protocol's (100, 479, 28)."""
    val: int | None = None
    """Validation views (10, 10, 0)."""
    test: int | None = None
    """Test views (200, 1000, and for forward every eighth of all)."""
    size: tuple[int, int] | None = None
    """Width and height (800 800, 512 512, 1008 756)."""
    spp: int | None = None
    """Samples a pixel; default: those of the scene's sampler."""
    seed: int = 0
    """Seed of camera positions and of the noise."""
    resume: bool = False
    """Go on with the dataset in OUT; missing and damaged views are made again."""
    cameras: Literal["hemisphere", "sphere"] | None = None
    """Where 360-degree cameras stand; default: as the scene says, or hemisphere."""
    up: Literal["x", "y", "z"] | None = None
    """Vertical axis; default: that of the scene's sensor, or z."""
    center: tuple[float, float, float] | None = None
    """What cameras look at; default: the origin, or the middle of scenes beyond [-1, 1]^3."""
    radius: float | None = None
    """Distance from it (forward: how far cameras move); default: 4, or as the scene's size says."""
    set: UseAppendAction[tuple[str, ...]] = ()
    """Values of the scene's $parameters: name=value; repeatable."""
    variant: Variant = None

    def run(self, _started: float) -> None:
        """Generates."""
        names = [field.name for field in fields(Options)]
        options = Options(**{name: getattr(self, name) for name in names})
        _seed(self.seed)
        record = generate(
            find_scene(self.scene),
            self.out,
            choose_variant(self.variant),
            options,
            parameters=dict(_pair(text) for text in self.set),
            resume=self.resume,
        )
        print(f"{self.out}: {summary(record)}")
        if not record["complete"]:
            raise KeyboardInterrupt


@dataclass(frozen=True)
class Train:
    """Trains a radiance field on a dataset of posed images.

    Examples:

    mi-nerf train lego/ --out runs/lego

    mi-nerf train lego/ --out runs/quick --downscale 2 --max-seconds 120

    mi-nerf train lego/ --out runs/wide --set network.width=128 optimizer.lr=5e-3

    mi-nerf train lego/ --out runs/lego --resume
    """

    data: Positional[Annotated[Path, arg(metavar="DATA")]]
    """Folder of a dataset (images and transforms_train.json, or poses_bounds.npy)."""
    out: Path
    """Folder of the run; created."""
    preset: str = "nerf"
    """Starting point of all settings: nerf or paper."""
    max_seconds: float | None = None
    """Stop after so many seconds of wall-clock time (default 600 if --steps is not given)."""
    steps: int | None = None
    """Stop after so many steps."""
    downscale: int = 1
    """Average images over blocks of K×K pixels."""
    seed: int = 0
    """Seed of initial weights, rays and samples."""
    resume: bool = False
    """Go on with the run in --out, with its own settings."""
    set: UseAppendAction[tuple[str, ...]] = ()
    """Change any setting: key=value, e.g. network.width=128; repeatable."""
    variant: Variant = None

    def run(self, started: float) -> None:
        """Trains."""
        config = preset(self.preset)
        config = replace(
            config, seed=_seed(self.seed), downscale=_positive("downscale", self.downscale)
        )
        config = with_settings(config, list(self.set))
        limits = {"steps": self.steps, "max_seconds": self.max_seconds}
        for name, value in limits.items():
            if value is not None:
                config = replace(config, **{name: _positive(name.replace("_", "-"), value)})
        if not self.resume and config.steps is None and config.max_seconds is None:
            config = replace(config, max_seconds=600.0)
        if self.resume and (self.out / training.CONFIG).exists():
            self._require_same_settings()
        run = training.start(
            self.data,
            self.out,
            config,
            choose_variant(self.variant),
            resume=self.resume,
            started=started,
        )
        run.train()
        trainer = run.trainer
        hint = "" if run.progress >= 1 else "; stopped early, go on with --resume"
        print(f"{self.out}: {trainer.step_count} steps in {run.seconds:.0f} s{hint}")

    def _require_same_settings(self) -> None:
        """Refuses options that a resumed run, which keeps its settings, would ignore."""
        recorded, _ = training.read_config(self.out)
        wanted = with_settings(recorded, list(self.set))
        for name, default in (("preset", "nerf"), ("seed", 0), ("downscale", 1)):
            if getattr(self, name) != default:
                wanted = replace(wanted, **{name: getattr(self, name)})
        wanted = replace(wanted, steps=recorded.steps, max_seconds=recorded.max_seconds)
        if wanted != recorded:
            raise InputError(
                f"{self.out}: a resumed run keeps its settings, expected no other --preset, "
                "--seed, --downscale or --set than it was started with"
            )


@dataclass(frozen=True)
class Ablate:
    """Measures what each part of the model is worth (NeRF, Table 2), on one dataset.

    Calling it again goes on where it was interrupted, or adds seeds and rows.

    Examples:

    mi-nerf ablate lego/ --out ablation/ --downscale 2 --max-seconds 300 --seeds 3

    mi-nerf ablate lego/ --out quick/ --rows no-pe no-vd complete --downscale 4 --steps 2000
    """

    data: Positional[Annotated[Path, arg(metavar="DATA")]]
    """Folder of a dataset."""
    out: Path
    """Folder of the runs, the table (ablation.md, ablation.json) and the figure."""
    rows: tuple[str, ...] = tuple(ROWS)
    """Which rows of the table."""
    seeds: int = 1
    """Runs of each row, with seeds from 0."""
    preset: str = "nerf"
    """Scale of the model: nerf, or paper for the published one."""
    max_seconds: float | None = None
    """Training time of each run (default 300 if --steps is not given)."""
    steps: int | None = None
    """Training steps of each run."""
    downscale: int = 1
    """Average images over blocks of K×K pixels."""
    split: str = "test"
    """Views to evaluate on."""
    views: int | None = None
    """Only so many of them, evenly spread."""
    set: UseAppendAction[tuple[str, ...]] = ()
    """Change any setting of all rows: key=value; repeatable."""
    variant: Variant = None

    def run(self, _started: float) -> None:
        """Trains and evaluates all rows."""
        config = with_settings(preset(self.preset), list(self.set))
        config = replace(config, downscale=_positive("downscale", self.downscale))
        if self.steps is None:
            seconds = 300.0 if self.max_seconds is None else self.max_seconds
            config = replace(config, max_seconds=_positive("max-seconds", seconds))
        else:
            config = replace(config, steps=_positive("steps", self.steps))
        if self.views is not None:
            _positive("views", self.views)
        record = ablate(
            self.data,
            self.out,
            config,
            choose_variant(self.variant),
            rows=self.rows,
            seeds=_positive("seeds", self.seeds),
            split=self.split,
            views=self.views,
        )
        print(table(record))
        if not record["complete"]:
            print(f"{self.out}: interrupted, the same command goes on")
            raise KeyboardInterrupt


@dataclass(frozen=True)
class Eval:
    """Measures held-out views by the nerf2020 protocol: 8 bits, on white, PSNR and SSIM.

    Examples:

    mi-nerf eval runs/lego

    mi-nerf eval runs/lego --split val --views 10 --json result.json --images pictures/

    mi-nerf eval lego.safetensors --data lego/ --downscale 2
    """

    target: Positional[Annotated[Path, arg(metavar="TARGET")]]
    """A run folder, or a field file (then with --data)."""
    data: Path | None = None
    """Dataset; default: the run's own."""
    split: str = "test"
    """Which views."""
    downscale: int | None = None
    """Average images over blocks of K×K pixels; default: as the run was trained."""
    views: int | None = None
    """Only so many views, evenly spread."""
    json: Path | None = None
    """Write the results to this file."""
    images: Path | None = None
    """Write the rendered views to this folder."""
    variant: Variant = None

    def run(self, _started: float) -> None:
        """Evaluates."""
        bar = _bar("eval", "view")

        def show(_result: dict[str, Any], total: int) -> None:
            bar.total = total
            bar.update()

        if self.json is not None:
            check_file(self.json)
        if self.images is not None:
            check_folder(self.images)
        with bar:
            record = evaluate(
                open_target(self.target),
                choose_variant(self.variant),
                data=self.data,
                split=self.split,
                downscale=self.downscale,
                views=self.views,
                images=self.images,
                on_image=show,
            )
        if self.json is not None:
            make_folder(self.json.parent)
            write_json(self.json, record)
        print(
            f"{record['split']}, {record['views']} views of {record['size'][0]}x"
            f"{record['size'][1]}: {quality(record)}, "
            f"{record['seconds_per_view']:.2f} s and {record['queries_per_ray']:.1f} queries a ray"
        )


@dataclass(frozen=True)
class Render:
    """Renders a run along a camera path, or a Mitsuba XML scene.

    Examples:

    mi-nerf render runs/lego -o orbit.mp4

    mi-nerf render runs/lego -o test_views/ --path test

    mi-nerf render scene.xml -o scene.exr --spp 64
    """

    target: Positional[Annotated[Path, arg(metavar="TARGET")]]
    """A run folder or a Mitsuba XML scene."""
    out: Annotated[Path, arg(aliases=["-o"])]
    """An .exr, .png or .mp4 file, or a folder of pictures."""
    path: Literal["orbit", "spiral", "test"] | None = None
    """Camera path; default: orbit for runs (spiral for forward-facing captures), the scene's
    own sensors for XML."""
    frames: int | None = None
    """Frames along the path; default: 1 for a picture, 60 otherwise, all for --path test."""
    size: tuple[int, int] | None = None
    """Width and height; default: those of the run's images or the scene's film."""
    spp: int | None = None
    """Samples a pixel; default: 1 for runs, the scene's own for XML."""
    variant: Variant = None

    def run(self, _started: float) -> None:
        """Renders."""
        for name in ("frames", "spp"):
            if getattr(self, name) is not None:
                _positive(name, getattr(self, name))
        if self.size is not None and min(self.size) < 1:
            raise InputError(
                f"--size {self.size[0]} {self.size[1]}: expected two numbers of at least 1"
            )
        if not self.target.exists():
            raise InputError(
                f"{self.target}: not found, expected a run folder or a Mitsuba XML scene"
            )
        picture = output_kind(self.out) == "picture"
        check_output(self.out, self.frames or 1)
        variant = choose_variant(self.variant)
        if self.target.suffix.lower() == ".xml":
            if self.frames is not None and self.path is None:
                raise InputError(
                    f"--frames {self.frames}: the sensors of a scene give one frame each, "
                    "expected --path orbit or --path spiral too"
                )
            frames = 1 if picture else 60
            count, images = scene_frames(
                self.target,
                variant,
                path=self.path,
                frames=self.frames or frames,
                size=self.size,
                spp=self.spp or 0,
            )
        else:
            target = open_target(self.target)
            path = self.path or default_path(target)
            frames = 1 if picture else (0 if path == "test" else 60)
            count, images = run_frames(
                target,
                variant,
                path=path,
                frames=self.frames or frames,
                size=self.size,
                spp=self.spp or 1,
            )
        with _bar("render", "frame", count) as bar:
            write_frames(self.out, count, images, on_frame=bar.update)
        print(f"{self.out}: {count} frame{'s' if count != 1 else ''}")


@dataclass(frozen=True)
class Report:
    """Draws what a field has learnt: so far, the colour of points over all directions.

    Examples:

    mi-nerf report runs/lego --out report/

    mi-nerf report lego.safetensors --out report/ --point 0.1 -0.3 0.2 --point 0 0 0.4
    """

    target: Positional[Annotated[Path, arg(metavar="TARGET")]]
    """A run folder, or a field file (then with --point)."""
    out: Path
    """Folder for report.md, report.json and the plots."""
    point: UseAppendAction[tuple[tuple[float, float, float], ...]] = ()
    """A point whose emission is drawn; repeatable. Default: three that the cameras see."""
    variant: Variant = None

    def run(self, _started: float) -> None:
        """Reports."""
        record = report(
            open_target(self.target), self.out, choose_variant(self.variant), self.point
        )
        for entry in record["view_dependence"]:
            where = ", ".join(f"{v:.3f}" for v in entry["point"])
            print(f"({where}): deviation over directions {entry['deviation']:.3f}")
        print(f"{self.out / 'report.md'}")


@dataclass(frozen=True)
class Import:
    """Makes a field file from a network that another NeRF code has trained.

    Reads checkpoints of the PyTorch port of the original code (network_fn_state_dict) and of the
    one with flexible models (model_coarse_state_dict). PyTorch is not needed, and nothing that a
    checkpoint contains is run. Networks trained in normalised device coordinates have no place in
    a world, and frequencies other than powers of two are not told apart.

    Examples:

    mi-nerf import checkpoint199999.ckpt -o lego.safetensors

    mi-nerf import 200000.tar -o room.safetensors --box -4 -4 -1 4 4 3 --samples 512
    """

    checkpoint: Positional[Annotated[Path, arg(metavar="CKPT")]]
    """A file written by torch.save."""
    out: Annotated[Path, arg(aliases=["-o"])]
    """The field file, .safetensors; an existing one is replaced."""
    network: Literal["fine", "coarse"] | None = None
    """Only one of the two; default: both, the coarse one placing the samples of the fine one."""
    box: tuple[float, float, float, float, float, float] = (-1.5, -1.5, -1.5, 1.5, 1.5, 1.5)
    """Minima and maxima of x, y and z; nothing is seen outside. Default: what holds the objects
    of nerf_synthetic."""
    samples: int | None = None
    """Samples on each ray through the box; default: 64, or 256 of a single network."""
    fine: int | None = None
    """Samples more, where the coarse network sees something; default: 128."""
    convention: Convention = "one"
    """Frequencies of the encoding: 2^k (one), as both codes have them, times pi or two_pi."""
    occupancy: int | None = None
    """Find empty space on a grid of so many cells along the longest side, say 64, so that rendering
    skips it; takes seconds to minutes and renders about ten times as fast; default: none."""
    variant: Variant = None

    def run(self, _started: float) -> None:
        """Imports."""
        if not all(math.isfinite(v) for v in self.box) or not all(
            self.box[i] < self.box[i + 3] for i in range(3)
        ):
            raise InputError(
                f"--box {' '.join(f'{v:g}' for v in self.box)}: expected three minima, then "
                "three larger maxima"
            )
        if self.samples is not None:
            _positive("samples", self.samples)
        if self.fine is not None and self.fine < 0:
            raise InputError(f"--fine {self.fine}: expected 0 or more")
        if self.occupancy is not None and not 1 <= self.occupancy <= 512:
            raise InputError(f"--occupancy {self.occupancy}: expected 1 to 512 cells")
        if self.out.suffix.lower() != ".safetensors":
            raise InputError(f"{self.out}: expected an output file .safetensors")
        check_file(self.out)
        settings = ImportSettings(
            self.network, self.box[:3], self.box[3:], self.samples, self.fine, self.convention
        )
        contents = import_network(self.checkpoint, settings)
        if self.occupancy is not None:
            variant = choose_variant(self.variant)
            cells = occupied_cells(contents, variant, self.occupancy)
            contents = replace(contents, occupancy=cells)
        make_folder(self.out.parent)
        save_field(self.out, contents)
        net, position = contents.config.network, contents.config.position
        print(
            f"{self.out}: {contents.provenance['state_dict']}, {net.depth}x{net.width} with "
            f"{position.frequencies} octaves, {contents.parameter_count()} parameters"
        )


@dataclass(frozen=True)
class Info:
    """Says what this machine offers, or what a run, checkpoint, field or dataset holds.

    Examples:

    mi-nerf info

    mi-nerf info runs/lego
    """

    target: Positional[Annotated[Path | None, arg(metavar="TARGET")]] = None
    """A run folder, a .safetensors file or a dataset folder."""

    def run(self, _started: float) -> None:
        """Prints a summary."""
        print(info.system() if self.target is None else info.describe(self.target))


@dataclass(frozen=True)
class Demo:
    """The whole job on a small scene: path-traces images, trains, evaluates, compares.

    Examples:

    mi-nerf demo

    mi-nerf demo --out /tmp/demo
    """

    out: Path | None = None
    """Folder for everything it makes; default: mi-nerf-demo, or the next free such name."""
    seconds: float = 45.0
    """Training time."""
    seed: int = 0
    """Seed of images and training."""
    variant: Variant = None

    def run(self, started: float) -> None:
        """Runs the demo."""
        run_demo(
            self.out,
            choose_variant(self.variant),
            seconds=_positive("seconds", self.seconds),
            seed=_seed(self.seed),
        )


COMMANDS = {
    "demo": Demo,
    "generate": Generate,
    "train": Train,
    "ablate": Ablate,
    "eval": Eval,
    "render": Render,
    "report": Report,
    "import": Import,
    "info": Info,
}


def command_type(chosen: str | None) -> Any:
    """All sub-commands as one type for tyro; only the chosen one shows its examples."""
    options = []
    for name, command in COMMANDS.items():
        text = inspect.getdoc(command) or ""
        shown = text if name == chosen else text.splitlines()[0]
        options.append(Annotated[command, subcommand(name, description=shown)])
    return Union[tuple(options)]  # noqa: UP007


def _positive(name: str, value: Any) -> Any:
    if not 0 < value < math.inf:
        raise InputError(f"--{name} {value}: expected a number above 0")
    return value


def _pair(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise InputError(f"--set {text}: expected name=value")
    return name, value


def _seed(value: int) -> int:
    if not 0 <= value < 1 << 31:
        raise InputError(f"--seed {value}: expected a number from 0 to {(1 << 31) - 1}")
    return value


def _bar(name: str, unit: str, total: int | None = None) -> tqdm[Any]:
    """A progress bar on a terminal; nothing elsewhere."""
    return tqdm(desc=name, unit=unit, total=total, disable=not sys.stderr.isatty())
