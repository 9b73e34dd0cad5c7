"""Unknown plugins that do not matter are replaced and named; others are refused."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.scene_xml.scene_file import SceneFile

KINDS = ("Film", "Integrator", "ReconstructionFilter", "Sampler", "Sensor")

SENSOR = """<sensor type="{sensor}"><float name="fov" value="33"/>
    <transform name="to_world"><lookat origin="1, 2, 3" target="0, 0, 0" up="0, 0, 1"/></transform>
    <sampler type="{sampler}"><integer name="sample_count" value="{spp}"/>{more_sampler}</sampler>
    <film type="{film}"><integer name="width" value="20"/><integer name="height" value="10"/>
        {more_film}<rfilter type="{rfilter}"/></film></sensor><shape type="cube"/>"""
USUAL = {
    "sensor": "perspective",
    "sampler": "independent",
    "spp": "16",
    "more_sampler": "",
    "film": "hdrfilm",
    "more_film": "",
    "rfilter": "box",
}


def sensor(folder: Path, **changes: str) -> Path:
    return scene(folder, SENSOR.format(**{**USUAL, **changes}))


def scene(folder: Path, content: str, version: str = "3.0.0") -> Path:
    path = folder / "scene.xml"
    path.write_text(f'<scene version="{version}">{content}</scene>')
    return path


def test_what_is_known_stays(variant: str, tmp_path: Path) -> None:
    for changes in (
        {},
        {"sampler": "multijitter"},
        {"sampler": "ldsampler"},
        {"rfilter": "lanczos"},
        {"sensor": "thinlens", "more_film": '<string name="pixel_format" value="rgba"/>'},
    ):
        changes = dict(changes)
        path = sensor(tmp_path, **changes)
        if changes.get("sensor") == "thinlens":
            text = path.read_text()
            path.write_text(text.replace('"fov"', '"aperture_radius"'))
        file = SceneFile(path)
        before = [str(props) for kind in KINDS for props in file.plugins(kind)]
        file.substitute(*KINDS)
        assert file.notes == []
        assert [str(props) for kind in KINDS for props in file.plugins(kind)] == before


@pytest.mark.parametrize("film", ["ldrfilm", "tiledhdrfilm", "mfilm", "path"])
def test_films(variant: str, tmp_path: Path, film: str) -> None:
    more = (
        '<string name="file_format" value="jpeg"/><float name="gamma" value="2.2"/>'
        '<integer name="crop_width" value="8"/><integer name="crop_offset_x" value="4"/>'
    )
    path = sensor(tmp_path, film=film, more_film=more)
    with pytest.raises(InputError, match=film):
        SceneFile(path).load()
    file = SceneFile(path)
    file.substitute("Film")
    assert file.notes == [f"film '{film}' does not exist in this Mitsuba, taken as 'hdrfilm'"]
    found = file.load().sensors()[0].film()
    assert list(found.size()) == [20, 10] and list(found.crop_size()) == [8, 10]
    assert list(found.crop_offset()) == [4, 0]
    assert "BoxFilter" in str(found.rfilter())


def test_unknown_properties_of_films(variant: str, tmp_path: Path) -> None:
    more = '<boolean name="attach_log" value="true"/><string name="pixel_format" value="rgba"/>'
    file = SceneFile(sensor(tmp_path, more_film=more))
    file.substitute("Film")
    assert file.notes == ["film 'hdrfilm': knows no attach_log, left out"]
    assert mi.has_flag(file.load().sensors()[0].film().flags(), mi.FilmFlags.Alpha)


@pytest.mark.parametrize("sampler", ["sobol", "halton", "hammersley"])
def test_samplers(variant: str, tmp_path: Path, sampler: str) -> None:
    path = sensor(tmp_path, sampler=sampler, more_sampler='<integer name="scramble" value="-1"/>')
    file = SceneFile(path)
    file.substitute("Film")
    assert file.notes == []
    with pytest.raises(InputError, match=sampler):
        file.load()
    file.substitute("Sampler")
    assert file.notes == [
        f"sampler '{sampler}' does not exist in this Mitsuba, taken as 'independent'"
    ]
    assert file.load().sensors()[0].sampler().sample_count() == 16


def test_filters_and_sensors(variant: str, tmp_path: Path) -> None:
    file = SceneFile(sensor(tmp_path, rfilter="windowed", sensor="perspective_rdist"))
    file.substitute(*KINDS)
    assert file.notes == [
        "reconstruction filter 'windowed' does not exist in this Mitsuba, taken as 'gaussian'",
        "sensor 'perspective_rdist' does not exist in this Mitsuba, taken as 'perspective'",
    ]
    found = file.load().sensors()[0]
    assert float(mi.traverse(found)["x_fov"][0]) == pytest.approx(33)
    assert np.ravel(found.world_transform().translation()) == pytest.approx([1, 2, 3])


def test_a_note_is_told_once(variant: str, tmp_path: Path) -> None:
    one = SENSOR.format(**{**USUAL, "film": "ldrfilm"}).replace('<shape type="cube"/>', "")
    file = SceneFile(scene(tmp_path, one * 3))
    file.substitute(*KINDS)
    assert len(file.notes) == 1 and len(file.load().sensors()) == 3


@pytest.mark.parametrize("name", ["bdpt", "pssmlt", "mlt", "erpt", "sppm", "photonmapper", "vpl"])
@pytest.mark.parametrize("medium", [False, True])
def test_light_transport(variant: str, tmp_path: Path, name: str, medium: bool) -> None:
    content = f"""<integrator type="{name}"><integer name="maxDepth" value="7"/>
        <boolean name="lightImage" value="true"/></integrator><shape type="cube"/>"""
    if medium:
        content += '<medium type="homogeneous" id="fog"/>'
    file = SceneFile(scene(tmp_path, content, "0.6.0"))
    file.substitute(*KINDS)
    expected = "volpath" if medium else "path"
    assert file.notes == [
        f"integrator '{name}' does not exist in this Mitsuba, '{expected}' in its place"
    ]
    (props,) = file.plugins("Integrator")
    assert props.plugin_name() == expected and props["max_depth"] == 7
    props["hide_emitters"] = True  # as for every integrator
    assert "max_depth = 7" in str(file.load().integrator())


def test_nested_light_transport(variant: str, tmp_path: Path) -> None:
    content = """<integrator type="irrcache"><float name="quality" value="1"/>
        <integrator type="path"><integer name="max_depth" value="3"/></integrator></integrator>"""
    file = SceneFile(scene(tmp_path, content + '<shape type="cube"/>'))
    file.substitute(*KINDS)
    assert "max_depth = 3" in str(file.load().integrator())


@pytest.mark.parametrize(
    "content",
    [
        '<integrator type="pahth"/>',
        '<integrator type="ao"/>',
        '<integrator type="path"><float name="max_dpeth" value="3"/></integrator>',
        '<shape type="hairs"/>',
        '<bsdf type="ward"/>',
        '<emitter type="sky"/>',
    ],
)
def test_what_matters_is_refused(variant: str, tmp_path: Path, content: str) -> None:
    file = SceneFile(scene(tmp_path, content))
    file.substitute(*KINDS)
    assert file.notes == []
    with pytest.raises(InputError) as refused:
        file.load()
    assert "\n" not in str(refused.value)
