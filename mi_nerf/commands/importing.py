"""``mi-nerf import``: a field file from another code's checkpoint."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from ..base.errors import InputError
from ..base.files import check_file, make_folder
from ..base.variants import choose_variant
from ..fields.fourier import Convention
from ..formats.field_file import save_field
from ..formats.foreign_networks import ImportSettings, import_network, occupied_cells
from .shared import Variant, positive


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
            positive("samples", self.samples)
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
