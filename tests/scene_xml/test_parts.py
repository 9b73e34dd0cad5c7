"""The shapes of a scene apart: names, boxes, planes, connected pieces."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_nerf.base.variants import choose_variant
from mi_nerf.scene_xml.parts import Part, pieces, read_parts
from mi_nerf.scene_xml.scene_file import SceneFile, visible_bounds

SCENE = """<scene version="3.0.0">
    <sensor type="perspective"/>
    <emitter type="constant"/>
    <bsdf type="diffuse" id="gray"/>
    <shape type="sphere" id="ball"><ref id="gray"/><float name="radius" value="0.6"/></shape>
    <shape type="cube" id="box"><ref id="gray"/>
        <transform name="to_world"><scale value="0.2"/><translate x="0.7"/></transform></shape>
    <shape type="cube" id="slab"><ref id="gray"/>
        <transform name="to_world"><scale x="5" y="8" z="0.1"/><rotate x="1" angle="30"/>
            <translate z="-7"/></transform></shape>
    <shape type="rectangle"><bsdf type="diffuse"/>
        <transform name="to_world"><scale value="9"/><rotate y="1" angle="40"/></transform></shape>
    <shape type="disk" id="lamp"><emitter type="area"/></shape>
    <shape type="cylinder"><float name="radius" value="3"/>
        <point name="p0" value="0, 0, 0"/><point name="p1" value="0, 0, 0.1"/></shape>
    <shape type="shapegroup" id="tree">
        <shape type="cube" id="leaf"><ref id="gray"/></shape>
        <shape type="sphere" id="stem"/>
    </shape>
    <shape type="instance" id="left"><ref id="tree"/>
        <transform name="to_world"><translate x="-10"/></transform></shape>
    <shape type="instance" id="right"><ref id="tree"/>
        <transform name="to_world"><translate x="10"/></transform></shape>
    <shape type="ply" id="mesh"><string name="filename" value="mesh.ply"/><ref id="gray"/></shape>
</scene>"""


def write_mesh(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """An ASCII PLY file."""
    lines = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    lines += [" ".join(map(str, v)) for v in vertices]
    lines += [" ".join(map(str, [3, *f])) for f in faces]
    path.write_text("\n".join(lines) + "\n")


def ground_and_pyramids(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A square of 200 units, two pyramids on it, in no order; corners are written twice."""
    ground = np.array([[-100, -100, 0], [100, -100, 0], [100, 100, 0], [-100, 100, 0]], float)
    tip = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, 1]])
    vertices = np.concatenate([ground, ground, tip, tip + [2, 0, 0], [[50, 50, 50]]])  # unused
    faces = np.array([[0, 1, 2], [4, 6, 7]])
    sides = np.array([[0, 1, 3], [1, 2, 3], [2, 0, 3]])
    faces = np.concatenate([faces, sides + 8, sides + 12])
    random = np.random.default_rng(seed)
    order = random.permutation(len(vertices))
    return vertices[order], np.argsort(order)[faces][random.permutation(len(faces))]


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    mi.set_variant(choose_variant())
    write_mesh(tmp_path / "mesh.ply", *ground_and_pyramids())
    path = tmp_path / "scene.xml"
    path.write_text(SCENE)
    return path


def parts_of(path: Path) -> dict[str, Part]:
    return {part.name: part for part in read_parts(SceneFile(path))}


def test_names_boxes_and_lamps(scene: Path) -> None:
    parts = parts_of(scene)
    copies = {f"{side}_{shape}" for side in ("left", "right") for shape in ("leaf", "stem")}
    assert set(parts) == {
        *("ball", "box", "slab", "rectangle 1", "lamp", "cylinder 1", "mesh"),
        *copies,
    }
    assert [name for name, part in parts.items() if part.glows] == ["lamp"]
    assert parts["ball"].lower == pytest.approx([-0.6] * 3)
    assert parts["box"].upper == pytest.approx([0.9, 0.2, 0.2])
    assert parts["left_stem"].lower == pytest.approx([-11, -1, -1])
    # Together they are what the scene itself says.
    lower = np.min([p.lower for p in parts.values() if not p.glows], axis=0)
    upper = np.max([p.upper for p in parts.values() if not p.glows], axis=0)
    whole = np.array(visible_bounds(SceneFile(scene).load()))
    assert np.array([lower, upper]) == pytest.approx(whole, abs=1e-5)


def test_planes(scene: Path) -> None:
    parts = parts_of(scene)
    flat = {name for name, part in parts.items() if part.normal is not None}
    assert flat == {"slab", "rectangle 1", "lamp", "cylinder 1"}
    sine, cosine = np.sin(np.radians([30, 40])), np.cos(np.radians([30, 40]))
    slab, rectangle = parts["slab"], parts["rectangle 1"]
    assert np.abs(slab.normal @ [0, -sine[0], cosine[0]]) == pytest.approx(1)
    assert np.ptp(slab.levels) == pytest.approx(0.2, abs=1e-5)
    assert np.abs(rectangle.normal @ [sine[1], 0, cosine[1]]) == pytest.approx(1)
    assert rectangle.levels == pytest.approx((0, 0), abs=1e-6)
    middle = np.array([[0, 0, -7.0], [0, 3 * cosine[0], -7 + 3 * sine[0]], [0, 3, -7], [0, 0, -6]])
    assert slab.holds(middle, 0.01).tolist() == [True, True, False, False]


@pytest.mark.parametrize("seed", range(4))
def test_pieces_of_a_mesh(scene: Path, seed: int) -> None:
    write_mesh(scene.parent / "mesh.ply", *ground_and_pyramids(seed))
    ground, *others = pieces(parts_of(scene)["mesh"])
    assert ground.name == "mesh (piece 1 of 3)" and ground.size == 200
    assert np.abs(ground.normal) == pytest.approx([0, 0, 1])
    assert sorted(part.upper[0] for part in others) == [1, 3]
    assert all(part.normal is None and part.size == pytest.approx(1) for part in others)


def test_what_is_one_piece_stays_one(scene: Path) -> None:
    parts = parts_of(scene)
    for name in ("ball", "box", "rectangle 1"):
        assert pieces(parts[name]) == [parts[name]]


def test_pieces_of_long_chains(tmp_path: Path) -> None:
    """Thousands of triangles in a row, numbered at random: as many pieces as there are rows."""
    mi.set_variant(choose_variant())
    random, rows, long = np.random.default_rng(1), 3, 2000
    x, y = np.meshgrid(np.arange(long), [0, 1])
    strip = np.stack([x, y, 0 * x], -1).reshape(-1, 3).astype(float)
    k = np.arange(long - 1)
    faces = np.concatenate(
        [np.stack([k, k + 1, k + long], 1), np.stack([k + 1, k + long + 1, k + long], 1)]
    )
    vertices = np.concatenate([strip + [0, 5 * row, 0] for row in range(rows)])
    faces = np.concatenate([faces + row * len(strip) for row in range(rows)])
    order = random.permutation(len(vertices))
    write_mesh(tmp_path / "mesh.ply", vertices[order], np.argsort(order)[faces])
    path = tmp_path / "scene.xml"
    path.write_text(
        '<scene version="3.0.0"><shape type="ply" id="rows">'
        '<string name="filename" value="mesh.ply"/></shape></scene>'
    )
    found = pieces(parts_of(path)["rows"])
    assert [part.name for part in found] == [f"rows (piece {i} of 3)" for i in (1, 2, 3)]
    assert sorted(part.lower[1] for part in found) == [0, 5, 10]
    assert all(part.size == long - 1 for part in found)


def test_the_file_itself_is_left_alone(scene: Path) -> None:
    file = SceneFile(scene)
    read_parts(file)
    loaded = file.load()
    assert len(loaded.emitters()) == 2 and len(loaded.sensors()) == 1
