"""Fields given by formulas: against their own integrals, and from XML."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerf.backend import array_module, choose_variant
from mi_nerf.cli import main
from mi_nerf.closed_form import GaussianConfig, GaussianField, closed_form
from mi_nerf.volume import (
    Evaluation,
    MarchSettings,
    integrate,
    place_samples,
    render_rays,
)

VARIANT = choose_variant()
BACKEND = array_module(VARIANT)

unit = st.floats(-1, 1)


@given(
    st.tuples(unit, unit, unit),
    st.tuples(unit, unit, unit).filter(lambda d: np.linalg.norm(d) > 0.1),
    st.floats(0.05, 2),
    st.floats(0, 30),
    st.tuples(*[st.floats(0, 5)] * 3),
)
def test_rays_through_a_gaussian(
    center: Any, direction: Any, width: float, peak: float, radiance: Any
) -> None:
    """Radiance, opacity and mean depth of rays, against float64 closed forms."""
    config = GaussianConfig(center=center, width=width, peak=peak / width, radiance=radiance)
    field = GaussianField(config, BACKEND.TensorXf)
    d = np.array(direction) / np.linalg.norm(direction)
    across = np.cross(d, [0.3, -0.5, 0.81])
    across /= np.linalg.norm(across)
    b = np.array([0.0, 0.5, 1.0, 2.0]) * width
    o = np.array(center) + b[:, None] * across - 9 * width * d
    origins, directions = BACKEND.Array3f(o.T), BACKEND.Array3f(np.repeat(d[:, None], 4, axis=1))
    seen = render_rays(field, origins, directions, MarchSettings(samples=512))
    tau = peak * math.sqrt(2 * math.pi) * np.exp(-0.5 * (b / width) ** 2)
    opacity = -np.expm1(-tau)
    assert np.array(seen.opacity) == pytest.approx(opacity, rel=2e-3, abs=1e-4)
    for channel, value in zip(seen.color, radiance, strict=True):
        assert np.array(channel) == pytest.approx(value * opacity, rel=2e-3, abs=1e-3)


def test_every_number_is_differentiable() -> None:
    """Against central differences in float64 of the closed form."""

    def truth(v: np.ndarray) -> float:
        """Radiance in the first channel of a ray along x that passes (0, 0.1, 0)."""
        x, y, z, width, peak, radiance = v
        b2 = (0.1 - y) ** 2 + z**2
        tau = peak * width * math.sqrt(2 * math.pi) * math.exp(-b2 / (2 * width**2))
        return radiance * -math.expm1(-tau)

    values = np.array([0.05, 0.02, 0.03, 0.25, 3.0, 1.7])
    x, y, z, width, peak, radiance = values.tolist()
    config = GaussianConfig((x, y, z), width, peak, (radiance, 0.5, 0.25))
    field = GaussianField(config, BACKEND.TensorXf)
    o, d = BACKEND.Array3f([-2], [0.1], [0]), BACKEND.Array3f([1], [0], [0])
    samples = place_samples(field, o, d, MarchSettings(samples=1024))
    for tensor in field.parameters().values():
        dr.enable_grad(tensor)
    evaluation = Evaluation(field, samples, 4096, keep=True)
    evaluation.enable_grad()
    dr.backward(integrate(evaluation, samples).color[0])
    evaluation.backward()
    found = np.concatenate([np.array(dr.grad(t)) for t in field.parameters().values()])[
        : len(values)
    ]
    h = 1e-5
    expected = [
        (truth(values + h * e) - truth(values - h * e)) / (2 * h) for e in np.eye(len(values))
    ]
    # Not along x: the box moves with the blob, the ray sees all of it either way.
    assert found[1:] == pytest.approx(np.array(expected)[1:], rel=2e-3)
    assert found[0] == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize(
    ("kind", "values", "message"),
    [
        ("gausian", {}, "field='gausian', expected gaussian"),
        ("gaussian", {"sigma": 1.0}, "'sigma' is no parameter of 'gaussian'"),
        ("gaussian", {"width": 0.0}, "width=0.0, expected a number above 0"),
        ("gaussian", {"peak": -1.0}, "expected numbers of 0 or more"),
    ],
)
def test_bad_formulas(kind: str, values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        closed_form(kind, values, BACKEND.TensorXf)


BLOB = """<scene version="3.0.0"><integrator type="nerf"/>
    <sensor type="perspective"><float name="fov" value="20"/>
        <transform name="to_world">
            <lookat origin="0, -4, 0" target="0, 0, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="21"/><integer name="height" value="21"/>
            <string name="pixel_format" value="rgba"/><rfilter type="box"/></film>
    </sensor>
    <shape type="cube" id="box"><bsdf type="null"/>
        <medium type="nerfmedium" name="interior" id="blob">
            <string name="field" value="gaussian"/>
            <float name="width" value="0.2"/><float name="peak" value="12"/>
            <vector name="radiance" value="1.5, 0.5, 0.25"/>
        </medium></shape></scene>"""


def test_from_xml() -> None:
    mi.set_variant(VARIANT)
    scene = mi.load_string(BLOB)
    image = np.array(mi.render(scene, spp=256))
    tau = 12 * 0.2 * math.sqrt(2 * math.pi)
    assert image[10, 10, 3] == pytest.approx(-math.expm1(-tau), abs=1e-3)
    assert image[10, 10, 0] == pytest.approx(1.5 * -math.expm1(-tau), rel=2e-3)
    assert image[0, 0, 3] == pytest.approx(0, abs=1e-2)
    params = mi.traverse(scene)
    names = {k.rsplit(".", 1)[1] for k in params.keys() if "interior_medium" in k}  # noqa: SIM118
    assert names == {"center", "width", "peak", "radiance"}
    params["box.interior_medium.radiance"] = mi.TensorXf([0.0, 1.0, 0.0])
    params.update()
    image = np.array(mi.render(scene, spp=16))
    assert image[10, 10, 0] == 0 and image[10, 10, 1] > 0.9


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name="peak"', 'name="top"', "'top' is no parameter of 'gaussian'"),
        ('value="gaussian"', 'value="box"', "field='box', expected gaussian"),
        ("</medium>", '<string name="filename" value="a"/></medium>', "expected one of them"),
    ],
)
def test_bad_xml(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, message: str
) -> None:
    scene = tmp_path / "scene.xml"
    scene.write_text(BLOB.replace(old, new))
    assert main(["render", str(scene), "-o", str(tmp_path / "x.png")]) == 2
    line = capsys.readouterr().err
    assert message in line and line.count("\n") == 1
