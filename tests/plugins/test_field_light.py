"""Fields as light sources: how much power they have, which directions they are sampled in."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.plugins.test_nerf_path import floor, overhead, paths, point_light
from tests.support.composed import GLOW, place, scene_of, slab

pytestmark = pytest.mark.usefixtures("variant")


def loaded(integrator: dict[str, Any] | None = None, **objects: Any) -> tuple[Any, Any, Any]:
    """A scene, its integrator, and the fields as the integrator has them."""
    from mi_nerf.plugins.placement import find_fields

    scene = mi.load_dict(scene_of(integrator or paths(), **objects))
    integrator = scene.integrator()
    return scene, integrator, integrator._marched(find_fields(scene, least=0))


def test_power_of_opaque_boxes() -> None:
    """π A L, of each by its own size and colour."""
    from mi_nerf.plugins.power import field_powers

    big = place().translate([2, 0, 1]).rotate([0, 0, 1], 30).scale([1.0, 0.5, 0.25])
    fields = {
        "a": slab(place().scale(0.5), 1e4, GLOW),
        "b": slab(big, 1e4, (0.2, 0.2, 0.2)),
        "c": slab(place().translate([9, 0, 0]), 0.0, GLOW),
    }
    _, _, found = loaded(**fields)
    areas = [6.0, 8 * (0.5 + 0.25 + 0.125), 24.0]
    expected = [np.pi * areas[0] * np.mean(GLOW), np.pi * areas[1] * 0.2, 0.0]
    np.testing.assert_allclose(field_powers(found), expected, rtol=1e-3, atol=1e-9)


def test_power_of_a_thin_box() -> None:
    """Of a medium that hides nothing: 4π σ V L."""
    from mi_nerf.plugins.power import field_powers

    _, _, found = loaded(a=slab(place().scale(0.5), 1e-3, (1, 1, 1)))
    # Lines through points of the volume are longer than lines on average: an estimate.
    (power,) = field_powers(found)
    assert 1.0 < power / (4 * np.pi * 2e-3 * 1.0) < 1.6


def test_share_of_a_field_among_lights() -> None:
    """Closed form: P / 4πR² (atan 2 − atan 1) against what a far point light and a sky bring."""
    from mi_nerf.plugins.power import field_powers, field_share

    field = {"a": slab(place().scale(0.5), 1e4, GLOW)}
    own = 6 * np.pi * np.mean(GLOW) / (4 * np.pi * 0.75) * (np.arctan(2) - np.arctan(1))
    lights = {
        "point": (point_light([0, 0, 100], 5e3), 0.5),
        "sky": ({"type": "constant", "radiance": 0.1}, 0.1 * 4 * np.pi),
    }
    for chosen in ([], ["point"], ["sky"], ["point", "sky"]):
        scene, integrator, found = loaded(**field, **{name: lights[name][0] for name in chosen})
        share = field_share(integrator._solid.of(scene), found, field_powers(found))
        expected = own / (own + sum(lights[name][1] for name in chosen))
        assert share == pytest.approx(expected, rel=2e-2)


def test_a_light_with_a_texture_that_cannot_send_rays(tmp_path: Any) -> None:
    """Colours of vertices are such: Mitsuba's emitters of them can only be seen."""
    triangle = mi.Mesh("triangle", 3, 1)
    params = mi.traverse(triangle)
    params["vertex_positions"] = mi.Float([0, 0, 3, 1, 0, 3, 0, 1, 3])
    params["faces"] = mi.UInt32([0, 2, 1])
    params.update()
    triangle.add_attribute("vertex_color", 3, [1.0] * 9)
    triangle.write_ply(str(tmp_path / "triangle.ply"))
    lamp = {
        "type": "ply",
        "filename": str(tmp_path / "triangle.ply"),
        "emitter": {
            "type": "area",
            "radiance": {"type": "mesh_attribute", "name": "vertex_color"},
        },
    }
    scene, integrator, _ = loaded(lamp=lamp, floor=floor(), field=slab(place(), 0.1, GLOW))
    assert integrator._scene(scene)._backdrop is not None
    assert np.isfinite(np.array(mi.render(scene, spp=1))).all()


@pytest.mark.parametrize(
    ("chosen", "lights", "sampled"),
    [
        ("auto", "none", True),
        ("auto", "weak", True),
        ("auto", "strong", False),
        ("auto", "sky", False),
        (True, "strong", True),
        (False, "none", False),
    ],
)
def test_fields_are_sampled_where_they_are_the_lamps(
    chosen: Any, lights: str, sampled: bool
) -> None:
    others = {
        "none": {},
        "weak": {"lamp": overhead((0.1, 0.1, 0.1))},
        "strong": {"lamp": overhead((90, 80, 70))},
        "sky": {"sky": {"type": "constant", "radiance": 1.0}},
    }[lights]
    field = slab(place().scale(0.5), 9.0, GLOW)
    scene, integrator, _ = loaded(paths(sample_fields=chosen), floor=floor(), field=field, **others)
    lit = integrator._scene(scene)._backdrop._around.fields
    assert bool(lit.boxes) == sampled


def test_an_unknown_choice_is_refused() -> None:
    with pytest.raises(RuntimeError, match="nerf_path: sample_fields='sometimes', expected true,"):
        mi.load_dict(paths(sample_fields="sometimes"))


def test_directions_have_the_density_that_is_said() -> None:
    """From several points: ∫ p dω = 1, and the mean of f / p over samples is ∫ f dω."""
    from mi_nerf.plugins.field_light import FieldLight

    turned = place().translate([1, 0.2, 0]).rotate([1, 0, 1], 30).scale([0.5, 0.4, 0.3])
    _, _, fields = loaded(
        a=slab(turned, 1.0, GLOW),
        b=slab(place().translate([-2, 0, 1]).scale(0.6), 1.0, GLOW),
        c=slab(place().translate([0, 3, 1]).scale(0.4), 1.0, GLOW),
    )
    light = FieldLight(fields, [5.0, 1.0, 0.0])
    count, rng = 1 << 20, np.random.default_rng(0)
    axis = mi.Vector3f(0.3, -0.5, 0.8)
    for origin in ([0, 0, -1.0], [1, 0.2, 0.05], [-4.0, 1, 1]):
        at = mi.Point3f(*(dr.full(mi.Float, x, count) for x in origin))
        u = [mi.Float(rng.random(count, np.float32)) for _ in range(4)]
        even = mi.warp.square_to_uniform_sphere(mi.Point2f(u[0], u[1]))
        pdf = np.array(light.pdf(at, even), np.float64)
        assert 4 * np.pi * pdf.mean() == pytest.approx(1, abs=4 * 4 * np.pi * pdf.std() / 1024)
        d = light.sample(at, u[0], mi.Point3f(*u[1:]))
        density = np.array(light.pdf(at, d), np.float64)
        f = np.array(dr.square(dr.dot(axis, d)), np.float64) / density
        reached = np.array(dr.square(dr.dot(axis, even)), np.float64) * (pdf > 0)
        expected, error = 4 * np.pi * reached.mean(), 4 * np.pi * reached.std() / 1024
        assert density.min() > 0
        assert f.mean() == pytest.approx(expected, abs=5 * (error + f.std() / 1024))


def test_near_and_strong_fields_are_sampled_most() -> None:
    from mi_nerf.plugins.field_light import FieldLight

    _, _, fields = loaded(
        a=slab(place().translate([5, 0, 0]).scale(0.5), 1.0, GLOW),
        b=slab(place().translate([-5, 0, 0]).scale(0.5), 1.0, GLOW),
    )
    strong, even = FieldLight(fields, [9.0, 1.0]), FieldLight(fields)
    towards = mi.Vector3f(1, 0, 0)
    middle, near = mi.Point3f(0, 0, 0), mi.Point3f(2, 0, 0)
    ratio = strong.pdf(middle, towards)[0] / even.pdf(middle, towards)[0]
    assert ratio == pytest.approx(0.9 / 0.5, rel=1e-3)
    # 9 + 0.75 against 49 + 0.75
    there = even.pdf(near, towards)[0] / FieldLight(fields[:1]).pdf(near, towards)[0]
    assert there == pytest.approx(49.75 / (49.75 + 9.75), rel=1e-3)
