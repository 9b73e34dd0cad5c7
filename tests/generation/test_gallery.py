"""Scenes of every kind become datasets: loaded, planned, two views, in which something is seen."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from mi_nerf.base.variants import choose_variant
from mi_nerf.generation import Options, generate
from tests.support import gallery

QUICK = {"sphere_and_cube", "version_0_5", "included_parts"}
LEAST_SEEN = 0.01  # share of an image's pixels


def exr(path: Path) -> np.ndarray:
    (channel,) = OpenEXR.File(str(path)).channels().values()
    return channel.pixels


@pytest.mark.parametrize(
    "name",
    [
        name if name in QUICK else pytest.param(name, marks=pytest.mark.slow)
        for name in gallery.SCENES
    ],
)
def test_two_views(name: str, tmp_path: Path) -> None:
    scene = gallery.write(name, tmp_path)
    wanted = {"train": 2, "val": 0, "test": 0, "size": (16, 16), "spp": 8}
    options = Options(**{**wanted, **gallery.SCENES[name].options})
    out = tmp_path / "out"
    record = generate(scene, out, choose_variant(), options, show=False)
    assert record["complete"] and len(record["views"]) == 2
    for view in record["views"]:
        image = exr(out / f"{view}.exr")
        assert image.shape == (16, 16, 4) and np.isfinite(image).all()
        assert (image[..., 3] > 0.02).mean() > LEAST_SEEN
        assert image[..., :3].max() > 0.01, "black"
        assert np.isfinite(exr(out / f"{view}_depth.exr")).all()


def test_there_are_scenes_of_every_kind() -> None:
    """As many as are promised, and every kind of Mitsuba's own shapes, materials and lights."""
    assert len(gallery.SCENES) >= 40
    text = "".join(scene.content for scene in gallery.SCENES.values())
    for plugin in (
        "bsplinecurve cube cylinder disk instance linearcurve obj ply rectangle sdfgrid serialized "
        "shapegroup sphere blendbsdf bumpmap conductor dielectric diffuse hair mask normalmap null "
        "plastic pplastic principled principledthin roughconductor roughdielectric roughplastic "
        "thindielectric twosided area constant directional directionalarea envmap point projector "
        "spot sunsky irradiancemeter orthographic perspective thinlens bitmap checkerboard "
        "mesh_attribute volume gridvolume constvolume homogeneous heterogeneous hg rayleigh "
        "tabphase blendphase aov direct moment path prb prbvolpath volpath volpathmis"
    ).split():
        assert f'type="{plugin}"' in text, plugin
