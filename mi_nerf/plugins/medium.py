"""The ``nerfmedium`` plugin: a radiance field as the interior of a cube."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from ..closed_form import closed_form
from ..errors import InputError
from ..field_file import load_field
from ..volume import MarchSettings


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
       - Instead of ``filename``: a field given by a formula. :monosp:`gaussian` has
         ``center``, ``width`` (standard deviation), ``peak`` (density at the centre, in
         1/scene unit), ``radiance`` (a vector: linear RGB) and ``extent`` (half the side of
         its box, in widths).
     * - occupancy
       - |bool|
       - Skip the cells that the field file marks as empty. (Default: true)
     * - (weights)
       - |tensor|
       - All tensors of the network, e.g. ``trunk_0_weight``, or the formula's parameters.
       - |exposed|, |differentiable|

    The medium belongs inside a ``cube``. The cube's ``to_world`` carries the field's own
    coordinate system into the scene: with the identity the field appears where it was
    trained, and moving, rotating or scaling the cube does the same to the field. The
    field fills its own box, which need not be the cube [−1, 1]³; ``mi-nerf info`` prints it.
    A field of a forward-facing capture lives in normalised device coordinates: in its own
    coordinate system it fills all of z ≤ −1 that the views saw, up to infinity, for rays
    that descend along −z.

    Only the integrator ``nerf`` shows it: Mitsuba's own volume integrators have no notion
    of emission that depends on direction.

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
        self._grid: Any = None
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
        self.march = contents.march

    def _describe_formula(self, props: mi.Properties) -> None:
        if "filename" in props:
            raise InputError("nerfmedium: both 'filename' and 'field', expected one of them")
        self._source = str(props["field"])
        values = {}
        for name in (n for n in props.unqueried() if n != "to_world"):
            value = props[name]
            values[name] = value if isinstance(value, float) else tuple(map(float, value))
        try:
            self.field = closed_form(self._source, values, mi.TensorXf)
        except (TypeError, ValueError) as error:
            raise InputError(f"nerfmedium: {error}") from error
        self.march = MarchSettings(samples=128)

    @property
    def occupancy(self) -> Any:
        """The grid of cells that may hold something, or ``None``."""
        return self._grid if self._use_occupancy else None

    def traverse(self, callback: Any) -> None:
        """Exposes every tensor of the network as a differentiable parameter."""
        parameters = self.field.parameters()
        for public, name in self._names.items():
            callback.put(public, parameters[name], mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str] | None = None) -> None:
        """New weights may fill cells that were empty: the grid no longer holds."""
        if keys is None or any(k in self._names for k in keys):
            self._grid = None

    def to_string(self) -> str:
        """Lists the settings."""
        return (
            "NerfMedium[\n"
            f"  source = {self._source},\n"
            f"  lower = {self.field.lower}, upper = {self.field.upper},\n"
            f"  color_space = {self.field.color_space},\n"
            f"  parameters = {list(self._names)},\n"
            f"  occupancy = {self.occupancy is not None}\n"
            "]"
        )


mi.register_medium("nerfmedium", NerfMedium)
