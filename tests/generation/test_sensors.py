"""A scene's own sensors as cameras: rays against those that Mitsuba's sensors shoot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.base.variants import choose_variant
from mi_nerf.cameras.pinhole import Intrinsics
from mi_nerf.cameras.poses import is_rigid
from mi_nerf.generation.sensors import Lens, SensorCamera, camera_dict, in_size, read_sensors
from mi_nerf.scene_xml.scene_file import SceneFile
from mi_nerf.scene_xml.sensors import separate_sensors

LOOKAT = '<lookat origin="3, -4, 3" target="0.1, 0, 0" up="0, 0.2, 1"/>'


def sensor_xml(
    kind: str = "perspective",
    more: str = "",
    film: str = "",
    before: str = "",
    size: Any = (64, 48),
) -> str:
    return f"""<scene version="3.0.0"><shape type="sphere"/>
    <sensor type="{kind}" id="it">{more}
        <transform name="to_world">{before}{LOOKAT}</transform>
        <film type="hdrfilm"><integer name="width" value="{size[0]}"/>
            <integer name="height" value="{size[1]}"/>{film}</film>
    </sensor></scene>"""


def load(folder: Path, text: str) -> tuple[Any, list[SensorCamera]]:
    mi.set_variant(choose_variant())
    path = folder / "scene.xml"
    path.write_text(text)
    file = SceneFile(path)
    separate_sensors(file.state)
    scene = file.load()
    return scene, read_sensors(scene)


def film_points(count: int = 40) -> np.ndarray:
    """Points of the film in [0, 1]², (count, 2)."""
    return np.random.default_rng(0).random((count, 2))


def mitsuba_rays(sensor: Any, points: np.ndarray) -> np.ndarray:
    """Directions through points of the film, by the middle of the lens, (N, 3)."""
    x, y = (mi.Float(v.astype(np.float32)) for v in points.T)
    middle = mi.Point2f(0.5, 0.5) + dr.zeros(mi.Point2f, len(points))
    ray, _ = sensor.sample_ray(mi.Float(0), mi.Float(0.5), mi.Point2f(x, y), middle)
    return np.array(ray.d).T


def our_rays(camera: Intrinsics, pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The same by the pinhole's formula in float64."""
    x, y = points[:, 0] * camera.width, points[:, 1] * camera.height
    local = [(x - camera.cx) / camera.fx, (camera.cy - y) / camera.fy, -np.ones_like(x)]
    d = np.stack(local, -1) @ pose[:3, :3].T
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


FOV = '<float name="fov" value="{0}"/><string name="fov_axis" value="{1}"/>'
CROP = (
    '<integer name="crop_offset_x" value="16"/><integer name="crop_offset_y" value="5"/>'
    '<integer name="crop_width" value="32"/><integer name="crop_height" value="20"/>'
)
SHIFT = (
    '<float name="principal_point_offset_x" value="0.15"/>'
    '<float name="principal_point_offset_y" value="-0.08"/>'
)


@pytest.mark.parametrize("size", [(64, 48), (40, 90)])
@pytest.mark.parametrize("axis", ["x", "y", "smaller", "larger", "diagonal"])
def test_field_of_view(tmp_path: Path, axis: str, size: tuple[int, int]) -> None:
    scene, (camera,) = load(tmp_path, sensor_xml(more=FOV.format(50, axis), size=size))
    assert (camera.intrinsics.width, camera.intrinsics.height) == size
    points = film_points()
    expected = mitsuba_rays(scene.sensors()[0], points)
    assert our_rays(camera.intrinsics, camera.pose, points) == pytest.approx(expected, abs=2e-6)


@pytest.mark.parametrize("kind", ["perspective", "thinlens"])
@pytest.mark.parametrize("crop", ["", CROP])
@pytest.mark.parametrize("shift", ["", SHIFT])
def test_windows_shifts_and_lenses(tmp_path: Path, kind: str, crop: str, shift: str) -> None:
    lens = kind == "thinlens"
    if lens and shift:
        pytest.skip("Mitsuba's lenses know no shift")
    more = '<float name="aperture_radius" value="0.3"/><float name="focus_distance" value="5"/>'
    more = shift + (more if lens else "") + '<float name="fov" value="45"/>'
    scene, (camera,) = load(tmp_path, sensor_xml(kind, more, crop))
    points = film_points()
    expected = mitsuba_rays(scene.sensors()[0], points)
    assert our_rays(camera.intrinsics, camera.pose, points) == pytest.approx(expected, abs=2e-6)
    assert camera.cropped == bool(crop) and camera.name == "sensor 'it'"
    assert camera.lens == (Lens(pytest.approx(0.3), 5) if lens else None)
    # And back: the sensor that renders it shoots the same rays.
    sensor = mi.load_dict(camera_dict(camera.intrinsics, camera.lens, (0.01, 100)))
    assert list(sensor.film().crop_size()) == [camera.intrinsics.width, camera.intrinsics.height]
    back = mitsuba_rays(sensor, points) @ camera.pose[:3, :3].T
    assert back == pytest.approx(expected, abs=2e-6)


def test_what_a_lens_blurs(tmp_path: Path) -> None:
    """Rays through other points of the lens meet those through its middle where it is sharp."""
    more = '<float name="aperture_radius" value="0.3"/><float name="focus_distance" value="5"/>'
    _, (camera,) = load(tmp_path, sensor_xml("thinlens", more, CROP))
    sensor = mi.load_dict(camera_dict(camera.intrinsics, camera.lens, (0.01, 100)))
    random = np.random.default_rng(1)
    x, y, u, v = (mi.Float(random.random(50).astype(np.float32)) for _ in range(4))
    ray, _ = sensor.sample_ray(mi.Float(0), mi.Float(0.5), mi.Point2f(x, y), mi.Point2f(u, v))
    o, d = np.array(ray.o).T, np.array(ray.d).T
    at_focus = o + d * ((-5 - o[:, 2]) / d[:, 2])[:, None]
    straight = our_rays(camera.intrinsics, np.eye(4), np.stack([x, y], -1))
    assert at_focus == pytest.approx(-5 * straight / straight[:, 2:], abs=2e-5)
    at_lens = o - d * (o[:, 2] / d[:, 2])[:, None]
    radius = np.linalg.norm(at_lens[:, :2], axis=1)
    assert radius.max() <= 0.3001 and radius.max() > 0.25


@pytest.mark.parametrize("crop", ["", CROP])
@pytest.mark.parametrize("before", ['<scale x="-1"/>', '<scale y="-1"/>', '<scale x="-2" z="2"/>'])
def test_mirrored_sensors_become_cameras(tmp_path: Path, before: str, crop: str) -> None:
    """The same rays, in pictures that are turned round."""
    more = '<float name="fov" value="45"/>' + SHIFT
    scene, (camera,) = load(tmp_path, sensor_xml(more=more, film=crop, before=before))
    assert camera.mirrored and is_rigid(camera.pose)
    points = film_points()
    turned = np.array([1, 0]) + points * [-1, 1]
    expected = mitsuba_rays(scene.sensors()[0], turned)
    assert our_rays(camera.intrinsics, camera.pose, points) == pytest.approx(expected, abs=2e-6)


def test_what_is_no_camera(tmp_path: Path) -> None:
    _, (camera,) = load(tmp_path, sensor_xml("orthographic"))
    assert camera.kind == "OrthographicCamera" and is_rigid(camera.pose)
    assert camera.pose[:3, 3] == pytest.approx([3, -4, 3])
    text = sensor_xml("perspective").replace(
        "</scene>",
        '<sensor type="radiancemeter">'
        '<film type="hdrfilm"><integer name="width" value="1"/><integer name="height" value="1"/>'
        '<rfilter type="box"/></film></sensor></scene>',
    )
    _, (camera,) = load(tmp_path, text)
    assert camera.kind is None


def test_other_sizes_of_a_picture(tmp_path: Path) -> None:
    _, (camera,) = load(tmp_path, sensor_xml(film=CROP, more=SHIFT))
    points = film_points()
    expected = our_rays(camera.intrinsics, camera.pose, points)
    assert in_size(camera, None) == in_size(camera, (32, 20)) == camera.intrinsics
    for size in ((64, 40), (160, 100), (8, 5)):
        film = in_size(camera, size)
        assert (film.width, film.height) == size
        assert our_rays(film, camera.pose, points) == pytest.approx(expected, abs=1e-9)
    film = in_size(camera, (33, 21))  # rounded: square pixels, the width is kept
    assert film.fx == film.fy
    with pytest.raises(InputError, match="32x20, expected a size of the same shape, such as 64 40"):
        in_size(camera, (64, 64))


def test_how_much_of_the_frame_a_box_spans() -> None:
    pose = np.eye(4)
    pose[2, 3] = 10
    film = Intrinsics.from_angle_x(200, 100, 2 * np.arctan(0.5))  # 10 wide and 5 high at 10
    camera = SensorCamera("it", None, pose, film, None, 1.0, False, False)
    low, high = np.array([-0.5, -0.5, -0.001]), np.array([0.5, 0.5, 0.001])
    assert camera.share_of_frame(low, high) == pytest.approx(1 / 5, rel=1e-3)
    assert camera.share_of_frame(low + [0, 0, 20], high + [0, 0, 20]) is None  # behind
    assert camera.share_of_frame(low + [9, 0, 0], high + [9, 0, 0]) is None  # beside
    assert camera.share_of_frame(np.full(3, -20.0), np.full(3, 20.0)) == 1.0  # around
