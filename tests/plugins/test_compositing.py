"""Fields among surfaces, lights and other fields, in one image."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mi_nerf
from mi_nerf.base.errors import InputError
from mi_nerf.cameras.ndc import Ndc
from tests.support.composed import (
    GLOW,
    SIZE,
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
    wall,
)
from tests.support.fields import formula_dict, scene_dict, small_file

pytestmark = pytest.mark.usefixtures("variant")
AOVS = "depth, opacity, normal, index"


# ---- Known answers --------------------------------------------------------------


def two_boxes() -> list[tuple[Any, float, Any]]:
    """They overlap, are rotated, and stretched differently along their axes."""
    first = place().translate([-0.3, 0.1, 0]).rotate([0.3, 1, 0.2], 25).scale([1.2, 0.8, 0.5])
    second = place().translate([0.4, 0.5, 0.2]).rotate([0, 0, 1], 40).scale([0.6, 1.0, 0.9])
    return [(first, 0.9, GLOW), (second, 1.7, (0.1, 0.3, 1.1))]


@pytest.mark.parametrize("y", [-3.0, 0.3, 3.0])  # in front of the boxes, inside, behind
@pytest.mark.parametrize("count", [1, 2])
def test_constant_boxes_agree_with_their_closed_form(y: float, count: int) -> None:
    """Occlusion by the wall is exact, wherever it stands."""
    boxes = two_boxes()[:count]
    fields = {f"box_{i}": slab(*box) for i, box in enumerate(boxes)}
    integrator = nerf(aovs="depth, opacity", jitter=False)
    scene = mi.load_dict(scene_of(integrator, wall=lamp(y, half=9.0), **fields))
    o, d = camera_rays(scene)
    reach = distance_to_wall(o, d, y)
    seen = boxes_seen(o, d, [(matrix_of(m), *rest) for m, *rest in boxes], reach)
    image = render(scene).reshape(-1, 6)
    through = 1 - seen[:, 3:4]
    np.testing.assert_allclose(image[:, :3], seen[:, :3] + through * np.array(GLOW), atol=2e-5)
    np.testing.assert_allclose(image[:, 5], seen[:, 3], atol=1e-5)
    np.testing.assert_allclose(image[:, 3], 1, atol=1e-5)  # the wall is opaque
    depth = seen[:, 4] * seen[:, 3] + through[:, 0] * reach
    np.testing.assert_allclose(image[:, 4], depth, atol=3e-4)
    assert (y == -3.0) == (image[:, 5].max() == 0)


@pytest.mark.slow
def test_absorbing_fog_agrees_with_a_homogeneous_medium() -> None:
    """Mitsuba's volpath is noisy here, but its mean is right."""
    scale = 0.8  # densities are per length of the field, a medium's per length of the world
    moved = place().translate([0.1, 0.2, 0]).rotate([0.6, 0, 0.8], 25).scale(scale)
    lamps = {"back": lamp(3.0), "among": lamp(0.2, (0.1, 0.6, 2.0), half=0.5)}
    fog = {"type": "homogeneous", "albedo": 0.0, "sigma_t": 0.7 / scale}
    cube = {"type": "cube", "to_world": moved, "bsdf": {"type": "null"}, "interior": fog}
    means, errors = [], []
    for scene in (
        scene_of(nerf(samples=4), field=slab(moved, 0.7, (0, 0, 0)), **lamps),
        scene_of({"type": "volpath"}, cube=cube, **lamps),
    ):
        loaded = mi.load_dict(scene)
        images = np.stack([render(loaded, spp=128, seed=i)[..., :3] for i in range(16)])
        means.append(images.mean(axis=0))
        errors.append(images.std(axis=0, ddof=1) / np.sqrt(len(images)))
    z = (means[0] - means[1]) / np.hypot(np.hypot(*errors), 2e-3)
    assert np.abs(z).max() < 6 and z.std() < 1.5
    assert means[0].std() > 0.1  # something is to be seen


@pytest.mark.slow
def test_white_furnace() -> None:
    """Where everything shines with 1, nothing can be told apart."""
    field = formula_dict("gaussian", place().translate([0.3, 0, 0]), peak=4.0, width=0.3)
    white = {"type": "diffuse", "reflectance": rgb((1, 1, 1))}
    scene = scene_of(
        nerf({"type": "path", "rr_depth": 1000}),
        spp=64,
        one=field,
        two=slab(place().scale(0.7), 0.5, (1, 1, 1)),
        ball={"type": "sphere", "radius": 0.4, "bsdf": white},
        sky={"type": "constant"},
    )
    image = render(scene)
    np.testing.assert_allclose(image, 1, atol=0.05)
    np.testing.assert_allclose(image.mean(axis=(0, 1)), 1, atol=2e-3)


# ---- Several fields -------------------------------------------------------------


def soft_fields(names: str = "ab") -> dict[str, dict[str, Any]]:
    """A Gaussian and a shell that overlap, by name."""
    blob = formula_dict("gaussian", place().translate([-0.2, 0.1, 0]), peak=3.0, width=0.35)
    blob["interior"]["radiance"] = mi.ScalarVector3f(0.2, 0.9, 0.4)
    shell = formula_dict("shell", place().rotate([1, 0, 0], 70).scale([1.4, 1, 1]), density=3.0)
    return dict(zip(names, (blob, shell), strict=True))


@pytest.mark.slow
def test_the_order_of_fields_does_not_matter() -> None:
    one = render(scene_of(nerf(aovs=AOVS), wall=wall(0.3), sky=sky(), **soft_fields("ab")))
    two = render(scene_of(nerf(aovs=AOVS), wall=wall(0.3), sky=sky(), **soft_fields("ba")))
    np.testing.assert_allclose(two[..., :9], one[..., :9], atol=2e-6)
    assert set(np.unique(one[..., 9])) == {1, 2}
    np.testing.assert_array_equal(two[..., 9], 3 - one[..., 9])


@pytest.mark.slow
def test_a_field_of_nothing_changes_nothing(tmp_path: Path) -> None:
    """Samples that were merged with others give what they give alone."""
    file = small_file(tmp_path)
    box = {"type": "cube", "interior": {"type": "nerfmedium", "filename": str(file)}}
    nothing = slab(place().translate([0.5, 0.2, 0]).rotate([0, 0, 1], 20), 0.0, (1, 1, 1))
    alone = render(scene_of(nerf(aovs=AOVS, stop=0.0), box=box, wall=wall(0.4), sky=sky()))
    merged = scene_of(nerf(aovs=AOVS, stop=0.0), box=box, wall=wall(0.4), sky=sky(), zero=nothing)
    image = render(merged)
    for channels, tolerance in ((slice(0, 4), 1e-5), (slice(5, 9), 1e-4), (slice(9, 10), 0)):
        np.testing.assert_allclose(image[..., channels], alone[..., channels], atol=tolerance)
    # Depths are those of the samples there, of the middle of their strata here.
    np.testing.assert_allclose(image[..., 4], alone[..., 4], atol=0.05)
    assert 0.2 < image[..., 5].mean() < 0.999


@pytest.mark.slow
def test_fields_that_are_empty_where_they_overlap(tmp_path: Path) -> None:
    contents = mi_nerf.load_field(small_file(tmp_path))
    empty = mi_nerf.FieldFile(
        contents.config, contents.weights, np.zeros((4, 4, 4), bool), contents.march
    )
    mi_nerf.save_field(tmp_path / "empty.safetensors", empty)
    medium = {"type": "nerfmedium", "filename": str(tmp_path / "empty.safetensors")}
    cubes = {name: {"type": "cube", "interior": medium} for name in "ab"}
    assert render(scene_of(nerf(None, aovs=AOVS), **cubes)).max() == 0
    fog = slab(place(), 0.5, GLOW)
    image = render(scene_of(nerf(None), **cubes, fog=fog))
    np.testing.assert_allclose(image, render(scene_of(nerf(None), fog=fog)), atol=1e-5)


@pytest.mark.slow
def test_instances_show_what_copies_show(tmp_path: Path) -> None:
    """One medium in two cubes, or two media of one file."""
    file = small_file(tmp_path)
    moves = [
        place().translate([-0.6, 0, 0]).scale(0.5),
        place().translate([0.5, 0.4, 0.2]).rotate([0, 1, 0], 30).scale([0.5, 0.7, 0.4]),
    ]
    medium = {"type": "nerfmedium", "filename": str(file)}
    shared, null = mi.load_dict(medium), mi.load_dict({"type": "null"})
    images = [
        render(
            scene_of(
                nerf(aovs=AOVS),
                **{
                    name: {"type": "cube", "to_world": move, "interior": interior, **bsdf}
                    for name, move in zip("ab", moves, strict=True)
                },
            )
        )
        # With one BSDF, too, Mitsuba merges the cubes into one mesh.
        for interior, bsdf in ((medium, {}), (shared, {}), (shared, {"bsdf": null}))
    ]
    np.testing.assert_array_equal(images[1], images[0])
    np.testing.assert_allclose(images[2][..., :9], images[0][..., :9], atol=1e-5)
    assert {1, 2} <= set(np.unique(images[0][..., 9]))


@pytest.mark.slow
def test_a_scene_that_moves_with_its_camera_looks_the_same() -> None:
    move = place().translate([3, -1, 2]).rotate([0.6, 0, 0.8], 70).scale(2.5)
    plain = scene_of(nerf(aovs=AOVS), wall=lamp(0.3, half=1.5), **soft_fields())
    moved = scene_of(nerf(aovs=AOVS), wall=lamp(0.3, half=1.5), **soft_fields())
    for name in ("wall", "a", "b"):
        moved[name]["to_world"] = move @ moved[name]["to_world"]
    moved["sensor"]["to_world"] = place().look_at(
        origin=move @ mi.ScalarPoint3f(0.3, -4.0, 0.5),
        target=move @ mi.ScalarPoint3f(0, 0, 0),
        up=move @ mi.ScalarVector3f(0, 0, 1),
    )
    moved["sensor"]["near_clip"] = 0.025  # 2.5 times the default
    before, after = render(plain, seed=1), render(moved, seed=1)
    np.testing.assert_allclose(after[..., :4], before[..., :4], atol=2e-3)
    np.testing.assert_allclose(after[..., 5], before[..., 5], atol=2e-3)
    np.testing.assert_allclose(after[..., 4], 2.5 * before[..., 4], atol=1e-2)
    turn = matrix_of(move)[:3, :3] / 2.5
    np.testing.assert_allclose(after[..., 6:9], before[..., 6:9] @ turn.T, atol=2e-2)


def test_the_medium_moves_within_its_cube() -> None:
    outer, inner = place().rotate([0, 0, 1], 30).scale(0.8), place().translate([0.3, 0.2, 0])
    whole = formula_dict("shell", outer @ inner)
    parts = formula_dict("shell", outer)
    parts["interior"]["to_world"] = inner
    image = render(scene_of(nerf(None), field=parts))
    np.testing.assert_allclose(image, render(scene_of(nerf(None), field=whole)), atol=2e-5)
    scene = mi.load_dict(scene_of(nerf(None), field=formula_dict("shell", outer)))
    params = mi.traverse(scene)
    params["field.interior_medium.to_world"] = mi.Transform4f(matrix_of(inner).astype(np.float32))
    params.update()
    np.testing.assert_allclose(render(scene), image, atol=2e-5)


def test_xml() -> None:
    """Nested integrators need no name there; Mitsuba merges meshes of such scenes."""
    xml = """<scene version="3.0.0">
        <integrator type="nerf"><integrator type="path"/></integrator>
        <sensor type="perspective">
            <float name="fov" value="40"/>
            <transform name="to_world">
                <lookat origin="0.3, -4, 0.5" target="0, 0, 0" up="0, 0, 1"/>
            </transform>
            <film type="hdrfilm">
                <integer name="width" value="16"/><integer name="height" value="12"/>
                <string name="pixel_format" value="rgba"/><rfilter type="box"/>
            </film>
            <sampler type="independent"><integer name="sample_count" value="1"/></sampler>
        </sensor>
        <shape type="cube"><bsdf type="null"/>
            <medium type="nerfmedium" name="interior"><string name="field" value="slab"/></medium>
        </shape>
        <shape type="cube"><bsdf type="null"/>
            <medium type="nerfmedium" name="interior"><string name="field" value="shell"/></medium>
        </shape>
        <shape type="cube">
            <transform name="to_world"><scale value="0.2"/><translate y="-1.1"/></transform>
        </shape>
        <emitter type="constant"/>
    </scene>"""
    image = np.array(mi.render(mi.load_string(xml)))
    same = scene_of(
        nerf(),
        one=formula_dict("slab"),
        two=formula_dict("shell"),
        block={"type": "cube", "to_world": place().translate([0, -1.1, 0]).scale(0.2)},
        sky={"type": "constant"},
    )
    np.testing.assert_allclose(image, render(same), atol=1e-4)


# ---- Surfaces -------------------------------------------------------------------


@pytest.mark.slow
def test_surfaces_are_seen_through_the_field(tmp_path: Path) -> None:
    """Fields keep their colours; what is behind is weakened in linear light, sRGB or not."""
    for space in ("srgb", "linear"):
        file = small_file(tmp_path, color_space=space)
        surfaces = {"wall": wall(3.0), "sky": sky()}
        scene = scene_dict(file, integrator={"nested": {"type": "path"}}, **surfaces)
        del scene["box"]
        path = render({**scene, "integrator": {"type": "path"}}, seed=2, spp=256)
        alone = render(scene_dict(file), seed=2, spp=256)
        both = scene_dict(file, integrator={"nested": {"type": "path"}}, **surfaces)
        expected = alone[..., :3] + (1 - alone[..., 3:]) * path[..., :3]
        np.testing.assert_allclose(render(both, seed=2, spp=256)[..., :3], expected, atol=0.02)


def test_fields_of_two_colour_spaces(tmp_path: Path) -> None:
    """Each is decoded on its own: disjoint on the film, they look as they do alone."""
    left = place().translate([-0.9, 0, 0]).scale(0.4)
    right = place().translate([0.9, 0, 0]).scale(0.4)
    cubes = [
        {
            "type": "cube",
            "to_world": move,
            "interior": {
                "type": "nerfmedium",
                "filename": str(small_file(tmp_path, seed=seed, color_space=space)),
            },
        }
        for seed, (move, space) in enumerate(((left, "srgb"), (right, "linear")))
    ]
    alone = [render(scene_of(nerf(None, stop=0.0), a=cube)) for cube in cubes]
    both = render(scene_of(nerf(None, stop=0.0), a=cubes[0], b=cubes[1]))
    assert all(image.max() > 0.1 for image in alone)
    np.testing.assert_allclose(both, sum(alone), atol=1e-5)


@pytest.mark.slow
def test_the_cube_casts_no_shadow() -> None:
    """With a null BSDF it would block the nested integrator's rays to a point light."""
    light = {"type": "point", "position": [0, -3.0, 1.0], "intensity": rgb((20, 20, 20))}
    solid = {"wall": wall(0.0), "light": light}
    empty = slab(place(), 0.0, (0, 0, 0))
    image = render(scene_of(nerf(), box=empty, **solid))
    np.testing.assert_allclose(image, render(scene_of({"type": "path"}, **solid)), atol=1e-5)
    assert image[..., 0].max() > 0.1


@pytest.mark.slow
def test_surfaces_that_change_are_followed() -> None:
    scene = mi.load_dict(
        scene_of(
            nerf(),
            field=slab(place(), 0.3, GLOW),
            ball={"type": "sphere", "radius": 0.3},
            wall=wall(2.0),
            sky=sky(),
        )
    )
    before = render(scene)
    params = mi.traverse(scene)
    params["ball.to_world"] = mi.Transform4f().translate([0.6, 0, 0.2]).scale(0.5)
    params["wall.bsdf.reflectance.value"] = mi.Color3f(0.9, 0.1, 0.1)
    params.update()
    after = render(scene)
    fresh = scene_of(
        nerf(),
        field=slab(place(), 0.3, GLOW),
        ball={"type": "sphere", "to_world": place().translate([0.6, 0, 0.2]).scale(0.5)},
        wall=wall(2.0, (0.9, 0.1, 0.1)),
        sky=sky(),
    )
    np.testing.assert_allclose(after, render(fresh), atol=1e-4)
    assert np.abs(after - before).max() > 0.1


def test_surfaces_are_left_out_without_a_nested_integrator() -> None:
    field = formula_dict("gaussian")
    image = render(scene_of(nerf(None, aovs=AOVS), field=field, wall=wall(-1.0)))
    np.testing.assert_array_equal(image, render(scene_of(nerf(None, aovs=AOVS), field=field)))


@pytest.mark.slow
@pytest.mark.parametrize("nested", ["direct", "volpath", "prb", "prb_basic", "prbvolpath"])
def test_nested_integrators_of_all_kinds(nested: str) -> None:
    """They show what ``path`` shows: their means differ by no more than they scatter."""
    solids = {"wall": wall(0.2), "sky": sky(), "field": slab(place(), 0.5, GLOW)}
    two = [mi.load_dict(scene_of(nerf(kind), **solids)) for kind in (nested, "path")]
    images = [render(two[0], spp=16, seed=i) - render(two[1], spp=16, seed=i) for i in range(16)]
    mean, error = np.mean(images, axis=0), np.std(images, axis=0, ddof=1) / 4
    assert np.abs(mean / np.hypot(error, 1e-3)).max() < 6
    assert np.abs(mean.mean(axis=(0, 1))).max() < 2e-3


@pytest.mark.slow
def test_several_paths_a_ray_are_less_noisy() -> None:
    """Of the same camera rays, whose values converge with the number of paths."""
    light = lamp(0.0, (6.0, 5.0, 4.0))
    light["to_world"] = place().look_at(origin=[1, -5, 3], target=[0, 0, 0], up=[0, 0, 1])
    solids = {"wall": wall(0.2), "light": light, "field": slab(place(), 0.5, GLOW)}
    few, more, many = (render(scene_of(nerf(paths=n), **solids)) for n in (1, 16, 256))
    errors = [np.square(image - many).mean() for image in (few, more)]
    assert errors[0] > 1e-5 and errors[1] < errors[0] / 8


def test_normals_point_out_of_the_densest_place() -> None:
    """Of a Gaussian, every gradient points to its centre, wherever its cube puts that."""
    move = place().translate([0.3, 0.2, -0.1]).rotate([0, 1, 0], 30).scale(0.7)
    field = formula_dict("gaussian", move, peak=60.0, width=0.3)
    scene = mi.load_dict(scene_of(nerf(aovs="normal, depth"), field=field))
    o, d = camera_rays(scene)
    image = render(scene).reshape(-1, 8)
    seen = image[:, 3] > 0.999
    out = o + image[:, 7:8] * d - matrix_of(move)[:3, 3]
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    assert seen.sum() > 10
    np.testing.assert_allclose(image[seen, 4:7], out[seen], atol=0.05)
    wall_only = scene_of(nerf(aovs="normal"), field=slab(place(), 0.0, GLOW), wall=wall(0.0))
    normal = render(wall_only)[..., 4:7].reshape(-1, 3)
    np.testing.assert_allclose(normal, np.tile([0, -1, 0], (len(normal), 1)), atol=1e-5)


# ---- Gradients ------------------------------------------------------------------


def nested_dict(name: str) -> dict[str, Any]:
    """A nested integrator of short paths."""
    return {"type": name} | ({} if name.startswith("direct") else {"max_depth": 3})


def interlocked(nested: str, file: Path) -> Any:
    """A network, two formulas and a wall through all of them, lit by a lamp.

    All rays enter the network's box through the same face: at silhouettes of a box, finite
    differences converge slowly.
    """
    move = place().translate([-0.4, 0.1, 0]).rotate([0, 0.6, 0.8], 20).scale([4, 0.5, 4])
    light = lamp(0.0, (6.0, 5.0, 4.0))
    light["to_world"] = place().look_at(origin=[1, -5, 3], target=[0, 0, 0], up=[0, 0, 1])
    blob = formula_dict("gaussian", place().translate([0.2, 0.2, 0]), peak=2.0, width=0.3)
    return mi.load_dict(
        scene_of(
            nerf(nested_dict(nested), aovs="depth", paths=2),
            net={
                "type": "cube",
                "to_world": move,
                "interior": {"type": "nerfmedium", "filename": str(file)},
            },
            blob=blob,
            slab=slab(place().translate([0.3, 0.3, 0]).scale([0.7, 0.6, 0.8]), 1.1, GLOW),
            wall=wall(0.3),
            light=light,
        )
    )


def turned(x: Any) -> Any:
    """A move, a turn and a stretch at once, none for x = 0."""
    move = mi.Transform4f().translate(mi.Vector3f(x, 0.5 * x, -x))
    return move.rotate(mi.Vector3f(0, 0.6, 0.8), 40 * x).scale(mi.Vector3f(1 + x, 1, 1 - x))


# What moves with x, the step of the finite difference, and the error allowed.
CHANGES: dict[str, tuple[dict[str, Any], float, float]] = {
    "weights": (
        {
            "net.interior_medium.density_bias": lambda v, x: v + x,
            "net.interior_medium.color_bias": lambda v, x: v - 2 * x,
            "slab.interior_medium.density": lambda v, x: v + x,
        },
        1e-2,
        0.01,
    ),
    "place of a network": ({"net.interior_medium.to_world": lambda v, x: turned(x)}, 5e-4, 0.01),
    "place of a formula": ({"blob.interior_medium.to_world": lambda v, x: turned(x)}, 3e-3, 0.01),
    "place of a box": (
        {"slab.interior_medium.to_world": lambda v, x: mi.Transform4f().scale(1 + x)},
        5e-4,
        0.05,
    ),
    "cube": (
        {"blob.vertex_positions": lambda v, x: v + x * dr.tile(mi.Float(1, 0.5, -1), 24)},
        3e-3,
        0.01,
    ),
    "surface": (
        {"wall.bsdf.reflectance.value": lambda v, x: v + mi.Color3f(x, 0, -x)},
        0.05,
        0.01,
    ),
    "light": (
        {"light.emitter.radiance.value": lambda v, x: v + mi.Color3f(x, 0, 2 * x)},
        0.5,
        0.01,
    ),
    "all": (
        {
            "net.interior_medium.density_bias": lambda v, x: v + x,
            "blob.interior_medium.to_world": lambda v, x: turned(x),
            "light.emitter.radiance.value": lambda v, x: v + 3 * x,
        },
        1e-3,
        0.02,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("nested", ["path", "prb"])
@pytest.mark.parametrize("kind", CHANGES)
def test_gradients_agree_with_finite_differences(kind: str, nested: str, tmp_path: Path) -> None:
    check_gradients(kind, nested, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(
    "nested",
    [
        "prb_basic",
        "prb_projective",
        "direct",
        "volpath",
        "volpathmis",
        "prbvolpath",
    ],
)
@pytest.mark.parametrize("kind", ["surface", "all"])
def test_gradients_through_every_nested_integrator(kind: str, nested: str, tmp_path: Path) -> None:
    check_gradients(kind, nested, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["surface", "weights", "all"])
def test_gradients_pass_by_pass(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same where rays are traced in four passes, each with a seed of its own."""
    from mi_nerf.plugins.film import FieldIntegrator

    for limit in ("rays_per_pass", "rays_per_adjoint"):
        monkeypatch.setattr(FieldIntegrator, limit, SIZE[0] * SIZE[1])
    check_gradients(kind, "prb", tmp_path)


def check_gradients(kind: str, nested: str, tmp_path: Path) -> None:
    """Of a weighted sum of all channels, along one number x, in both modes."""
    changes, step, tolerance = CHANGES[kind]
    file = small_file(tmp_path, density_activation="softplus")
    scene = interlocked(nested, file)
    if nested == "prb":  # in several chunks
        for shape in scene.shapes():
            if (medium := shape.interior_medium()) is not None:
                medium.march = replace(medium.march, chunk=60_000, block=2048)
    params = mi.traverse(scene)
    start = {key: params[key] + 0 if "to_world" not in key else None for key in changes}
    pull = mi.TensorXf(np.random.default_rng(0).normal(size=(SIZE[1], SIZE[0], 5)))

    def loss_at(x: Any, seed: int = 0, **options: Any) -> Any:
        for key, change in changes.items():
            params[key] = type(params[key])(change(start[key], x))
        params.update()
        image = mi.render(scene, seed=seed, spp=4, **options)
        return dr.sum(image * pull, axis=None)

    def attached() -> Any:
        x = mi.Float(0.0)
        dr.enable_grad(x)
        return x

    ahead, behind = (float(loss_at(mi.Float(s * step), 7).array[0]) for s in (1, -1))
    expected = (ahead - behind) / (2 * step)
    x = attached()
    dr.backward(loss_at(x, params=params, seed_grad=7))
    assert float(dr.grad(x)[0]) == pytest.approx(expected, rel=tolerance)
    y = attached()
    loss = loss_at(y, params=params, seed_grad=7)
    if nested == "prbvolpath":
        with pytest.raises(InputError, match="'prbvolpath' has no derivatives in forward mode"):
            dr.forward(y)
        return
    dr.forward(y)
    assert float(dr.grad(loss).array[0]) == pytest.approx(float(dr.grad(x)[0]), rel=1e-3)


def test_the_environment_is_differentiable() -> None:
    """Without a nested integrator; what passes the field is its derivative."""
    scene = mi.load_dict(scene_of(nerf(None), sky=sky(), field=slab(place(), 0.7, GLOW)))
    params = mi.traverse(scene)
    key = "sky.radiance.value"
    dr.enable_grad(params[key])
    params.update()
    image = mi.render(scene, params, seed=1, seed_grad=2)
    dr.backward(dr.sum(image, axis=None))
    through = (1 - render(scene, seed=2)[..., 3]).sum()
    np.testing.assert_allclose(np.ravel(dr.grad(params[key])), [through] * 3, rtol=1e-5)


# ---- Bad input ------------------------------------------------------------------


def refused(**objects: Any) -> str:
    """What is said about a scene; loading or rendering it fails."""
    with pytest.raises(RuntimeError) as failure:
        integrator = objects.pop("integrator", nerf())
        render(scene_of(integrator, **objects))
    return f"{failure.value} {failure.value.__cause__}"


def test_bad_fields() -> None:
    field = slab(place(), 1.0, GLOW)
    medium = field["interior"]
    assert "no 'nerfmedium', expected at least one, in a cube" in refused(wall=wall(0.0))
    assert "'Sphere', expected a 'cube'" in refused(box={"type": "sphere", "interior": medium})
    sheet = {"type": "rectangle", "interior": medium}
    assert "'Rectangle', expected a 'cube'" in refused(box=sheet)
    for scale in ([1, 1, 0], [1e-9, 1, 1]):
        flat = place().scale(scale)
        assert "cube's to_world is singular" in refused(box={**field, "to_world": flat})
        inner = {**field, "interior": {**medium, "to_world": flat}}
        assert "medium's to_world is singular" in refused(box=inner)
    light = {"type": "area", "radiance": rgb(GLOW)}
    assert "'box' is a light source" in refused(box={**field, "emitter": light})
    missing = {"type": "cube", "interior": {"type": "nerfmedium", "filename": "none.safetensors"}}
    assert "none.safetensors: not found" in refused(box=missing)


def test_media_of_other_kinds_are_refused() -> None:
    fog = {"type": "homogeneous", "albedo": 0.5, "sigma_t": 1.0}
    ball = {"type": "sphere", "bsdf": {"type": "null"}, "interior": fog}
    said = refused(box=slab(place(), 1.0, GLOW), ball=ball)
    assert "shape 'ball' holds a medium of type 'HomogeneousMedium', expected" in said


@pytest.mark.parametrize(
    ("nested", "message"),
    [
        ({"type": "ptracer"}, "'ParticleTracerIntegrator', expected path, direct"),
        ({"type": "aov", "aovs": "z:depth"}, "'AOVIntegrator', expected path, direct"),
        ({"type": "direct_projective"}, "expected path, direct"),
        ({"type": "depth"}, "'DepthIntegrator', expected path, direct"),
        ({"type": "nerf"}, "nested in 'nerf', expected one like 'path'"),
    ],
)
def test_nested_integrators_that_cannot_render(nested: dict[str, Any], message: str) -> None:
    assert message in refused(integrator=nerf(nested), box=slab(place(), 1.0, GLOW))
    two = {**nerf("path"), "other": {"type": "prb"}}
    assert "2 nested integrators, expected at most one" in refused(integrator=two)


@pytest.mark.slow
def test_normalised_device_coordinates_stand_alone(tmp_path: Path) -> None:
    file = small_file(tmp_path, ndc=Ndc(1.0, 1.0))
    box = {"type": "cube", "interior": {"type": "nerfmedium", "filename": str(file)}}
    said = refused(box=box, other=slab(place(), 1.0, GLOW))
    assert "2 fields, one of them in normalised device coordinates" in said
    assert "aov 'normal' of a field in normalised" in refused(integrator=nerf(aovs=AOVS), box=box)
    image = render(scene_of(nerf(), box=box, wall=wall(2.0), sky=sky()))
    assert np.isfinite(image).all()
    scene = mi.load_dict(scene_of(nerf(), box=box))
    params = mi.traverse(scene)
    dr.enable_grad(params["box.interior_medium.to_world"])
    params.update()
    with pytest.raises(mi_nerf.InputError, match="the place of a field in normalised"):
        dr.backward(mi.render(scene, params))


# ---- Recovery -------------------------------------------------------------------


@pytest.mark.slow
def test_a_pose_is_recovered_from_an_image() -> None:
    """The recipe of README: descent on a field's place, from a picture of it elsewhere."""
    field = formula_dict("two_color", place().scale([0.8, 0.5, 0.4]), density=6.0)
    field["interior"]["axis"] = mi.ScalarVector3f(1, 0, 0)
    scene = mi.load_dict(scene_of(nerf(), field=field, back=lamp(1.5, (0.1, 0.2, 0.3))))
    params = mi.traverse(scene)

    def move(shift: Any, angle: Any) -> None:
        """Shifts the field, and turns it about the vertical axis."""
        pose = mi.Transform4f().translate(shift).rotate(mi.Vector3f(0, 0, 1), angle)
        params["field.interior_medium.to_world"] = pose
        params.update()

    true_shift, true_angle = [0.3, -0.4, 0.5], 25.0
    move(mi.Vector3f(true_shift), mi.Float(true_angle))
    target = mi.render(scene, spp=64, seed=1)
    optimizer = mi.ad.Adam(lr=0.05)
    optimizer["shift"], optimizer["turn"] = mi.Vector3f(0), mi.Float(0)
    losses = []
    for step in range(60):
        move(optimizer["shift"], 30 * optimizer["turn"])
        image = mi.render(scene, params, spp=8, seed=2 * step, seed_grad=2 * step + 1)
        loss = dr.mean(dr.square(image - target), axis=None)
        dr.backward(loss)
        optimizer.step()
        losses.append(float(loss.array[0]))
    assert losses[-1] < losses[0] / 10
    np.testing.assert_allclose(np.ravel(optimizer["shift"]), true_shift, atol=0.06)
    assert 30 * float(optimizer["turn"][0]) == pytest.approx(true_angle, abs=3)
