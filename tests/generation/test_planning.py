"""From scenes of many kinds to plans: what they look at, from where, and what is said of it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import mitsuba as mi
import numpy as np
import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.base.variants import available_variants, choose_variant, using_variant
from mi_nerf.cameras.poses import is_rigid
from mi_nerf.cli import main
from mi_nerf.data import available_splits, load_dataset
from mi_nerf.generation import Options, Plan, generate, preview
from mi_nerf.generation import run as generation
from mi_nerf.generation.viewpoints import around
from mi_nerf.scene_xml.library import find_scene
from mi_nerf.scene_xml.scene_file import SceneFile

from ..scene_xml.test_parts import ground_and_pyramids, write_mesh
from ..support.scenes import (
    BALL,
    GRAY,
    SKY,
    TWO_SIDED,
    floor,
    pinhole,
    room,
    square,
    write_scene,
)

VARIANT = choose_variant()
Z = np.array([0.0, 0.0, 1.0])


def plan_of(path: Path, **options: Any) -> Plan:
    mi.set_variant(VARIANT)
    return generation._plan(SceneFile(path), Options(**options))[-1]


def said(plan: Plan) -> str:
    return "\n".join(plan.notes)


def places(plan: Plan) -> np.ndarray:
    return np.array([view.pose[:3, 3] for view in plan.views])


# ---- Around the object -------------------------------------------------------


def test_a_large_floor_changes_nothing_about_the_cameras(tmp_path: Path) -> None:
    alone = plan_of(write_scene(tmp_path, BALL, SKY, pinhole()))
    plan = plan_of(write_scene(tmp_path, BALL, SKY, pinhole(), floor(500)))
    assert (places(plan) == places(alone)).all() and plan.radius == 4
    assert "object: ball, box; not floor, up to 667 times as large" in said(plan)
    assert plan.record()["surroundings"] == ["floor"]
    whole, near = [[-500, -500, -0.6], [500, 500, 0.7]], [[-4, -4, -0.6], [4, 4, 0.7]]
    assert np.array(plan.box) == pytest.approx(np.array(whole), rel=1e-5)
    # What a field should hold is what is near the cameras.
    assert np.array(plan.region) == pytest.approx(np.array(near), rel=1e-5)
    assert 0.1 < plan.survey.coverage < 0.2
    assert plan.clips[0] < 0.1 and plan.clips[1] > 1e5


def test_a_floor_of_three_times_the_size_counts(tmp_path: Path) -> None:
    plan = plan_of(write_scene(tmp_path, BALL, SKY, floor(2.2)))
    assert plan.subject.is_all and plan.radius == pytest.approx(4 * 2.2)
    assert plan.region == plan.box


def test_objects_told_by_id(tmp_path: Path) -> None:
    path = write_scene(tmp_path, BALL, SKY, floor(500))
    box = plan_of(path, object=("box",))
    assert box.center == pytest.approx((0.7, 0, 0.5)) and box.radius == pytest.approx(0.8)
    both = plan_of(path, object=("box", "ball"))
    assert both.radius == pytest.approx(3) and "object: box, ball; not floor" in said(both)
    assert plan_of(path, object=("floor",)).radius == pytest.approx(2000)
    assert plan_of(path, center=(0, 0, 9), radius=3.0).center == (0, 0, 9)
    with pytest.raises(InputError, match="no such shape, expected one of ball, box, floor"):
        plan_of(path, object=("ball", "tabel"))


def lamp(place: str, name: str = "") -> str:
    """A cube of 0.4 that shines, with or without a name."""
    told = f' id="{name}"' if name else ""
    return (
        f'<shape type="cube"{told}><transform name="to_world">'
        f'<scale value="0.2"/><translate {place}/></transform><emitter type="area"/></shape>'
    )


def test_an_object_that_shines_must_be_seen(tmp_path: Path) -> None:
    path = write_scene(tmp_path, BALL, SKY, lamp('x="3"', "bulb"))
    with pytest.raises(InputError, match="object=.bulb.: a light source, which is not seen, exp"):
        plan_of(path, object=("bulb",))
    plan = plan_of(path, object=("bulb",), keep_emitters=("bulb",))
    assert plan.center == pytest.approx((3, 0, 0)) and plan.survey.coverage > 0.1
    assert plan_of(path, object=("bulb", "ball")).subject.names == ("bulb", "ball")


def test_lights_without_a_name_that_are_kept_count(tmp_path: Path) -> None:
    path = write_scene(tmp_path, BALL, SKY, lamp('x="3"'), lamp('x="-5"', "other"))
    plan = plan_of(path)
    assert plan.center == (0, 0, 0) and "lights that are not seen: other and 1 more" in said(plan)
    plan = plan_of(path, keep_emitters=("all",))
    assert plan.center == pytest.approx((-1, 0, 0.05)) and "not seen" not in said(plan)


@pytest.mark.slow
@pytest.mark.parametrize("light", [SKY, lamp('x="3"', "bulb")])
def test_light_is_found_at_its_wavelengths(tmp_path: Path, light: str) -> None:
    spectral = [name for name in available_variants() if name.endswith("ad_spectral")]
    if not spectral:
        pytest.skip("no spectral variant on this machine")
    path = write_scene(tmp_path, BALL, light)
    with using_variant(spectral[0]):
        plan = generation._plan(SceneFile(path), Options())[-1]
    assert plan.survey.lit > 0.2 and "no light" not in said(plan)


def test_ground_and_object_in_one_mesh(tmp_path: Path) -> None:
    write_mesh(tmp_path / "all.ply", *ground_and_pyramids())
    mesh = '<shape type="ply" id="all"><string name="filename" value="all.ply"/></shape>'
    plan = plan_of(write_scene(tmp_path, SKY, mesh))
    assert "object: all (2 of 3 pieces); not all (piece 1 of 3)" in said(plan)
    assert plan.center == pytest.approx((1.5, 0.5, 0.5)) and plan.radius == pytest.approx(6)


def test_rectangles_merged_with_cubes_count(tmp_path: Path) -> None:
    """Mitsuba merges them into one mesh, whose box lacks the rectangle."""
    cube = f'<shape type="cube" id="cube">{GRAY}</shape>'
    plan = plan_of(write_scene(tmp_path, cube, SKY, floor(3, -1)))
    assert np.array(plan.box) == pytest.approx(np.array([[-3, -3, -1], [3, 3, 1]]))
    assert plan.subject.is_all and plan.radius == pytest.approx(12)


def test_rectangles_alone_are_a_scene(tmp_path: Path) -> None:
    two = [square(f"s{k}", f'<rotate x="1" angle="{90 * k}"/>', TWO_SIDED) for k in range(2)]
    plan = plan_of(write_scene(tmp_path, SKY, *two))
    assert np.array(plan.box) == pytest.approx(np.array([[-1, -1, -1], [1, 1, 1]]))


def test_tiny_scenes_are_not_looked_at_from_afar(tmp_path: Path) -> None:
    tiny = f'<shape type="sphere"><float name="radius" value="0.0006"/>{GRAY}</shape>'
    plan = plan_of(write_scene(tmp_path, tiny, SKY))
    assert plan.radius == pytest.approx(0.0024) and plan.survey.coverage > 0.2
    small = tiny.replace("0.0006", "0.25")
    assert plan_of(write_scene(tmp_path, small, SKY)).radius == 4


def test_places_behind_a_wall_are_passed_over(tmp_path: Path) -> None:
    wall = square("wall", '<scale value="30"/><rotate x="1" angle="90"/><translate y="1.5"/>')
    path = write_scene(tmp_path, BALL, SKY, pinhole(), floor(50), wall)
    plan = plan_of(path)
    assert (places(plan)[:, 1] < 1.5).all() and "places around it do not see" in said(plan)
    assert [len(plan.of_split(s)) for s in ("train", "val", "test")] == [100, 10, 200]
    few = plan_of(path, train=7, val=0, test=3)
    assert (few.views[6].pose == plan.views[6].pose).all()  # fewer are the first of more
    below = plan_of(write_scene(tmp_path, BALL, SKY, floor(50)), cameras="sphere")
    assert (places(below)[:, 2] > -0.6).all()


def test_the_suite_keeps_its_cameras() -> None:
    """Whatever is found out about a scene: the paper's, from the seed alone."""
    for name, cameras in (("spheres", "hemisphere"), ("vase", "hemisphere"), ("blob", "sphere")):
        plan = plan_of(find_scene(name), train=5, val=2, test=4, seed=3)
        assert plan.subject.is_all and plan.region == plan.box and plan.up == (0, 0, 1)
        expected = [
            around(n, split, 3, cameras=cameras, up=Z, center=np.zeros(3), radius=4.0)
            for split, n in (("train", 5), ("val", 2), ("test", 4))
        ]
        found = np.array([view.pose for view in plan.views])
        assert (found == np.concatenate(expected)).all()


def test_light_passes_what_lets_it_through(tmp_path: Path) -> None:
    """A box of nothing around the object is no wall, and what is in it no room."""
    null = '<shape type="cube" id="null"><bsdf type="null"/></shape>'
    plan = plan_of(write_scene(tmp_path, BALL, SKY, null))
    assert plan.cameras == "hemisphere" and plan.survey.lit > 0.9
    assert plan_of(write_scene(tmp_path, BALL, SKY)).survey.lit > 0.9


# ---- Up ----------------------------------------------------------------------


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_up_of_mirrored_sensors_is_the_one_that_is_named(tmp_path: Path, axis: str) -> None:
    sensor = pinhole(before=f'<scale {axis}="-1"/>')
    plan = plan_of(write_scene(tmp_path, BALL, SKY, sensor), train=2, val=0, test=0)
    assert plan.up == (0, 0, 1) and (places(plan)[:, 2] > 0).all()


def test_up_and_what_it_comes_from(tmp_path: Path) -> None:
    ball = f'<shape type="sphere" id="ball">{GRAY}</shape>'
    tilted = pinhole(up="0.3, 0, 1")
    plan = plan_of(write_scene(tmp_path, ball, SKY, tilted))
    assert plan.up == pytest.approx(np.array([0.3, 0, 1]) / np.linalg.norm([0.3, 0, 1]))
    assert "up is taken from the up vector of sensor 'it'" in said(plan)
    heights = (places(plan) - plan.center) @ np.array(plan.up)
    assert heights.min() > 0
    base = square("base", '<scale value="3"/><rotate x="1" angle="-90"/><translate y="-1"/>')
    plan = plan_of(write_scene(tmp_path, ball, SKY, base))
    assert plan.up == (0, 1, 0) and "the base of the scene, base" in said(plan)
    assert plan_of(write_scene(tmp_path, ball, SKY, base), up="-x").up == (-1, 0, 0)
    assert plan_of(write_scene(tmp_path, ball, SKY, base), up=(0, 3, 4)).up == (0, 0.6, 0.8)


# ---- Rooms -------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("parts", "why"),
    [
        ([room()], "black back of its surfaces"),
        ([room(), pinhole("-1, -1.5, 1.6", "0.5, 1, 0.8")], "black back of its surfaces"),
        ([room(TWO_SIDED), pinhole("-1, -1.5, 1.6", "0.5, 1, 0.8")], "no light falls on"),
        ([room(TWO_SIDED)], "no light falls on"),
        ([room(TWO_SIDED), SKY, pinhole("-1, -1.5, 1.6", "0.5, 1, 0.8")], "is enclosed"),
        ([room(front=False), pinhole("0, -8, 1.2", "0, 0, 1.2")], "black back of its surfaces"),
    ],
)
def test_rooms_are_recognised(tmp_path: Path, parts: list[str], why: str) -> None:
    path = write_scene(tmp_path, *parts)
    plan = plan_of(path, train=12, val=2, test=4)
    assert plan.protocol == plan.cameras == "room" and not plan.hide_emitters
    assert why in said(plan) and "this is a room, cameras are inside" in said(plan)
    found = places(plan)
    assert (found > plan.box[0]).all() and (found < plan.box[1]).all()
    # What they see is in the box that a field will have.
    assert (np.array(plan.region[0]) < [-1.9, -2.4, 0.1]).all()
    assert (np.array(plan.region[1]) > [1.9, 2.3, 2.4]).all()
    assert plan.survey.darkness < 0.02


@pytest.mark.slow
def test_who_asks_for_cameras_around_a_room_gets_them(tmp_path: Path) -> None:
    closed = write_scene(tmp_path, room())
    for options in ({"protocol": "realistic360"}, {"cameras": "sphere"}, {"radius": 9.0}):
        with pytest.raises(InputError, match="none sees the object, expected protocol='room'"):
            plan_of(closed, **options)
    open_room = write_scene(tmp_path, room(front=False))
    plan = plan_of(open_room, protocol="realistic360")
    assert plan.cameras == "hemisphere" and plan.protocol == "realistic360"
    assert "warning: " in said(plan) and "of the pixels see the object" in said(plan)
    own = '<default name="protocol" value="realistic360"/>'
    assert plan_of(write_scene(tmp_path, own, room(front=False))).protocol == "realistic360"
    told = plan_of(open_room, protocol="room", train=3, val=0, test=0)
    assert told.cameras == "room" and "this is a room" not in said(told)
    with pytest.raises(InputError, match="radius: has no meaning for the protocol 'room'"):
        plan_of(open_room, protocol="room", radius=1.0)
    with pytest.raises(InputError, match="no place in the scene is enclosed"):
        plan_of(write_scene(tmp_path, BALL, SKY), protocol="room")


def test_domes_and_courtyards_are_no_rooms(tmp_path: Path) -> None:
    """Their cameras around the object stand within."""
    dome = (
        '<shape type="sphere" id="dome"><float name="radius" value="100"/>'
        f'<boolean name="flip_normals" value="true"/>{GRAY}</shape>'
    )
    bulb = (
        '<shape type="sphere" id="sun"><point name="center" value="0, 0, 60"/>'
        '<emitter type="area"/></shape>'
    )
    for sensor in (pinhole(), ""):
        plan = plan_of(write_scene(tmp_path, BALL, dome, bulb, sensor))
        assert plan.cameras == "hemisphere" and plan.radius == 4
        assert [part.name for part in plan.subject.others] == ["dome"]


@pytest.mark.slow
def test_a_room_can_be_trained_on(tmp_path: Path) -> None:
    path = write_scene(tmp_path, room())
    out = tmp_path / "data"
    options = Options(train=3, val=1, test=1, size=(40, 30), spp=8)
    record = generate(path, out, VARIANT, options, show=False)
    assert record["settings"]["protocol"] == "room"
    for split in ("train", "val", "test"):
        views = load_dataset(out, split)
        images = views.premultiplied()
        assert (images[..., 3] == 1).all()  # closed: everything is opaque, the lamp is there
        assert (images[..., :3].mean(axis=(1, 2, 3)) > 0.02).all()
        origin = views.cam_to_world[:, :3, 3]
        assert (origin > views.box[0]).all() and (origin < views.box[1]).all()


# ---- The scene's own sensors -------------------------------------------------


def ring(count: int, kind: str = "perspective") -> list[str]:
    angles = 2 * np.pi * np.arange(count) / count
    more = '<float name="aperture_radius" value="0.2"/><float name="focus_distance" value="4"/>'
    return [
        pinhole(
            f"{4 * np.cos(a)}, {4 * np.sin(a)}, 1.5",
            kind=kind,
            more=more if kind == "thinlens" else "",
            name=f"s{k}",
        )
        for k, a in enumerate(angles)
    ]


@pytest.mark.parametrize(
    ("count", "options", "expected"),
    [
        (1, {}, (1, 0, 0)),
        (2, {}, (1, 0, 1)),
        (8, {}, (7, 0, 1)),
        (17, {}, (14, 0, 3)),
        (8, {"test": 3}, (5, 0, 3)),
        (8, {"val": 2}, (5, 2, 1)),
        (8, {"train": 4}, (4, 0, 1)),
        (8, {"train": 8}, (8, 0, 0)),
        (8, {"train": 2, "val": 1, "test": 0}, (2, 1, 0)),
    ],
)
def test_every_eighth_sensor_is_held_out(
    tmp_path: Path, count: int, options: dict[str, int], expected: tuple[int, ...]
) -> None:
    plan = plan_of(write_scene(tmp_path, BALL, SKY, *ring(count)), cameras="scene", **options)
    found = [len(plan.of_split(split)) for split in ("train", "val", "test")]
    assert tuple(found) == expected
    assert len({tuple(place) for place in places(plan)}) == sum(expected)  # none twice
    if not options and count > 1:
        angles = np.arctan2(*places(plan)[-expected[2] :, 1::-1].T) % (2 * np.pi)
        assert angles == pytest.approx(2 * np.pi * np.arange(0, count, 8) / count, abs=1e-5)


def test_more_than_there_are(tmp_path: Path) -> None:
    path = write_scene(tmp_path, BALL, SKY, *ring(3))
    for options in ({"train": 4}, {"test": 3}, {"train": 2, "test": 2}, {"train": 0}):
        with pytest.raises(InputError, match="the scene has 3 sensors"):
            plan_of(path, cameras="scene", **options)
    with pytest.raises(InputError, match="center: has no meaning for the scene's own sensors"):
        plan_of(path, cameras="scene", center=(0, 0, 0))
    nothing = write_scene(tmp_path, BALL, SKY)
    with pytest.raises(InputError, match="has no sensor that is a camera, expected one of persp"):
        plan_of(nothing, cameras="scene")


def test_what_is_said_of_sensors(tmp_path: Path) -> None:
    crop = '<integer name="crop_width" value="8"/>'
    ortho = pinhole(kind="orthographic", name="flat").replace('<float name="fov" value="40"/>', "")
    lens, window, turned = (
        ring(1, "thinlens")[0],
        pinhole(film=crop, name="window"),
        pinhole(before='<scale x="-1"/>', name="turned"),
    )
    path = write_scene(tmp_path, BALL, SKY, lens, window, turned, ortho)
    around_it = said(plan_of(path))
    assert "3 of the scene's 4 sensors are not used: --cameras scene" in around_it
    assert "the lens of sensor 's0' is not used: --cameras scene takes it" in around_it
    own = said(plan_of(path, cameras="scene"))
    assert "lens: sensor 's0'; transforms hold the pinhole in its centre" in own
    assert "crop window: sensor 'window'; pictures are the window alone" in own
    assert "mirrored: sensor 'turned'; pictures are not" in own
    assert "no cameras of a dataset: sensor 'flat' (OrthographicCamera)" in own
    alone = write_scene(tmp_path, BALL, SKY, ortho)
    with pytest.raises(InputError, match="has no sensor that is a camera"):
        plan_of(alone, cameras="scene")


@pytest.mark.slow
def test_pictures_of_the_scenes_sensors(tmp_path: Path) -> None:
    """Against Mitsuba's own, pixel by pixel; mirrored ones turned round."""
    alpha = '<string name="pixel_format" value="rgba"/>'
    sensors = [
        pinhole(name="a", film=alpha),
        pinhole("-3, -3, 2", name="b", film=alpha),
        pinhole("0, -4, 1", before='<scale x="-1"/>', name="c", film=alpha),
    ]
    path = write_scene(tmp_path, BALL, SKY, *sensors)
    out = tmp_path / "data"
    generate(path, out, VARIANT, Options(cameras="scene", test=0, spp=256), show=False)
    views = load_dataset(out, "train")
    assert len(views) == 3 and all(is_rigid(pose) for pose in views.cam_to_world)
    mi.set_variant(VARIANT)
    scene = mi.load_file(str(path))
    integrator = mi.load_dict({"type": "path", "max_depth": 4, "hide_emitters": True})
    for k in range(3):
        found = np.asarray(iio.imread(out / f"train/r_{k}.png"), np.float64)[..., 3] / 255
        image = mi.render(scene, sensor=scene.sensors()[k], integrator=integrator, spp=256)
        expected = np.array(image)[..., 3]
        expected = expected[:, ::-1] if k == 2 else expected
        assert np.abs(found - np.clip(expected, 0, 1)).mean() < 0.02
        assert 0.05 < found.mean() < 0.5


@pytest.mark.slow
def test_lenses_and_films_of_several_kinds(tmp_path: Path) -> None:
    wide = pinhole(name="wide").replace('value="40"', 'value="60"')
    path = write_scene(tmp_path, BALL, SKY, ring(1, "thinlens")[0], wide)
    out = tmp_path / "data"
    generate(path, out, VARIANT, Options(cameras="scene", test=0, spp=64), show=False)
    meta = json.loads((out / "transforms_train.json").read_text())
    first, second = meta["frames"]
    assert first["lens"] == {"aperture_radius": pytest.approx(0.2), "focus_distance": 4}
    assert first["fl_x"] == pytest.approx(16 / np.tan(np.radians(20)))
    assert second["fl_x"] == pytest.approx(16 / np.tan(np.radians(30))) and "lens" not in second
    # Blurred where it is out of focus: the rim of the ball is soft.
    alpha = [np.asarray(iio.imread(out / f"train/r_{k}.png"))[..., 3] for k in range(2)]
    soft = [((a > 10) & (a < 245)).sum() / (a > 127).sum() for a in alpha]
    sharp = plan_of(write_scene(tmp_path, BALL, SKY, ring(1)[0]), cameras="scene")
    assert sharp.views[0].lens is None and soft[0] > 0.2


# ---- Looked at before it is rendered -----------------------------------------


def test_a_plan_writes_its_picture_and_nothing_else(tmp_path: Path) -> None:
    path = write_scene(tmp_path, BALL, SKY, floor(500), *ring(3))
    out = tmp_path / "data"
    found = preview(path, out, VARIANT, Options(train=5, val=1, test=2), show=False)
    assert [p.name for p in out.iterdir()] == ["cameras.png"]
    assert found["picture"] == str(out / "cameras.png") and 0.1 < found["coverage"] < 0.2
    assert found["views"] == {"train": 5, "val": 1, "test": 2}
    assert iio.imread(out / "cameras.png").std() > 10
    preview(path, tmp_path / "own.png", VARIANT, Options(cameras="scene"), show=False)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["data", "own.png", "scene.xml"]


@pytest.mark.slow
def test_the_command_plans_and_then_generates(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = write_scene(tmp_path, BALL, SKY, floor(500), *ring(3)), tmp_path / "data"
    few = ["--train", "2", "--val", "0", "--test", "1", "--size", "16", "16", "--spp", "4"]
    assert main(["generate", str(path), str(out), *few, "--plan"]) == 0
    text = capsys.readouterr().out
    assert "object: ball, box; not floor" in text and "the object covers" in text
    assert f"{out / 'cameras.png'}: the cameras" in text
    assert main(["generate", str(path), str(out), *few]) == 0
    assert available_splits(out) == ("train", "test") and (out / "cameras.png").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--up", "w"], "--up w: expected x, y, z, -x, -y, -z or three numbers"),
        (["--up", "1", "2"], "--up 1 2: expected x, y, z, -x, -y, -z or three numbers"),
        (["--up", "0", "0", "0"], "--up 0 0 0: expected x, y, z"),
        (["--object", "ball", "tabel"], "--object tabel: no such shape, expected one of ball, box"),
        (["--cameras", "scene", "--radius", "1"], "--radius: has no meaning for the scene's own"),
        (["--cameras", "scene", "--train", "9"], "--train 9, --val 0, --test 0: the scene has 1"),
        (
            ["--cameras", "scene", "--size", "9", "9"],
            "--size 9 9: the film of sensor 'it' is 32x24",
        ),
    ],
)
def test_bad_options(
    refused: Callable[..., str], tmp_path: Path, options: list[str], message: str
) -> None:
    path = write_scene(tmp_path, BALL, SKY, pinhole())
    assert message in refused("generate", path, tmp_path / "out", *options)
    assert not (tmp_path / "out").exists()
