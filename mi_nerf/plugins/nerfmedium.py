"""The ``nerfmedium`` plugin: a radiance field as the interior of a cube."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..base.errors import InputError
from ..fields.closed_form import closed_form
from ..fields.neural import NeuralFieldConfig
from ..formats.field_file import FieldFile, load_field
from ..march.followed import FollowedGrid
from ..march.settings import MarchSettings
from ..march.trained import HIDDEN, TrainedGrid


class NerfMedium(mi.Medium):
    r"""
    .. _medium-nerfmedium:

    Neural radiance field (:monosp:`nerfmedium`)
    --------------------------------------------

    .. pluginparameters::

     * - filename
       - |string|
       - Field file (``field.safetensors``) written by ``mi-nerf train`` or
         ``mi-nerf import``; looked up like any file of the scene.
     * - field
       - |string|
       - Instead of ``filename``: a field given by a formula, :monosp:`slab`,
         :monosp:`two_color`, :monosp:`fog`, :monosp:`ramp`, :monosp:`step`, :monosp:`sheet`,
         :monosp:`gaussian` or :monosp:`shell`, and then its parameters, listed below.
     * - occupancy
       - |bool|
       - Skip the cells that the field file marks as empty. When weights change, so do these
         cells: the field is looked at again before the next picture. (Default: true)
     * - training
       - |bool|
       - The weights are trained from the start, step by step, as ``mi-nerf train`` does. Cells
         that the file marks as empty stay so for good, and some of the others are looked at
         again every 16 changes of the weights. Pictures of up to 16384 rays, while weights have
         gradients, and their derivatives take the same samples, without those behind an
         optical depth of 10 of what was always seen dense: derivatives are those of the very
         picture, its noise included, instead of having a seed of their own. (Default: false, all
         cells are looked at after every change)
     * - to_world
       - |transform|
       - Moves the field within the cube's coordinate system: applied before the cube's own
         ``to_world``. Any affine map that is not singular. (Default: none, i.e. identity)
       - |exposed|, |differentiable|
     * - (weights)
       - |tensor|
       - All tensors of the network, e.g. ``trunk_0_weight``, or the formula's parameters; of a
         coarse network that places samples, the same with ``coarse_`` in front.
       - |exposed|, |differentiable|

    **Formulas** (:py:mod:`mi_nerf.fields.closed_form` has the equations and defaults). Lengths are
    in scene units, densities in 1/scene unit; points, directions and colours are vectors.

    .. pluginparameters::

     * - radiance
       - |vector|
       - All: what is emitted, linear RGB, in :monosp:`two_color` along the axis only.
         (Default: 1, 1, 1; :monosp:`two_color`: 1, 0.5, 0.1)
     * - opposite
       - |vector|
       - :monosp:`two_color`: what is emitted against the axis; in between, the cosine blends.
         (Default: 0.1, 0.5, 1)
     * - lower, upper
       - |vector|
       - Corners of the box of all but :monosp:`gaussian` and :monosp:`shell`, which end where
         their density does. (Default: −1, −1, −1 and 1, 1, 1)
     * - axis
       - |vector|
       - :monosp:`fog`, :monosp:`ramp`, :monosp:`step`, :monosp:`sheet`, :monosp:`two_color`:
         the direction along which they vary. (Default: 0, 0, 1)
     * - position
       - |float|
       - The first four of these: where along the axis their plane is. (Default: 0)
     * - density
       - |float|
       - :monosp:`slab`, :monosp:`two_color` (default: 2), :monosp:`shell` (10): the density;
         :monosp:`fog`, :monosp:`ramp` (1): that of the plane.
     * - height
       - |float|
       - :monosp:`fog`: the length over which density falls by a factor of e. (Default: 0.5)
     * - slope
       - |float|
       - :monosp:`ramp`: growth of density along the axis. (Default: 1)
     * - before, beyond
       - |float|
       - :monosp:`step`: densities on both sides of the plane. (Default: 0.5 and 5)
     * - thickness
       - |float|
       - :monosp:`sheet`: optical depth along the axis. (Default: 1)
     * - width
       - |float|
       - :monosp:`sheet`: how thin it is (default: 0.02); :monosp:`gaussian`: the standard
         deviation (0.2).
     * - edge
       - |float|
       - :monosp:`step` (default: 0.05), :monosp:`shell` (0.05), :monosp:`sheet` (0.01): the
         length over which density goes up or down. With 0 it jumps, and the gradient with
         respect to the place of the jump is lost.
     * - center
       - |vector|
       - :monosp:`gaussian`, :monosp:`shell`: their centre. (Default: 0, 0, 0)
     * - peak, extent
       - |float|
       - :monosp:`gaussian`: density at the centre, and half the side of its box in widths.
         (Default: 10 and 4.5)
     * - inner, outer
       - |float|
       - :monosp:`shell`: its radii. (Default: 0.4 and 0.6)

    All but the box (``lower``, ``upper``, ``extent``) are exposed and differentiable. The box
    stays as it was when they change.

    The medium belongs inside a ``cube``. The cube's ``to_world`` carries the field's own
    coordinate system into the scene: with the identity the field appears where it was
    trained, and moving, rotating or scaling the cube does the same to the field. The
    field fills its own box, which need not be the cube [−1, 1]³; ``mi-nerf info`` prints it.
    Densities are per length of the field: in a scaled cube it stays as opaque as it was.
    Any number of cubes may hold fields, and several may share one medium. The cube itself
    is never seen, whatever its BSDF.
    A field of a forward-facing capture lives in normalised device coordinates: in its own
    coordinate system it fills all of z ≤ −1 that the views saw, up to infinity, for rays
    that descend along −z.

    Gradients with respect to the field's pose reach the medium's ``to_world`` and the cube's
    ``vertex_positions``.

    Only the integrators ``nerf``, ``nerf_path`` and ``nerf_tracking`` show it: Mitsuba's own volume
    integrators have no notion of emission that depends on direction, and see a vacuum instead.

    .. tabs::
        .. code-tab:: xml

            <shape type="cube">
                <bsdf type="null"/>
                <medium type="nerfmedium" name="interior" id="field">
                    <string name="filename" value="lego.safetensors"/>
                </medium>
            </shape>

        .. code-tab:: python

            'type': 'cube',
            'bsdf': {'type': 'null'},
            'interior': {'type': 'nerfmedium', 'filename': 'lego.safetensors'}
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self._use_occupancy = bool(props.get("occupancy", True))
        self.training = bool(props.get("training", False))
        matrix = props.get("to_world", mi.ScalarTransform4f()).matrix
        self.to_world = mi.Transform4f(np.array(matrix, np.float32))
        self._grid: Any = None
        self._contents: FieldFile | None = None  # what the grid belongs to, until weights change
        self._stale, self._checked = False, False
        self._config: NeuralFieldConfig | None = None  # none of a formula
        self.field: Any
        if "field" in props:
            self._describe_formula(props)
        elif "filename" in props:
            self._load_file(str(mi.file_resolver().resolve(str(props["filename"]))))
        else:
            raise InputError("nerfmedium: expected 'filename', a field file, or 'field', a formula")
        # Parameter names must not hold dots, which separate objects.
        self._names = {n.replace(".", "_"): n for n in self.field.parameters()}

    def _load_file(self, path: str) -> None:
        contents = load_field(path)
        self._source = path
        self.field, self._grid = contents.build(mi)
        self._contents = contents if self._use_occupancy and self._grid is not None else None
        self.march, self._config = contents.march, contents.config

    def _describe_formula(self, props: mi.Properties) -> None:
        if "filename" in props:
            raise InputError("nerfmedium: both 'filename' and 'field', expected one of them")
        self._source = str(props["field"])
        values = {n: _plain(props[n]) for n in props.unqueried()}
        try:
            self.field = closed_form(self._source, values, mi.TensorXf)
        except ValueError as error:
            raise InputError(f"nerfmedium: {error}") from error
        self.march = MarchSettings(samples=128, block=1 << 17)  # of formulas, large ones are quick

    @property
    def occupancy(self) -> Any:
        """The grid of cells that may hold something with the weights as they are, or ``None``."""
        if not self._use_occupancy or self._grid is None:
            return None
        if self._stale:
            if self._contents is not None:
                self._grid = self._moving_grid(self._contents)
                self._contents = None
            self._grid.follow(self.field)
            self._stale = False
        return self._grid

    def _moving_grid(self, contents: FieldFile) -> Any:
        """A grid that keeps up with the weights, from the file's."""
        if self.training:
            return TrainedGrid(self._grid, mi.Float)
        before, _ = contents.build(mi)  # from here on, any cell may fill
        return FollowedGrid(self._grid, before, mi.Float)

    @property
    def hidden(self) -> float:
        """The optical depth behind which derivatives leave out samples; 0: none."""
        return HIDDEN if self.training else 0.0

    def field_file(self) -> FieldFile:
        """The field as it is now, for :func:`mi_nerf.save_field`.

        Raises:
            InputError: if it is given by a formula.
        """
        if self._config is None:
            raise InputError(f"nerfmedium: '{self._source}' is a formula, expected a network")
        coarse, grid = self.field.coarse, self.occupancy
        return FieldFile(
            self._config,
            self.field.weights(),
            None if grid is None else grid.mask(),
            self.march,
            coarse=None if coarse is None else coarse.weights(),
        )

    def traverse(self, callback: Any) -> None:
        """Exposes every tensor of the network, and ``to_world``, as differentiable parameters."""
        for public, tensor in self._tensors().items():
            callback.put(public, tensor, mi.ParamFlags.Differentiable)
        callback.put("to_world", self.to_world, mi.ParamFlags.Differentiable)

    def _tensors(self) -> dict[str, Any]:
        """The parameters of the field and of its coarse network, by their public names."""
        fields = {"": self.field}
        if self.field.coarse is not None:
            fields["coarse_"] = self.field.coarse
        return {
            prefix + public: field.parameters()[name]
            for prefix, field in fields.items()
            for public, name in self._names.items()
        }

    def parameters_changed(self, keys: list[str] | None = None) -> None:
        """New weights may fill cells that were empty: the next picture looks at them again."""
        changed = not keys or any(k in self._names for k in keys)
        self._stale |= changed
        self._checked &= not changed and not any(k.startswith("coarse_") for k in keys or ())

    def check_finite(self) -> None:
        """Refuses weights that would turn the whole picture into NaN.

        Raises:
            InputError: naming those that are NaN or infinite.
        """
        if self._checked:
            return
        tensors = self._tensors()
        bad = dr.zeros(mi.UInt32, len(tensors))
        dr.make_opaque(bad)
        for i, tensor in enumerate(tensors.values()):
            values = dr.detach(tensor)
            values = values.array if dr.is_tensor_v(values) else dr.ravel(values)
            dr.scatter(bad, mi.UInt32(1), dr.opaque(mi.UInt32, i), ~dr.isfinite(values))
        wrong = [name for name, b in zip(tensors, np.array(bad), strict=True) if b]
        if wrong:
            raise InputError(
                f"nerfmedium: '{self.id()}': {', '.join(wrong)}: NaN or infinite, "
                "expected finite numbers"
            )
        self._checked = True

    # ---- What Mitsuba's own volume integrators find: nothing. Theirs would fail otherwise, ----
    # ---- in any scene, as long as a field exists anywhere.                                 ----

    def intersect_aabb(self, ray: Any) -> tuple[Any, Any, Any]:
        """No ray meets anything."""
        return mi.Bool(False), mi.Float(0), mi.Float(dr.inf)

    def get_majorant(self, interaction: Any, active: Any = True) -> Any:
        """Nothing scatters or absorbs."""
        return mi.UnpolarizedSpectrum(0)

    def get_scattering_coefficients(self, interaction: Any, active: Any = True) -> Any:
        """Scattering, null and total coefficients: none."""
        return tuple(mi.UnpolarizedSpectrum(0) for _ in range(3))

    def to_string(self) -> str:
        """Lists the settings."""
        return (
            "NerfMedium[\n"
            f"  source = {self._source},\n"
            f"  lower = {self.field.lower}, upper = {self.field.upper},\n"
            f"  color_space = {self.field.color_space},\n"
            f"  parameters = {list(self._names)},\n"
            f"  occupancy = {self._use_occupancy and self._grid is not None}\n"
            "]"
        )


def _plain(value: Any) -> Any:
    """Mitsuba's vectors and colours as tuples; anything else as it is."""
    if isinstance(value, str | int | float):
        return value
    try:
        return tuple(float(entry) for entry in value)
    except TypeError:
        return value


mi.register_medium("nerfmedium", NerfMedium)
