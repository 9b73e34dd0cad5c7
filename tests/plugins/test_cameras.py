"""Sensors and films of Mitsuba's own, through every integrator that shows fields.

Before test_native_loop.py, by name: Mitsuba's ``batch`` traces every sensor that there is, and
those of a RayDataLoader, even of one that is gone, fail in it (Mitsuba 3.9.1).
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_nerf.base.errors import InputError
from tests.support.composed import (
    GLOW,
    boxes_seen,
    matrix_of,
    nerf,
    place,
    render,
    rgb,
    slab,
)

pytestmark = pytest.mark.usefixtures("variant")


FILM = {
    "type": "hdrfilm",
    "width": 16,
    "height": 12,
    "pixel_format": "rgba",
    "rfilter": {"type": "box"},
}
ONE = FILM | {"width": 1, "height": 1}
LENS = {"type": "thinlens", "fov": 40.0, "aperture_radius": 0.3, "focus_distance": 3.0}


def view() -> Any:
    return place().look_at(origin=[0.3, -4.0, 0.5], target=[0, 0, 0], up=[0, 0, 1])


def sensors() -> dict[str, dict[str, Any]]:
    """By what is special about them."""
    plain = {"type": "perspective", "fov": 40.0, "to_world": view(), "film": FILM}
    window = {"crop_width": 5, "crop_height": 4, "crop_offset_x": 8, "crop_offset_y": 2}
    return {
        "principal point": plain
        | {"principal_point_offset_x": 0.2, "principal_point_offset_y": -0.1},
        "crop window": plain | {"film": FILM | window},
        "thin lens": LENS | {"to_world": view(), "film": FILM},
        "orthographic": {
            "type": "orthographic",
            "to_world": view() @ place().scale([2, 1.5, 1]),
            "film": FILM,
        },
        "radiance meter": {
            "type": "radiancemeter",
            "origin": [0.3, -4.0, 0.5],
            "direction": [-0.3, 4.0, -0.5],
            "film": ONE,
        },
        "batch": {
            "type": "batch",
            "first": {key: plain[key] for key in ("type", "fov", "to_world")},
            "second": LENS | {"to_world": view() @ place().rotate([0, 0, 1], 20)},
            "film": FILM | {"width": 32},
        },
    }


def cube() -> Any:
    return place().rotate([0.2, 0, 1], 30).scale(0.6)


def scene_with(sensor: dict[str, Any], integrator: dict[str, Any]) -> dict[str, Any]:
    """A box that shines: a dense field, or for ``path`` a mesh."""
    box = slab(cube(), 400.0, GLOW)
    if integrator["type"] == "path":
        light = {"type": "area", "radiance": rgb(GLOW)}
        box = {"type": "cube", "to_world": cube(), "emitter": light}
    sampler = {"type": "independent", "sample_count": 16}
    sensor = sensor | {"sampler": sampler}
    return {"type": "scene", "integrator": integrator, "sensor": sensor, "box": box}


INTEGRATORS = [nerf("path"), {"type": "nerf_path"}, {"type": "nerf_tracking"}]


@pytest.mark.slow
@pytest.mark.parametrize("integrator", INTEGRATORS, ids=lambda integrator: integrator["type"])
@pytest.mark.parametrize(
    "kind",
    ["principal point", "crop window", "thin lens", "orthographic", "radiance meter", "batch"],
)
def test_a_box_looks_like_a_mesh(kind: str, integrator: dict[str, Any]) -> None:
    """The samplers give both the same rays."""
    sensor = sensors()[kind]
    expected = render(scene_with(sensor, {"type": "path"}), seed=1)
    image = render(scene_with(sensor, integrator), seed=1)
    assert image.shape == expected.shape
    np.testing.assert_allclose(image, expected, atol=1.5 / 16)
    assert np.abs(image - expected).mean() < 3e-3
    if expected.size > 4 and kind != "crop window":
        assert 0.1 < expected[..., 3].mean() < 0.9


@pytest.mark.parametrize("kind", ["thin lens", "orthographic", "batch"])
def test_partly_transparent_boxes_agree_with_their_closed_form(kind: str) -> None:
    """Along the very rays that ``sample_ray`` gives."""
    sensor = sensors()[kind] | {"sampler": {"type": "independent", "sample_count": 1}}
    box = (cube(), 0.9, GLOW)
    integrator = nerf(None, jitter=False)
    scene = mi.load_dict(
        {"type": "scene", "integrator": integrator, "sensor": sensor, "box": slab(*box)}
    )
    eye = scene.sensors()[0]
    sampler, _ = scene.integrator().prepare(eye, 0, 1, [])
    ray, _, _ = scene.integrator().sample_rays(scene, eye, sampler)
    o, d = (np.array(v, np.float64).T for v in (ray.o, ray.d))
    seen = boxes_seen(o, d, [(matrix_of(box[0]), *box[1:])], np.full(len(o), np.inf))[:, :4]
    np.testing.assert_allclose(render(scene).reshape(-1, 4), seen, atol=2e-5)
    assert 0.1 < (seen[:, 3] > 0).mean() < 0.9


@pytest.mark.slow
def test_an_irradiance_meter() -> None:
    """On a ball beside the box: it takes part as a surface, and its sensor sees the field."""
    meter = {"type": "irradiancemeter", "film": ONE}
    meter["sampler"] = {"type": "independent", "sample_count": 4096}
    found = []
    for integrator in ({"type": "path"}, *INTEGRATORS):
        scene = scene_with({"type": "perspective"}, integrator)
        del scene["sensor"]
        scene["ball"] = {"type": "sphere", "center": [0, -2, 0], "radius": 0.2, "sensor": meter}
        found.append(render(scene, seed=1).ravel()[:3])
    np.testing.assert_allclose(found[1:], np.tile(found[0], (3, 1)), rtol=0.02)
    assert found[0][0] > 0.05


def test_several_sensors_in_a_scene() -> None:
    """Pictures and derivatives of each, by its number or as an object."""
    first, second = sensors()["principal point"], sensors()["orthographic"]
    scene = scene_with(first, nerf(None, jitter=False))
    scene["sensor_2"] = second | {"sampler": {"type": "independent", "sample_count": 1}}
    scene["box"] = slab(cube(), 0.9, GLOW)
    both = mi.load_dict(scene)
    single = mi.load_dict({**scene_with(second, nerf(None, jitter=False)), "box": scene["box"]})
    for sensor in (1, both.sensors()[1]):
        image = render(both, sensor=sensor, spp=4)
        np.testing.assert_array_equal(image, render(single, spp=4))
    slopes = []
    for loaded, sensor in ((both, 1), (single, 0)):
        params = mi.traverse(loaded)
        key = "box.interior_medium.density"
        dr.enable_grad(params[key])
        params.update()
        image = mi.render(loaded, params, sensor=sensor, spp=4, seed_grad=5)
        dr.backward(dr.sum(image, axis=None))
        slopes.append(np.array(dr.grad(params[key])).item())
    assert slopes[0] == pytest.approx(slopes[1], rel=1e-5) and slopes[0] > 1
    for number in (2, -1):
        with pytest.raises(InputError, match="the scene has no such sensor"):
            both.integrator().render(both, sensor=number)


@pytest.mark.parametrize("what", ["sensor type='perspective'", "shape type='cube'"])
def test_mitsuba_refuses_animations(what: str) -> None:
    keys = "<transform time='0'/><transform time='1'><translate x='1'/></transform>"
    part = f"<{what}><animation name='to_world'>{keys}</animation></{what.split()[0]}>"
    with pytest.raises(RuntimeError, match="unsupported XML element: <animation>"):
        mi.load_string(f"<scene version='3.0.0'>{part}</scene>")
