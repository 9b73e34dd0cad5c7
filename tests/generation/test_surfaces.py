"""Depth, normals and coverage against closed forms, from 1e-4 to 1e5 units and away from 0."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mi_nerf.base.variants import choose_variant
from mi_nerf.cameras.pinhole import Intrinsics
from mi_nerf.cameras.poses import look_at
from mi_nerf.generation.emitters import Hidden
from mi_nerf.generation.surfaces import coverage, trace_surfaces

SCALES = (1e-4, 1e-2, 1.0, 1e3, 1e5)
OFFSETS = (0.0, 10.0, 1000.0)  # in sizes of the scene
CAMERA = Intrinsics(48, 40, 60.0, 60.0, 24.0, 20.0)
DIFFUSE = {"type": "twosided", "bsdf": {"type": "diffuse"}}


@pytest.fixture(autouse=True)
def variant() -> None:
    mi.set_variant(choose_variant())


def pose_of(scale: float, center: np.ndarray) -> np.ndarray:
    """A camera 4 sizes away, as single precision holds it."""
    pose = look_at(center + scale * np.array([2.0, -2.8, 2.0]), center, np.array([0.0, 0.0, 1.0]))
    return pose.astype(np.float32).astype(np.float64)


def rays(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The origin and unit directions through the pixels' centres."""
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width] + 0.5
    right, up = (x - CAMERA.cx) / CAMERA.fx, (CAMERA.cy - y) / CAMERA.fy
    local = np.stack([right, up, -np.ones_like(x)], axis=-1)
    d = local @ pose[:3, :3].T
    return pose[:3, 3], d / np.linalg.norm(d, axis=-1, keepdims=True)


def sphere_hit(o: np.ndarray, d: np.ndarray, center: np.ndarray, radius: float) -> np.ndarray:
    """Distance to a sphere, NaN beside it."""
    b = d @ (o - center)
    inside = b * b - ((o - center) @ (o - center) - radius**2)
    return np.where(inside > 0, -b - np.sqrt(np.maximum(inside, 0)), np.nan)


def floor_hit(o: np.ndarray, d: np.ndarray, center: np.ndarray, scale: float) -> np.ndarray:
    """Distance to a square of 1.8 sizes, half a size below the centre; NaN beside it."""
    t = (center[2] - 0.5 * scale - o[2]) / d[..., 2]
    p = o + t[..., None] * d - center
    return np.where((np.abs(p[..., :2]) < 0.9 * scale).all(-1) & (t > 0), t, np.nan)


def moved(scale: float, center: np.ndarray, z: float, half: float) -> Any:
    place = mi.ScalarTransform4f().translate(center + np.array([0, 0, z * scale]))
    return place @ mi.ScalarTransform4f().scale([half * scale] * 3)


def scene_of(scale: float, center: np.ndarray, **more: Any) -> Any:
    ball = {"type": "sphere", "radius": 0.5 * scale, "center": center.tolist(), "bsdf": DIFFUSE}
    floor = {"type": "rectangle", "to_world": moved(scale, center, -0.5, 0.9), "bsdf": DIFFUSE}
    return mi.load_dict({"type": "scene", "ball": ball, "floor": floor, **more})


def tolerance(scale: float, center: np.ndarray) -> float:
    """What single precision can hold: of the way, and of places."""
    return 4e-6 * scale + 8 * float(np.spacing(np.float32(np.abs(center).max() + 4 * scale)))


def check(scene: Any, scale: float, center: np.ndarray, hide: bool | Hidden = True) -> None:
    """The ball on its floor, whatever stands before them and is not there for the camera."""
    pose = pose_of(scale, center)
    o, d = rays(pose)
    depth, normal = trace_surfaces(scene, CAMERA, pose, hide_emitters=hide)
    depth = depth[..., 0].astype(np.float64)
    ball, floor = sphere_hit(o, d, center, 0.5 * scale), floor_hit(o, d, center, scale)
    expected = np.fmin(ball, floor)
    # Not where a ray of another rounding may miss: within a hundredth of an outline.
    b = d @ (o - center)
    miss = np.sqrt((o - center) @ (o - center) - b * b)
    wider = floor_hit(o, d, center, scale * 1.01)
    clear = np.abs(miss - 0.5 * scale) > 0.02 * scale
    clear &= np.isnan(floor) == np.isnan(wider)
    on_ball = clear & ~np.isnan(ball) & ~(floor < ball)
    on_floor = clear & ~np.isnan(floor) & ~on_ball
    assert on_ball.sum() > 80 and on_floor.sum() > 80
    assert (depth[clear & np.isnan(expected)] == 0).all()
    hit = clear & ~np.isnan(expected)
    assert np.abs(depth - expected)[hit].max() <= tolerance(scale, center)
    points = (o + expected[..., None] * d - center) / (0.5 * scale)
    slack = 20 * tolerance(scale, center) / scale
    assert np.abs(normal[on_ball] - points[on_ball]).max() <= slack
    assert np.abs(normal[on_floor] - [0, 0, 1]).max() <= 1e-5


def places() -> list[Any]:
    """Scales and offsets, of which a few are enough to be quick."""
    quick = ((1e-4, 0.0), (1e5, 10.0))
    return [
        pytest.param(s, o, marks=[] if (s, o) in quick else pytest.mark.slow)
        for s in SCALES
        for o in OFFSETS
    ]


def centre(scale: float, offset: float) -> np.ndarray:
    center = scale * offset * np.array([1.0, -0.7, 0.4])
    return center.astype(np.float32).astype(np.float64)


@pytest.mark.parametrize(("scale", "offset"), places())
def test_a_ball_on_a_floor(scale: float, offset: float) -> None:
    center = centre(scale, offset)
    check(scene_of(scale, center), scale, center)


@pytest.mark.parametrize(("scale", "offset"), places())
def test_through_boundaries_close_to_the_surface(scale: float, offset: float) -> None:
    """Three thin shells of nothing around the ball, a lamp before all, and layers on the floor."""
    center = centre(scale, offset)
    null = {"type": "null"}
    gap = 1e-3 + 30 * float(np.spacing(np.float32(scale * (offset + 4)))) / scale
    shells = {
        f"shell_{i}": {
            "type": "sphere",
            "radius": scale * (0.5 + (i + 1) * gap),
            "center": center.tolist(),
            "bsdf": null,
        }
        for i in range(3)
    }
    layers = {
        f"layer_{i}": {
            "type": "rectangle",
            "to_world": moved(scale, center, -0.5 + (i + 1) * gap, 0.9),
            "bsdf": null,
        }
        for i in range(8)
    }
    lamp = {
        "type": "sphere",
        "radius": 0.4 * scale,
        "center": (center + scale * np.array([1.0, -1.4, 1.0])).tolist(),
        "emitter": {"type": "area"},
    }
    check(scene_of(scale, center, **shells, **layers, lamp=lamp), scale, center)


@pytest.mark.slow
@pytest.mark.parametrize("scale", SCALES)
def test_glass_is_a_surface(scale: float) -> None:
    """The outer of two nested spheres of glass."""
    center = np.zeros(3)
    inner = {"type": "sphere", "radius": 0.3 * scale, "bsdf": {"type": "dielectric"}}
    scene = mi.load_dict(
        {
            "type": "scene",
            "inner": inner,
            "outer": {**inner, "radius": 0.5 * scale},
            "floor": {
                "type": "rectangle",
                "to_world": moved(scale, center, -0.5, 0.9),
                "bsdf": DIFFUSE,
            },
        }
    )
    check(scene, scale, center)


def test_what_is_no_number_is_nothing() -> None:
    mesh = mi.Mesh("bad", 3, 1)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = [0.0, 0.0, 0.0, float("nan"), 0.0, 0.0, 0.0, 1.0, 0.0]
    parameters["faces"] = [0, 1, 2]
    parameters.update()
    scene = scene_of(1.0, np.zeros(3), bad=mesh)
    depth, normal = trace_surfaces(scene, CAMERA, pose_of(1.0, np.zeros(3)), hide_emitters=True)
    assert np.isfinite(depth).all() and np.isfinite(normal).all()
    assert (depth > 0).sum() > 100


# ---- Coverage ----------------------------------------------------------------


def cover(scene: Any, hidden: Hidden, scale: float, center: np.ndarray) -> np.ndarray:
    o, d = rays(pose_of(scale, center))
    ray = mi.Ray3f(mi.Point3f(o.tolist()), mi.Vector3f(d.reshape(-1, 3).T.astype(np.float32)))
    alpha = np.array(coverage(scene, ray, mi.Bool(True), hidden))
    return np.broadcast_to(alpha, d[..., 0].size).reshape(d.shape[:2])


@pytest.mark.parametrize(("scale", "offset"), places())
def test_coverage_of_veils(scale: float, offset: float) -> None:
    """Two square veils of 30 %: what passes is a product, and no veil counts twice."""
    center = centre(scale, offset)
    veil = {"type": "mask", "opacity": 0.3, "bsdf": DIFFUSE}
    scene = mi.load_dict(
        {
            "type": "scene",
            **{
                f"veil_{i}": {
                    "type": "rectangle",
                    "to_world": moved(scale, center, -0.5 - i * 0.25, 0.9),
                    "bsdf": veil,
                }
                for i in range(2)
            },
            "boundary": {
                "type": "cube",
                "to_world": moved(scale, center, 0.0, 1.0),
                "bsdf": {"type": "null"},
            },
        }
    )
    alpha = cover(scene, Hidden(scene, True), scale, center)
    values = np.array([0.0, 0.3, 0.51])
    nearest = np.abs(alpha[..., None] - values).argmin(-1)
    assert np.abs(alpha - values[nearest]).max() < 1e-5
    assert (np.bincount(nearest.ravel(), minlength=3) > 30).all()
    o, d = rays(pose_of(scale, center))
    first = ~np.isnan(floor_hit(o, d, center, scale * 0.99))
    assert (alpha[first] > 0.29).all()


def test_the_sky_covers_what_it_is_seen_through() -> None:
    sky = {"type": "constant"}
    scene = scene_of(1.0, np.zeros(3), sky=sky)
    assert (cover(scene, Hidden(scene, False), 1.0, np.zeros(3)) == 1).all()
    hidden = cover(scene, Hidden(scene, True), 1.0, np.zeros(3))
    assert 0.2 < hidden.mean() < 0.9 and set(np.unique(hidden)) == {0.0, 1.0}


def test_lamps_that_are_kept_and_others() -> None:
    center = np.zeros(3)
    lamps = {
        name: {
            "type": "sphere",
            "id": name,
            "radius": 0.2,
            "center": place,
            "emitter": {"type": "area", "id": f"light_of_{name}"},
        }
        for name, place in (("left", [-0.8, -0.8, 0.5]), ("right", [0.8, 0.8, 0.5]))
    }
    scene = scene_of(1.0, center, **lamps)
    pose = pose_of(1.0, center)
    o, d = rays(pose)
    left = sphere_hit(o, d, np.array([-0.8, -0.8, 0.5]), 0.2)
    for keep in (("left",), ("light_of_left",)):
        hidden = Hidden(scene, True, keep)
        depth, _ = trace_surfaces(scene, CAMERA, pose, hide_emitters=hidden)
        seen = ~np.isnan(left)
        assert seen.sum() > 20
        assert np.abs(depth[..., 0] - left)[seen].max() < 1e-5
        assert (cover(scene, hidden, 1.0, center)[seen] == 1).all()
    nothing, _ = trace_surfaces(scene, CAMERA, pose, hide_emitters=True)
    both, _ = trace_surfaces(scene, CAMERA, pose, hide_emitters=Hidden(scene, True, ["all"]))
    assert ((nothing != both)[..., 0] & seen).sum() > 0
    elsewhere = np.isnan(left)
    assert (depth[elsewhere] == nothing[elsewhere]).all()
