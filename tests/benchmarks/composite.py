"""What fields among surfaces cost: beside the same scene without, and by their number.

    python -m tests.benchmarks.composite

Then what light paths through a field cost, and whether it pays to sample it as a light source.

The field is an untrained network of the size that preset nerf trains, in a ball that fills most
of its box, so dense that a ray asks it about 28 times: what a rendering costs does not depend
on what the network shows, but on where it is asked. The scene is a room for Mitsuba's path
tracer. Medians of repeated renderings through mi.render, after one that compiles.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

import mi_nerf
from mi_nerf.base.variants import choose_variant
from mi_nerf.fields.network import NetworkConfig, initial_weights
from mi_nerf.fields.neural import NeuralFieldConfig
from mi_nerf.march import query, walk
from mi_nerf.march.settings import MarchSettings
from tests.benchmarks import machine
from tests.benchmarks.results import RENDERING, Figure, Row, add_options, save
from tests.support.fields import camera_dict

_WIDTH, _PATHS = 256, 64


def main() -> None:
    """Prints all tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--variant")
    add_options(parser)
    options = parser.parse_args()
    variant = choose_variant(options.variant)
    mi.set_variant(variant)
    print(f"{machine()}, {variant}, {_WIDTH}x{_WIDTH} pixels")
    with tempfile.TemporaryDirectory() as folder:
        file = _field_file(Path(folder))
        beside = [*_against_none(file, options.repeats), *_by_number(file, options.repeats)]
        transport = list(_light_transport(file, options.repeats))
    parts = (*RENDERING, "estimators")
    save("composite", beside, options, variant, parts, whole=True)
    save("light_transport", transport, options, variant, parts, whole=True)


def _against_none(file: Path, repeats: int) -> Iterator[Row]:
    """A room with an object that covers a tenth of the pixels, and without it."""
    field = _cube(file, mi.ScalarTransform4f().translate([0.2, 0, -0.4]).scale(0.88))
    path = _seconds(mi.load_dict(_room({"type": "path"})), _PATHS, repeats)[0]
    print(f"{_PATHS} paths a pixel: path alone {path:.3f} s")
    for spp in (1, 4):
        nested = {"type": "nerf", "nested": {"type": "path"}, "paths": _PATHS // spp}
        scene = mi.load_dict(_room({**nested, "aovs": "opacity"}, field=field))
        opacity = np.array(mi.render(scene, spp=spp))[..., 4]
        seconds, queries = _seconds(scene, spp, repeats)
        print(
            f"{_PATHS} paths and {spp} rays a pixel, a field over {(opacity > 0).mean():.1%} of "
            f"them: {seconds:.3f} s, {seconds / path:.2f} times, "
            f"{queries / 1e6:.2f} million queries"
        )
        yield Row(
            {
                "what": f"a field over {(opacity > 0).mean():.1%} of the pixels, {_PATHS} paths "
                f"and {spp} rays a pixel, against the scene without it"
            },
            {
                "seconds": Figure(seconds, "s"),
                "times": Figure(seconds / path),
                "million_queries": Figure(queries / 1e6),
            },
        )


def _by_number(file: Path, repeats: int) -> Iterator[Row]:
    """Fields beside each other, and all in one place."""
    for name in ("side by side", "overlapping"):
        for count in (1, 2, 4, 8):
            cubes = {f"field_{i}": _cube(file, _place(name, i)) for i in range(count)}
            scene = mi.load_dict(_room({"type": "nerf"}, **cubes))
            seconds, queries = _seconds(scene, 1, repeats)
            a_million = 1e6 * seconds / queries if queries else float("nan")
            print(
                f"{count} {name}: {seconds:.3f} s, {queries / 1e6:.2f} million queries, "
                f"{a_million:.3f} s a million"
            )
            yield Row(
                {"what": f"{count} fields, {name}"},
                {
                    "seconds": Figure(seconds, "s"),
                    "million_queries": Figure(queries / 1e6),
                    "seconds_a_million": Figure(a_million, "s"),
                },
            )


def _light_transport(file: Path, repeats: int) -> Iterator[Row]:
    """Paths through a field, beside paths that do not know it, and how noisy both are.

    Noise is the mean over all pixels of the variance between renderings; times seconds, it is
    what a given error costs.
    """
    cubes = {"field": _cube(file, mi.ScalarTransform4f().translate([0.2, 0, -0.4]).scale(0.88))}
    nested = {"type": "nerf", "nested": {"type": "path", "max_depth": 6}}
    integrators = {
        "path, without the field": ({"type": "path", "max_depth": 6}, {}),
        "nerf around path": (nested, cubes),
        "nerf_path": ({"type": "nerf_path", "max_depth": 6, "sample_fields": False}, cubes),
        "nerf_path, fields sampled": (
            {"type": "nerf_path", "max_depth": 6, "sample_fields": True},
            cubes,
        ),
    }
    for lit in (True, False):
        for name, (integrator, fields) in integrators.items():
            room = _room(integrator, **fields)
            if not lit:  # by nothing but the field
                del room["lamp"], room["sky"]
            if not lit and not fields:
                continue
            scene = mi.load_dict(room)
            seconds, queries = _seconds(scene, 4, repeats)
            images = [np.array(mi.render(scene, spp=4, seed=100 + i)) for i in range(8)]
            noise = float(np.var(images, axis=0, ddof=1)[..., :3].mean())
            print(
                f"{'lamp and sky' if lit else 'no other light'}, {name}, 4 paths a pixel: "
                f"{seconds:.3f} s, {queries / 1e6:.2f} million queries, variance {noise:.2e}, "
                f"times seconds {noise * seconds:.2e}"
            )
            yield Row(
                {"light": "lamp and sky" if lit else "the field alone", "integrator": name},
                {
                    "seconds": Figure(seconds, "s"),
                    "million_queries": Figure(queries / 1e6),
                    "variance": Figure(noise),
                },
            )


def _place(name: str, i: int) -> Any:
    """Of the i-th of eight fields; equally large on the film either way."""
    turn = mi.ScalarTransform4f().rotate([0, 0, 1], 20.0 * i)
    if name == "overlapping":
        return mi.ScalarTransform4f().translate([0.02 * i, 0, 0]) @ turn.scale(0.7)
    x, z = 0.8 * (i % 4) - 1.2, 0.9 * (i // 4) - 0.45
    return mi.ScalarTransform4f().translate([x, 0, z]) @ turn.scale(0.7)


def _seconds(scene: mi.Scene, spp: int, repeats: int) -> tuple[float, int]:
    """Median time of a rendering and its queries."""
    times, queries = [], 0
    for seed in range(repeats + 1):
        _Counted.queries = 0
        start = time.perf_counter()
        dr.eval(mi.render(scene, spp=spp, seed=seed))
        dr.sync_thread()
        times.append(time.perf_counter() - start)
        queries = _Counted.queries
    return float(np.median(times[1:])), queries


class _Counted:
    """Counts what the fields are asked, wherever; plugins are loaded anew with each variant."""

    queries = 0


def _count(make: Callable[..., None]) -> Callable[..., None]:
    def counting(self: query.Evaluation, *arguments: Any, **options: Any) -> None:
        make(self, *arguments, **options)
        _Counted.queries += len(self.asked)

    return counting


query.Evaluation.__init__ = _count(query.Evaluation.__init__)  # type: ignore[method-assign]


def _count_walks(make: Callable[..., Any]) -> Callable[..., Any]:
    """The same of fields that are asked within one kernel."""

    def counting(*arguments: Any, **options: Any) -> Any:
        walked = make(*arguments, **options)
        _Counted.queries += int(dr.sum(walked.queries)[0])
        return walked

    return counting


walk.walk_rays = _count_walks(walk.walk_rays)  # before the plugins are imported anew


def _field_file(folder: Path) -> Path:
    """An untrained network, occupied in a ball that fills most of its box."""
    network = NetworkConfig(depth=4, width=64, skip=-1, view_width=32)
    config = NeuralFieldConfig(network=network, density_scale=60.0)
    center = (np.indices((64, 64, 64)) + 0.5) / 32 - 1
    ball = np.sum(center**2, axis=0) < 0.8**2
    weights = initial_weights(config.shapes(), 0)
    march = MarchSettings(samples=128, stop=1e-3)
    path = folder / "field.safetensors"
    mi_nerf.save_field(path, mi_nerf.FieldFile(config, weights, ball, march))
    return path


def _cube(file: Path, to_world: Any) -> dict[str, Any]:
    return {
        "type": "cube",
        "to_world": to_world,
        "interior": {"type": "nerfmedium", "filename": str(file)},
    }


def _room(integrator: dict[str, Any], **objects: Any) -> dict[str, Any]:
    """Floor, back wall, a glass and a matt ball under a lamp, seen along +y."""
    place = mi.ScalarTransform4f
    view = place().look_at(origin=[0, -5.5, 0.5], target=[0, 0, 0], up=[0, 0, 1])
    matt = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.6, 0.5, 0.4]}}
    return {
        "type": "scene",
        "integrator": integrator,
        "sensor": camera_dict(view, size=(_WIDTH, _WIDTH), spp=1),
        "floor": {
            "type": "rectangle",
            "to_world": place().translate([0, 0, -1]).scale(5),
            "bsdf": matt,
        },
        "back": {
            "type": "rectangle",
            "to_world": place().translate([0, 3, 0]).rotate([1, 0, 0], 90).scale(5),
            "bsdf": matt,
        },
        "glass": {
            "type": "sphere",
            "center": [1.1, -0.5, -0.6],
            "radius": 0.4,
            "bsdf": {"type": "dielectric"},
        },
        "ball": {"type": "sphere", "center": [-1.1, 0.5, -0.5], "radius": 0.5, "bsdf": matt},
        "lamp": {
            "type": "rectangle",
            "to_world": place().translate([0, 0, 4]).rotate([1, 0, 0], 180),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [9, 9, 9]}},
        },
        "sky": {"type": "constant", "radiance": 0.2},
        **objects,
    }


if __name__ == "__main__":
    main()
