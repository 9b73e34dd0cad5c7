"""Small scenes of every kind, in the manner of Mitsuba's documentation, tests and gallery.

Each is written with the files that it reads: pictures, meshes, grids, curves and spectra, all
made here. ``write("dielectrics", folder)`` returns the path of the XML file.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np

from mi_nerf.images.write import write_exr


@dataclass(frozen=True)
class Scene:
    """What stands in ``<scene>``, and how views of it are asked for."""

    content: str
    version: str = "3.0.0"
    options: dict[str, Any] = field(default_factory=dict)


def write(name: str, folder: Path) -> Path:
    """Writes a scene of :data:`SCENES` and all files that any of them reads."""
    scene = SCENES[name]
    write_assets(folder)
    path = folder / f"{name}.xml"
    path.write_text(f'<scene version="{scene.version}">\n{scene.content}\n</scene>\n', "utf-8")
    return path


# ---- Parts -------------------------------------------------------------------

LOOKAT = '<lookat origin="3, -4, 3" target="0, 0, 0" up="0, 0, 1"/>'
FILM = """<film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="24"/>
    </film>"""
SAMPLER = '<sampler type="independent"><integer name="sample_count" value="16"/></sampler>'


def _sensor(kind: str = "perspective", more: str = '<float name="fov" value="40"/>') -> str:
    return f"""<sensor type="{kind}">{more}
        <transform name="to_world">{LOOKAT}</transform>{SAMPLER}{FILM}</sensor>"""


PATH = '<integrator type="path"><integer name="max_depth" value="5"/></integrator>'
VOLPATH = '<integrator type="volpath"><integer name="max_depth" value="8"/></integrator>'
SKY = '<emitter type="constant"><rgb name="radiance" value="0.8, 0.9, 1"/></emitter>'
CLAY = '<bsdf type="diffuse"><rgb name="reflectance" value="0.7, 0.4, 0.3"/></bsdf>'
FLOOR = """<shape type="rectangle" id="floor">
    <transform name="to_world"><scale value="0.95"/><translate z="-0.7"/></transform>
    <bsdf type="twosided"><bsdf type="diffuse"><texture type="checkerboard" name="reflectance">
        <rgb name="color0" value="0.2"/><rgb name="color1" value="0.6"/>
        <transform name="to_uv"><scale value="6"/></transform></texture></bsdf></bsdf></shape>"""
USUAL = PATH + _sensor() + SKY


def _ball(inside: str, x: float = 0.0, radius: float = 0.6) -> str:
    return f"""<shape type="sphere"><float name="radius" value="{radius}"/>
        <point name="center" x="{x}" y="0" z="0"/>{inside}</shape>"""


def _lit_by(emitter: str) -> str:
    """A ball on a floor, under one emitter."""
    return PATH + _sensor() + _ball(CLAY) + FLOOR + emitter


def _cloud(medium: str, integrator: str = VOLPATH) -> str:
    """A cube of a medium."""
    return f"""{integrator}{_sensor()}{SKY}{FLOOR}<shape type="cube"><bsdf type="null"/>
        <transform name="to_world"><scale value="0.5"/></transform>{medium}</shape>"""


GRID = """<volume name="{name}" type="gridvolume"><string name="filename" value="blob.vol"/>
    <transform name="to_world"><translate value="-0.5"/></transform></volume>"""

# ---- Shapes ------------------------------------------------------------------

_SHAPES = {
    "sphere_and_cube": USUAL
    + _ball(CLAY)
    + """<shape type="cube"><transform name="to_world"><scale value="0.2"/>
        <rotate z="1" angle="30"/><translate x="0.7" z="0.5"/></transform></shape>""",
    "cylinder_disk_rectangle": USUAL
    + FLOOR
    + """<shape type="cylinder"><point name="p0" value="0, 0, -0.7"/>
        <point name="p1" value="0, 0, 0.3"/><float name="radius" value="0.3"/>
        <bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>
    <shape type="disk"><transform name="to_world"><scale value="0.3"/><translate z="0.3"/>
        </transform><bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>""",
    "obj_mesh": USUAL + f'<shape type="obj"><string name="filename" value="wedge.obj"/>{CLAY}'
    '<boolean name="face_normals" value="true"/></shape>',
    "ply_with_colours": USUAL
    + """<shape type="ply"><string name="filename" value="wedge.ply"/><bsdf type="diffuse">
        <texture type="mesh_attribute" name="reflectance">
            <string name="name" value="vertex_color"/></texture></bsdf></shape>""",
    "serialized_mesh": USUAL
    + f"""<shape type="serialized"><string name="filename" value="wedge.serialized"/>{CLAY}
        <integer name="shape_index" value="0"/></shape>""",
    "bspline_curves": USUAL
    + f'<shape type="bsplinecurve"><string name="filename" value="curls.txt"/>{CLAY}</shape>',
    "linear_curves": USUAL
    + f'<shape type="linearcurve"><string name="filename" value="curls.txt"/>{CLAY}</shape>',
    "distance_field": USUAL
    + f"""<shape type="sdfgrid"><string name="filename" value="distance.vol"/>{CLAY}
        <transform name="to_world"><translate value="-0.5"/></transform></shape>""",
    "instances": USUAL
    + f"""<shape type="shapegroup" id="group"><shape type="cube">{CLAY}
            <transform name="to_world"><scale value="0.25"/></transform></shape>
        <shape type="sphere"><float name="radius" value="0.25"/>
            <point name="center" value="0, 0, 0.4"/>{CLAY}</shape></shape>
    <shape type="instance"><ref id="group"/><transform name="to_world">
        <rotate x="1" angle="20"/><translate x="-0.5"/></transform></shape>
    <shape type="instance"><ref id="group"/><transform name="to_world">
        <scale x="1" y="1" z="1.5"/><translate x="0.5"/></transform></shape>
    <shape type="instance"><ref id="group"/><transform name="to_world">
        <scale x="-1"/><translate y="0.8"/></transform></shape>""",
    "rows_of_balls": USUAL
    + "".join(
        f'<shape type="sphere"><float name="radius" value="0.25"/><ref id="m{x % 2}"/>'
        f'<point name="center" x="{0.6 * x}" y="{0.6 * y}" z="0"/></shape>'
        for x in (-1, 0, 1)
        for y in (-1, 0, 1)
    )
    + '<bsdf type="diffuse" id="m0"><rgb name="reflectance" value="0.7 0.2 0.1"/></bsdf>'
    + '<bsdf type="roughplastic" id="m1"><float name="alpha" value="0.2"/></bsdf>',
}

# ---- Materials ---------------------------------------------------------------

_MATERIALS = {
    "testball": f"""{PATH}{_sensor()}{FLOOR}
    <emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>
    <bsdf type="roughconductor" id="shell"><string name="material" value="Au"/>
        <float name="alpha" value="0.15"/><string name="distribution" value="ggx"/></bsdf>
    <bsdf type="twosided" id="core"><bsdf type="plastic">
        <rgb name="diffuse_reflectance" value="0.1, 0.3, 0.5"/></bsdf></bsdf>
    <shape type="sphere" id="outer"><float name="radius" value="0.5"/><ref id="shell"/></shape>
    <shape type="cylinder" id="foot"><point name="p0" value="0, 0, -0.7"/>
        <point name="p1" value="0, 0, -0.4"/><float name="radius" value="0.4"/>
        <ref id="core"/></shape>""",
    "conductor_of_spectra": USUAL
    + FLOOR
    + _ball("""<bsdf type="conductor"><spectrum name="eta" filename="gold.eta.spd"/>
        <spectrum name="k" filename="spectra/gold.k.spd"/></bsdf>"""),
    "dielectrics": USUAL
    + FLOOR
    + _ball('<bsdf type="dielectric"><string name="int_ior" value="bk7"/></bsdf>', -0.6, 0.3)
    + _ball('<bsdf type="thindielectric"/>', 0.0, 0.3)
    + _ball('<bsdf type="roughdielectric"><float name="alpha" value="0.1"/></bsdf>', 0.6, 0.3),
    "plastics": USUAL
    + _ball('<bsdf type="plastic"><boolean name="nonlinear" value="True"/></bsdf>', -0.6, 0.3)
    + _ball('<bsdf type="roughplastic"><float name="alpha" value="0.3"/></bsdf>', 0.0, 0.3)
    + _ball('<bsdf type="pplastic"/>', 0.6, 0.3),
    "principled": USUAL
    + _ball(
        """<bsdf type="principled"><rgb name="base_color" value="1, 0.6, 0.2"/>
        <float name="metallic" value="0.7"/><float name="roughness" value="0.3"/>
        <float name="clearcoat" value="0.5"/></bsdf>""",
        -0.4,
        0.35,
    )
    + _ball('<bsdf type="principledthin"><float name="roughness" value="0.4"/></bsdf>', 0.4, 0.35),
    "blended_and_masked": USUAL
    + _ball(
        f"""<bsdf type="blendbsdf"><texture type="checkerboard" name="weight">
        <transform name="to_uv"><scale value="8"/></transform></texture>
        {CLAY}<bsdf type="conductor"><string name="material" value="Cu"/></bsdf></bsdf>""",
        -0.4,
        0.35,
    )
    + _ball(
        f"""<bsdf type="mask"><texture type="bitmap" name="opacity">
        <string name="filename" value="dots.png"/><boolean name="raw" value="true"/></texture>
        <bsdf type="twosided">{CLAY}</bsdf></bsdf>""",
        0.4,
        0.35,
    ),
    "bump_and_normal_maps": USUAL
    + _ball(
        f"""<bsdf type="bumpmap"><texture type="bitmap" name="arbitrary">
        <boolean name="raw" value="true"/><string name="filename" value="dots.png"/></texture>
        {CLAY}</bsdf>""",
        -0.4,
        0.35,
    )
    + _ball(
        f"""<bsdf type="normalmap"><texture type="bitmap" name="normalmap">
        <boolean name="raw" value="true"/><string name="filename" value="normals.png"/></texture>
        {CLAY}</bsdf>""",
        0.4,
        0.35,
    ),
    "measured_material": USUAL
    + _ball('<bsdf type="measured"><string name="filename" value="paint.bsdf"/></bsdf>'),
    "hair": USUAL
    + """<shape type="bsplinecurve"><string name="filename" value="curls.txt"/>
        <bsdf type="hair"><float name="eumelanin" value="0.2"/></bsdf></shape>""",
}

# ---- Textures ----------------------------------------------------------------

_TEXTURES = {
    "bitmaps": USUAL
    + FLOOR
    + """<texture type="bitmap" id="paint"><string name="filename" value="textures/paint.png"/>
        <string name="filter_type" value="nearest"/><string name="wrap_mode" value="mirror"/>
        <transform name="to_uv"><scale x="3" y="2"/></transform></texture>
    <shape type="sphere"><float name="radius" value="0.6"/>
        <bsdf type="diffuse"><ref name="reflectance" id="paint"/></bsdf></shape>""",
    "volume_texture": USUAL
    + _ball(
        f"""<bsdf type="diffuse"><texture type="volume" name="reflectance">
        {GRID.format(name="volume")}</texture></bsdf>""",
        radius=0.45,
    ),
    "spectra_in_line": PATH
    + _sensor()
    + """<emitter type="constant"><spectrum name="radiance" value="400:0.5, 600:0.9 700:1"/>
        </emitter>"""
    + _ball(
        """<bsdf type="diffuse"><spectrum name="reflectance"
        value="400:0.1, 500:0.2, 700:0.8"/></bsdf>""",
        -0.4,
        0.35,
    )
    + _ball(
        """<bsdf type="diffuse"><spectrum name="reflectance" value="0.5"/></bsdf>""", 0.4, 0.35
    ),
}

# ---- Emitters ----------------------------------------------------------------

_LIGHTS = {
    "area_lights": _lit_by("""<shape type="rectangle"><transform name="to_world">
        <rotate y="1" angle="180"/><scale value="0.3"/><translate z="1.2"/></transform>
        <emitter type="area"><texture type="bitmap" name="radiance">
            <string name="filename" value="textures/paint.png"/><boolean name="raw" value="true"/>
        </texture></emitter></shape>
    <shape type="sphere"><float name="radius" value="0.1"/><point name="center" value="1, -1, 1"/>
        <emitter type="area"><rgb name="radiance" value="30"/></emitter></shape>"""),
    "environment_map": _lit_by("""<emitter type="envmap"><string name="filename" value="sky.exr"/>
        <float name="scale" value="1.5"/><transform name="to_world"><rotate x="1" angle="90"/>
        </transform></emitter>"""),
    "point_and_spot": _lit_by("""<emitter type="point"><point name="position" value="2, -2, 3"/>
        <rgb name="intensity" value="20"/></emitter>
    <emitter type="spot"><transform name="to_world">
        <lookat origin="-2, -2, 3" target="0, 0, 0" up="0, 0, 1"/></transform>
        <rgb name="intensity" value="30, 20, 10"/><float name="cutoff_angle" value="25"/>
        </emitter>"""),
    "directional": _lit_by("""<emitter type="directional"><vector name="direction" x="1" y="1"
        z="-1"/><rgb name="irradiance" value="3"/></emitter>"""),
    "projector": _lit_by("""<emitter type="projector"><transform name="to_world">
        <lookat origin="1, -2, 3" target="0, 0, 0" up="0, 0, 1"/></transform>
        <float name="fov" value="40"/><float name="scale" value="20"/>
        <texture type="bitmap" name="irradiance">
            <string name="filename" value="textures/paint.png"/></texture></emitter>"""),
    "sun_and_sky": _lit_by("""<emitter type="sunsky"><float name="turbidity" value="4"/>
        <vector name="sun_direction" x="1" y="-1" z="1"/></emitter>"""),
    "collimated_area": _lit_by("""<shape type="rectangle"><transform name="to_world">
        <rotate y="1" angle="180"/><translate z="1.5"/></transform>
        <emitter type="directionalarea"><rgb name="radiance" value="2"/></emitter></shape>
        """)
    + SKY,
    "black_bodies": _lit_by("""<emitter type="constant"><spectrum name="radiance" type="blackbody">
        <float name="temperature" value="5000"/></spectrum></emitter>
    <emitter type="point"><point name="position" value="2, -2, 3"/>
        <spectrum name="intensity" type="d65"><float name="scale" value="10"/></spectrum>
        </emitter>"""),
}

# ---- Sensors, samplers, films ------------------------------------------------

_BALL_ON_FLOOR = _ball(CLAY) + FLOOR + SKY + PATH

_SENSORS = {
    "thin_lens": _BALL_ON_FLOOR
    + _sensor(
        "thinlens",
        """<float name="fov" value="40"/><float name="aperture_radius" value="0.2"/>
        <float name="focus_distance" value="5"/>""",
    ),
    "orthographic": _BALL_ON_FLOOR
    + f"""<sensor type="orthographic"><transform name="to_world"><scale value="1.5"/>{LOOKAT}
        </transform>{SAMPLER}{FILM}</sensor>""",
    "irradiance_meter": PATH
    + SKY
    + _ball(f"""{CLAY}<sensor type="irradiancemeter">{SAMPLER}<film type="hdrfilm">
        <integer name="width" value="1"/><integer name="height" value="1"/>
        <rfilter type="box"/></film></sensor>"""),
    "several_sensors": _BALL_ON_FLOOR + _sensor() + _sensor("perspective", ""),
    "no_sensor": _BALL_ON_FLOOR,
    "film_and_sampler": _BALL_ON_FLOOR
    + f"""<sensor type="perspective"><string name="focal_length" value="50mm"/>
        <transform name="to_world">{LOOKAT}</transform>
        <sampler type="multijitter"><integer name="sample_count" value="16"/></sampler>
        <film type="hdrfilm"><integer name="width" value="48"/><integer name="height" value="32"/>
            <integer name="crop_offset_x" value="8"/><integer name="crop_offset_y" value="4"/>
            <integer name="crop_width" value="24"/><integer name="crop_height" value="20"/>
            <string name="pixel_format" value="luminance"/>
            <string name="component_format" value="float32"/>
            <rfilter type="mitchell"/></film></sensor>""",
    "spectral_film": _BALL_ON_FLOOR
    + f"""<sensor type="perspective"><transform name="to_world">{LOOKAT}</transform>{SAMPLER}
        <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/>
            <string name="file_format" value="rgbe"/><string name="pixel_format" value="rgb"/>
            <rfilter type="lanczos"/></film></sensor>""",
}

# ---- Media -------------------------------------------------------------------

_MEDIA = {
    "fog": _cloud("""<medium name="interior" type="homogeneous"><rgb name="albedo" value="0.9"/>
        <float name="sigma_t" value="4"/><phase type="hg"><float name="g" value="0.4"/></phase>
        </medium>"""),
    "smoke": _cloud(
        f"""<medium name="interior" type="heterogeneous">
        <volume name="albedo" type="constvolume"><rgb name="value" value="0.9, 0.8, 0.7"/></volume>
        {GRID.format(name="sigma_t")}<float name="scale" value="20"/></medium>""",
        '<integrator type="volpathmis"/>',
    ),
    "blended_phases": _cloud("""<medium name="interior" type="homogeneous">
        <rgb name="albedo" value="0.8"/><float name="sigma_t" value="3"/>
        <phase type="blendphase"><float name="weight" value="0.3"/><phase type="rayleigh"/>
            <phase type="tabphase"><string name="values" value="0.5, 1.0, 1.5, 2.0"/></phase>
        </phase></medium>"""),
    "coloured_glass": VOLPATH
    + _sensor()
    + SKY
    + FLOOR
    + _ball("""<bsdf type="dielectric"/><medium name="interior" type="homogeneous">
        <rgb name="albedo" value="0"/><rgb name="sigma_t" value="0.1, 0.5, 1"/>
        <float name="scale" value="2"/></medium>"""),
}

# ---- Integrators -------------------------------------------------------------


def _by(integrator: str) -> str:
    return integrator + _sensor() + SKY + _ball(CLAY) + FLOOR


_INTEGRATORS = {
    "direct": _by("""<integrator type="direct"><integer name="emitter_samples" value="2"/>
        <integer name="bsdf_samples" value="1"/></integrator>"""),
    "aov_channels": _by(f"""<integrator type="aov">
        <string name="aovs" value="d:depth, n:sh_normal, i:shape_index"/>{PATH}</integrator>"""),
    "moments": _by(f'<integrator type="moment">{PATH}</integrator>'),
    "path_replay": _by('<integrator type="prb"><integer name="max_depth" value="4"/></integrator>'),
    "projective": _by('<integrator type="prb_projective"/>'),
    "direct_projective": _by('<integrator type="direct_projective"/>'),
    "volume_replay": _by('<integrator type="prbvolpath"/>'),
}

# ---- Files as they are found -------------------------------------------------

_OLD = f"""<sensor type="perspective"><float name="fov" value="40"/>
        <string name="fovAxis" value="smaller"/><float name="nearClip" value="0.1"/>
        <transform name="toWorld">{LOOKAT}</transform>
        <sampler type="{{sampler}}"><integer name="sampleCount" value=" 16 "/></sampler>
        <film type="{{film}}"><integer name="width" value="32"/>
            <integer name="height" value="24"/>{{more}}</film></sensor>"""

_FILES = {
    "version_0_5": Scene(
        """<!-- -- exported -- 2013 -- -->
    <integrator type="path"><integer name="maxDepth" value="5"/><integer name="rrDepth" value="4"/>
        <boolean name="hideEmitters" value="True"/></integrator>"""
        + _OLD.format(
            sampler="ldsampler",
            film="ldrfilm",
            more='<string name="pixelFormat" value="rgb"/><rfilter type="gaussian"/>'
            '<float name="gamma" value="2.2"/><boolean name="banner" value="false"/>',
        )
        + f"""{SKY}<bsdf type="plastic" id="m"><rgb name="diffuseReflectance" value=".7 .3 .2"/>
        <float name="intIOR" value="1.6"/></bsdf>
    <bsdf type="diffuse" id="d"><texture type="bitmap" name="diffuseReflectance">
        <string name="filename" value="textures/paint.png"/><float name="uscale" value="3"/>
        <float name="vscale" value="2"/><float name="uoffset" value="0.5"/></texture></bsdf>
    <shape type="shapegroup" id="pair"><shape type="sphere"><ref id="m"/>
        <float name="radius" value="0.3"/></shape><shape type="cube"><ref id="d"/>
        <transform name="toWorld"><scale value="0.2"/><translate z="0.5"/></transform></shape>
    </shape>
    <shape type="instance"><ref id="pair"/><transform name="toWorld"><translate x="-0.5"/>
        </transform></shape>
    <shape type="instance"><ref id="pair"/><transform name="toWorld">
        <rotate z="1" angle="45"/><translate x="0.5"/></transform></shape>""",
        "0.5.0",
    ),
    "version_0_6": Scene(
        """<integrator type="bdpt"><integer name="maxDepth" value="6"/>
        <boolean name="lightImage" value="false"/><boolean name="sampleDirect" value="true"/>
    </integrator>"""
        + _OLD.format(
            sampler="sobol",
            film="tiledhdrfilm",
            more='<string name="componentFormat" value="float16"/><rfilter type="catmullrom"/>',
        )
        + SKY
        + _ball("""<bsdf type="roughconductor"><string name="material" value="Ag"/>
        <float name="alpha" value="0.1"/><rgb name="specularReflectance" value="0.9"/></bsdf>"""),
        "0.6.0",
    ),
    "version_2_1": Scene(USUAL + FLOOR + _ball(CLAY), "2.1.0"),
    "included_parts": Scene(
        """<default name="spp" value="8"/><default name="part" value="ball"/>
    <path value="spectra"/><include filename="parts/frame.xml"/>
    <include filename="parts/$part.xml"/>
    <bsdf type="diffuse" id="first"/><alias id="first" as="second"/>
    <shape type="cube"><transform name="to_world"><scale value="0.3"/><translate z="-0.4"/>
        </transform><ref id="second"/></shape>
    <shape type="sphere"><float name="radius" value="0.2"/><point name="center" value="1, 0, 0"/>
        <bsdf type="conductor"><spectrum name="eta" filename="gold.eta.spd"/>
            <spectrum name="k" filename="gold.k.spd"/></bsdf></shape>"""
        + SKY
    ),
    "cornell_box": Scene(
        PATH
        + f"""<sensor type="perspective"><float name="fov" value="39.3"/>
        <transform name="to_world"><lookat origin="0, -3.9, 0" target="0, 0, 0" up="0, 0, 1"/>
        </transform>{SAMPLER}{FILM}</sensor>
    <bsdf type="twosided" id="white"><bsdf type="diffuse">
        <rgb name="reflectance" value="0.88, 0.86, 0.84"/></bsdf></bsdf>
    <bsdf type="twosided" id="green"><bsdf type="diffuse">
        <rgb name="reflectance" value="0.1, 0.37, 0.07"/></bsdf></bsdf>
    <bsdf type="twosided" id="red"><bsdf type="diffuse">
        <rgb name="reflectance" value="0.57, 0.04, 0.04"/></bsdf></bsdf>"""
        + "".join(
            f"""<shape type="rectangle" id="{name}"><ref id="{colour}"/>
        <transform name="to_world">{turn}<translate {axis}="{place}"/></transform></shape>"""
            for name, colour, turn, axis, place in (
                ("floor", "white", "", "z", -1),
                ("ceiling", "white", "", "z", 1),
                ("back", "white", '<rotate x="1" angle="90"/>', "y", 1),
                ("left", "red", '<rotate y="1" angle="90"/>', "x", -1),
                ("right", "green", '<rotate y="1" angle="90"/>', "x", 1),
            )
        )
        + """<shape type="rectangle" id="light"><transform name="to_world"><scale value="0.25"/>
        <rotate x="1" angle="180"/><translate z="0.99"/></transform>
        <emitter type="area"><rgb name="radiance" value="18.4, 15.6, 8"/></emitter></shape>
    <shape type="cube" id="small"><ref id="white"/><transform name="to_world"><scale value="0.3"/>
        <rotate z="1" angle="-17"/><translate x="0.33" y="-0.38" z="-0.7"/></transform></shape>
    <shape type="cube" id="tall"><ref id="white"/><transform name="to_world">
        <scale x="0.3" y="0.3" z="0.6"/><rotate z="1" angle="18"/>
        <translate x="-0.33" y="0.28" z="-0.4"/></transform></shape>""",
        options={"protocol": "forward", "radius": 0.2},
    ),
}

SCENES: dict[str, Scene] = {
    **{
        name: Scene(content)
        for group in (_SHAPES, _MATERIALS, _TEXTURES, _LIGHTS, _SENSORS, _MEDIA, _INTEGRATORS)
        for name, content in group.items()
    },
    **_FILES,
}

# ---- The files that they read ------------------------------------------------

_CORNERS = np.array(
    [[-0.6, -0.5, -0.5], [0.6, -0.5, -0.5], [0.6, 0.5, -0.5], [-0.6, 0.5, -0.5], [0, 0, 0.7]],
    np.float32,
)
_FACES = np.array([[0, 2, 1], [0, 3, 2], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]], np.uint32)


def write_assets(folder: Path) -> None:
    """Writes every file that one of the scenes reads, in subfolders as people have them."""
    for name in ("textures", "spectra", "parts"):
        (folder / name).mkdir(exist_ok=True)
    rng = np.random.default_rng(0)
    iio.imwrite(folder / "textures/paint.png", rng.integers(64, 255, (8, 8, 3), np.uint8))
    y, x = np.mgrid[:16, :16]
    dots = np.uint8(255) * ((x // 4 + y // 4) % 2).astype(np.uint8)
    iio.imwrite(folder / "dots.png", dots)
    tilt = np.stack([128 + 30 * np.sin(x), 128 + 30 * np.cos(y), np.full((16, 16), 250)], -1)
    iio.imwrite(folder / "normals.png", tilt.astype(np.uint8))
    sky = np.tile(np.linspace(1, 0.2, 8, dtype=np.float32)[:, None, None], (1, 16, 3))
    write_exr(folder / "sky.exr", sky)
    for where in ("", "spectra/"):
        (folder / f"{where}gold.eta.spd").write_text("400 1.6\n500 0.9\n600 0.25\n700 0.16\n")
        (folder / f"{where}gold.k.spd").write_text("400 1.9\n500 1.8\n600 3.0\n700 3.9\n")
    _write_meshes(folder)
    grid = np.linspace(-1, 1, 12)
    radius = np.sqrt(sum(axis**2 for axis in np.meshgrid(grid, grid, grid, indexing="ij")))
    _write_volume(folder / "blob.vol", np.clip(1 - radius, 0, 1))
    _write_volume(folder / "distance.vol", (radius - 0.8) / 2)  # in the unit cube
    _write_measured(folder / "paint.bsdf")
    t = np.linspace(0, 1, 12)
    curls = [
        np.stack([np.cos(7 * t + k), np.sin(7 * t + k), 2 * t - 1, 0 * t + 0.15], -1) * 0.6
        for k in range(5)
    ]
    # Mitsuba 3.9.1 reads too far where a ray meets the last curve's end: this one is never met.
    curls.append(curls[0][:5] * [1, 1, 1, 0.1])
    lines = ["\n".join(" ".join(f"{v:.4f}" for v in row) for row in curl) for curl in curls]
    (folder / "curls.txt").write_text("\n\n".join(lines) + "\n")
    (folder / "parts/frame.xml").write_text(
        f"""<scene version="3.0.0">{PATH}
        {_sensor().replace('value="16"', 'value="$spp"')}</scene>"""
    )
    (folder / "parts/ball.xml").write_text(
        '<shape version="0.6.0" type="sphere"><float name="radius" value="0.4"/>'
        '<transform name="toWorld"><translate z="0.3"/></transform></shape>'
    )


def _write_meshes(folder: Path) -> None:
    """The same wedge as text of two kinds and in Mitsuba's own format."""
    (folder / "wedge.obj").write_text(
        "".join(f"v {x} {y} {z}\n" for x, y, z in _CORNERS)
        + "".join(f"f {a} {b} {c}\n" for a, b, c in _FACES + 1)
    )
    header = f"""ply
format ascii 1.0
element vertex {len(_CORNERS)}
property float x
property float y
property float z
property float r
property float g
property float b
element face {len(_FACES)}
property list uchar int vertex_indices
end_header
"""
    rows = [f"{x} {y} {z} {0.5 + x / 2} 0.5 {0.5 + z / 2}\n" for x, y, z in _CORNERS]
    rows += [f"3 {a} {b} {c}\n" for a, b, c in _FACES]
    (folder / "wedge.ply").write_text(header + "".join(rows))
    single, face_normals = 0x1000, 0x0010
    body = struct.pack("<I", single | face_normals) + b"wedge\0"
    body += struct.pack("<QQ", len(_CORNERS), len(_FACES)) + _CORNERS.tobytes() + _FACES.tobytes()
    packed = struct.pack("<HH", 0x041C, 4) + zlib.compress(body)
    (folder / "wedge.serialized").write_bytes(packed + struct.pack("<QI", 0, 1))


def _write_volume(path: Path, values: np.ndarray[Any, Any]) -> None:
    """Mitsuba's grid of float32 in the unit cube, x fastest."""
    z, y, x = values.shape
    head = b"VOL" + struct.pack("<B5i6f", 3, 1, x, y, z, 1, 0, 0, 0, 1, 1, 1)
    path.write_bytes(head + values.astype("<f4").tobytes())


def _write_measured(path: Path) -> None:
    """An isotropic reflectance in the format of the RGL database: the same in all directions."""
    angles, side = 4, 4
    theta = np.linspace(0, np.pi / 2, angles, dtype=np.float32)
    fields: dict[str, np.ndarray[Any, Any]] = {
        "description": np.frombuffer(b"paint", np.uint8),
        "phi_i": np.zeros(1, np.float32),
        "theta_i": theta,
        "sigma": np.ones((side, side), np.float32),
        "ndf": np.ones((side, side), np.float32),
        "vndf": np.ones((1, angles, side, side), np.float32),
        "luminance": np.ones((1, angles, side, side), np.float32),
        "rgb": np.full((1, angles, 3, side, side), 0.3, np.float32),
        "jacobian": np.ones(1, np.uint8),
    }
    kinds = {np.dtype(np.uint8): 1, np.dtype(np.float32): 10}
    head = 12 + 2 + 4
    head += sum(2 + len(name) + 2 + 1 + 8 + 8 * value.ndim for name, value in fields.items())
    table, body = b"", b""
    for name, value in fields.items():
        table += struct.pack("<H", len(name)) + name.encode()
        table += struct.pack("<HBQ", value.ndim, kinds[value.dtype], head + len(body))
        table += struct.pack(f"<{value.ndim}Q", *value.shape)
        body += value.tobytes()
    start = b"tensor_file\0" + struct.pack("<BBI", 1, 0, len(fields))
    path.write_bytes(start + table + body)
