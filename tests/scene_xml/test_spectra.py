"""Spectra as plugins, in variants that know colours only."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerf.base.errors import InputError
from mi_nerf.base.variants import available_variants, using_variant
from mi_nerf.scene_xml.scene_file import SceneFile
from mi_nerf.scene_xml.spectra import planck

IRREGULAR = """<spectrum name="{name}" type="irregular">
    <string name="wavelengths" value="400, 550,  700"/>
    <string name="values" value="0.1 0.6, 0.3"/></spectrum>"""
REGULAR = """<spectrum name="{name}" type="regular"><float name="wavelength_min" value="400"/>
    <float name="wavelength_max" value="700"/><string name="values" value="0.1, 0.6, 0.3"/>
    </spectrum>"""
IN_LINE = '<spectrum name="{name}" value="400:0.1, 550:0.6, 700:0.3"/>'
BLACK_BODY = """<spectrum name="{name}" type="blackbody">
    <float name="temperature" value="4000"/></spectrum>"""


def scene(folder: Path, spectrum: str, where: str) -> Path:
    emitter = f'<emitter type="constant">{spectrum if where == "radiance" else ""}</emitter>'
    inside = spectrum if where == "reflectance" else ""
    path = folder / "scene.xml"
    path.write_text(
        f"""<scene version="3.0.0"><integrator type="path"/>{emitter}
        <sensor type="perspective"><transform name="to_world"><translate z="-3"/></transform>
            <film type="hdrfilm"><integer name="width" value="8"/>
            <integer name="height" value="8"/></film></sensor>
        <shape type="sphere"><float name="radius" value="0.3"/>
            <bsdf type="diffuse">{inside}</bsdf></shape></scene>"""
    )
    return path


def picture(path: Path, spp: int = 64) -> np.ndarray:
    return np.array(mi.render(SceneFile(path).load(), spp=spp, seed=1))


@pytest.mark.parametrize("where", ["radiance", "reflectance"])
@pytest.mark.parametrize("spectrum", [IRREGULAR, REGULAR], ids=["irregular", "regular"])
def test_values_as_mitsuba_takes_them_in_line(
    variant: str, tmp_path: Path, spectrum: str, where: str
) -> None:
    expected = picture(scene(tmp_path, IN_LINE.format(name=where), where))
    found = picture(scene(tmp_path, spectrum.format(name=where), where))
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert np.ptp(found[4, 4]) > 0.01  # a colour


def test_notes(variant: str, tmp_path: Path) -> None:
    path = scene(tmp_path, IRREGULAR.format(name="radiance"), "radiance")
    said = "spectrum 'irregular': not known to colours, taken as the colour it has"
    assert SceneFile(path).notes == [said]


@pytest.mark.slow
def test_a_black_body_has_the_colour_that_it_has_in_spectral_light(tmp_path: Path) -> None:
    spectral = [name for name in available_variants() if name.endswith("_spectral")]
    if not spectral:
        pytest.skip("no spectral variant on this machine")
    path = scene(tmp_path, BLACK_BODY.format(name="radiance"), "radiance")
    backend = spectral[0].split("_")[0]
    with using_variant(spectral[0]):
        assert SceneFile(path).notes == []
        expected = picture(path, 4096).mean(axis=(0, 1))
    with using_variant(f"{backend}_ad_rgb"):
        found = picture(path, 64).mean(axis=(0, 1))
    assert found == pytest.approx(expected, rel=0.02)
    assert found[0] > found[1] > found[2] > 0  # 4000 K is reddish


def test_a_black_body_behind_a_filter(variant: str, tmp_path: Path) -> None:
    """Only the red end of it."""
    end = '<float name="wavelength_min" value="620"/></spectrum>'
    filtered = BLACK_BODY.replace("</spectrum>", end).format(name="radiance")
    found = picture(scene(tmp_path, filtered, "radiance"))[0, 0]
    assert found[0] > 3 * np.abs(found[1:]).max()


@given(st.floats(500, 20000), st.floats(300, 900))
def test_planck_against_the_displacement_and_the_ratio(temperature: float, at: float) -> None:
    """Wien's displacement in closed form, and L(λ, T) = L(aλ, T/a) · a⁵."""
    assert planck(np.array([at]), temperature)[0] == pytest.approx(
        planck(np.array([2 * at]), temperature / 2)[0] * 32, rel=1e-9
    )
    peak = 2.897771955e6 / temperature
    around = planck(peak * np.array([0.98, 1, 1.02]), temperature)
    assert around[1] == around.max()


def test_the_power_of_a_black_body() -> None:
    """Over all wavelengths, σT⁴/π (Stefan and Boltzmann)."""
    wavelengths = np.geomspace(50, 1e6, 20001)
    values = planck(wavelengths, 3000.0)
    total = ((values[1:] + values[:-1]) / 2 * np.diff(wavelengths)).sum()
    assert total == pytest.approx(5.670374419e-8 * 3000**4 / np.pi, rel=1e-4)


@pytest.mark.parametrize(
    "wrong",
    [
        '<string name="wavelengths" value="400, a"/><string name="values" value="1, 2"/>',
        '<string name="wavelengths" value="400, 500"/><string name="values" value="1"/>',
        '<string name="wavelengths" value="400, 500"/>',
        '<string name="wavelengths" value="500, 400"/><string name="values" value="1, 2"/>',
    ],
)
def test_what_mitsuba_refuses(variant: str, tmp_path: Path, wrong: str) -> None:
    spectrum = f'<spectrum name="radiance" type="irregular">{wrong}</spectrum>'
    with pytest.raises(InputError, match="Mitsuba cannot load this scene"):
        SceneFile(scene(tmp_path, spectrum, "radiance")).load()
