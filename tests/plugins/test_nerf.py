"""The integrator and the medium as a Mitsuba user meets them."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mi_nerf  # noqa: F401
from mi_nerf.base.color import srgb_to_linear
from mi_nerf.plugins.placement import cubes_to_world
from tests.support.composed import GLOW, boxes_seen, camera_rays, slab
from tests.support.fields import formula_dict, scene_dict, small_file, weight_keys


@pytest.fixture
def field(tmp_path: Path) -> Path:
    return small_file(tmp_path)


def render(scene: Any, **options: Any) -> np.ndarray:
    return np.array(mi.render(mi.load_dict(scene), **options))


# --------------------------------------------------------------------------
#   Loading
# --------------------------------------------------------------------------


def test_xml_finds_the_field_beside_the_scene(variant: str, field: Path) -> None:
    xml = """<scene version="3.0.0">
        <integrator type="nerf"/>
        <sensor type="perspective">
            <transform name="to_world">
                <lookat origin="0, -4, 0" target="0, 0, 0" up="0, 0, 1"/>
            </transform>
            <film type="hdrfilm">
                <integer name="width" value="8"/><integer name="height" value="6"/>
                <string name="pixel_format" value="rgba"/>
            </film>
        </sensor>
        <shape type="cube">
            <bsdf type="null"/>
            <medium type="nerfmedium" name="interior" id="field">
                <string name="filename" value="field_0.safetensors"/>
            </medium>
        </shape>
    </scene>"""
    path = field.parent / "scene.xml"
    path.write_text(xml)
    image = np.array(mi.render(mi.load_file(str(path))))
    assert image.shape == (6, 8, 4)
    assert image[3, 4, 3] > 0.5 and np.isfinite(image).all()


@pytest.mark.slow
def test_plugins_survive_variant_switches(field: Path) -> None:
    mi.set_variant("llvm_ad_rgb")
    before = render(scene_dict(field), seed=3)
    for other in ("scalar_rgb", "llvm_ad_spectral", "scalar_rgb", "llvm_ad_rgb"):
        mi.set_variant(other)
    np.testing.assert_array_equal(render(scene_dict(field), seed=3), before)


def test_the_package_may_be_reloaded(field: Path) -> None:
    """As Mitsuba does from version 3.10 on, for packages that declare its entry point."""
    mi.set_variant("llvm_ad_rgb")
    importlib.reload(mi_nerf)
    assert render(scene_dict(field)).shape == (12, 16, 4)


@pytest.mark.parametrize(
    ("integrator", "message"),
    [
        ({"samples": -1}, "samples=-1, expected 1 or more"),
        ({"rule": "cubic"}, "rule='cubic', expected constant or cells or linear"),
        ({"paths": 0}, "paths=0, expected 1 or more"),
        ({"aovs": "color"}, "aov 'color' is unknown, expected depth, opacity, normal or index"),
    ],
)
def test_bad_integrator_properties(variant: str, integrator: Any, message: str) -> None:
    with pytest.raises(RuntimeError, match=message):
        mi.load_dict({"type": "nerf", **integrator})


def test_missing_field_file(variant: str, tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match=r"nothing\.safetensors: not found"):
        mi.load_dict({"type": "nerfmedium", "filename": str(tmp_path / "nothing.safetensors")})
    with pytest.raises(RuntimeError, match="expected 'filename', a field file, or 'field'"):
        mi.load_dict({"type": "nerfmedium"})


# --------------------------------------------------------------------------
#   Film, sampler, sensor
# --------------------------------------------------------------------------


def test_alpha_is_the_opacity_and_aovs_follow(variant: str, field: Path) -> None:
    image = render(scene_dict(field, integrator={"aovs": "z:depth, opacity"}))
    assert image.shape == (12, 16, 6)
    np.testing.assert_allclose(image[..., 3], image[..., 5], atol=1e-6)
    assert 0.05 < image[6, 8, 3] < 0.999  # neither a Boolean nor empty
    assert image[..., 3].min() >= 0 and image[..., 3].max() <= 1
    seen = image[..., 5] > 0.5
    distance = np.linalg.norm([1.5, -3.0, 1.0])
    assert np.all(np.abs(image[seen, 4] - distance) < 2)


def test_opacity_and_depth_do_not_depend_on_the_distance_unit(variant: str, field: Path) -> None:
    plain = render(scene_dict(field, integrator={"aovs": "depth"}), seed=1)
    grown = scene_dict(
        field,
        integrator={"aovs": "depth"},
        to_world=mi.ScalarTransform4f().scale(50.0),
    )
    grown["sensor"]["near_clip"] = 0.5  # 50 times the default
    image = render(grown, seed=1)
    np.testing.assert_allclose(image[..., :4], plain[..., :4], atol=2e-5)
    np.testing.assert_allclose(image[..., 4], 50 * plain[..., 4], rtol=1e-3, atol=1e-2)


def test_box_moves_rotates_and_scales_with_its_cube(variant: str, field: Path) -> None:
    transform = (
        mi.ScalarTransform4f().translate([3.0, -1.0, 7.0]).rotate([0.6, 0.0, 0.8], 40).scale(0.5)
    )
    scene = scene_dict(field, to_world=transform)
    scene["sensor"]["near_clip"] = 0.005
    np.testing.assert_allclose(render(scene, seed=2), render(scene_dict(field), seed=2), atol=1e-3)


def test_cube_to_world_is_recovered(variant: str) -> None:
    transform = (
        mi.ScalarTransform4f().translate([3, -1, 7]).rotate([1, 2, 0.5], 40).scale([2, 0.5, 3])
    )
    cube = mi.load_dict({"type": "cube", "to_world": transform})
    expected = np.array(transform.matrix, np.float64).reshape(4, 4)
    np.testing.assert_allclose(cubes_to_world(cube), [expected], atol=2e-6)


def test_box_outside_the_unit_cube_appears_where_it_was_trained(
    variant: str, tmp_path: Path
) -> None:
    file = small_file(tmp_path, lower=(1.0, 1.0, 1.0), upper=(1.5, 2.0, 1.5))
    scene = scene_dict(file, origin=(1.25, -2.0, 1.25))
    view = mi.ScalarTransform4f().look_at(
        origin=[1.25, -2.0, 1.25], target=[1.25, 1.5, 1.25], up=[0, 0, 1]
    )
    scene["sensor"]["to_world"] = view
    alpha = render(scene)[..., 3]
    assert alpha[6, 8] > 0.1 and alpha[0, 0] == 0


@pytest.mark.slow
def test_crop_window_is_a_part_of_the_whole(variant: str, field: Path) -> None:
    whole = scene_dict(field, size=(16, 12), spp=256)
    crop = {"crop_width": 5, "crop_height": 4, "crop_offset_x": 6, "crop_offset_y": 3}
    part = render(scene_dict(field, size=(16, 12), spp=256, film=crop))
    assert part.shape == (4, 5, 4)
    np.testing.assert_allclose(part, render(whole)[3:7, 6:11], atol=0.02)


@pytest.mark.slow
def test_seed_and_spp(variant: str, field: Path) -> None:
    scene = mi.load_dict(scene_dict(field))
    first = np.array(mi.render(scene, seed=5))
    np.testing.assert_array_equal(np.array(mi.render(scene, seed=5)), first)
    assert np.abs(np.array(mi.render(scene, seed=6)) - first).max() > 1e-4
    reference = np.array(mi.render(scene, spp=1024))
    errors = [
        np.square(np.array(mi.render(scene, spp=spp, seed=9)) - reference).mean() for spp in (1, 64)
    ]
    assert errors[1] < errors[0] / 8


@pytest.mark.slow
def test_passes_of_bounded_size_agree(
    variant: str, field: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mi_nerf.plugins.film import FieldIntegrator

    scene = mi.load_dict(scene_dict(field))
    whole = np.array(mi.render(scene, spp=512))
    monkeypatch.setattr(FieldIntegrator, "rays_per_pass", 16 * 12 * 100)
    np.testing.assert_allclose(np.array(mi.render(scene, spp=512)), whole, atol=0.02)


@pytest.mark.parametrize("filter_name", ["gaussian", "tent", "mitchell"])
def test_reconstruction_filters(variant: str, field: Path, filter_name: str) -> None:
    box = render(scene_dict(field, spp=64))
    film = {"rfilter": {"type": filter_name}}
    image = render(scene_dict(field, spp=64, film=film))
    assert np.abs(image - box).max() > 1e-3  # it is used
    np.testing.assert_allclose(image[3:-3, 3:-3].mean(), box[3:-3, 3:-3].mean(), rtol=0.05)


def assert_is_the_closed_form(scene: dict[str, Any]) -> None:
    """The scene's one field, made a constant one, looks as it must: a ray a pixel."""
    loaded = mi.load_dict({**scene, "box": slab(mi.ScalarTransform4f(), 0.9, GLOW)})
    o, d = camera_rays(loaded)
    expected = boxes_seen(o, d, [(np.eye(4), 0.9, GLOW)], np.full(len(o), np.inf))[:, :4]
    assert (expected[:, 3] > 0.5).any()
    image = np.array(mi.render(loaded))
    width, height = loaded.sensors()[0].film().size()
    np.testing.assert_allclose(image, expected.reshape(height, width, 4), atol=2e-5)


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1)])
def test_tiny_films(variant: str, field: Path, size: tuple[int, int]) -> None:
    assert_is_the_closed_form(scene_dict(field, size=size, spp=1))


def test_rgb_film(variant: str, field: Path) -> None:
    rgb = render(scene_dict(field, film={"pixel_format": "rgb"}))
    np.testing.assert_allclose(rgb, render(scene_dict(field))[..., :3], atol=1e-6)


def test_camera_inside_the_box(variant: str, field: Path) -> None:
    assert_is_the_closed_form(scene_dict(field, origin=(0.1, -0.2, 0.3), spp=1))


def test_near_and_far_cut_the_ray(variant: str, field: Path) -> None:
    whole = render(scene_dict(field), seed=1)[..., 3]
    distance = float(np.linalg.norm([1.5, -3.0, 1.0]))
    near = render(scene_dict(field, integrator={"far": distance}), seed=1)[..., 3]
    far = render(scene_dict(field, integrator={"near": distance}), seed=1)[..., 3]
    assert np.all(near <= whole + 1e-6) and np.all(far <= whole + 1e-6)
    # Transmittances of the two halves multiply, up to the different placement of samples.
    np.testing.assert_allclose((1 - near) * (1 - far), 1 - whole, atol=0.05)
    assert render(scene_dict(field, integrator={"far": 0.1})).max() == 0


# --------------------------------------------------------------------------
#   Background and colour
# --------------------------------------------------------------------------


def test_environment_shows_behind_the_field(variant: str, field: Path) -> None:
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [0.2, 0.5, 2.0]}}
    alone = render(scene_dict(field), seed=4)
    behind = render(scene_dict(field, sky=sky), seed=4)
    expected = alone[..., :3] + (1 - alone[..., 3:]) * np.array([0.2, 0.5, 2.0])
    np.testing.assert_allclose(behind[..., :3], expected, atol=1e-5)
    np.testing.assert_allclose(behind[..., 3], alone[..., 3], atol=1e-6)
    hidden = render(scene_dict(field, sky=sky, integrator={"hide_emitters": True}), seed=4)
    np.testing.assert_allclose(hidden, alone, atol=1e-6)


@pytest.mark.slow
def test_envmap_is_seen_in_the_direction_of_the_ray(variant: str, field: Path) -> None:
    pixels = np.random.default_rng(0).random((8, 16, 3)).astype(np.float32)
    sky = {"type": "envmap", "bitmap": mi.Bitmap(pixels)}
    scene = scene_dict(field, sky=sky, spp=64)
    scene["sensor"]["to_world"] = mi.ScalarTransform4f().look_at(
        origin=[0, -5, 0], target=[0, -10, 0], up=[0, 0, 1]
    )  # away from the field
    ours = render(scene)
    path = render({**scene, "integrator": {"type": "path"}, "box": {"type": "cube"}})
    np.testing.assert_allclose(ours[..., :3], path[..., :3], atol=0.02)
    assert ours[..., 3].max() == 0


def test_srgb_fields_come_out_linear(variant: str, tmp_path: Path) -> None:
    srgb = render(scene_dict(small_file(tmp_path, seed=1)), seed=1, spp=1)
    linear = render(scene_dict(small_file(tmp_path, seed=1, color_space="linear")), seed=1, spp=1)
    alpha = linear[..., 3:]
    straight = linear[..., :3] / np.maximum(alpha, 1e-9)
    expected = np.where(alpha > 0, srgb_to_linear(straight) * alpha, 0)
    np.testing.assert_allclose(srgb[..., :3], expected, atol=1e-5)


# --------------------------------------------------------------------------
#   Parameters and memory
# --------------------------------------------------------------------------


def test_weights_are_scene_parameters(variant: str, field: Path) -> None:
    scene = mi.load_dict(scene_dict(field))
    params = mi.traverse(scene)
    keys = weight_keys(params)
    assert "box.interior_medium.trunk_0_weight" in keys and len(keys) == 14
    before = np.array(mi.render(scene))
    key = "box.interior_medium.density_bias"
    params[key] = params[key] - 50.0
    params.update()
    after = np.array(mi.render(scene))
    assert before[..., 3].max() > 0.5 and after[..., 3].max() < 1e-6
    assert "trunk" not in scene.integrator().to_string()


def test_a_grid_without_cells_does_not_hide_new_weights(variant: str, tmp_path: Path) -> None:
    contents = mi_nerf.load_field(small_file(tmp_path))
    empty = np.zeros((4, 4, 4), bool)
    path = tmp_path / "masked.safetensors"
    mi_nerf.save_field(
        path, mi_nerf.FieldFile(contents.config, contents.weights, empty, contents.march)
    )
    scene = mi.load_dict(scene_dict(path))
    assert np.array(mi.render(scene)).max() == 0
    params = mi.traverse(scene)
    key = "box.interior_medium.density_bias"
    params[key] = params[key] + 0.1
    params.update()
    assert np.array(mi.render(scene))[..., 3].max() > 0.5


@pytest.mark.slow
def test_optimising_a_weight_through_mi_render(variant: str, field: Path) -> None:
    scene = mi.load_dict(scene_dict(field, spp=1))
    target = mi.render(scene, seed=0, spp=16)
    params = mi.traverse(scene)
    key = "box.interior_medium.color_bias"
    optimizer = mi.ad.Adam(lr=0.2)
    optimizer[key] = params[key] + 1.5
    losses = []
    for step in range(25):
        params.update(optimizer)
        loss = dr.mean(dr.square(mi.render(scene, params, seed=step, spp=4) - target), axis=None)
        dr.backward(loss)
        optimizer.step()
        losses.append(float(loss.array[0]))
    assert losses[-1] < 0.1 * losses[0]


@pytest.mark.parametrize("kind", ["nerf", "nerf_path", "nerf_tracking"])
def test_parameters_that_are_no_numbers(variant: str, kind: str) -> None:
    """One sentence instead of a black or a NaN picture; and all is well once they are back."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": kind},
            "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 2, "height": 2}},
            "box": formula_dict("slab"),
        }
    )
    params = mi.traverse(scene)
    field = "box.interior_medium"
    flat = np.diag([1.0, 1.0, 0.0, 1.0])
    for key, value, message in [
        ("density", [np.nan], "density: NaN or infinite, expected finite numbers"),
        ("density", [np.inf], "density: NaN or infinite, expected finite numbers"),
        ("to_world", np.full((4, 4), np.nan), "to_world is NaN or infinite, expected finite"),
        ("to_world", flat, "to_world is singular, expected a volume"),
    ]:
        before = params[f"{field}.{key}"]
        kept = type(before)(np.array(before.matrix if key == "to_world" else before))
        value = np.array(value, np.float32)
        params[f"{field}.{key}"] = type(before)(value)
        params.update()
        with pytest.raises(RuntimeError) as caught:
            mi.render(scene, spp=1)
        assert "nerfmedium: " in str(caught.value.__cause__)
        assert message in str(caught.value.__cause__)
        params[f"{field}.{key}"] = kept
        params.update()
        assert np.isfinite(np.array(mi.render(scene, spp=1))).all()
    for name in ("near", "far"):
        with pytest.raises(RuntimeError, match=f"{kind}: {name}=nan, expected a distance"):
            mi.load_dict({"type": kind, name: float("nan")})
