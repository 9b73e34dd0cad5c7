"""Every setting of a training run, with its default: one frozen dataclass a concern."""

from __future__ import annotations

import dataclasses
import difflib
import json
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from ..base.errors import InputError, Option
from ..fields.activations import ColorActivation, DensityActivation
from ..fields.fourier import FourierEncoding
from ..fields.fused_network import WIDEST
from ..fields.hash_grid import HashGridConfig
from ..fields.network import NetworkConfig
from ..march.rules import Rule
from .plain import assign, build, leaf_names, require

if TYPE_CHECKING:  # what code sees that works with settings: they are resolved before
    Found = int
else:  # what may be set; none: found from the data (mi_nerf.training.scaling)
    Found = int | None
FROM_DATA: Any = None

# Queries whose gradients may be added up in half precision. Of more, the sums lose their digits:
# the error of a weight's gradient is 1 % with these, 14 % with four times as many.
HALF_BLOCK = 1 << 14


@dataclass(frozen=True)
class DensityConfig:
    """How raw network outputs become densities."""

    activation: DensityActivation = "softplus"  # of raw densities
    shift: float = -1.0  # added before the activation (softplus(x − 1): mip-NeRF)
    gain: float = 1.0  # density of activation output 1, per half side of the box
    noise: float = 0.0  # of N(0, 1) added to raw densities in training; images without alpha only

    def __post_init__(self) -> None:
        require(self, "gain", above=0)
        require(self, "noise", at_least=0)


@dataclass(frozen=True)
class OccupancyConfig:
    """The grid that spares the field's evaluation in empty space."""

    enabled: bool = True  # false: samples are evaluated everywhere in the box
    hull: bool = True  # start from the silhouettes, where images have alpha
    resolution: Found = 64  # cells along the longest side of the box; none: by the images
    threshold: float = 0.01  # optical thickness of a cell below which it counts as empty
    decay: float = 0.9  # of remembered densities, at each refresh of a cell
    every: int = 16  # steps between refreshes
    queries: Found = 8192  # cells looked at in one refresh; none: by the images
    start: int = 256  # steps before the first refresh

    def __post_init__(self) -> None:
        require(self, "resolution every queries", at_least=1)
        require(self, "threshold start", at_least=0)
        require(self, "decay", at_least=0, at_most=1)


@dataclass(frozen=True)
class SamplingConfig:
    """Rays and the samples on them."""

    samples: Found = 64  # strata a ray in training; none: by the images
    fine: int = 0  # samples more, where a second, coarse network sees something (0: no such)
    render_samples: Found = 128  # strata in evaluation and for the field file; none: by the images
    render_fine: int | None = None  # samples more in evaluation; none: as in training
    batch: Found = 32768  # field queries a step, at most; none: by the features
    max_rays: int = 16384  # rays a step, at most
    render_stop: float = 1e-3  # transmittance at which a ray ends in evaluation; 0: never
    rays: int | None = None  # rays a step; none: as many as fill the batch
    rule: Rule = "constant"  # of quadrature, in training and evaluation
    near: float | None = None  # least distance of samples, scene units; none: the box alone
    far: float | None = None  # largest distance of samples, scene units; none: the box alone
    block: int = 16384  # queries the network evaluates at a time
    hidden: float = 0.0  # training leaves out samples behind this optical depth; 0: none

    def __post_init__(self) -> None:
        require(self, "samples render_samples batch max_rays rays block", at_least=1)
        require(self, "near fine render_fine hidden", at_least=0)
        require(self, "far", above=0)
        require(self, "render_stop", at_least=0, below=1)
        known = None not in (self.batch, self.samples)
        if known and self.batch < self.samples:
            raise ValueError(
                f"batch={self.batch}, expected at least the samples={self.samples} of one ray"
            )
        if self.near is not None and self.far is not None and self.near >= self.far:
            raise ValueError(f"near={self.near}, expected less than far={self.far}")


@dataclass(frozen=True)
class PyramidConfig:
    """Coarse images first: level l of the pyramid averages 2^l×2^l pixels.

    The level falls evenly from the coarsest to that of the images themselves. Between two
    levels, either is drawn for its share of the rays.
    """

    levels: int | None = 0  # coarser than the images; none: by their size
    until: float = 0.4  # share of the budget after which the images themselves are seen
    mixed: float = 0.0  # share of rays that see any level, at any time
    jitter: bool = False  # rays anywhere through a coarse pixel; false: through its middle
    features: bool = False  # a level of the grid joins when the images resolve it

    def __post_init__(self) -> None:
        require(self, "levels", at_least=0, at_most=12)
        require(self, "until mixed", at_least=0, at_most=1)


@dataclass(frozen=True)
class OptimizerConfig:
    """Adam with warm-up and decay."""

    lr: float = 5e-4  # learning rate after warm-up
    lr_final: float = 5e-5  # learning rate at the end of the schedule
    schedule: Literal["exponential", "cosine", "linear"] = "exponential"  # between the two
    warmup: int = 100  # steps of linear increase
    beta1: float = 0.9  # decay of the mean gradient
    beta2: float = 0.99  # decay of the mean squared gradient
    epsilon: float = 1e-8  # added to the root of the latter
    muon: bool = False  # orthogonal updates of matrices between hidden layers, in place of Adam

    def __post_init__(self) -> None:
        require(self, "lr epsilon", above=0)
        require(self, "lr_final", at_least=0)
        if self.schedule == "exponential":  # never reaches 0
            require(self, "lr_final", above=0)
        require(self, "warmup", at_least=0)
        require(self, "beta1 beta2", at_least=0, below=1)


@dataclass(frozen=True)
class TrainConfig:
    """A training run, resolved: what ``config.json`` records.

    For forward-facing captures, ``box`` and all that counts per length of it is in
    normalised device coordinates.
    """

    preset: str = "nerf"  # where the other settings come from
    seed: int = 0  # of initial weights, rays and samples
    steps: int | None = None  # stop after so many steps
    max_seconds: float | None = None  # stop after so much wall-clock time
    downscale: int = 1  # images are averaged over blocks of K×K pixels
    images: Literal["png", "exr"] | None = None  # files of views; none: those the data name
    views: int | None = None  # train on so many views, evenly spread; none: all
    box: tuple[float, float, float, float, float, float] | None = None  # min, max; none: found
    background: Literal["auto", "white", "black", "random"] = "auto"  # auto: random with alpha
    loss: Literal["auto", "mse", "relative"] = "auto"  # auto: relative for linear images
    loss_floor: float = 1e-3  # radiance below which the relative loss becomes absolute
    color_activation: Literal["auto"] | ColorActivation = "auto"  # auto: exp for linear images
    network: NetworkConfig = field(default_factory=NetworkConfig)
    position: FourierEncoding | None = None  # none: as many octaves as the images resolve
    grid: HashGridConfig | None = None  # features of a hash grid, besides those of position
    direction: FourierEncoding = field(default_factory=lambda: FourierEncoding(frequencies=4))
    density: DensityConfig = field(default_factory=DensityConfig)
    occupancy: OccupancyConfig = field(default_factory=OccupancyConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    pyramid: PyramidConfig = field(default_factory=PyramidConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    report_every: float = 2.0  # seconds between lines of the log
    checkpoint_every: float = 60.0  # seconds between checkpoints
    collapse_check: int = 400  # steps after which a run that learnt nothing restarts
    max_restarts: int = 3  # after a collapse, each with other weights
    crop_steps: int = 0  # so many first steps see only the middle of the images
    crop: float = 0.5  # share of width and height that they see
    max_skipped: int = 20  # steps in a row, not finite or without a whole ray, that end the run
    store_activations: float = 3.0  # GiB of activations; larger steps are taken in parts
    half_precision: bool = False  # of the network in training, for GPUs; slower on CPUs

    def __post_init__(self) -> None:
        require(self, "seed", at_least=0, below=1 << 31)
        require(self, "steps downscale views max_skipped", at_least=1)
        require(self, "max_seconds loss_floor", above=0)
        require(self, "report_every checkpoint_every crop_steps", at_least=0)
        require(self, "crop", above=0, at_most=1)
        require(self, "collapse_check max_restarts", at_least=0)
        require(self, "store_activations", above=0)
        widest = max(self.network.width, self.network.view_width)
        if self.half_precision and widest > WIDEST:
            raise ValueError(
                f"half_precision=true with {widest} neurons a layer, expected {WIDEST} at most"
            )
        together = min(self.sampling.block, self.sampling.batch or self.sampling.block)
        if self.half_precision and together > HALF_BLOCK:
            raise ValueError(
                f"half_precision=true with block={self.sampling.block}, expected {HALF_BLOCK} at "
                "most: sums of more gradients lose their digits"
            )
        box = self.box or (0, 0, 0, 1, 1, 1)
        if not all(box[i] < box[i + 3] for i in range(3)):
            raise ValueError(f"box={self.box}, expected three minima below three maxima")


def to_json(config: TrainConfig) -> dict[str, Any]:
    """The configuration as plain JSON values."""
    result: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(config)))
    return result


def from_json(data: dict[str, Any], source: str) -> TrainConfig:
    """Rebuilds a configuration; ``source`` names the file in error messages."""
    try:
        config: TrainConfig = build(TrainConfig, data)
    except ValueError as error:
        raise InputError(
            f"{source}: not a training configuration of this version: {error}"
        ) from error
    return config


def with_settings(config: TrainConfig, assignments: list[str]) -> TrainConfig:
    """Applies ``key=value`` assignments; nested settings as ``network.width=128``.

    Their order does not matter to settings that depend on each other.

    Raises:
        InputError: for an unknown key, a value of the wrong kind or out of range.
    """
    values = dataclasses.asdict(config)
    for assignment in assignments:
        option = Option("settings", assignment)
        key, separator, text = assignment.partition("=")
        if not separator:
            raise InputError("{}: expected key=value", option)
        if key == "preset":  # would change the name and nothing else
            raise InputError("{}: expected {}", option, Option("preset", text))
        try:
            assign(values, TrainConfig, key.split("."), text)
        except KeyError:
            raise InputError("{}: unknown setting, {}", option, _similar(key)) from None
        except ValueError as error:
            raise InputError("{}: {}", option, error) from None
    try:
        result: TrainConfig = build(TrainConfig, values)
    except ValueError as error:
        names = [a for a in assignments if f"{a.partition('=')[0].split('.')[-1]}=" in str(error)]
        raise InputError(
            "{}: {}", Option("settings", " ".join(names or assignments)), error
        ) from error
    return result


def setting_names() -> list[str]:
    """All keys of assignments."""
    return [name for name in leaf_names(TrainConfig) if name != "preset"]


def _similar(key: str) -> str:
    """What the user may have meant instead of an unknown key."""
    names = setting_names()
    group = key.partition(".")[0] + "."
    close = difflib.get_close_matches(key, names, n=3)
    close = close or [n for n in names if n.split(".")[-1] == key.split(".")[-1]]
    close = close or [n for n in names if n.startswith(group)]
    return f"expected {'for example ' if close else 'one of '}{', '.join(close or names)}"
