"""Small Mitsuba scenes as text, for tests of what is made of them."""

from __future__ import annotations

from pathlib import Path

GRAY = '<bsdf type="diffuse"><rgb name="reflectance" value="0.6"/></bsdf>'
TWO_SIDED = f'<bsdf type="twosided">{GRAY}</bsdf>'
SKY = '<emitter type="constant"><float name="radiance" value="0.8"/></emitter>'

# A ball of 1.2 and a box on its side: the object of most of these scenes.
BALL = (
    f'<shape type="sphere" id="ball"><float name="radius" value="0.6"/>{GRAY}</shape>'
    '<shape type="cube" id="box"><transform name="to_world"><scale value="0.2"/>'
    f'<translate x="0.7" z="0.5"/></transform>{GRAY}</shape>'
)


def write_scene(folder: Path, *parts: str) -> Path:
    """A scene of these elements, path-traced."""
    path = folder / "scene.xml"
    integrator = '<integrator type="path"><integer name="max_depth" value="4"/></integrator>'
    path.write_text(f'<scene version="3.0.0">{integrator}{"".join(parts)}</scene>')
    return path


def pinhole(
    origin: str = "3, -4, 3",
    target: str = "0, 0, 0",
    up: str = "0, 0, 1",
    *,
    kind: str = "perspective",
    before: str = "",
    film: str = "",
    more: str = "",
    name: str = "it",
) -> str:
    """A sensor of 40 degrees and 32x24 pixels."""
    return (
        f'<sensor type="{kind}" id="{name}"><float name="fov" value="40"/>{more}'
        f'<transform name="to_world">{before}'
        f'<lookat origin="{origin}" target="{target}" up="{up}"/></transform>'
        '<film type="hdrfilm"><integer name="width" value="32"/>'
        f'<integer name="height" value="24"/>{film}</film></sensor>'
    )


def square(name: str, place: str, bsdf: str = GRAY) -> str:
    """A square of 2x2 in the plane z = 0 that faces +z, put in its place."""
    transform = f'<transform name="to_world">{place}</transform>'
    return f'<shape type="rectangle" id="{name}">{transform}{bsdf}</shape>'


def floor(half: float, level: float = -0.6, bsdf: str = GRAY) -> str:
    return square("floor", f'<scale value="{half}"/><translate z="{level}"/>', bsdf)


def room(bsdf: str = GRAY, *, front: bool = True) -> str:
    """Four by five and 2.5 high, on z = 0, with a table, a cupboard and a lamp at the ceiling.

    The walls face inwards; without ``front`` that at y = -2.5 is missing.
    """
    walls = [
        square("ground", '<scale x="2" y="2.5"/>', bsdf),
        square(
            "ceiling",
            '<scale x="2" y="2.5"/><rotate x="1" angle="180"/><translate z="2.5"/>',
            bsdf,
        ),
        square("left", _upright(1.25, 2.5, 'y="1" angle="90"', 'x="-2"'), bsdf),
        square("right", _upright(1.25, 2.5, 'y="1" angle="-90"', 'x="2"'), bsdf),
        square("back", _upright(2, 1.25, 'x="1" angle="90"', 'y="2.5"'), bsdf),
    ]
    if front:
        walls.append(square("front", _upright(2, 1.25, 'x="1" angle="-90"', 'y="-2.5"'), bsdf))
    things = [
        _block("table", (0.7, 0.4, 0.03), (0.3, 0.4, 0.75)),
        _block("cupboard", (0.3, 0.8, 0.9), (-1.6, 0.5, 0.9)),
    ]
    lamp = square(
        "lamp",
        '<scale x="0.8" y="0.5"/><rotate x="1" angle="180"/><translate z="2.45"/>',
        '<emitter type="area"><float name="radiance" value="6"/></emitter>',
    )
    return "".join([*walls, *things, lamp])


def _upright(x: float, y: float, turn: str, place: str) -> str:
    return f'<scale x="{x}" y="{y}"/><rotate {turn}/><translate {place} z="1.25"/>'


def _block(name: str, half: tuple[float, float, float], center: tuple[float, float, float]) -> str:
    sizes, places = (
        " ".join(f'{a}="{v}"' for a, v in zip("xyz", n, strict=True)) for n in (half, center)
    )
    transform = f'<transform name="to_world"><scale {sizes}/><translate {places}/></transform>'
    return f'<shape type="cube" id="{name}">{transform}{GRAY}</shape>'
