"""The ``nerfviews`` sensor: all views of a dataset as one film."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

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

    All N cameras of a dataset as one sensor, whose film holds their W×H images one below the
    other, W×(N·H) pixels. Rays are made from a table of camera matrices: a kernel is as small
    for a hundred views as for one, and :monosp:`mi.ad.loaders.RayDataLoader`, which otherwise traces
    every sensor in every step, takes them as a single one. In Python, ``images()`` holds what
    such a film should show: premultiplied, in the dataset's colour space.

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
        self.dataset = load_dataset(path, split, downscale=downscale)
        if self.dataset.ndc is not None:
            raise InputError(
                f"nerfviews: {path} is a forward-facing capture, whose field lives in normalised "
                "device coordinates, expected a dataset without"
            )
        camera = self.dataset.intrinsics
        props["film"] = mi.load_dict(
            {
                "type": "hdrfilm",
                "width": camera.width,
                "height": camera.height * len(self.dataset),
                "pixel_format": "rgba",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            }
        )
        super().__init__(props)
        self._poses = upload(mi.Float, pack_poses(self.dataset.cam_to_world))

    def images(self) -> mi.TensorXf:
        """(N·H, W, 4): the dataset's images, premultiplied, one below the other."""
        pixels = self.dataset.premultiplied()
        views, height, width, channels = pixels.shape
        return upload(mi.TensorXf, pixels.reshape(views * height, width, channels))

    def sample_ray_differential(
        self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
    ) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        """Rays through points of the film, from (0, 0) to (1, 1)."""
        camera, views = self.dataset.intrinsics, len(self.dataset)
        height = dr.opaque(mi.Float, camera.height)
        y = sample2.y * dr.opaque(mi.Float, camera.height * views)
        view = dr.clip(dr.floor(y / height), 0, dr.opaque(mi.Float, views - 1))
        x = sample2.x * dr.opaque(mi.Float, camera.width)
        o, d = pixel_rays(self._poses, camera, mi.UInt32(view), x, y - view * height)
        ray = mi.RayDifferential3f(mi.Point3f(o), mi.Vector3f(d), time)
        spectrum = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), sample1, active)
        ray.wavelengths, weight = spectrum
        return ray, weight

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
            f"  views = {len(data)}, size = {data.intrinsics.width}x{data.intrinsics.height}\n"
            "]"
        )


mi.register_sensor("nerfviews", NerfViews)
