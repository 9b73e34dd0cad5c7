"""Unknown plugins that do not matter are replaced and named; others are refused."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.cli import main
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
    assert file.notes == ["film 'hdrfilm': attach_log not understood, left out"]
    assert mi.has_flag(file.load().sensors()[0].film().flags(), mi.FilmFlags.Alpha)


def test_films_of_other_variants_and_wrong_values(variant: str, tmp_path: Path) -> None:
    more = '<spectrum name="band" value="400:1, 500:0.5"/>'
    file = SceneFile(sensor(tmp_path, film="specfilm", more_film=more))
    file.substitute("Film")
    assert file.notes == ["film 'specfilm' cannot be used here, taken as 'hdrfilm'"]
    assert list(file.load().sensors()[0].film().size()) == [20, 10]
    more = '<string name="pixel_format" value="rgb, luminance"/>'
    file = SceneFile(sensor(tmp_path, more_film=more))
    file.substitute("Film")
    assert file.notes == ["film 'hdrfilm': pixel_format not understood, left out"]
    assert list(file.load().sensors()[0].film().size()) == [20, 10]


def test_films_that_scenes_refer_to(variant: str, tmp_path: Path) -> None:
    content = """<film type="ldrfilm" id="f"><integer name="width" value="7"/></film>
        <sensor type="perspective"><ref id="f"/></sensor><shape type="cube"/>"""
    file = SceneFile(scene(tmp_path, content))
    file.substitute("Film")
    assert file.load().sensors()[0].film().size()[0] == 7


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


def test_commands_say_what_was_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = sensor(tmp_path, film="ldrfilm", sampler="sobol")
    path.write_text(path.read_text().replace("</scene>", '<emitter type="constant"/></scene>'))
    film = "film 'ldrfilm' does not exist in this Mitsuba, taken as 'hdrfilm'"
    sampler = "sampler 'sobol' does not exist in this Mitsuba, taken as 'independent'"
    views = ["--train", "1", "--val", "0", "--test", "0", "--size", "8", "8", "--spp", "2"]
    assert main(["generate", str(path), str(tmp_path / "data"), *views]) == 0
    said = capsys.readouterr().out.splitlines()
    assert {film, sampler, "no integrator in the scene, 'path' is taken"} <= set(said)
    assert main(["info", str(path)]) == 0
    assert capsys.readouterr().out.splitlines()[-2:] == [film, sampler]
    out = tmp_path / "picture.png"
    assert main(["render", str(path), "-o", str(out)]) == 2  # it takes the sampler as it is
    assert capsys.readouterr().err.count("\n") == 1
    path.write_text(path.read_text().replace("sobol", "independent"))
    assert main(["render", str(path), "-o", str(out), "--spp", "1"]) == 0
    assert capsys.readouterr().out.splitlines()[0] == film


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("", "path"),
        ('<medium type="homogeneous" id="m"/>', "volpath"),
        (
            '<shape type="cube"><bsdf type="null"/><medium type="nerfmedium" name="interior">'
            '<string name="field" value="shell"/></medium></shape>',
            "nerf",
        ),
    ],
)
def test_a_scene_without_an_integrator(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str, expected: str
) -> None:
    content += '<emitter type="constant"/><sensor type="perspective"/><shape type="sphere"/>'
    path = scene(tmp_path, content)
    size = ["--size", "6", "4", "--spp", "2"]
    assert main(["render", str(path), "-o", str(tmp_path / "picture.png"), *size]) == 0
    assert capsys.readouterr().out.splitlines()[0] == (
        f"no integrator in the scene, '{expected}' is taken"
    )
    file = SceneFile(path)
    file.complete()
    file.complete()
    assert len(file.notes) == 1 and len(file.plugins("Integrator")) == 1
