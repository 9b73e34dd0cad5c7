"""The ``nerfviews`` sensor: all views of a dataset as one film."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..base.arrays import upload
from ..base.errors import InputError
from ..cameras.pinhole import pack_poses, pixel_rays


class NerfViews(mi.Sensor):
    r"""
    .. _sensor-nerfviews:

    Views of a dataset (:monosp:`nerfviews`)
    ----------------------------------------

    .. pluginparameters::

     * - filename
       - |string|
       - Folder of a dataset, such as ``mi-nerf generate`` writes; looked up like any file of the
         scene.
     * - split
       - |string|
       - Which of its views. (Default: ``train``)
     * - downscale
       - |int|
       - Averages the images over blocks of so many pixels squared. (Default: 1)
     * - centers
       - |bool|
       - Rays pass the middle of each pixel, as in ``mi-nerf train`` and ``mi-nerf eval``; else
         anywhere in it, as the sampler has it. (Default: true)

    All cameras of a dataset as one sensor, whose film holds their images row by row, in about as
    many rows as columns; places left over in the last row show the first views again. Rays are
    made from a table of camera matrices: a kernel is as small for a hundred views as for one,
    and Mitsuba's ``RayDataLoader``, which otherwise traces every sensor in every step, takes
    them as a single one. In Python, ``images()`` is what such a film should show:
    premultiplied, in the dataset's colour space.

    .. tabs::
        .. code-tab:: xml

            <sensor type="nerfviews">
                <string name="filename" value="lego"/>
            </sensor>

        .. code-tab:: python

            'type': 'nerfviews',
            'filename': 'lego'
    """

    def __init__(self, props: mi.Properties) -> None:
        from ..data import load_dataset  # none of which other scenes need

        path = str(mi.file_resolver().resolve(str(props.get("filename", ""))))
        split, downscale = str(props.get("split", "train")), int(props.get("downscale", 1))
        self.centers = bool(props.get("centers", True))
        self.dataset = load_dataset(path, split, downscale=downscale)
        if self.dataset.ndc is not None:
            raise InputError(
                f"nerfviews: {path} is a forward-facing capture, whose field lives in normalised "
                "device coordinates, expected a dataset without"
            )
        camera = self.dataset.intrinsics
        self._columns = math.isqrt(len(self.dataset) - 1) + 1  # the root, rounded up
        self._rows = -(-len(self.dataset) // self._columns)
        props["film"] = mi.load_dict(
            {
                "type": "hdrfilm",
                "width": camera.width * self._columns,
                "height": camera.height * self._rows,
                "pixel_format": "rgba",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            }
        )
        super().__init__(props)
        self._poses = upload(mi.Float, pack_poses(self.dataset.cam_to_world))

    def images(self) -> mi.TensorXf:
        """The dataset's images, premultiplied, where the film has them: (height, width, 4)."""
        pixels, rows, columns = self.dataset.premultiplied(), self._rows, self._columns
        order = np.arange(rows * columns) % len(pixels)
        height, width, channels = pixels.shape[1:]
        placed = pixels[order].reshape(rows, columns, height, width, channels).swapaxes(1, 2)
        return upload(mi.TensorXf, placed.reshape(rows * height, columns * width, channels))

    def sample_ray_differential(
        self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
    ) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        """Rays through points of the film, from (0, 0) to (1, 1)."""
        camera = self.dataset.intrinsics
        column, x = self._along(sample2.x, self._columns, camera.width)
        row, y = self._along(sample2.y, self._rows, camera.height)
        view = row * dr.opaque(mi.UInt32, self._columns) + column
        view = view % dr.opaque(mi.UInt32, len(self.dataset))
        o, d = pixel_rays(self._poses, camera, view, x, y)
        ray = mi.RayDifferential3f(mi.Point3f(o), mi.Vector3f(d), time)
        spectrum = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), sample1, active)
        ray.wavelengths, weight = spectrum
        return ray, weight

    def _along(self, sample: Any, count: int, size: int) -> tuple[Any, Any]:
        """Along one axis of the film: which of ``count`` images, and where within it."""
        place = sample * dr.opaque(mi.Float, count * size)
        if self.centers:
            place = dr.floor(place) + 0.5
        place = dr.clip(place, 0, dr.opaque(mi.Float, count * size - 0.5))
        number = dr.floor(place * dr.opaque(mi.Float, 1 / size))
        return mi.UInt32(number), place - number * dr.opaque(mi.Float, size)

    def sample_ray(
        self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
    ) -> tuple[mi.Ray3f, mi.Spectrum]:
        """The same without differentials."""
        ray, weight = self.sample_ray_differential(time, sample1, sample2, sample3, active)
        return mi.Ray3f(ray), weight

    def to_string(self) -> str:
        """Lists the settings."""
        data = self.dataset
        return (
            "NerfViews[\n"
            f"  dataset = {data.path}, split = {data.split},\n"
            f"  views = {len(data)}, size = {data.intrinsics.width}x{data.intrinsics.height},\n"
            f"  centers = {self.centers}\n"
            "]"
        )


mi.register_sensor("nerfviews", NerfViews)
