"""Alpha, colours and refusals of every kind of integrator."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.base.variants import choose_variant
from mi_nerf.data import load_dataset
from mi_nerf.generation import Options, generate
from mi_nerf.generation import passes as passes_module
from mi_nerf.generation.run import prepare
from mi_nerf.scene_xml.scene_file import SceneFile

VARIANT = choose_variant()
OPTIONS = Options(train=1, val=0, test=0, size=(48, 40), spp=64)

# A ball on a square, an invisible box beside them, under a lamp that hangs above.
SCENE = """<scene version="3.0.0">
    {integrator}
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="3, -3, 2" target="0, 0, 0" up="0, 0, 1"/>
        </transform><sampler type="{sampler}">
        <integer name="sample_count" value="64"/></sampler></sensor>
    <shape type="sphere"><float name="radius" value="0.5"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.7, 0.4, 0.2"/></bsdf></shape>
    <shape type="rectangle">
        <transform name="to_world"><scale value="0.9"/><translate z="-0.5"/></transform>
        <bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>
    <shape type="cube"><bsdf type="null"/>
        <transform name="to_world"><scale value="0.2"/><translate x="1.1" z="-0.3"/></transform>
    </shape>
    <shape type="sphere" id="bulb"><float name="radius" value="0.3"/>
        <point name="center" value="0, 0, 1.4"/>
        <emitter type="area"><float name="radiance" value="8"/></emitter></shape>
</scene>"""

PLAIN = '<integrator type="{}"><integer name="max_depth" value="{}"/></integrator>'
ALL = {
    "path": PLAIN.format("path", 3),
    "direct": '<integrator type="direct"/>',
    "volpath": PLAIN.format("volpath", 3),
    "volpathmis": PLAIN.format("volpathmis", 3),
    "prb": PLAIN.format("prb", 3),
    "prb_basic": PLAIN.format("prb_basic", 3),
    "prbvolpath": PLAIN.format("prbvolpath", 3),
    "prb_projective": PLAIN.format("prb_projective", 3),
    "direct_projective": '<integrator type="direct_projective"/>',
    "ptracer": PLAIN.format("ptracer", 3),
    "aov": '<integrator type="aov"><string name="aovs" value="d:depth,n:sh_normal"/>'
    + PLAIN.format("path", 3)
    + "</integrator>",
    "moment": '<integrator type="moment">' + PLAIN.format("path", 3) + "</integrator>",
    "two": '<integrator type="aov"><string name="aovs" value="d:depth"/>'
    '<integrator type="moment">'
    + PLAIN.format("direct", 3).replace('<integer name="max_depth" value="3"/>', "")
    + "</integrator></integrator>",
}


def write(folder: Path, integrator: str, sampler: str = "independent") -> Path:
    path = folder / "scene.xml"
    path.write_text(SCENE.format(integrator=integrator, sampler=sampler))
    return path


def exr(path: Path) -> np.ndarray:
    (channel,) = OpenEXR.File(str(path)).channels().values()
    return channel.pixels


def coverage_of(record: dict[str, Any], pose: np.ndarray, lamp: bool) -> np.ndarray:
    """The share of 16x16 rays a pixel that meet the ball, the square or, if seen, the lamp."""
    fine, focal = 16, 24 / np.tan(record["settings"]["camera_angle_x"] / 2)
    y, x = (np.mgrid[: 40 * fine, : 48 * fine] + 0.5) / fine
    d = np.stack([(x - 24) / focal, (20 - y) / focal, -np.ones_like(x)], -1) @ pose[:3, :3].T
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    o = pose[:3, 3]
    hit = np.zeros(d.shape[:2], bool)
    for center, radius in [((0, 0, 0), 0.5)] + [((0, 0, 1.4), 0.3)] * lamp:
        b = d @ (o - center)
        hit |= b * b > (o - center) @ (o - center) - radius**2
    p = o + ((-0.5 - o[2]) / d[..., 2])[..., None] * d
    hit |= (np.abs(p[..., :2]) < 0.9).all(-1)
    return hit.reshape(40, fine, 48, fine).mean((1, 3))


def made(folder: Path, scene: Path, **more: Any) -> tuple[dict[str, Any], np.ndarray, np.ndarray]:
    """The record, the picture, and its camera."""
    record = generate(scene, folder, VARIANT, replace(OPTIONS, **more), show=False)
    pose = load_dataset(folder, "train").cam_to_world[0]
    return record, exr(folder / "train/r_0.exr"), pose


@pytest.mark.slow
@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("kept", [(), ("all",)])
def test_alpha_is_coverage(tmp_path: Path, name: str, kept: tuple[str, ...]) -> None:
    scene = write(tmp_path, ALL[name])
    record, image, pose = made(tmp_path / "out", scene, keep_emitters=kept)
    expected = coverage_of(record, pose, bool(kept))
    alpha = image[..., 3]
    tolerance = 5 * np.sqrt(expected * (1 - expected) / 64) + 2 / 16
    assert (np.abs(alpha - expected) <= tolerance).all()
    partial = (expected > 0) & (expected < 1)
    assert partial.sum() > 40 and np.abs(alpha - expected)[partial].mean() < 0.06
    # What is hidden has neither colour nor depth, what is kept has both.
    depth = exr(tmp_path / "out/train/r_0_depth.exr")
    assert ((depth > 0) == (expected > 0.5))[~partial].all()
    # Paths from the light meet outlines elsewhere than camera rays.
    assert (image[..., :3][expected == 0] > 0).mean() < (0.01 if name == "ptracer" else 1e-6)
    lamp = coverage_of(record, pose, True) - coverage_of(record, pose, False)
    assert (lamp > 0.99).sum() > 10
    shown = image[..., 0][lamp > 0.99]
    assert shown == pytest.approx(8 if kept else 0, rel=0.6 if name == "ptracer" else 0.2)


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in ALL if n not in ("path", "direct_projective")])
def test_colours_are_those_of_path(tmp_path: Path, name: str) -> None:
    """The mean colour over the object, with a lamp that is hidden."""
    images = [made(tmp_path / f"{i}", write(tmp_path, ALL[i]))[1] for i in ("path", name)]
    a, b = (image[..., :3].mean((0, 1)) for image in images)
    limit = 0.15 if "direct" in name or name == "two" else 0.04  # of one bounce less
    assert b == pytest.approx(a, rel=limit)


@pytest.mark.parametrize(
    ("integrator", "message"),
    [
        ('<integrator type="depth"/>', "'depth' gives distances instead of colours"),
        (
            '<integrator type="aov"><string name="aovs" value="n:sh_normal"/></integrator>',
            "'aov' nests none that gives colours",
        ),
        ('<integrator type="volprim_rf_basic"/>', "'volprim_rf_basic' gives no alpha"),
    ],
)
def test_no_colours(tmp_path: Path, integrator: str, message: str) -> None:
    scene = write(tmp_path, integrator)
    with pytest.raises(InputError, match=message) as caught:
        generate(scene, tmp_path / "out", VARIANT, OPTIONS, show=False)
    assert str(scene) in str(caught.value) and not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ptracer", "volpath"])
def test_one_lamp_and_no_other(tmp_path: Path, name: str) -> None:
    """Those that cannot choose say so; all by name is all."""
    scene = write(tmp_path, ALL[name])
    text = scene.read_text().replace(
        "</scene>",
        '<shape type="sphere" id="other"><float name="radius" value="0.1"/>'
        '<emitter type="area"/></shape></scene>',
    )
    scene.write_text(text)
    mi.set_variant(VARIANT)
    options = replace(OPTIONS, keep_emitters=("bulb",))
    with pytest.raises(InputError, match="can show all light sources or none, expected keep_emi"):
        prepare(SceneFile(scene), options)


@pytest.mark.slow
@pytest.mark.parametrize(
    "sampler", ["independent", "stratified", "multijitter", "orthogonal", "ldsampler"]
)
@pytest.mark.parametrize("name", ["path", "ptracer"])
def test_passes_of_every_sampler(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sampler: str, name: str
) -> None:
    """In parts of few paths, a picture has the same mean and noise as at once."""
    scene = write(tmp_path, ALL[name], sampler)
    whole, image, _ = made(tmp_path / "whole", scene, spp=None)
    limit = 48 * 40 * 5 + 7
    monkeypatch.setattr(passes_module, "SAMPLES_PER_PASS", limit)
    parts, pieces, _ = made(tmp_path / "parts", scene, spp=None)
    tracer, _ = prepare(SceneFile(scene), replace(OPTIONS, spp=None))
    assert tracer.samples_at_once <= limit
    assert parts["settings"] == whole["settings"]
    told = [r["views"]["train/r_0"]["noise"]["mse_linear"] for r in (whole, parts)]
    assert told[1] == pytest.approx(told[0], rel=0.5)
    between = np.mean((image - pieces)[..., :3] ** 2)
    assert between == pytest.approx(told[0] + told[1], rel=0.5)
    assert np.abs(image - pieces)[..., 3].mean() < 0.01
