"""Samples that are no numbers: dropped, counted, and the rest of the picture as it would be."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerf.base.errors import InputError
from mi_nerf.base.variants import choose_variant
from mi_nerf.generation import Options, generate
from mi_nerf.generation.invalid import one_by_one, without_invalid
from mi_nerf.generation.noise import estimate, mean_image
from mi_nerf.images.write import write_exr

VARIANT = choose_variant()
FINE = 400  # texels a side, a few to a pixel

# A square, seen from above, that a constant light makes as bright as its texture says.
SQUARE = """<scene version="3.0.0">
    <integrator type="{integrator}">{depth}</integrator>
    <emitter type="constant"><float name="radiance" value="1"/></emitter>
    <shape type="rectangle"><bsdf type="twosided"><bsdf type="diffuse">
        <texture type="bitmap" name="reflectance"><string name="filename" value="texture.exr"/>
            <string name="filter_type" value="nearest"/><boolean name="raw" value="true"/>
        </texture></bsdf></bsdf></shape>
    {more}
</scene>"""

OPTIONS = Options(train=2, val=0, test=0, size=(48, 40), spp=16)


def square(folder: Path, texture: np.ndarray, integrator: str = "path", more: str = "") -> Path:
    folder.mkdir(exist_ok=True)
    write_exr(folder / "texture.exr", np.repeat(texture[..., None], 3, -1))
    depth = '<integer name="max_depth" value="2"/>' if integrator != "direct" else ""
    path = folder / "square.xml"
    path.write_text(SQUARE.format(integrator=integrator, depth=depth, more=more))
    return path


def texture_of(share: float, bad: float, seed: int = 1) -> np.ndarray:
    """Grey, with a random share of texels that are ``bad``."""
    texture = np.full((FINE, FINE), 0.5, np.float32)
    texture[np.random.default_rng(seed).random(texture.shape) < share] = bad
    return texture


def make(scene: Path, out: Path, options: Options = OPTIONS) -> dict[str, Any]:
    return generate(scene, out, VARIANT, options, show=False)


def exr(path: Path) -> np.ndarray:
    (channel,) = OpenEXR.File(str(path)).channels().values()
    return channel.pixels


# ---- The arithmetic ----------------------------------------------------------


@given(st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_the_rest_of_a_pixel(samples: int, seed: int) -> None:
    """Against the mean of the good samples of every pixel, one after another."""
    rng = np.random.default_rng(seed)
    values = rng.random((samples, 3, 5, 4))
    bad = rng.random((samples, 3, 5)) < 0.4
    counted = np.where(bad[..., None], 0, values).mean(0)
    image = np.concatenate([counted, bad.mean(0)[..., None]], -1).astype(np.float32)
    mean, good = without_invalid(image, samples)
    for y in range(3):
        for x in range(5):
            kept = values[~bad[:, y, x], y, x]
            assert good[y, x, 0] == len(kept)
            assert mean[y, x] == pytest.approx(kept.mean(0) if len(kept) else 0, abs=1e-5)
    spoilt = np.where(bad[..., None], rng.choice([np.nan, np.inf, -np.inf, 1e31]), values)
    again, same = one_by_one(lambda i: spoilt[i].astype(np.float32), samples)
    assert (same == good).all() and again == pytest.approx(mean, abs=1e-5)


def test_noise_of_unequal_pixels() -> None:
    """The estimate is unbiased where pixels have lost samples, and counts no empty one."""
    rng = np.random.default_rng(0)
    counts = [rng.integers(1, 9, (60, 70, 1)).astype(np.float32) for _ in range(2)]
    counts[0][:5] = 0
    told, true, true_mean = [], [], []
    for _ in range(30):
        halves = []
        for n in counts:
            noise = rng.normal(0, 0.1, (60, 70, 3)) / np.sqrt(np.maximum(n, 1))
            image = np.concatenate([0.5 + noise, np.ones((60, 70, 1))], -1)
            halves.append(np.where(n > 0, image, 0).astype(np.float32))
        told.append(estimate(*halves, (counts[0], counts[1])).mse_linear)
        mean = mean_image(*halves, (counts[0], counts[1]))
        true.append(np.mean((mean[5:, :, :3] - 0.5) ** 2))
        true_mean.append(mean[..., :3].mean())
        assert mean[:5] == pytest.approx(halves[1][:5])
    assert np.mean(told) == pytest.approx(np.mean(true), rel=0.05)
    assert np.mean(true_mean) == pytest.approx(0.5, abs=1e-3)


# ---- Whole datasets ----------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["path", "direct", "volpath", "prb", "direct_projective"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 3e38])
def test_bad_texels_do_not_end_a_job(tmp_path: Path, integrator: str, bad: float) -> None:
    """One in 300: every pixel is as bright as its other samples, and they are counted."""
    if integrator != "path" and not np.isnan(bad):
        pytest.skip("the same for all")
    record = make(square(tmp_path / "s", texture_of(1 / 300, bad), integrator), tmp_path / "out")
    assert record["complete"]
    total = 0
    for name, view in record["views"].items():
        image, count = exr(tmp_path / f"out/{name}.exr"), view["invalid_samples"]
        total += count
        assert np.isfinite(image).all()
        inside = image[..., 3] > 0.999
        assert inside.sum() > 100 and 0 < count < 0.01 * image.shape[0] * image.shape[1] * 16
        assert image[..., :3][inside].mean() == pytest.approx(0.5, rel=0.02)
        assert np.isfinite(view["noise"]["mse_linear"])
    views = [exr(tmp_path / f"out/{name}.exr") for name in record["views"]]
    covered = float(sum(image[..., 3].sum() * 16 for image in views))
    # Half of the samples of a pixel, and then the other: binomial, five standard deviations.
    assert total == pytest.approx(
        covered / 300, abs=5 * float(np.sqrt(covered / 300)) + 0.2 * total
    )


@pytest.mark.slow
def test_other_pixels_do_not_change(tmp_path: Path) -> None:
    """One bad texel: all pixels but those that see it are the same numbers as without it."""
    texture = np.full((8, 8), 0.5, np.float32)
    plain = make(square(tmp_path / "a", texture), tmp_path / "plain", replace(OPTIONS, spp=64))
    texture[3, 4] = np.nan
    texture = np.repeat(np.repeat(texture, 8, 0), 8, 1)
    texture[np.isnan(texture)] = 0.5
    texture[28, 36] = np.nan
    record = make(square(tmp_path / "b", texture), tmp_path / "bad", replace(OPTIONS, spp=64))
    for name in plain["views"]:
        a, b = (exr(tmp_path / f"{folder}/{name}.exr") for folder in ("plain", "bad"))
        changed = (a != b).any(-1)
        count = record["views"][name]["invalid_samples"]
        assert count > 0 and 0 < changed.sum() < 12
        assert a[changed][:, :3] == pytest.approx(b[changed][:, :3], abs=0.05)
        assert np.isfinite(b).all()


@pytest.mark.slow
def test_too_many(tmp_path: Path) -> None:
    scene = square(tmp_path / "s", texture_of(0.2, np.nan))
    with pytest.raises(InputError, match=r"view train/r_0: \d+\.\d% of its samples are NaN or inf"):
        make(scene, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_integrators_without_single_rays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sample by sample, if nothing else is known of an integrator: as many bad ones."""
    scene = square(tmp_path / "s", texture_of(1 / 300, np.nan))
    ray_by_ray = make(scene, tmp_path / "a")
    monkeypatch.setattr("mi_nerf.generation.tracer.samples_rays", lambda integrator: False)
    sample_by_sample = make(scene, tmp_path / "b")
    for name, view in ray_by_ray["views"].items():
        a, b = (exr(tmp_path / f"{folder}/{name}.exr") for folder in "ab")
        assert np.isfinite(b).all()
        counts = view["invalid_samples"], sample_by_sample["views"][name]["invalid_samples"]
        assert counts[1] == pytest.approx(counts[0], abs=6 * counts[0] ** 0.5)
        assert b.mean((0, 1)) == pytest.approx(a.mean((0, 1)), rel=0.02)


@pytest.mark.slow
def test_the_record_and_a_second_go(tmp_path: Path) -> None:
    """The same bytes again, and whether the views before had any does not matter."""
    scene = square(tmp_path / "s", texture_of(1 / 300, np.nan))
    make(scene, tmp_path / "a")
    make(scene, tmp_path / "b")
    names = [f"train/r_{i}{end}" for i in range(2) for end in (".exr", ".png", "_depth.exr")]
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    before = json.loads((tmp_path / "a/dataset.json").read_text())
    (tmp_path / "a/train/r_1.exr").unlink()
    again = generate(scene, tmp_path / "a", VARIANT, OPTIONS, resume=True, show=False)
    assert again == before  # the second view, traced first


@pytest.mark.slow
def test_a_material_in_python(tmp_path: Path) -> None:
    mi.set_variant(VARIANT)

    class Rarely(mi.BSDF):  # type: ignore[misc]
        """Diffuse, and NaN in stripes."""

        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.m_flags = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
            self.m_components = [self.m_flags]

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any) -> Any:
            import drjit as dr

            found = dr.zeros(mi.BSDFSample3f)
            found.wo = mi.warp.square_to_cosine_hemisphere(sample2)
            found.pdf = mi.warp.square_to_cosine_hemisphere_pdf(found.wo)
            found.eta = 1.0
            found.sampled_type = mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
            found.sampled_component = mi.UInt32(0)
            return found, mi.Color3f(0.5 * self._factor(si))

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
            import drjit as dr

            up = dr.maximum(mi.Frame3f.cos_theta(wo), 0)
            return mi.Color3f(0.5 / np.pi * up * self._factor(si))

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
            return mi.warp.square_to_cosine_hemisphere_pdf(wo)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def _factor(self, si: Any) -> Any:
            import drjit as dr

            stripe = si.uv.x * 250
            return dr.select(stripe - dr.floor(stripe) < 0.003, dr.nan, mi.Float(1))

    mi.register_bsdf("rarely_nan", lambda props: Rarely(props))
    scene = square(tmp_path / "s", texture_of(0, 0))
    text = scene.read_text()
    start, end = text.index('<bsdf type="twosided">'), text.index("</bsdf></shape>")
    scene.write_text(text[:start] + '<bsdf type="rarely_nan">' + text[end:])
    record = make(scene, tmp_path / "out")
    for name, view in record["views"].items():
        image = exr(tmp_path / f"out/{name}.exr")
        assert np.isfinite(image).all() and view["invalid_samples"] > 0
        inside = image[..., 3] > 0.999
        assert image[..., :3][inside].mean() == pytest.approx(0.5, rel=0.02)


@pytest.mark.parametrize("vertex", ["nan 0 0", "inf 0 0"])
def test_vertices_that_are_no_numbers(tmp_path: Path, vertex: str) -> None:
    """Mitsuba does not load such meshes: one line that says so."""
    mesh = '<shape type="obj"><string name="filename" value="m.obj"/></shape>'
    scene = square(tmp_path / "s", texture_of(0, 0), more=mesh)
    lines = ["v -0.5 -0.5 0.3", "v 0.5 -0.5 0.3", f"v {vertex}", "f 1 2 3"]
    (tmp_path / "s/m.obj").write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError, match="invalid vertex position data") as caught:
        make(scene, tmp_path / "out")
    assert str(scene) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.slow
def test_emitters_below_zero_and_huge(tmp_path: Path) -> None:
    """Numbers all the same: kept, and written as finite values."""
    scene = square(tmp_path / "s", texture_of(0, 0))
    for value in ("-1", "1e25"):
        scene.write_text(scene.read_text().replace('value="1"', f'value="{value}"'))
        record = make(scene, tmp_path / f"out{value}")
        image = exr(tmp_path / f"out{value}/train/r_0.exr")
        assert record["views"]["train/r_0"]["invalid_samples"] == 0
        inside = image[..., 3] > 0.999
        assert image[..., :3][inside].mean() == pytest.approx(0.5 * float(value), rel=0.02)
        assert np.isfinite(list(record["noise"]["train"].values())[0])
        scene.write_text(scene.read_text().replace(f'value="{value}"', 'value="1"'))
    scene.write_text(scene.read_text().replace('value="1"', 'value="1e36"'))
    with pytest.raises(InputError, match="samples are NaN or infinite"):
        make(scene, tmp_path / "infinite")
