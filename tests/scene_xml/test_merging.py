"""Meshes of one material are one, in the order of the file."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_nerf.base.variants import choose_variant
from mi_nerf.scene_xml.scene_file import SceneFile

MATERIALS = 12


def cube(x: int, material: int, more: str = "") -> str:
    return (
        f'<shape type="cube"><transform name="to_world"><scale value="0.25"/>'
        f'<translate x="{x}"/></transform><ref id="m{material}"/>{more}</shape>'
    )


def starts(tmp_path: Path, *shapes: str) -> list[float]:
    """Where along x the shapes of a loaded scene begin, in their order."""
    mi.set_variant(choose_variant())
    materials = "".join(
        f'<bsdf type="diffuse" id="m{k}"><rgb name="reflectance" value="{k / 20}"/></bsdf>'
        for k in range(MATERIALS)
    )
    path = tmp_path / "scene.xml"
    path.write_text(f'<scene version="3.0.0">{materials}{"".join(shapes)}</scene>')
    boxes = [s.bbox() for s in SceneFile(path).load().shapes()]
    return [float(np.ravel(box.min)[0]) for box in boxes if box.valid()]


def test_shapes_come_in_the_order_of_the_file(tmp_path: Path) -> None:
    order = np.random.default_rng(3).permutation(MATERIALS).tolist()
    cubes = [cube(x, m) for x, m in enumerate([*order, *order[::-1]])]
    assert starts(tmp_path, *cubes) == pytest.approx(np.arange(MATERIALS) - 0.25)


def test_what_differs_stays_apart(tmp_path: Path) -> None:
    flip = '<boolean name="flip_normals" value="true"/>'
    glow = '<emitter type="area"/>'
    fog = '<medium type="homogeneous" name="interior"/>'
    apart = [cube(x, 0, more) for x, more in enumerate(["", flip, glow, glow, fog])]
    assert len(starts(tmp_path, *apart, cube(8, 0), cube(9, 0, flip))) == 5
    ball = '<shape type="sphere"><ref id="m0"/></shape>'
    assert len(starts(tmp_path, ball, ball, cube(8, 0), cube(9, 0))) == 3
