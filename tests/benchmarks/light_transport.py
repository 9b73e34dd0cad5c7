"""Noise and time of the composed scenes, beside those of another checkout and of meshes.

    python -m tests.benchmarks.light_transport --against ../before
    python -m tests.benchmarks.light_transport --scenes table --meshes

Each scene is rendered with a few samples a pixel and many seeds. Its noise is the variance of a
pixel's estimate, the mean over pixels and channels; times the seconds of a picture, it is what
a given error costs, whatever the number of samples. Seconds are those of all threads together,
the median of pictures that compile nothing; processes of all checkouts take turns. The ratio is
that of this product to that of the other checkout, ``means`` the largest difference of the
means of rows of pixels, in standard errors.

With ``--meshes``, the same scenes by Mitsuba's ``path``, each field replaced by a mesh of the
same look: marching cubes through its density, black, with the colour that the field shows along
the normal as emission. The ratio is then that of ``nerf_path`` to it.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerf.base.variants import choose_variant
from tests.benchmarks import checkout, machine, results
from tests.benchmarks.results import RENDERING, ROOT, Figure, Row, median_of, save

SCENES = ("table", "mirror", "interlocked")
RENDER = """
import time
import drjit as dr
import mitsuba as mi
import numpy as np
import mi_nerf

a = arguments
mi.set_variant(a["variant"])
if a["threads"]:
    dr.set_thread_count(a["threads"])
if a["meshes"]:
    from tests.benchmarks.light_transport import with_meshes
width, height = a["size"]
scene = mi.load_file(a["scene"], width=width, height=height, spp=a["spp"])
integrator, sensor = scene.integrator(), scene.sensors()[0]
if a["meshes"]:
    scene = with_meshes(scene, a["out"])
    integrator = mi.load_dict({"type": "path", "max_depth": 8})
busy, images = [], []
for seed in range(a["seeds"] + 1):
    start = time.process_time()
    image = np.array(
        mi.render(scene, sensor=sensor, integrator=integrator, spp=a["spp"], seed=seed + a["first"])
    )
    busy.append(time.process_time() - start)
    images.append(image[..., :3])
np.save(a["out"] + "/images.npy", np.array(images[1:], np.float32))
answer({"package": mi_nerf.__file__, "busy": busy[1:]})
"""


def main() -> None:
    """Renders all scenes with all checkouts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES)
    parser.add_argument("--size", type=int, nargs=2, default=(128, 64))
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--seeds", type=int, default=4, help="pictures of each process")
    parser.add_argument("--repeats", type=int, default=2, help="processes of each checkout")
    parser.add_argument("--threads", type=int, default=1, help="0: one for each core")
    parser.add_argument("--meshes", action="store_true", help="beside meshes of the same look")
    parser.add_argument("--variant")
    checkout.add_options(parser)
    results.add_options(parser)
    options = parser.parse_args()
    options.variant = choose_variant(options.variant)
    print(f"{machine()}, {options.size[0]}x{options.size[1]}, {options.spp} samples a pixel")
    for scene in options.scenes:
        _compare(scene, options)


def _compare(scene: str, options: argparse.Namespace) -> None:
    """Renders one scene with all checkouts in turns, and saves their rows."""
    versions = checkout.versions(options)
    if options.meshes:
        versions = {"path, meshes": ROOT, **versions}
    busy: dict[str, list[float]] = {name: [] for name in versions}
    images: dict[str, list[np.ndarray[Any, Any]]] = {name: [] for name in versions}
    for turn in range(options.repeats):
        for name, folder in versions.items():
            seconds, seen = _rendered(folder, scene, turn, name == "path, meshes", options)
            busy[name] += seconds
            images[name] += [*seen]
    costs: dict[str, float] = {}
    for name, folder in versions.items():
        seen = np.array(images[name], np.float64)
        variance = float(seen.var(axis=0, ddof=1).mean())
        costs[name] = variance * float(np.median(busy[name]))
        figures = {
            "busy": median_of(busy[name], "s"),
            "variance": Figure(variance),
            "cost": Figure(costs[name], "s"),
        }
        if name == "this":
            for other in costs:
                if other != name:
                    figures[f"to {other}"] = Figure(costs[name] / costs[other])
            if options.against is not None:
                figures["means"] = Figure(_apart(seen, np.array(images[options.against_name])))
        print(f"{scene}, {name}: " + ", ".join(f"{k} {f.value:.3g}" for k, f in figures.items()))
        labels = {"scene": scene, "version": name, "samples": str(options.spp)}
        row = Row(labels, figures)
        save("noise", [row], options, options.variant, RENDERING, checkout=folder)


def _rendered(
    folder: Path, scene: str, turn: int, meshes: bool, options: argparse.Namespace
) -> tuple[list[float], np.ndarray[Any, Any]]:
    """Seconds of pictures, and the pictures, (K, H, W, 3)."""
    with tempfile.TemporaryDirectory() as place:
        found = checkout.measured(
            folder,
            RENDER,
            scene=str(folder / "scenes" / "composed" / f"{scene}.xml"),
            out=place,
            size=list(options.size),
            spp=options.spp,
            seeds=options.seeds,
            first=1000 * turn,
            threads=options.threads,
            meshes=meshes,
            variant=options.variant,
        )
        return found["busy"], np.load(Path(place) / "images.npy")


def _apart(a: np.ndarray[Any, Any], b: np.ndarray[Any, Any]) -> float:
    """The largest difference of the means of rows of pixels, in standard errors."""
    means = [x.mean(axis=(2, 3)) for x in (a, b)]
    error = np.sqrt(sum(m.var(axis=0, ddof=1) / len(m) for m in means))
    return float(np.abs((means[0].mean(axis=0) - means[1].mean(axis=0)) / error).max())


# ---- Meshes -------------------------------------------------------------------


def with_meshes(scene: Any, folder: str, cells: int = 128) -> Any:
    """The scene, its fields replaced by meshes that look the same."""
    import mitsuba as mi

    from mi_nerf.plugins.placement import find_fields
    from mi_nerf.plugins.solid_scene import SolidScene

    props = mi.Properties("scene")
    solid = SolidScene().of(scene)
    shapes = list(solid.shapes())
    parts = shapes + [e for e in solid.emitters() if e.is_environment()]
    for i, placed in enumerate(find_fields(scene)):
        path = f"{folder}/field_{i}.ply"
        _mesh_of(placed, cells).write_ply(path)
        colors = {"type": "mesh_attribute", "name": "vertex_color"}
        parts.append(
            mi.load_dict(
                {
                    "type": "ply",
                    "filename": path,
                    "bsdf": {"type": "diffuse", "reflectance": 0.0},
                    "emitter": {"type": "area", "radiance": colors},
                }
            )
        )
    for i, part in enumerate(parts):
        props[f"part_{i}"] = part
    return mi.Scene(props)


def _mesh_of(placed: Any, cells: int) -> Any:
    """A field's surface, where a cell becomes half opaque, with linear colours at its vertices."""
    import drjit as dr
    import mitsuba as mi
    from skimage.measure import marching_cubes

    from mi_nerf.base.color import srgb_to_linear

    field, grid = placed.medium.field, placed.medium.occupancy
    lower, upper = np.array(field.lower), np.array(field.upper)
    step = (upper - lower).max() / cells
    axes = [np.arange(a + step / 2, b, step) for a, b in zip(lower, upper, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    flat = points.reshape(-1, 3).T.astype(np.float32)
    parts = np.array_split(flat, cells, axis=1)
    density = np.concatenate([np.array(field.density(mi.Vector3f(*part))) for part in parts])
    density = density.reshape(points.shape[:3])
    if grid is not None:
        mask = grid.mask()
        at = ((points - lower) / (upper - lower) * mask.shape).astype(int)
        density = np.where(mask[tuple(np.moveaxis(at, -1, 0))], density, 0)
    density = np.pad(density, 1)
    vertices, faces, _, _ = marching_cubes(density, np.log(2) / step)
    vertices = lower + (vertices - 0.5) * step
    normals = _normals(vertices, faces)
    inside = (vertices - 0.5 * step * normals).T.astype(np.float32)
    _, color = field.density_emission(
        mi.Vector3f(*inside), mi.Vector3f(*(-normals).T.astype(np.float32))
    )
    if field.color_space == "srgb":
        color = [srgb_to_linear(c) for c in color]
    world = vertices @ placed.to_world[:3, :3].T + placed.to_world[:3, 3]
    if np.linalg.det(placed.to_world[:3, :3]) < 0:
        faces = faces[:, ::-1]
    mesh = mi.Mesh("field", len(vertices), len(faces))
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float(world.astype(np.float32).ravel())
    params["faces"] = mi.UInt32(faces.astype(np.uint32).ravel())
    params.update()
    mesh.add_attribute("vertex_color", 3, mi.Float(dr.ravel(mi.Color3f(*color))))
    return mesh


def _normals(vertices: Any, faces: Any) -> Any:
    """Outward unit normals of vertices, (N, 3)."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(vertices)
    for i in range(3):
        np.add.at(total, faces[:, i], across)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-20)


if __name__ == "__main__":
    main()
