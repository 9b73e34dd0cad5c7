"""Light paths through fields: integrator nerf_path against known answers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mi_nerf
from tests.support.composed import (
    GLOW,
    boxes_seen,
    camera_rays,
    distance_to_wall,
    lamp,
    matrix_of,
    nerf,
    place,
    render,
    rgb,
    scene_of,
    sky,
    slab,
    slab_interval,
    wall,
)
from tests.support.fields import formula_dict, small_file

pytestmark = pytest.mark.usefixtures("variant")


def paths(**options: Any) -> dict[str, Any]:
    """The integrator."""
    return {"type": "nerf_path", **options}


def statistics(scene: dict[str, Any], spp: int, runs: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """The mean of independent renderings, and its standard error."""
    loaded = mi.load_dict(scene)
    images = np.stack([render(loaded, spp=spp, seed=i) for i in range(runs)])
    return images.mean(axis=0), images.std(axis=0, ddof=1) / np.sqrt(runs)


def agree(
    first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray], floor: float = 1e-3
) -> None:
    """A Z-test of every pixel, and of the mean over all; ``floor`` is an error of its own."""
    z = (first[0] - second[0]) / np.sqrt(first[1] ** 2 + second[1] ** 2 + floor**2)
    assert np.abs(z).max() < 6 and z.std() < 1.5
    error = np.sqrt(np.mean(first[1] ** 2 + second[1] ** 2) / z.size)
    assert abs(first[0].mean() - second[0].mean()) < 5 * error + floor


def floor(reflectance: Any = (0.6, 0.5, 0.4), z: float = -1.0, half: float = 5.0) -> dict[str, Any]:
    return {
        "type": "rectangle",
        "to_world": place().translate([0, 0, z]).scale(half),
        "bsdf": {"type": "diffuse", "reflectance": rgb(reflectance)},
    }


def overhead(radiance: Any, z: float = 3.0, half: float = 0.7) -> dict[str, Any]:
    """A lamp that shines down."""
    return {
        "type": "rectangle",
        "to_world": place().translate([0.3, 0, z]).rotate([1, 0, 0], 180).scale(half),
        "emitter": {"type": "area", "radiance": rgb(radiance)},
    }


def room() -> dict[str, dict[str, Any]]:
    """Matt, glossy, glass, mirror, a lamp and a sky."""
    return {
        "floor": floor(),
        "wall": wall(2.5),
        "glass": {
            "type": "sphere",
            "center": [0.9, -0.6, -0.4],
            "radius": 0.4,
            "bsdf": {"type": "dielectric"},
        },
        "metal": {
            "type": "sphere",
            "center": [-1.0, 0, -0.3],
            "radius": 0.5,
            "bsdf": {"type": "roughconductor", "alpha": 0.2},
        },
        "lamp": overhead((9, 8, 7)),
        "sky": {"type": "constant", "radiance": 0.3},
    }


# ---- Without anything to see ----------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {"max_depth": 1},
        {"max_depth": 2},
        {"max_depth": 5},
        {"rr_depth": 1},
        {"hide_emitters": True, "max_depth": 3},
    ],
)
def test_without_fields_it_is_a_path_tracer(options: dict[str, Any]) -> None:
    """Also with one of nothing, and with Russian roulette from the first surface on."""
    expected = statistics(scene_of({"type": "path", **options}, **room()), 64)
    for fields in ({}, {"nothing": slab(place().scale(0.7), 0.0, GLOW)}):
        seen = statistics(scene_of(paths(**options), **room(), **fields), 64)
        agree(seen, expected)
        np.testing.assert_allclose(seen[0][..., 3], expected[0][..., 3], atol=1e-6)


@pytest.mark.parametrize("sampler", ["independent", "stratified", "multijitter"])
def test_without_surfaces_it_shows_what_nerf_shows(sampler: str) -> None:
    objects = {"field": formula_dict("gaussian"), "other": slab(place().scale(0.5), 0.4, GLOW)}
    images = []
    for integrator in (paths(), nerf(None)):
        scene = scene_of(integrator, spp=4, **objects)
        scene["sensor"]["sampler"]["type"] = sampler
        images.append(render(scene))
    np.testing.assert_allclose(images[0], images[1], atol=1e-6)
    assert images[0].max() > 0.5


def test_depth_zero_shows_nothing() -> None:
    image = render(scene_of(paths(max_depth=0), field=slab(place(), 1.0, GLOW), sky=sky()))
    assert image[..., :3].max() == 0


@pytest.mark.slow
@pytest.mark.parametrize("y", [-3.0, 0.3, 3.0])
def test_depth_one_shows_what_emits(y: float) -> None:
    """Fields and the lamp behind them, as the integrator nerf shows them; closed form."""
    move = place().translate([-0.3, 0.1, 0]).rotate([0.3, 1, 0.2], 25).scale([1.2, 0.8, 0.5])
    field = slab(move, 0.9, GLOW)
    white = {"wall": lamp(y, half=9.0), "field": field}
    scene = mi.load_dict(scene_of(paths(max_depth=1, jitter=False), **white))
    o, d = camera_rays(scene)
    seen = boxes_seen(o, d, [(matrix_of(move), 0.9, GLOW)], distance_to_wall(o, d, y))
    expected = seen[:, :3] + (1 - seen[:, 3:4]) * np.array(GLOW)
    np.testing.assert_allclose(render(scene).reshape(-1, 4)[:, :3], expected, atol=2e-5)
    # A wall that only reflects is dark.
    dark = scene_of(
        paths(max_depth=1, jitter=False), wall=wall(y), lamp=overhead(GLOW), field=field
    )
    np.testing.assert_allclose(render(dark).reshape(-1, 4)[:, :3], seen[:, :3], atol=2e-5)


# ---- Fields that absorb ---------------------------------------------------------


@pytest.mark.slow
def test_absorbing_fog_agrees_with_a_homogeneous_medium() -> None:
    """All light that a room reflects passes it, in Mitsuba's volpath and here."""
    scale = 0.8
    moved = place().translate([0.1, 0.2, -0.1]).rotate([0.6, 0, 0.8], 25).scale(scale)
    fog = {"type": "homogeneous", "albedo": 0.0, "sigma_t": 0.7 / scale}
    cube = {"type": "cube", "to_world": moved, "bsdf": {"type": "null"}, "interior": fog}
    among = {"floor": floor(z=-0.5), "wall": wall(2.0), "lamp": overhead((9, 8, 7)), "sky": sky()}
    field = slab(moved, 0.7, (0, 0, 0))
    seen = statistics(scene_of(paths(samples=8, max_depth=4), field=field, **among), 128)
    expected = statistics(scene_of({"type": "volpath", "max_depth": 4}, cube=cube, **among), 128)
    without = statistics(scene_of(paths(max_depth=4), **among), 16)
    assert np.abs(without[0] - seen[0]).max() > 0.1
    agree(seen, expected)


def point_light(position: Any, intensity: float = 20.0) -> dict[str, Any]:
    return {"type": "point", "position": list(position), "intensity": rgb([intensity] * 3)}


def chord(o: np.ndarray, d: np.ndarray, transform: Any, reach: Any) -> np.ndarray:
    """Length of a ray in a moved unit box, up to ``reach``, in units of the box."""
    inverse = np.linalg.inv(matrix_of(transform))
    local_o, local_d = o @ inverse[:3, :3].T + inverse[:3, 3], d @ inverse[:3, :3].T
    near, far = slab_interval(local_o, local_d, [-1] * 3, [1] * 3).T
    return (np.minimum(far, reach) - np.minimum(near, reach)) * np.linalg.norm(local_d, axis=1)


TWO_BOXES = (
    (
        lambda: place().translate([0.3, 0.2, 0.3]).rotate([0.3, 1, 0.2], 25).scale([0.5, 0.4, 0.3]),
        1.2,
    ),
    (lambda: place().translate([-0.1, 0.4, 0.5]).rotate([0, 0, 1], 40).scale([0.6, 0.5, 0.3]), 0.8),
)


@pytest.mark.slow
@pytest.mark.parametrize("light", ["point", "directional"])
@pytest.mark.parametrize("count", [1, 2])
def test_shadows_of_fields_agree_with_closed_form_transmittance(light: str, count: int) -> None:
    """Of the one light that a floor receives, and of what the camera sees of that."""
    boxes = [(make(), density) for make, density in TWO_BOXES[:count]]
    fields = {f"box_{i}": slab(move, density, (0, 0, 0)) for i, (move, density) in enumerate(boxes)}
    at, along = np.array([0.2, 0.1, 2.5]), np.array([0.3, -0.2, -1.0])
    if light == "point":
        lights = {"light": point_light(at)}
    else:  # infinitely far, though the scene without fields is no larger than the floor
        lights = {
            "light": {"type": "directional", "direction": list(along), "irradiance": rgb((2, 2, 2))}
        }
    ground = floor((0.6, 0.5, 0.4), half=1.5)
    scene = mi.load_dict(
        scene_of(paths(max_depth=2, jitter=False), floor=ground, **fields, **lights)
    )
    o, d = camera_rays(scene)
    reach = (-1 - o[:, 2]) / d[:, 2]
    p = o + reach[:, None] * d
    there = (np.abs(p[:, :2]).max(axis=1) < 1.5) & (reach > 0)
    to_light = at - p if light == "point" else -np.broadcast_to(along, p.shape)
    distance = np.linalg.norm(to_light, axis=1)
    to_light = to_light / distance[:, None]
    irradiance = 20 / distance**2 if light == "point" else np.full(len(p), 2.0)
    far = distance if light == "point" else np.inf
    tau = sum(
        density * (chord(p, to_light, move, far) + chord(o, d, move, reach))
        for move, density in boxes
    )
    lit = irradiance * to_light[:, 2] * np.exp(-tau) / np.pi
    expected = np.where(there, lit, 0)[:, None] * np.array([0.6, 0.5, 0.4])
    np.testing.assert_allclose(render(scene).reshape(-1, 4)[:, :3], expected, rtol=2e-4, atol=2e-5)
    assert there.sum() > 40 and (tau[there] > 0.3).sum() > 8


# ---- Fields that shine ----------------------------------------------------------


def irradiance_of_box(p: np.ndarray, transform: Any, density: float, cells: int = 64) -> np.ndarray:
    """∫ (1 − exp(−τ)) cos dω at points of a floor below a moved unit box, by midpoints.

    Over all directions on a grid that is even in azimuth and in the square of the sine.
    """
    u = (np.arange(cells * 4) + 0.5) / (cells * 4)
    azimuth, sine = 2 * np.pi * u, np.sqrt((np.arange(cells) + 0.5) / cells)
    grid = np.meshgrid(azimuth, sine, indexing="ij")
    d = np.stack(
        [grid[1] * np.cos(grid[0]), grid[1] * np.sin(grid[0]), np.sqrt(1 - grid[1] ** 2)], axis=-1
    ).reshape(-1, 3)
    sums = [
        -np.expm1(-density * chord(np.broadcast_to(x, d.shape), d, transform, np.inf)).mean()
        for x in p
    ]
    return np.pi * np.array(sums)


@pytest.mark.slow
def test_light_of_a_constant_box_agrees_with_its_closed_form() -> None:
    """On a floor below, for every camera ray on its own, with the box sampled as a light or not."""
    move = place().translate([0.1, 0.2, 0.1]).rotate([0.3, 1, 0.2], 25).scale([0.5, 0.4, 0.3])
    objects = {"floor": floor((0.6, 0.5, 0.4)), "field": slab(move, 2.0, GLOW)}
    scenes = [
        mi.load_dict(scene_of(paths(max_depth=2, paths=512, sample_fields=s), **objects))
        for s in (False, True)
    ]
    o, d = camera_rays(scenes[0])
    reach = (-1 - o[:, 2]) / d[:, 2]
    clear = (chord(o, d, move, np.inf) == 0) & (reach > 0) & (reach < 7)
    p = o[clear] + reach[clear, None] * d[clear]
    e = irradiance_of_box(p, move, 2.0) / np.pi
    expected = e[:, None] * np.array(GLOW) * np.array([0.6, 0.5, 0.4])
    errors = [render(scene).reshape(-1, 4)[clear, :3] - expected for scene in scenes]
    for error, largest, mean in zip(errors, (0.02, 0.004), (2.5e-3, 5e-4), strict=True):
        assert np.abs(error).max() < largest and abs(error[:, 0].mean()) < mean
    assert clear.sum() > 50 and expected[:, 0].mean() > 0.02
    assert np.square(errors[1]).mean() < np.square(errors[0]).mean() / 10  # 27 when it was made


@pytest.mark.slow
@pytest.mark.parametrize("sampled", [True, False])
def test_an_opaque_field_is_an_area_light(sampled: bool) -> None:
    """A floor and a glossy ball receive the same from a box that shines."""
    move = place().translate([0.4, 0.6, 0.3]).rotate([0.3, 1, 0.2], 25).scale([0.5, 0.4, 0.3])
    solids = {"floor": floor(), "ball": room()["metal"]}
    field = slab(move, 200.0, GLOW)
    shape = {"type": "cube", "to_world": move, "emitter": {"type": "area", "radiance": rgb(GLOW)}}
    black = {"type": "diffuse", "reflectance": 0.0}
    seen = statistics(
        scene_of(paths(max_depth=3, sample_fields=sampled), field=field, **solids), 64
    )
    expected = statistics(
        scene_of({"type": "path", "max_depth": 3}, shape={**shape, "bsdf": black}, **solids), 256
    )
    agree(
        (seen[0][..., :3], seen[1][..., :3]),
        (expected[0][..., :3], expected[1][..., :3]),
        floor=3e-3,
    )


@pytest.mark.slow
@pytest.mark.parametrize("sampled", [True, False])
def test_white_furnace(sampled: bool) -> None:
    """Where everything shines or reflects with 1, nothing can be told apart."""
    white = {"type": "diffuse", "reflectance": rgb((1, 1, 1))}
    scene = scene_of(
        paths(rr_depth=1000, max_depth=64, sample_fields=sampled),
        one=formula_dict("gaussian", place().translate([0.3, 0, 0]), peak=4.0, width=0.2),
        two=slab(place().scale(0.7), 0.5, (1, 1, 1)),
        ball={"type": "sphere", "radius": 0.4, "bsdf": white},
        glass={
            "type": "sphere",
            "center": [0.4, -1.3, 0.1],
            "radius": 0.3,
            "bsdf": {"type": "dielectric"},
        },
        ground=floor((1, 1, 1), -0.6),
        sky={"type": "constant"},
    )
    image = render(scene, spp=64)
    np.testing.assert_allclose(image, 1, atol=0.12)
    np.testing.assert_allclose(image.mean(axis=(0, 1)), 1, atol=6e-3)


# ---- Mirrors and glass ----------------------------------------------------------


def along(scene: Any, o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """What the scene's integrator sees along rays, (R, 3)."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, len(o))
    ray = mi.Ray3f(mi.Point3f(o.T.astype(np.float32)), mi.Vector3f(d.T.astype(np.float32)))
    radiance, *_ = scene.integrator().sample(dr.ADMode.Primal, scene, sampler, ray)
    return np.array(radiance, np.float64).T


@pytest.mark.slow
@pytest.mark.parametrize("space", ["srgb", "linear"])
def test_a_mirror_shows_what_a_mirrored_camera_sees(space: str, tmp_path: Path) -> None:
    file = small_file(tmp_path, color_space=space)
    box = {"type": "cube", "interior": {"type": "nerfmedium", "filename": str(file)}}
    mirror = {**wall(2.0, half=50.0), "bsdf": {"type": "conductor", "material": "none"}}
    rng = np.random.default_rng(0)
    target = rng.uniform(
        [-0.9, 5.0 - 2, -0.9], [0.9, 5.0, 0.9], (200, 3)
    )  # of the image of the box
    o = np.tile([4.0, -1.0, 0.3], (200, 1))
    d = (target - o) / np.linalg.norm(target - o, axis=1, keepdims=True)
    flip = np.array([1, -1, 1])
    seen = along(mi.load_dict(scene_of(paths(jitter=False), box=box, mirror=mirror)), o, d)
    alone = scene_of(nerf(None, jitter=False), box=box)
    expected = along(mi.load_dict(alone), o * flip + [0, 4.0, 0], d * flip)
    np.testing.assert_allclose(seen, expected, atol=5e-4)  # rays start off the mirror
    assert expected.mean() > 0.05


@pytest.mark.slow
def test_glass_shows_what_is_behind_it() -> None:
    """A pane that neither reflects nor refracts, and the same without."""
    pane = {**wall(-1.5), "bsdf": {"type": "thindielectric", "int_ior": 1.0, "ext_ior": 1.0}}
    field = slab(place(), 0.7, GLOW)
    image = render(scene_of(paths(jitter=False), pane=pane, field=field))
    expected = render(scene_of(paths(jitter=False), field=field))
    np.testing.assert_allclose(image[..., :3], expected[..., :3], atol=5e-4)


# ---- Several fields, channels, settings -----------------------------------------


@pytest.mark.slow
def test_the_order_of_fields_does_not_matter() -> None:
    one = formula_dict("gaussian", place().translate([-0.2, 0.1, 0]), peak=3.0, width=0.35)
    two = formula_dict("shell", place().rotate([1, 0, 0], 70).scale([1.4, 1, 1]), density=3.0)
    options = {"max_depth": 3, "sample_fields": False}
    images = [
        render(scene_of(paths(**options), a=a, b=b, **room()), spp=4)
        for a, b in ((one, two), (two, one))
    ]
    np.testing.assert_allclose(images[0], images[1], atol=1e-4)
    assert images[0].std() > 0.1


@pytest.mark.slow
def test_channels_are_those_of_camera_rays() -> None:
    """As the integrator nerf has them; alpha too, where there is no sky."""
    objects = {
        "wall": wall(0.3, half=0.6),
        "field": formula_dict("gaussian"),
        "lamp": overhead((3, 3, 3)),
    }
    aovs = "depth, opacity, normal, index"
    image = render(scene_of(paths(aovs=aovs), **objects))
    expected = render(scene_of(nerf(aovs=aovs), **objects))
    np.testing.assert_allclose(image[..., 3:], expected[..., 3:], atol=1e-5)
    assert expected[..., 3].min() < 0.1 and expected[..., 3].max() > 0.999


@pytest.mark.slow
def test_bounds_of_the_distance_are_those_of_cameras(tmp_path: Path) -> None:
    """A field file's near plane hides the field from the camera, not from the light."""
    contents = mi_nerf.load_field(small_file(tmp_path))
    hidden = replace(contents, march=replace(contents.march, near=40.0, far=50.0))
    mi_nerf.save_field(tmp_path / "far.safetensors", hidden)
    images = []
    for name in ("field_0", "far"):
        medium = {"type": "nerfmedium", "filename": str(tmp_path / f"{name}.safetensors")}
        cube = {"type": "cube", "to_world": place().scale(0.5), "interior": medium}
        light = {"light": point_light((0, 0, 2.0)), "floor": floor()}
        integrator = paths(max_depth=2, jitter=False, sample_fields=False, aovs="opacity")
        images.append(render(scene_of(integrator, cube=cube, **light)))
    seen, hidden = images
    assert seen[..., 4].max() > 0.2 and hidden[..., 4].max() == 0
    free = (seen[..., 4] == 0) & (seen[..., 0] > 0)
    lit = render(scene_of(paths(max_depth=2), **light))
    assert np.abs(lit - seen[..., :4])[free].max() > 0.05
    np.testing.assert_allclose(hidden[free][:, :3], seen[free][:, :3], atol=1e-5)


def test_paths_end_where_fields_let_almost_nothing_pass() -> None:
    """``stop`` bounds what is lost."""
    objects = {"field": slab(place(), 2.0, GLOW), "wall": lamp(2.0, (1, 1, 1))}
    exact, ended = (render(scene_of(paths(jitter=False, stop=s), **objects)) for s in (0.0, 0.1))
    lost = (exact - ended)[..., :3]
    assert 0.005 < lost.max() <= 0.1 and lost.min() > -1e-5


# ---- Bad input ------------------------------------------------------------------


def refused(**objects: Any) -> str:
    """What is said about a scene; loading or rendering it fails."""
    with pytest.raises(RuntimeError) as failure:
        render(scene_of(objects.pop("integrator", paths()), **objects))
    return f"{failure.value} {failure.value.__cause__}"


def test_bad_scenes() -> None:
    field = slab(place(), 1.0, GLOW)
    medium = field["interior"]
    assert "nerfmedium: 'loose' is in no shape, expected" in refused(loose=medium)
    assert "'Sphere', expected a 'cube'" in refused(box={"type": "sphere", "interior": medium})
    flat = place().scale([1, 1, 0])
    assert "cube's to_world is singular" in refused(box={**field, "to_world": flat})
    missing = {"type": "cube", "interior": {"type": "nerfmedium", "filename": "none.safetensors"}}
    assert "none.safetensors: not found" in refused(box=missing)
    fog = {"type": "homogeneous", "albedo": 0.5, "sigma_t": 1.0}
    said = refused(box=field, ball={"type": "sphere", "bsdf": {"type": "null"}, "interior": fog})
    assert "shape 'ball' holds a medium of type 'HomogeneousMedium', expected" in said


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_depth": -2}, "nerf_path: max_depth=-2, expected 0 or more"),
        ({"rr_depth": 0}, "nerf_path: rr_depth=0, expected 1 or more"),
        ({"paths": 0}, "nerf_path: paths=0, expected 1 or more"),
        ({"samples": -3}, "nerf_path: samples=-3, expected 1 or more"),
        ({"stop": 1.0}, "nerf_path: stop=1.0, expected 0 to less than 1"),
        ({"aovs": "albedo"}, "nerf_path: aov 'albedo' is unknown, expected"),
        ({"encoded": True}, "encoded"),
    ],
)
def test_bad_settings(options: dict[str, Any], message: str) -> None:
    assert message in refused(integrator=paths(**options), box=slab(place(), 1.0, GLOW))


def test_it_cannot_be_nested() -> None:
    said = refused(integrator=nerf("nerf_path"), box=slab(place(), 1.0, GLOW))
    assert "'nerf_path' nested in 'nerf', expected one like 'path'" in said
