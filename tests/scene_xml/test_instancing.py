"""Copies of instances show what the instances show."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_nerf.base.variants import choose_variant
from mi_nerf.scene_xml import instancing
from mi_nerf.scene_xml.scene_file import SceneFile
from tests.support import gallery

SCENE = """<scene version="3.0.0">
    <integrator type="path"/>
    <sensor type="perspective"><float name="fov" value="40"/>
        <transform name="to_world">
            <lookat origin="3, -4, 3" target="0, 0, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="40"/><integer name="height" value="30"/>
            <string name="pixel_format" value="rgba"/></film>
    </sensor>
    <emitter type="constant"/>
    <bsdf type="diffuse" id="red"><rgb name="reflectance" value="0.8, 0.1, 0.1"/></bsdf>
    <shape type="shapegroup" id="pair">
        <shape type="cube" id="low"><ref id="red"/>
            <transform name="to_world"><scale value="0.2"/><translate x="0.4"/></transform></shape>
        <shape type="sphere" id="high"><float name="radius" value="0.2"/>
            <point name="center" value="0, 0, 0.5"/><bsdf type="plastic"/></shape>
    </shape>
    <shape type="shapegroup" id="unused"><shape type="sphere"/></shape>
    <shape type="instance" id="plain"><ref id="pair"/></shape>
    <shape type="instance" id="turned"><ref id="pair"/>
        <transform name="to_world"><rotate z="1" angle="50"/><translate x="-0.9" z="-0.3"/>
        </transform></shape>
    <shape type="instance" id="tilted"><ref id="pair"/>
        <transform name="to_world"><rotate x="1" angle="30"/><translate y="0.8"/>
        </transform></shape>
    <shape type="rectangle" id="floor"><transform name="to_world"><translate z="-1"/></transform>
    </shape>
</scene>"""


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    mi.set_variant(choose_variant())
    path = tmp_path / "scene.xml"
    path.write_text(SCENE)
    return path


def test_the_picture_is_the_same(scene: Path) -> None:
    expected = mi.load_file(str(scene))
    found = SceneFile(scene).load()
    kinds = {shape.class_name() for shape in found.shapes()}
    assert "Instance" in {shape.class_name() for shape in expected.shapes()}
    assert "Instance" not in kinds and "ShapeGroup" not in kinds
    images = [np.array(mi.render(s, spp=256, seed=k)) for s, k in ((expected, 0), (found, 1))]
    assert images[0][..., 3] == pytest.approx(images[1][..., 3], abs=0.2)
    difference = (images[0] - images[1])[..., :3]
    assert np.abs(difference.mean(axis=(0, 1))).max() < 2e-3
    assert np.abs(difference).mean() < 0.015


def test_bounds_are_tight(scene: Path) -> None:
    turned = [s for s in SceneFile(scene).load().shapes() if s.class_name() == "Sphere"]
    tops = sorted(float(shape.bbox().max.z) for shape in turned)
    assert tops == pytest.approx([0.4, 0.2 + 0.5 * np.cos(np.pi / 6), 0.7])


def test_too_many_stay_instances(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(instancing, "MAX_COPIES", 5)
    kinds = [shape.class_name() for shape in SceneFile(scene).load().shapes()]
    assert kinds.count("Instance") == 3


def test_scenes_without_instances_are_left_alone(scene: Path) -> None:
    scene.write_text(
        SCENE.replace('type="instance"', 'type="sphere"').replace(
            '<ref id="pair"/>', "<float name='radius' value='0.1'/>"
        )
    )
    shapes = SceneFile(scene).load().shapes()
    assert sum(shape.class_name() == "Sphere" for shape in shapes) == 3


# ---- Where a copy would look different ---------------------------------------

MOVES = {
    "turned": '<rotate x="1" angle="30"/><translate x="0.3"/>',
    "smaller": '<rotate x="1" angle="30"/><scale value="0.7"/><translate x="0.3"/>',
    "uneven": '<scale x="1" y="1.5" z="0.6"/>',
    "sheared": '<matrix value="1 0.4 0 0  0 1 0 0  0 0 1 0  0 0 0 1"/>',
    "mirrored": '<scale x="-1"/><rotate x="1" angle="40"/>',
}
SHAPES = {
    "ball": '<shape type="sphere"><float name="radius" value="0.5"/>{}</shape>',
    "square": '<shape type="rectangle">{}</shape>',
    "cube": '<shape type="cube"><transform name="to_world"><scale value="0.4"/></transform>{}'
    "</shape>",
    "faces": '<shape type="ply"><string name="filename" value="wedge.ply"/>{}</shape>',
    "smooth": '<shape type="ply"><string name="filename" value="smooth.ply"/>{}</shape>',
    "flat": '<shape type="ply"><string name="filename" value="smooth.ply"/>'
    '<boolean name="face_normals" value="true"/>{}</shape>',
    "curve": '<shape type="bsplinecurve"><string name="filename" value="curls.txt"/>{}</shape>',
    "grid": '<shape type="sdfgrid"><string name="filename" value="distance.vol"/>{}</shape>',
}
STAY = {
    *((shape, move) for shape in ("ball", "square") for move in ("uneven", "sheared")),
    *((shape, "mirrored") for shape in ("ball", "faces", "flat")),
    *(("curve", move) for move in ("smaller", "uneven", "sheared")),
    *(("grid", move) for move in MOVES),
}


@pytest.mark.parametrize(
    "move", [m if m == "mirrored" else pytest.param(m, marks=pytest.mark.slow) for m in MOVES]
)
@pytest.mark.parametrize("kind", SHAPES)
def test_any_place_looks_the_same(scene: Path, kind: str, move: str) -> None:
    """One-sided materials are black from behind: copies that are inside out would show that."""
    gallery.write_assets(scene.parent)
    write_smooth_mesh(scene.with_name("smooth.ply"))
    shape = SHAPES[kind].format('<bsdf type="diffuse"/>')
    head = SCENE.split('<bsdf type="diffuse" id="red">')[0]
    scene.write_text(
        f"""{head}<shape type="shapegroup" id="g">{shape}</shape>
        <shape type="instance"><ref id="g"/><transform name="to_world">{MOVES[move]}</transform>
        </shape></scene>"""
    )
    found = SceneFile(scene).load()
    kinds = {s.class_name() for s in found.shapes()}
    assert ("Instance" in kinds) == ((kind, move) in STAY)
    images = [np.array(mi.render(s, spp=64, seed=0)) for s in (mi.load_file(str(scene)), found)]
    difference = (images[0] - images[1])[..., :3]
    assert images[0][..., :3].min() < 0.9  # something is seen
    # Normals of stretched vertices are found and interpolated before or after the stretch.
    stretched = kind in ("faces", "smooth") and move in ("uneven", "sheared")
    close = 1e-2 if stretched else 1e-3
    assert np.abs(difference.mean(axis=(0, 1))).max() < close
    assert np.abs(difference).mean() < 2 * close


def write_smooth_mesh(path: Path) -> None:
    """A pyramid whose vertices have normals."""
    corners = np.array([[0, 0, 0.9], [-0.6, -0.4, -0.3], [0.6, -0.4, -0.3], [0, 0.7, -0.3]])
    mesh = mi.Mesh("pyramid", 4, 4, has_vertex_normals=True)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = corners.ravel()
    normals = corners / np.linalg.norm(corners, axis=1, keepdims=True)
    parameters["vertex_normals"] = normals.ravel()
    parameters["faces"] = [0, 1, 2, 0, 2, 3, 0, 3, 1, 1, 3, 2]
    parameters.update()
    mesh.write_ply(str(path))


def test_some_are_copied_and_others_stay(scene: Path) -> None:
    scene.write_text(
        SCENE.replace(
            '<shape type="instance" id="plain"><ref id="pair"/>',
            '<shape type="instance" id="plain"><ref id="pair"/><transform name="to_world">'
            '<scale x="-1"/></transform>',
        )
    )
    kinds = [shape.class_name() for shape in SceneFile(scene).load().shapes()]
    assert kinds.count("Instance") == 1 and kinds.count("Sphere") == 2
