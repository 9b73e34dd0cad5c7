"""The ``nerfmedium`` plugin: a radiance field as the interior of a cube."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from ..errors import InputError
from ..field_file import load_field


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
     * - occupancy
       - |bool|
       - Skip the cells that the field file marks as empty. (Default: true)
     * - (weights)
       - |tensor|
       - All tensors of the network, e.g. ``trunk_0_weight``.
       - |exposed|, |differentiable|

    The medium belongs inside a ``cube``. The cube's ``to_world`` carries the field's own
    coordinate system into the scene: with the identity the field appears where it was
    trained, and moving, rotating or scaling the cube does the same to the field. The
    field fills its own box, which need not be the cube [−1, 1]³; ``mi-nerf info`` prints it.

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
        if "filename" not in props:
            raise InputError("nerfmedium: 'filename' is missing, expected a field file")
        name = str(props["filename"])
        self._path = str(mi.file_resolver().resolve(name))
        self._use_occupancy = bool(props.get("occupancy", True))
        contents = load_field(self._path)
        self.field, self._grid = contents.build(mi)
        self.march = contents.march
        # Parameter names must not hold dots, which separate objects.
        self._names = {n.replace(".", "_"): n for n in self.field.parameters()}

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
        config = self.field.config
        return (
            "NerfMedium[\n"
            f"  filename = {self._path},\n"
            f"  lower = {config.lower}, upper = {config.upper},\n"
            f"  color_space = {config.color_space},\n"
            f"  parameters = {config.parameter_count()},\n"
            f"  occupancy = {self.occupancy is not None}\n"
            "]"
        )


mi.register_medium("nerfmedium", NerfMedium)
