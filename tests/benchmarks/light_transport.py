"""Noise and time of the composed scenes, beside those of another checkout and of meshes.

    python -m tests.benchmarks.light_transport --against ../before
    python -m tests.benchmarks.light_transport --scenes table --meshes

Each scene is rendered with a few samples a pixel and many seeds. Its noise is the variance of a
pixel's estimate, the mean over pixels and channels; times the seconds of a picture, it is what
a given error costs, whatever the number of samples. Seconds are those of all threads together,
the median of pictures that compile nothing; processes of all checkouts take turns. ``ratio`` is
that of this product to that of the other checkout, ``means`` the largest difference of the
means of rows of pixels, in standard errors.

With ``--meshes``, the same scenes by Mitsuba's ``path``, each field replaced by a mesh of the
same look: marching cubes through its density, black, with the colour that the field shows along
the normal as emission. ``to_path`` is the ratio to it.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerf.base.variants import choose_variant
from tests.benchmarks import checkout, machine, results
from tests.benchmarks.results import RENDERING, ROOT, Figure, Row, median_of, save

_MESHES = "path, meshes"
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
busy = {}
for path in a["scenes"]:
    name = path.split("/")[-1].removesuffix(".xml")
    scene = mi.load_file(path, width=width, height=height, spp=a["spp"])
    integrator, sensor = scene.integrator(), scene.sensors()[0]
    if a["meshes"]:
        scene = with_meshes(scene, a["out"])
        integrator = mi.load_dict({"type": "path", "max_depth": 8})
    busy[name], images = [], []
    for seed in range(a["seeds"] + 1):
        start = time.process_time()
        image = mi.render(
            scene, sensor=sensor, integrator=integrator, spp=a["spp"], seed=seed + a["first"]
        )
        images.append(np.array(image)[..., :3])
        busy[name].append(time.process_time() - start)
    np.save(f"{a['out']}/{name}.npy", np.array(images[1:], np.float32))
    busy[name] = busy[name][1:]
answer({"package": mi_nerf.__file__, "busy": busy})
"""


def main() -> None:
    """Renders all scenes with all checkouts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES)
    parser.add_argument("--size", type=int, nargs=2, default=(96, 48))
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--seeds", type=int, default=5, help="pictures of each process")
    parser.add_argument("--repeats", type=int, default=2, help="processes of each checkout")
    parser.add_argument("--threads", type=int, default=1, help="0: one for each core")
    parser.add_argument("--meshes", action="store_true", help="beside meshes of the same look")
    parser.add_argument("--variant")
    checkout.add_options(parser)
    results.add_options(parser)
    options = parser.parse_args()
    options.variant = choose_variant(options.variant)
    print(f"{machine()}, {options.size[0]}x{options.size[1]}, {options.spp} samples a pixel")
    versions = checkout.versions(options)
    if options.meshes:
        versions = {_MESHES: ROOT, **versions}
    pictures: dict[str, list[Pictures]] = {name: [] for name in versions}
    for turn in range(options.repeats):
        for name, folder in versions.items():
            pictures[name].append(_rendered(folder, turn, name == _MESHES, options))
    for scene in options.scenes:
        rows = _rows(scene, pictures, options)
        for name, folder in versions.items():
            save("noise", [rows[name]], options, options.variant, RENDERING, checkout=folder)


@dataclass(frozen=True)
class Pictures:
    """What one process has rendered, by scene."""

    busy: dict[str, list[float]]  # seconds
    images: dict[str, np.ndarray[Any, Any]]  # (K, H, W, 3)


def _rendered(folder: Path, turn: int, meshes: bool, options: argparse.Namespace) -> Pictures:
    """All scenes, with seeds of this turn."""
    with tempfile.TemporaryDirectory() as place:
        composed = folder / "scenes" / "composed"
        found = checkout.measured(
            folder,
            RENDER,
            scenes=[str(composed / f"{scene}.xml") for scene in options.scenes],
            out=place,
            size=list(options.size),
            spp=options.spp,
            seeds=options.seeds,
            first=1000 * turn,
            threads=options.threads,
            meshes=meshes,
            variant=options.variant,
        )
        images = {scene: np.load(Path(place) / f"{scene}.npy") for scene in options.scenes}
        return Pictures(found["busy"], images)


def _rows(
    scene: str, pictures: dict[str, list[Pictures]], options: argparse.Namespace
) -> dict[str, Row]:
    """The rows of one scene, by version, this one last."""
    costs: dict[str, float] = {}
    images: dict[str, np.ndarray[Any, Any]] = {}
    rows = {}
    for name, processes in pictures.items():
        busy = [seconds for process in processes for seconds in process.busy[scene]]
        images[name] = np.concatenate([process.images[scene] for process in processes])
        variance = float(images[name].var(axis=0, ddof=1, dtype=np.float64).mean())
        costs[name] = variance * float(np.median(busy))
        figures = {
            "busy": median_of(busy, "s"),
            "variance": Figure(variance),
            "cost": Figure(costs[name], "s"),
        }
        other = options.against_name
        if name == "this" and other in costs:
            figures["ratio"] = Figure(costs[name] / costs[other])
            figures["means"] = Figure(_apart(images[name], images[other]))
        if name == "this" and _MESHES in costs:
            figures["to_path"] = Figure(costs[name] / costs[_MESHES])
        print(f"{scene}, {name}: " + ", ".join(f"{k} {f.value:.3g}" for k, f in figures.items()))
        rows[name] = Row({"scene": scene, "version": name, "samples": str(options.spp)}, figures)
    return rows


def _apart(a: np.ndarray[Any, Any], b: np.ndarray[Any, Any]) -> float:
    """The largest difference of the means of rows of pixels, in standard errors."""
    means = [x.mean(axis=(2, 3), dtype=np.float64) for x in (a, b)]
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
    corners = vertices[faces]
    if np.sum(corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])) < 0:
        faces = faces[:, ::-1]  # they look outwards if the volume within is positive
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
