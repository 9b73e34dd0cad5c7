"""Rays that ask a scene, against closed forms."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_nerf.base.variants import choose_variant
from mi_nerf.cameras.pinhole import Intrinsics, project
from mi_nerf.cameras.poses import look_at
from mi_nerf.generation.probes import all_around, blocked, camera_rays, first_hits

from ..support.scenes import TWO_SIDED, square, write_scene

LAMP = '<emitter type="area"/>'
NULL = '<bsdf type="null"/>'
FOG = f'{NULL}<medium type="homogeneous" name="interior"/>'


def scene_of(folder: Path, *parts: str) -> mi.Scene:
    mi.set_variant(choose_variant())
    return mi.load_file(str(write_scene(folder, *parts)))


def down(*heights: float) -> tuple[np.ndarray, np.ndarray]:
    """Rays down the z axis from these heights."""
    o = np.array([[0.1, 0.2, z] for z in heights])
    return o, np.broadcast_to([0.0, 0.0, -1.0], o.shape)


def test_distances_to_a_ball(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, '<shape type="sphere"><float name="radius" value="2"/></shape>')
    o = np.random.default_rng(0).normal(size=(5000, 3)) * 3
    d = all_around(5000)
    hits = first_hits(scene, o, d, hide_emitters=True)
    b, c = (o * d).sum(-1), (o * o).sum(-1) - 4
    root = np.sqrt(np.maximum(b * b - c, 0))
    near = np.where(c > 0, -b - root, -b + root)
    expected = np.where((b * b > c) & (near > 0), near, np.inf)
    clear = (np.abs(b * b - c) > 1e-2) & (np.abs(c) > 1e-2)
    assert hits.distance[clear] == pytest.approx(expected[clear], rel=1e-4)
    # From within a ball one sees its back, which reflects nothing.
    assert (hits.dark == (np.isfinite(hits.distance) & (c < 0)))[clear].all()
    assert np.isinf(hits.fog).all()


def test_backs_and_lamps_and_what_lets_through(tmp_path: Path) -> None:
    up, over = '<translate z="{0}"/>', '<rotate x="1" angle="180"/><translate z="{0}"/>'
    scene = scene_of(
        tmp_path,
        square("bottom", up.format(-2)),
        square("back", over.format(0)),
        square("two", over.format(1), TWO_SIDED),
        square("lamp", up.format(2), LAMP),
        square("glass", up.format(3), NULL),
        '<shape type="cube"><transform name="to_world"><translate z="6"/></transform>'
        f"{FOG}</shape>",
    )
    o, d = down(-1.0, 0.5, 1.5, 2.5, 3.5, 9.0)
    shown = first_hits(scene, o, d, hide_emitters=False)
    assert shown.distance == pytest.approx([1, 0.5, 0.5, 0.5, 1.5, 7], rel=1e-5)
    assert shown.dark.tolist() == [False, True, False, False, False, False]
    assert shown.fog == pytest.approx([np.inf] * 5 + [2], rel=1e-5)
    assert shown.something.all() and shown.nearest[-1] == pytest.approx(2)
    hidden = first_hits(scene, o, d, hide_emitters=True)
    # Behind glass or fog a lamp is seen, as in pictures.
    assert hidden.distance == pytest.approx([1, 0.5, 0.5, 1.5, 1.5, 7], rel=1e-5)


def test_what_stands_between(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, '<shape type="sphere"/>')
    ends = np.array([[3.0, 0, 0], [-3, 0, 0], [0, 3, 0], [1.001, 0, 0]])
    start = np.broadcast_to([3.0, 0.001, 0], ends.shape)
    assert blocked(scene, start, ends).tolist() == [False, True, False, False]


def test_rays_of_cameras() -> None:
    """They pass through the places of the film that :func:`project` gives back."""
    films = [Intrinsics(64, 48, 70, 70, 30, 25), Intrinsics(20, 80, 30, 30, 10, 40)]
    poses = [look_at((3, -4, 3), (0, 0, 0)), look_at((0, 5, 1), (1, 0, 0))]
    o, d = camera_rays(poses, films, 5)
    assert o.shape == d.shape == (2, 25, 3)
    for k, (pose, film) in enumerate(zip(poses, films, strict=True)):
        xy, _ = project(o[k] + 7 * d[k], film, pose)
        steps = (np.arange(5) + 0.5) / 5
        x, y = np.meshgrid(steps * film.width, steps * film.height)
        assert xy == pytest.approx(np.stack([x.ravel(), y.ravel()], -1))


def test_directions_all_around() -> None:
    d = all_around(1000)
    assert np.linalg.norm(d, axis=1) == pytest.approx(1)
    assert np.abs(d.mean(axis=0)).max() < 2e-3
    assert d.T @ d / 1000 == pytest.approx(np.eye(3) / 3, abs=2e-3)
