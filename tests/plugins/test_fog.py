"""Media of Mitsuba's own beside fields: in the right order, against known answers."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mi_nerf  # noqa: F401
from mi_nerf.base.errors import InputError
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
    slab,
    slab_interval,
)
from tests.support.variants import EVERY
from tests.support.variants import variant as variant_of

pytestmark = pytest.mark.usefixtures("variant")

EXTINCTION = np.array([0.5, 0.8, 1.1])
BACK = 3.2  # where the lamp is


def bank(
    y: float, depth: float, uneven: bool = False, albedo: float = 0.0, high: float = 6.0
) -> dict[str, Any]:
    """Fog across the view from y to y + depth.

    An uneven one has a grid that is constant as far as one sees, and denser in a corner: so
    some of the collisions that Mitsuba samples are none.
    """
    fill = place().translate([0, y + depth / 2, 0]).scale([6, depth / 2, high])
    medium: dict[str, Any] = {"type": "homogeneous", "sigma_t": rgb(EXTINCTION / 2)}
    if uneven:
        corner = fill.translate([-1, -1, -1]).scale(2)
        grid = np.tile(np.float32(EXTINCTION / 2), (7, 7, 7, 1))
        grid[0, 0, 0] = 1.0
        values = mi.VolumeGrid(grid)
        volume = {"type": "gridvolume", "grid": values, "to_world": corner, "raw": True}
        medium = {"type": "heterogeneous", "sigma_t": volume}
    medium |= {"albedo": albedo, "scale": 2.0}
    return {"type": "cube", "to_world": fill, "bsdf": {"type": "null"}, "interior": medium}


def check(errors: np.ndarray, floor: float = 5e-3) -> None:
    """That K pictures are 0 on average: in every pixel, and in the mean over all."""
    error = errors.std(axis=0, ddof=1) / np.sqrt(len(errors))
    z = errors.mean(axis=0) / np.hypot(error, floor)
    assert np.abs(z).max() < 8 and z.std() < 1.5
    whole = np.abs(errors.mean(axis=(0, 1, 2)))
    assert (whole < 5 * np.sqrt((error**2).mean(axis=(0, 1)) / error[..., 0].size) + 1e-4).all()


# ---- Closed forms ----------------------------------------------------------------


def closed_form(
    o: np.ndarray, d: np.ndarray, layers: list[tuple[str, Any]], extinction: Any = EXTINCTION
) -> np.ndarray:
    """What rays see of layers one behind the other: boxes of fields, and depths of fog."""
    color, through = np.zeros((len(o), 3)), np.ones((len(o), 3))
    for kind, what in layers:
        if kind == "field":
            seen = boxes_seen(o, d, [what], distance_to_wall(o, d, BACK))
            color += through * seen[:, :3]
            through = through * (1 - seen[:, 3:4])
        else:
            through = through * np.exp(-what / d[:, 1:2] * extinction)
    return color + through * np.array(GLOW)


ORDERS = {  # fog by where it begins
    "fog, field": [-1.6, "here"],
    "field, fog": ["here", 0.7],
    "fog, field, fog": [-1.6, "here", 0.7],
    "field, fog, field": ["here", 0.7, "beyond"],
}
DEPTH = 0.8


def box_of(name: str) -> tuple[Any, float, Any]:
    """Place, density and radiance of a field."""
    if name == "here":
        return place().scale([0.9, 0.5, 0.7]), 0.9, (0.2, 0.7, 1.3)
    beyond = place().translate([0.2, 2.2, 0]).rotate([0, 1, 0], 30).scale([0.9, 0.5, 0.9])
    return beyond, 1.7, (0.1, 0.3, 1.1)


def layered(order: str, integrator: dict[str, Any], uneven: bool = False) -> dict[str, Any]:
    objects = {
        f"part_{i}": slab(*box_of(what)) if isinstance(what, str) else bank(what, DEPTH, uneven)
        for i, what in enumerate(ORDERS[order])
    }
    return scene_of(integrator, back=lamp(BACK), **objects)


def layers_of(order: str) -> list[tuple[str, Any]]:
    """For ``closed_form``."""
    fields = {name: box_of(name) for name in ("here", "beyond")}
    return [
        ("field", (matrix_of(fields[what][0]), *fields[what][1:]))
        if isinstance(what, str)
        else ("fog", DEPTH)
        for what in ORDERS[order]
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("nested", "order", "uneven"),
    [
        ("volpath", "field, fog, field", False),
        ("volpath", "fog, field, fog", True),
        ("volpathmis", "fog, field", False),
        ("prbvolpath", "field, fog", False),
        ("prbvolpath", "field, fog, field", True),
    ],
)
def test_layers_agree_with_their_closed_form(nested: str, order: str, uneven: bool) -> None:
    """Rays differ from seed to seed: each picture is compared with what its own rays see."""
    integrator = nerf(nested, samples=4, paths=16, jitter=False)
    scene, runs = mi.load_dict(layered(order, integrator, uneven)), 12
    layers = layers_of(order)
    errors = []
    for seed in range(runs):
        expected = closed_form(*camera_rays(scene, seed), layers).reshape(12, 16, 3)
        errors.append(render(scene, seed=seed)[..., :3] - expected)
    check(np.stack(errors))


@pytest.mark.slow
@pytest.mark.parametrize(("banks", "uneven"), [([0.8], False), ([-1.6, 0.8], True)])
def test_light_that_fog_scatters_agrees_with_volpath(banks: list[float], uneven: bool) -> None:
    """A field that only absorbs, before a fog bank, as volpath shows such a medium.

    Banks are lit from straight above, so that no light comes through the field to them.
    """
    cube = place().scale(0.6)
    light = {"type": "directional", "direction": [0, 0, -1], "irradiance": rgb((20, 18, 16))}
    dark = {"type": "homogeneous", "albedo": 0.0, "sigma_t": 0.9, "scale": 1 / 0.6}
    among = {f"fog_{i}": bank(y, 0.6, uneven, 0.7, high=0.9) for i, y in enumerate(banks)}
    among["light"] = light
    short = {"type": "volpath", "max_depth": 2}
    field = slab(cube, 0.9, (0, 0, 0))
    ours = mi.load_dict(scene_of(nerf(short, samples=4), field=field, **among))
    medium = {"type": "cube", "to_world": cube, "bsdf": {"type": "null"}, "interior": dark}
    theirs = mi.load_dict(scene_of(short, medium=medium, **among))
    none = mi.load_dict(scene_of(short, **among))
    seeds = range(12)
    one, two, three = (
        np.stack([render(scene, spp=64, seed=97 * i + j)[..., :3] for i in seeds])
        for j, scene in enumerate((ours, theirs, none))
    )
    check(one - two, floor=2e-3)
    assert np.abs((one - three).mean(axis=0)).max() > 0.05  # the field matters


# ---- Fields in fog ---------------------------------------------------------------


def both_seen(
    o: np.ndarray,
    d: np.ndarray,
    box: tuple[Any, float, Any],
    fog: tuple[float, float],
    extinction: np.ndarray,
) -> np.ndarray:
    """Fog that only absorbs, from one y to another, and a box of constant density in it."""
    matrix, density, color = box
    inverse = np.linalg.inv(matrix)
    local_o, local_d = o @ inverse[:3, :3].T + inverse[:3, 3], d @ inverse[:3, :3].T
    in_box = slab_interval(local_o, local_d, [-1] * 3, [1] * 3)
    in_fog = np.stack([(y - o[:, 1]) / d[:, 1] for y in fog], axis=1)
    rate = density * np.linalg.norm(local_d, axis=1)[:, None]
    ends = np.sort(np.concatenate([in_box, in_fog], axis=1), axis=1)
    seen, through = np.zeros((len(o), 3)), np.ones((len(o), 3))
    for a, b in zip(ends[:, :-1].T, ends[:, 1:].T, strict=True):
        inside = [((s[:, 0] <= a) & (b <= s[:, 1]))[:, None] for s in (in_box, in_fog)]
        field, medium = inside[0] * rate, inside[1] * extinction
        total = field + medium
        weight = through * -np.expm1(-total * (b - a)[:, None])
        seen += weight * field / np.maximum(total, 1e-300) * color
        through = through * np.exp(-total * (b - a)[:, None])
    return seen + through * np.array(GLOW)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("nested", "fog", "uneven", "opaque"),
    [
        ("volpath", (-1.6, 1.4), False, True),  # all around the field
        ("volpathmis", (-1.6, 1.4), True, False),
        ("volpath", (-1.6, 0.1), False, True),  # before it, and in its front half
        ("volpath", (0.1, 1.6), False, False),
    ],
)
def test_a_field_in_fog_agrees_with_its_closed_form(
    nested: str, fog: tuple[float, float], uneven: bool, opaque: bool
) -> None:
    """What is opaque is seen through the fog before it; what is not, at its mean depth.

    The second is right to second order: thin fog makes that less than the noise.
    """
    transform, density, color = box_of("here")
    density, scale = (60.0, 1.0) if opaque else (density, 0.15)
    bank_of_fog = bank(fog[0], fog[1] - fog[0], uneven)
    bank_of_fog["interior"]["scale"] *= scale
    integrator = nerf(nested, samples=512 if opaque else 64, paths=16, jitter=False)
    objects = {"box": slab(transform, density, color), "fog": bank_of_fog}
    scene, errors = mi.load_dict(scene_of(integrator, back=lamp(BACK), **objects)), []
    for seed in range(12):
        rays = camera_rays(scene, seed)
        box = (matrix_of(transform), density, np.array(color))
        expected = both_seen(*rays, box, fog, scale * EXTINCTION).reshape(12, 16, 3)
        errors.append(render(scene, seed=seed)[..., :3] - expected)
    check(np.stack(errors))


@pytest.mark.slow
def test_fog_before_and_behind_an_opaque_field_scatters_as_around_a_black_cube() -> None:
    """Lit from behind the camera: nothing that is seen lies in the shadow of the cube."""
    cube = place().scale(0.6)
    light = {"type": "directional", "direction": [0, 1, 0], "irradiance": rgb((20, 18, 16))}
    around = {"light": light, "fog": bank(-1.6, 3.0, albedo=0.7)}
    short = {"type": "volpath", "max_depth": 2}
    field = slab(cube, 200.0, (0, 0, 0))
    ours = mi.load_dict(scene_of(nerf(short, samples=512), field=field, **around))
    solid = {"type": "cube", "to_world": cube, "bsdf": {"type": "diffuse", "reflectance": 0.0}}
    theirs = mi.load_dict(scene_of(short, solid=solid, **around))
    one, two = (
        np.stack([render(scene, spp=64, seed=97 * i + j)[..., :3] for i in range(12)])
        for j, scene in enumerate((ours, theirs))
    )
    check(one - two, floor=1e-2)
    assert two.mean() > 0.1


def test_derivatives_of_a_field_in_fog_are_refused() -> None:
    transform, density, color = box_of("here")
    objects = {"box": slab(transform, density, color), "fog": bank(-1.6, 3.0)}
    scene = mi.load_dict(scene_of(nerf("volpath", jitter=False), back=lamp(BACK), **objects))
    params = mi.traverse(scene)
    dr.enable_grad(params["box.interior_medium.density"])
    params.update()
    image = mi.render(scene, params, spp=1)
    with pytest.raises((InputError, RuntimeError), match="within fog has no derivatives"):
        dr.backward(dr.sum(image, axis=None))


# ---- Other variants --------------------------------------------------------------

LUMINANCE = np.array([0.212671, 0.715160, 0.072169])


def grey(scene: dict[str, Any]) -> dict[str, Any]:
    """The same with fog that weakens all colours alike: a spectrum does not change what is left."""
    for part in scene.values():
        if isinstance(part, dict) and part.get("interior", {}).get("type") == "homogeneous":
            part["interior"] |= {"sigma_t": rgb([0.4] * 3)}
    return scene


@pytest.mark.slow
@pytest.mark.parametrize("name", [p for p in EVERY if "_mono" in str(p) or "_spectral" in str(p)])
def test_colors_of_other_variants(name: str) -> None:
    """Grey fog before and behind fields, against the closed form: means of pictures."""
    with variant_of(name):
        integrator = nerf("volpath", samples=4, paths=16, jitter=False)
        scene, errors = mi.load_dict(grey(layered("fog, field, fog", integrator))), []
        for seed in range(16):
            rays = camera_rays(scene, seed)
            expected = closed_form(*rays, layers_of("fog, field, fog"), np.full(3, 0.8))
            expected = expected if "_spectral" in name else (expected @ LUMINANCE)[:, None]
            found = render(scene, seed=seed)[..., : expected.shape[-1]]
            error = found - expected.reshape(found.shape)
            errors.append(error.mean(axis=(0, 1)))
    bound = 4 * np.std(errors, axis=0, ddof=1) / 4 + 5e-4 * expected.mean()
    assert (np.abs(np.mean(errors, axis=0)) < bound).all()
    assert (bound < 0.08 * expected.mean(axis=0)).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["llvm_ad_mono", "llvm_ad_spectral"])
def test_derivatives_in_other_variants(name: str) -> None:
    """By the field's density and colour, in fog, against finite differences."""
    with variant_of(name):
        nested = nerf("prbvolpath", samples=4, paths=1, jitter=False)
        scene = mi.load_dict(grey(layered("fog, field, fog", nested)))
        params = mi.traverse(scene)
        keys = [f"part_1.interior_medium.{key}" for key in ("density", "radiance")]
        options = {"spp": 4, "seed": 5}
        image = np.array(mi.render(scene, **options))
        pull = np.random.default_rng(0).random(image.shape)
        expected = []
        for key in keys:
            start, sums = np.array(params[key], np.float32), []
            for step in (1e-2, -1e-2, 0):
                moved = start.copy()
                moved.flat[0] += step
                params[key] = type(params[key])(moved)
                params.update()
                sums.append(float((render(scene, **options) * pull).sum()))
            expected.append((sums[0] - sums[1]) / 2e-2)
        for key in keys:
            dr.enable_grad(params[key])
        params.update()
        pull_in = mi.TensorXf(pull.astype(np.float32))
        scene.integrator().render_backward(scene, params, pull_in, **options)
        found = [np.array(dr.grad(params[key])).flat[0] for key in keys]
        np.testing.assert_allclose(found, expected, rtol=1e-2)
        assert np.abs(expected).min() > 0.1


# ---- Derivatives -----------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("uneven", [False, True])
def test_gradients_agree_with_those_of_the_closed_form(uneven: bool) -> None:
    """Of all pixels, with respect to what the fog absorbs, and how dense the field behind is."""
    scene = mi.load_dict(layered("fog, field", nerf("prbvolpath", samples=4, jitter=False), uneven))
    params = mi.traverse(scene)
    name = "data" if uneven else "value.value"
    keys = [f"part_0.interior_medium.sigma_t.{name}", "part_1.interior_medium.density"]
    dr.enable_grad([params[key] for key in keys])
    params.update()
    found = []
    for seed in range(12):
        image = mi.render(scene, params, spp=32, seed=seed, seed_grad=1000 + seed)
        dr.backward(dr.mean(image[..., :3], axis=None) * 3)
        of_fog, of_field = (np.array(dr.grad(params[key]), np.float64) for key in keys)
        of_fog = of_fog.reshape(-1, 3).sum(axis=0) if uneven else of_fog.ravel()
        found.append([*(of_fog / 2), of_field.item()])  # the scale of the medium is 2
        dr.set_grad(params[keys[0]], 0), dr.set_grad(params[keys[1]], 0)
    o, d = camera_rays(scene)
    move, density, color = box_of("here")

    def mean(extinction: np.ndarray, density: float) -> np.ndarray:
        layers = [("fog", DEPTH), ("field", (matrix_of(move), density, color))]
        return closed_form(o, d, layers, extinction).mean(axis=0)

    step = 1e-4
    expected = [
        *(mean(EXTINCTION + step, density) - mean(EXTINCTION - step, density)) / (2 * step),
        (mean(EXTINCTION, density + step) - mean(EXTINCTION, density - step)).sum() / (2 * step),
    ]
    error = np.std(found, axis=0, ddof=1) / np.sqrt(len(found))
    off = np.mean(found, axis=0) - expected
    assert (np.abs(off) < 5 * error + 2e-3 * np.abs(expected)).all()
    assert (error < 0.05 * np.abs(expected)).all()


@pytest.mark.slow
def test_forward_derivatives_are_those_of_backward_mode() -> None:
    scene = mi.load_dict(layered("fog, field, fog", nerf("volpath", jitter=False)))
    params = mi.traverse(scene)
    key = "part_1.interior_medium.density"

    def attached() -> tuple[Any, Any]:
        x = mi.Float(0.0)
        dr.enable_grad(x)
        params[key] = mi.TensorXf(x + 0.9)
        params.update()
        return x, dr.sum(mi.render(scene, params, spp=4, seed_grad=3), axis=None)

    x, loss = attached()
    dr.backward(loss)
    y, loss = attached()
    dr.forward(y)
    assert float(dr.grad(loss).array[0]) == pytest.approx(float(dr.grad(x)[0]), rel=1e-3)
    assert abs(float(dr.grad(x)[0])) > 1e-2


@pytest.mark.slow
def test_pictures_compile_nothing_after_the_first_ones() -> None:
    scene = mi.load_dict(layered("field, fog, field", nerf("volpath")))
    missed = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for seed in range(4):
            dr.kernel_history_clear()
            dr.eval(mi.render(scene, spp=4, seed=seed))
            missed.append(sum(k.get("cache_hit") == 0 for k in dr.kernel_history()))
        dr.kernel_history_clear()
    assert missed[2:] == [0, 0]


# ---- Bad input -------------------------------------------------------------------


def refused(
    integrator: dict[str, Any], sensor: dict[str, Any] | None = None, **objects: Any
) -> str:
    scene = scene_of(integrator, **objects)
    scene["sensor"] |= sensor or {}
    with pytest.raises(RuntimeError) as failure:
        render(scene)
    return f"{failure.value} {failure.value.__cause__}"


def test_what_is_refused() -> None:
    field, fog = slab(place(), 1.0, GLOW), bank(1.5, 1.0)
    for integrator in (nerf(None), nerf("path"), {"type": "nerf_path"}, {"type": "nerf_tracking"}):
        said = refused(integrator, box=field, fog=fog)
        assert "shape 'fog' holds a medium of type 'HomogeneousMedium', expected no" in said
    said = refused(nerf("prbvolpath"), box=field, fog=bank(0.5, 1.0))
    assert "a field lies within a medium, where nested integrator 'prbvolpath' cannot" in said
    inside = {"medium": bank(0, 1)["interior"], "id": "eye"}
    said = refused(nerf("volpath"), inside, box=field)
    assert "the sensor 'eye' is in a medium, expected it outside" in said
