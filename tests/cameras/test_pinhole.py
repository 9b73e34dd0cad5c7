"""Cameras against NumPy oracles and against Mitsuba's own sensor."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mi_nerf.base.errors import InputError
from mi_nerf.cameras import poses as cameras
from mi_nerf.cameras.pinhole import (
    Intrinsics,
    film_directions,
    pack_poses,
    pixel_rays,
    project,
    sensor_dict,
)
from mi_nerf.cameras.poses import look_at
from tests.support.datasets import orbit_poses

CENTERED = Intrinsics.from_angle_x(40, 30, 0.7)
OFF_CENTER = Intrinsics(width=24, height=56, fx=61.0, fy=61.0, cx=3.5, cy=41.25)
STRETCHED = Intrinsics(width=31, height=17, fx=20.0, fy=33.0, cx=18.0, cy=5.0)


@st.composite
def rigid_poses(draw: st.DrawFn) -> np.ndarray:
    """Random rotations (from unit quaternions) and translations, (4, 4)."""
    unit = st.floats(-1, 1)
    q = np.array(draw(st.tuples(unit, unit, unit, unit).filter(lambda q: math.hypot(*q) > 0.1)))
    w, x, y, z = q / np.linalg.norm(q)
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = draw(st.tuples(*[st.floats(-100, 100)] * 3))
    return pose


def slow_rays(
    poses: np.ndarray, intrinsics: Intrinsics, camera: np.ndarray, x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """One ray after another, in double precision."""
    origins, directions = [], []
    for c, px, py in zip(camera, x.astype(float), y.astype(float), strict=True):
        right, down = (px - intrinsics.cx) / intrinsics.fx, (py - intrinsics.cy) / intrinsics.fy
        d = poses[c][:3, :3] @ np.array([right, -down, -1.0])
        origins.append(poses[c][:3, 3])
        directions.append(d / np.linalg.norm(d))
    return np.array(origins), np.array(directions)


def random_pixels(intrinsics: Intrinsics, n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, intrinsics.width, n), rng.uniform(0, intrinsics.height, n)
    return x.astype(np.float32), y.astype(np.float32)


# ---- Axis conventions -------------------------------------------------------

PAIRS = [("opengl", "opencv"), ("opengl", "mitsuba"), ("opencv", "mitsuba")]


@pytest.mark.slow
@pytest.mark.parametrize(("a", "b"), PAIRS + [(b, a) for a, b in PAIRS])
@given(pose=rigid_poses())
def test_conversions_round_trip(a: str, b: str, pose: np.ndarray) -> None:
    there, back = getattr(cameras, f"{b}_from_{a}"), getattr(cameras, f"{a}_from_{b}")
    assert np.array_equal(back(there(pose)), pose)
    # Still rigid, and still in the same place.
    assert np.linalg.det(there(pose)[:3, :3]) == pytest.approx(1)
    assert np.array_equal(there(pose)[:, 3], pose[:, 3])


@given(pose=rigid_poses())
def test_conversions_compose(pose: np.ndarray) -> None:
    via_opengl = cameras.mitsuba_from_opengl(cameras.opengl_from_opencv(pose))
    assert np.array_equal(via_opengl, cameras.mitsuba_from_opencv(pose))


def test_conversions_keep_what_the_camera_sees() -> None:
    opengl = look_at((1, 2, 3), (-2, 0, 1))
    right, up, forward = opengl[:3, 0], opengl[:3, 1], -opengl[:3, 2]
    opencv = cameras.opencv_from_opengl(opengl)
    mitsuba = cameras.mitsuba_from_opengl(opengl)
    assert np.array_equal(opencv[:3, :3].T, [right, -up, forward])
    assert np.array_equal(mitsuba[:3, :3].T, [-right, up, forward])


def test_conversions_are_batched() -> None:
    poses = orbit_poses(6)
    one_by_one = np.stack([cameras.mitsuba_from_opengl(pose) for pose in poses])
    batched = cameras.mitsuba_from_opengl(poses.reshape(2, 3, 4, 4))
    assert np.array_equal(batched.reshape(6, 4, 4), one_by_one)
    with pytest.raises(ValueError, match=r"\(3, 4\)"):
        cameras.mitsuba_from_opengl(poses[0, :3])


# ---- look_at ----------------------------------------------------------------


def test_look_at() -> None:
    pose = look_at((4, 0, 3), (0, 0, 0))
    assert pose[:3, :3].T @ pose[:3, :3] == pytest.approx(np.eye(3), abs=1e-15)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    points = [(0, 0, 0), (0, 0, 0.1), (0, 0.1, 0)]
    pixels, depth = project(points, CENTERED, pose)
    assert pixels[0] == pytest.approx((20, 15))
    assert depth[0] == pytest.approx(5)
    # World z appears upright; seen from +x, world +y is to the right.
    assert pixels[1][0] == pytest.approx(20) and pixels[1][1] < 15
    assert pixels[2][0] > 20 and pixels[2][1] == pytest.approx(15)


@pytest.mark.parametrize(
    ("origin", "target", "up"),
    [
        ((1, 2, 3), (1, 2, 3), (0, 0, 1)),
        ((0, 0, 2), (0, 0, 0), (0, 0, 5)),
        ((1, 2, 3), (0,) * 3, (0,) * 3),
    ],
)
def test_look_at_refuses_what_has_no_answer(origin: Any, target: Any, up: Any) -> None:
    with pytest.raises(InputError, match="look_at"):
        look_at(origin, target, up)


# ---- Intrinsics -------------------------------------------------------------


def test_from_angle_x() -> None:
    camera = Intrinsics.from_angle_x(800, 600, 0.6911112070083618)
    assert camera.fx == camera.fy == pytest.approx(1111.1110311937682)
    assert (camera.cx, camera.cy) == (400, 300)
    assert camera.angle_x == pytest.approx(0.6911112070083618)
    assert camera.fov_x == pytest.approx(math.degrees(0.6911112070083618))
    assert camera.principal_point_offset == (0, 0)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"width": 0}, "width"),
        ({"height": 2.5}, "height"),
        ({"fx": 0.0}, "fx"),
        ({"fy": math.inf}, "fy"),
        ({"fx": -3.0}, "fx"),
        ({"cx": math.nan}, "cx"),
        ({"cy": math.inf}, "cy"),
    ],
)
def test_intrinsics_are_validated(change: dict[str, Any], named: str) -> None:
    good = {"width": 4, "height": 3, "fx": 5.0, "fy": 5.0, "cx": 2.0, "cy": 1.5}
    Intrinsics(**good)
    with pytest.raises(InputError, match=named):
        Intrinsics(**{**good, **change})


@pytest.mark.parametrize("angle", [0.0, -1.0, math.pi, math.nan])
def test_angle_is_validated(angle: float) -> None:
    with pytest.raises(InputError, match="camera_angle_x"):
        Intrinsics.from_angle_x(4, 3, angle)


def test_downscale_crops_the_remainder() -> None:
    small = Intrinsics(width=11, height=8, fx=9.0, fy=6.0, cx=5.5, cy=4.0).downscale(3)
    assert small == Intrinsics(width=3, height=2, fx=3.0, fy=2.0, cx=5.5 / 3, cy=4.0 / 3)
    assert OFF_CENTER.downscale(1) == OFF_CENTER


@pytest.mark.parametrize("k", [0, -2, 25])
def test_downscale_is_validated(k: int) -> None:
    with pytest.raises(InputError, match=f"downscale.* {k}"):
        OFF_CENTER.downscale(k)


# ---- Rays -------------------------------------------------------------------


@pytest.mark.parametrize("intrinsics", [CENTERED, OFF_CENTER, STRETCHED])
@pytest.mark.parametrize(("precision", "tolerance"), [("32", 1e-6), ("64", 1e-14)])
def test_pixel_rays_against_slow_rays(
    ad: Any, intrinsics: Intrinsics, precision: str, tolerance: float
) -> None:
    poses = orbit_poses(7).astype(np.float32).astype(np.float64)
    x, y = random_pixels(intrinsics, 50)
    camera = np.random.default_rng(1).integers(0, 7, 50).astype(np.uint32)
    Float = getattr(ad, "Float" + precision)
    o, d = pixel_rays(Float(pack_poses(poses)), intrinsics, ad.UInt32(camera), Float(x), Float(y))
    assert type(d) is (ad.Array3f64 if precision == "64" else ad.Array3f)
    slow_o, slow_d = slow_rays(poses, intrinsics, camera, x, y)
    assert np.asarray(o).T == pytest.approx(slow_o, abs=tolerance)
    assert np.asarray(d).T == pytest.approx(slow_d, abs=tolerance)
    assert np.asarray(dr.norm(d)) == pytest.approx(np.ones(50), abs=tolerance)


def test_one_camera_for_all_rays(ad: Any) -> None:
    poses = orbit_poses(3)
    x, y = random_pixels(CENTERED, 5)
    o, d = pixel_rays(ad.Float(pack_poses(poses)), CENTERED, ad.UInt32(2), ad.Float(x), ad.Float(y))
    slow_o, slow_d = slow_rays(poses, CENTERED, np.full(5, 2), x, y)
    assert np.asarray(o).T == pytest.approx(np.broadcast_to(slow_o[0], np.asarray(o).T.shape))
    assert np.asarray(d).T == pytest.approx(slow_d, abs=1e-6)


@settings(max_examples=30)
@given(pose=rigid_poses(), seed=st.integers(0, 1000), distance=st.floats(0.1, 100))
def test_project_inverts_slow_rays(pose: np.ndarray, seed: int, distance: float) -> None:
    for intrinsics in (CENTERED, OFF_CENTER, STRETCHED):
        x, y = random_pixels(intrinsics, 4, seed)
        o, d = slow_rays(pose[None], intrinsics, np.zeros(4, int), x, y)
        pixels, depth = project(o + distance * d, intrinsics, pose)
        assert pixels == pytest.approx(np.stack([x, y], -1), rel=1e-9, abs=1e-9)
        assert depth == pytest.approx(distance * (d @ -pose[:3, 2]))


def test_points_behind_the_camera_have_negative_depth() -> None:
    _, depth = project([(6, 0, 0), (4, 0, 0), (0, 0, 0)], CENTERED, look_at((4, 0, 0), (0, 0, 0)))
    assert depth == pytest.approx([-2, 0, 4])


@pytest.mark.parametrize("k", [2, 3, 7])
@pytest.mark.parametrize("intrinsics", [CENTERED, OFF_CENTER, STRETCHED])
def test_downscaled_pixels_have_the_rays_of_their_blocks(
    ad: Any, intrinsics: Intrinsics, k: int
) -> None:
    small = intrinsics.downscale(k)
    poses = ad.Float64(pack_poses(orbit_poses(1)))
    row, column = np.mgrid[: small.height, : small.width].reshape(2, -1)
    x, y = ad.Float64(column + 0.5), ad.Float64(row + 0.5)
    _, d_small = pixel_rays(poses, small, ad.UInt32(0), x, y)
    _, d_full = pixel_rays(poses, intrinsics, ad.UInt32(0), k * x, k * y)
    assert np.asarray(d_small) == pytest.approx(np.asarray(d_full), abs=1e-14)


def test_gradients_reach_the_poses(ad: Any) -> None:
    poses = ad.Float(pack_poses(orbit_poses(2)))
    dr.enable_grad(poses)
    o, _ = pixel_rays(poses, CENTERED, ad.UInt32([1, 1]), ad.Float([3, 4]), ad.Float([5, 6]))
    dr.backward(o.x)
    expected = np.zeros(24)
    expected[12 + 3] = 2
    assert np.array_equal(dr.grad(poses), expected)


def test_another_camera_reuses_the_kernel(ad: Any) -> None:
    def kernels(intrinsics: Intrinsics) -> list[str]:
        # Made by Dr.Jit: it borrows the memory of NumPy arrays, and compiles
        # different kernels for aligned and unaligned memory.
        x = dr.linspace(ad.Float, 0, intrinsics.width, 64)
        y = dr.linspace(ad.Float, 0, intrinsics.height, 64)
        poses, camera = ad.Float(pack_poses(orbit_poses(3))), dr.zeros(ad.UInt32, 64)
        dr.make_opaque(x, y, poses, camera)
        dr.kernel_history_clear()
        dr.eval(pixel_rays(poses, intrinsics, camera, x, y))
        return [str(entry["hash"]) for entry in dr.kernel_history([dr.KernelType.JIT])]

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        first = kernels(CENTERED)
        assert len(first) == 1
        assert kernels(OFF_CENTER) == first
        assert kernels(STRETCHED) == first


def test_pack_poses() -> None:
    poses = np.arange(32.0).reshape(2, 4, 4)
    packed = pack_poses(poses)
    assert packed.dtype == np.float32
    assert packed.tolist() == [*range(12), *range(16, 28)]
    for wrong in (poses[0], poses[:, :3]):
        with pytest.raises(ValueError, match=r"\(N, 4, 4\)"):
            pack_poses(wrong)


# ---- Against Mitsuba --------------------------------------------------------


@pytest.fixture(scope="module")
def mi() -> Any:
    if not dr.has_backend(dr.JitBackend.LLVM):
        pytest.skip("no LLVM on this machine")
    mitsuba = pytest.importorskip("mitsuba")
    before = mitsuba.variant()
    mitsuba.set_variant("llvm_ad_rgb")
    yield mitsuba
    if before is not None:
        mitsuba.set_variant(before)


@pytest.mark.parametrize("intrinsics", [CENTERED, OFF_CENTER])
def test_rays_agree_with_mitsuba(mi: Any, intrinsics: Intrinsics) -> None:
    pose = look_at((3, -1, 2), (0.2, 0.1, -0.3))
    x, y = (mi.Float(values) for values in random_pixels(intrinsics, 100))
    o, d = pixel_rays(mi.Float(pack_poses(pose[None])), intrinsics, mi.UInt32(0), x, y)

    sensor = mi.load_dict(sensor_dict(intrinsics, pose))
    film_position = mi.Point2f(x / intrinsics.width, y / intrinsics.height)
    ray, _ = sensor.sample_ray(0, 0, film_position, mi.Point2f(0.5))
    assert np.asarray(ray.d) == pytest.approx(np.asarray(d), abs=2e-6)
    # Mitsuba's rays start on the near plane: at a distance, but on ours.
    distance = dr.norm(ray.o - o)
    assert np.asarray(ray.o) == pytest.approx(np.asarray(o + distance * d), abs=1e-6)


@pytest.mark.parametrize("intrinsics", [CENTERED, OFF_CENTER])
def test_projection_agrees_with_mitsuba(mi: Any, intrinsics: Intrinsics) -> None:
    pose = look_at((3, -1, 2), (0.2, 0.1, -0.3))
    x, y = random_pixels(intrinsics, 100)
    o, d = slow_rays(pose[None], intrinsics, np.zeros(100, int), x, y)
    points = o + np.random.default_rng(2).uniform(1, 10, (100, 1)) * d

    sensor = mi.load_dict(sensor_dict(intrinsics, pose))
    interaction = dr.zeros(mi.Interaction3f, 100)
    interaction.p = mi.Point3f(points.T.astype(np.float32))
    sample, _ = sensor.sample_direction(interaction, mi.Point2f(0.5))
    pixels, _ = project(points, intrinsics, pose)
    assert np.asarray(sample.uv).T == pytest.approx(pixels, abs=1e-3)


@pytest.mark.parametrize("intrinsics", [CENTERED, OFF_CENTER])
def test_rendered_ball_is_where_it_should_be(mi: Any, intrinsics: Intrinsics) -> None:
    pose = look_at((3, -1, 2), (0.2, 0.1, -0.3))
    target = np.array([intrinsics.width * 0.7, intrinsics.height * 0.2])
    (origin,), (direction,) = slow_rays(pose[None], intrinsics, np.zeros(1, int), *target[:, None])
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct"},
            "sensor": sensor_dict(intrinsics, pose, spp=64),
            "ball": {
                "type": "sphere",
                "center": list(origin + 5 * direction),
                "radius": 0.15,
                "emitter": {"type": "area"},
            },
        }
    )
    image = np.asarray(mi.render(scene))
    assert image.shape == (intrinsics.height, intrinsics.width, 4)
    rows, columns = np.mgrid[: intrinsics.height, : intrinsics.width] + 0.5
    weight = image[..., 3] / image[..., 3].sum()
    centroid = (weight * columns).sum(), (weight * rows).sum()
    assert centroid == pytest.approx(target, abs=0.1)


def test_sensor_dict_settings(mi: Any) -> None:
    settings = sensor_dict(OFF_CENTER, np.eye(4), spp=7, pixel_format="rgb", rfilter="gaussian")
    sensor = mi.load_dict(settings)
    assert list(sensor.film().size()) == [24, 56]
    assert sensor.sampler().sample_count() == 7
    assert "Gaussian" in str(sensor.film().rfilter())


def test_sensor_dict_wants_square_pixels(mi: Any) -> None:
    with pytest.raises(InputError, match=r"fx = 20 and fy = 33"):
        sensor_dict(STRETCHED, np.eye(4))


def test_film_directions_invert_projection() -> None:
    camera = Intrinsics(40, 30, 51.0, 47.0, 18.5, 16.0)
    x, y = np.random.default_rng(0).uniform(0, 40, (2, 50))
    directions = film_directions(x, y, camera)
    assert (directions[:, 2] == -1).all()
    found, depth = project(3 * directions, camera, np.eye(4))
    np.testing.assert_allclose(found, np.stack([x, y], axis=1), rtol=1e-12)
    np.testing.assert_allclose(depth, 3)
