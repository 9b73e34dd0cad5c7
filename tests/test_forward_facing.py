"""Fields in normalised device coordinates: sampled, trained, rendered and shown alike."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import imageio.v3 as iio
import mitsuba as mi
import numpy as np
import pytest

from mi_nerf import load_field
from mi_nerf.base.variants import array_module, choose_variant
from mi_nerf.cameras.ndc import Ndc
from mi_nerf.cameras.pinhole import Intrinsics, sensor_dict
from mi_nerf.cameras.poses import average_pose, look_at
from mi_nerf.cameras.trajectory import forward_spiral
from mi_nerf.cli import main
from mi_nerf.data import hull, load_dataset
from mi_nerf.march.marched import MarchedField
from mi_nerf.march.placing import place_samples
from mi_nerf.march.quadrature import integrate
from mi_nerf.march.query import Evaluation
from mi_nerf.march.render import render_rays
from mi_nerf.march.settings import MarchSettings
from mi_nerf.march.view import render_view
from mi_nerf.training.config import TrainConfig
from mi_nerf.training.model import field_config
from tests.support.analytic import AnalyticField, uniform
from tests.support.arrays import unit, vectors
from tests.support.datasets import forward_poses, orbit_poses, write_llff_dataset
from tests.support.fields import scene_dict, small_file

NDC = Ndc(1.4, 1.8)


def forward_rays(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Origins before the near plane and directions within the frustum, float32."""
    rng = np.random.default_rng(seed)
    o = rng.uniform(-0.2, 0.2, (count, 3))
    d = unit(np.c_[rng.uniform(-0.4, 0.4, (count, 2)), -np.ones(count)])
    return o.astype(np.float32), d.astype(np.float32)


def projected(points: np.ndarray) -> np.ndarray:
    """Points, (..., 3), through the matrix of ``NDC``, in double precision."""
    clip = np.concatenate([points, np.ones_like(points[..., :1])], -1) @ NDC.matrix().T
    return clip[..., :3] / clip[..., 3:]


# ---- Samples -----------------------------------------------------------------


def test_samples_are_even_in_disparity(ad: Any) -> None:
    """Strata of equal width in t' from 0 to 1, at the projections of points on the ray."""
    o, d = forward_rays(20)
    field = AnalyticField(uniform(1.0), ndc=NDC)
    samples = place_samples(
        MarchedField(field, MarchSettings(samples=8)), vectors(ad, o), vectors(ad, d)
    )
    assert samples.ndc is not None and samples.queries == 160
    length = np.array(samples.ndc.length)
    t = np.array(samples.t).reshape(20, 8) / length[:, None]
    assert t == pytest.approx(np.tile((np.arange(8) + 0.5) / 8, (20, 1)), abs=1e-6)
    # The widths count along d', as densities do.
    assert np.array(samples.delta).reshape(20, 8).sum(axis=1) == pytest.approx(length, rel=1e-6)
    z = -1 / (1 - t)  # t' = 1 + n/z
    o, d = o.astype(float), d.astype(float)
    points = o[:, None] + ((z - o[:, 2:]) / d[:, 2:])[..., None] * d[:, None]
    place = (
        np.array(samples.o).T[:, None]
        + np.array(samples.t).reshape(20, 8)[..., None] * np.array(samples.d).T[:, None]
    )
    assert place == pytest.approx(projected(points), abs=1e-5)


def test_emission_sees_directions_before_projection(ad: Any) -> None:
    o, d = forward_rays(30)
    field = AnalyticField(uniform(1e3), lambda p, d: [d.x, d.y, d.z], ndc=NDC)
    seen = render_rays(
        MarchedField(field, MarchSettings(samples=4)), vectors(ad, o), vectors(ad, d)
    )
    assert np.array(seen.color).T == pytest.approx(d, abs=1e-5)


def wall(depth: float) -> AnalyticField:
    """Opaque beyond a z-depth, empty before it."""
    z = 1 - 2 / depth  # of NDC, near plane 1
    return AnalyticField(lambda p: dr.select(p.z > z, type(p.x)(1e5), 0), ndc=NDC)


@pytest.mark.parametrize("depth", [1.5, 4.0, 40.0])
def test_depth_is_a_distance_along_the_ray(ad: Any, depth: float) -> None:
    o, d = forward_rays(30)
    settings = MarchSettings(samples=2000)
    seen = render_rays(MarchedField(wall(depth), settings), vectors(ad, o), vectors(ad, d))
    expected = (-depth - o[:, 2]) / d[:, 2]
    assert np.array(seen.opacity) == pytest.approx(np.ones(30))
    # A stratum is 1/2000 of t', and dt = dt'·depth² on the axis.
    assert np.abs(np.array(seen.depth) - expected).max() < 1.5 * depth**2 / 2000


def test_empty_space_has_no_depth(ad: Any) -> None:
    o, d = forward_rays(5)
    field = AnalyticField(uniform(0.0), ndc=NDC)
    seen = render_rays(
        MarchedField(field, MarchSettings(samples=4)), vectors(ad, o), vectors(ad, d)
    )
    assert not np.array(seen.depth).any() and not np.array(seen.opacity).any()


def test_rays_that_face_backwards_see_nothing(ad: Any) -> None:
    o, d = forward_rays(6)
    d[::2, 2] *= -1
    seen = render_rays(
        MarchedField(wall(2.0), MarchSettings(samples=64)), vectors(ad, o), vectors(ad, d)
    )
    assert np.array(seen.opacity) == pytest.approx([0, 1, 0, 1, 0, 1])


def test_nothing_behind_a_camera_beyond_the_near_plane(ad: Any) -> None:
    """A layer from z-depth 2 to 3, from before, from within and from behind it."""
    low, high = 1 - 2 / 2.0, 1 - 2 / 3.0
    field = AnalyticField(
        lambda p: dr.select((p.z > low) & (p.z < high), type(p.x)(3.0), 0), ndc=NDC
    )
    o = np.array([(0, 0, 0), (0, 0, -2.4), (0, 0, -3.5)], np.float32)
    d = np.tile(np.float32((0, 0, -1)), (3, 1))
    seen = render_rays(
        MarchedField(field, MarchSettings(samples=3000)), vectors(ad, o), vectors(ad, d)
    )
    crossed = np.array([high - low, high - (1 - 2 / 2.4), 0])
    assert np.array(seen.opacity) == pytest.approx(1 - np.exp(-3 * crossed), abs=2e-3)


def test_bounds_are_distances(ad: Any) -> None:
    """near and far cut the ray where the wall's strata are, in scene units."""
    o, d = forward_rays(10)
    o[:] = 0
    rays = vectors(ad, o), vectors(ad, d)
    reach = 4 / -d[:, 2]  # where the ray meets z-depth 4
    settings = MarchSettings(samples=256, near=0.5, far=float(reach.min() * 0.99))
    assert not np.array(render_rays(MarchedField(wall(4.0), settings), *rays).opacity).any()
    settings = MarchSettings(samples=256, near=float(reach.max() * 1.01))
    depth = np.array(render_rays(MarchedField(wall(4.0), settings), *rays).depth)
    assert depth == pytest.approx(np.full(10, settings.near), rel=0.05)


def test_depth_is_differentiable(ad: Any) -> None:
    """The gradient of a depth against differences, through the way back to distances."""
    o, d = (vectors(ad, v) for v in forward_rays(3))

    def depth(density: Any) -> Any:
        field = AnalyticField(uniform(1.0), ndc=NDC)
        samples = place_samples(MarchedField(field, MarchSettings(samples=16)), o, d)
        evaluation = Evaluation(field, samples, 64)
        evaluation._channels[0] = density + dr.zeros(ad.Float, 48)
        return dr.sum(integrate(evaluation, samples).depth)

    density = ad.Float(0.8)
    dr.enable_grad(density)
    dr.backward(depth(density))
    step = 1e-2
    slope = (depth(ad.Float(0.8 + step))[0] - depth(ad.Float(0.8 - step))[0]) / (2 * step)
    assert dr.grad(density)[0] == pytest.approx(slope, rel=5e-3)


# ---- Files and Mitsuba -------------------------------------------------------


def test_field_files_keep_the_projection(tmp_path: Path) -> None:
    contents = load_field(small_file(tmp_path, ndc=NDC))
    assert contents.config.ndc == NDC
    assert load_field(small_file(tmp_path)).config.ndc is None


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_mitsuba_sees_what_evaluation_sees(scale: float, tmp_path: Path) -> None:
    """One field, one camera, through ``mi.render`` and ``render_view``; also when moved."""
    path = small_file(tmp_path, color_space="linear", ndc=NDC)
    variant = choose_variant()
    mi.set_variant(variant)
    camera = Intrinsics(16, 12, 13.0, 13.0, 8.0, 6.0)
    pose = look_at((0.1, -0.05, 0.1), (0, 0, -4), (0, 1, 0))
    to_world = mi.ScalarTransform4f().translate((1, 2, 3)).rotate((0, 1, 0), 40).scale(scale)
    matrix = np.array(to_world.matrix, float)
    moved = matrix @ pose
    moved[:3, :3] /= scale
    integrator = {"jitter": False, "aovs": "depth,opacity"}
    parts = scene_dict(path, integrator=integrator, to_world=to_world)
    parts["sensor"] = sensor_dict(camera, moved, near_clip=1e-3, far_clip=1e9)
    seen = np.array(mi.render(mi.load_dict(parts), spp=256)).astype(float)

    contents = load_field(path)
    backend = array_module(variant)
    view = render_view(contents.marched(backend), camera, pose, backend, spp=64)
    assert view.opacity.max() > 0.3
    expected = np.concatenate([view.color, view.opacity[..., None]], axis=-1)
    assert np.abs(expected - seen[..., :4]).max() < 0.02
    visible = view.opacity > 0.3
    assert (np.abs(seen[..., 4] / scale - view.depth) < 0.03 * view.depth)[visible].all()


# ---- Runs --------------------------------------------------------------------


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nine views of two striped walls at z-depths 3 and 9. Not to be changed."""
    poses = forward_poses(9)
    y, x = np.mgrid[:24, :32] + 0.5
    local = np.stack([(x - 16) / 28, (12 - y) / 28, -np.ones_like(x)], axis=-1)
    images = []
    for pose in poses:
        d = local @ pose[:3, :3].T  # the cameras look along −y
        near, far = (pose[:3, 3] + (-depth - pose[1, 3]) / d[..., 1:2] * d for depth in (3.0, 9.0))
        stripes = np.where(np.sin(1.5 * far[..., :1]) > 0, (0.9, 0.7, 0.1), (0.1, 0.3, 0.8))
        ahead = (near[..., :1] > 0) & (near[..., 2:] < 0.5)
        image = np.where(ahead, 0.5 + 0.4 * np.sin(3 * near[..., 2:]) * (1, 0, -1), stripes)
        images.append(np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8))
    folder = tmp_path_factory.mktemp("walls")
    return write_llff_dataset(folder, np.array(images), poses, 28.0, bounds=(3.0, 9.0))


@pytest.fixture(scope="module")
def forward_run(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 150 steps on ``capture``. Not to be changed."""
    out = tmp_path_factory.mktemp("runs") / "run"
    settings = ["network.width=32", "network.view_width=16", "occupancy.resolution=16"]
    settings += ["occupancy.start=64", "optimizer.warmup=20", "sampling.samples=32"]
    assert (
        main(["train", str(capture), "--out", str(out), "--steps", "150", "--set", *settings]) == 0
    )
    return out


def test_the_field_of_a_capture(capture: Path) -> None:
    dataset = load_dataset(capture, "train")
    config = field_config(TrainConfig(), dataset)
    assert config.ndc == dataset.ndc
    assert (config.lower, config.upper) == dataset.box
    side = config.upper[0] - config.lower[0]
    # Octaves down to a period of two pixels, of 32 pixels on [−1, 1].
    assert config.position.frequencies == round(np.log2(side * 16))


def test_silhouettes_do_not_carve_projected_boxes(capture: Path) -> None:
    dataset = load_dataset(capture, "train")
    assert dataset.box is not None
    transparent = replace(dataset, has_alpha=True, images=0 * dataset.premultiplied())
    assert hull.view_box(transparent) == dataset.box
    assert hull.carve(transparent, *dataset.box, 8).all()
    assert hull.tighten(transparent, *dataset.box) == dataset.box


@pytest.mark.slow
def test_training_learns_the_capture(forward_run: Path, tmp_path: Path) -> None:
    """Held-out views come out better than any one colour, in files that XML scenes load."""
    file = tmp_path / "result.json"
    assert main(["eval", str(forward_run), "--json", str(file)]) == 0
    record = json.loads(file.read_text())
    truth = load_dataset(record_data(forward_run), "test").premultiplied()[..., :3]
    even = -10 * np.log10(np.var(truth.reshape(-1, 3), axis=0).mean())
    assert record["views"] == 2 and record["mean"]["psnr"] > even + 3
    contents = load_field(forward_run / "field.safetensors")
    assert contents.config.ndc == load_dataset(record_data(forward_run), "train").ndc


def record_data(run: Path) -> str:
    return json.loads((run / "config.json").read_text())["data"]["path"]


@pytest.mark.slow
def test_evaluation_refuses_cameras_of_another_kind(
    forward_run: Path, blob_run: Path, capture: Path, tmp_path: Path, refused: Callable[..., str]
) -> None:
    around = record_data(blob_run)
    said = refused("eval", forward_run, "--data", around)
    assert f"{around}: posed images all around, expected a forward-facing capture" in said
    said = refused("eval", blob_run, "--data", capture)
    assert f"{capture}: a forward-facing capture, expected posed images all around" in said
    views = np.zeros((9, 24, 32, 3), np.uint8)
    zoomed = write_llff_dataset(tmp_path, views, forward_poses(9), 2 * 28.0, bounds=(3.0, 9.0))
    said = refused("eval", forward_run, "--data", zoomed)
    assert f"{zoomed}: Ndc(" in said and "expected about Ndc(" in said


@pytest.mark.slow
def test_a_run_goes_on(forward_run: Path, tmp_path: Path) -> None:

    run = Path(shutil.copytree(forward_run, tmp_path / "run"))
    options = ["--out", str(run), "--resume", "--steps", "152"]
    assert main(["train", record_data(run), *options]) == 0
    assert json.loads((run / "log.jsonl").read_text().splitlines()[-1])["step"] == 152


@pytest.mark.slow
def test_spiral_is_the_path_of_forward_runs(
    forward_run: Path, tmp_path: Path, refused: Callable[..., str]
) -> None:
    for options in ([], ["--path", "spiral"]):
        out = tmp_path / f"frames{len(options)}"
        assert main(["render", str(forward_run), "-o", str(out), "--frames", "3", *options]) == 0
        names = sorted(path.name for path in out.iterdir())
        assert names == [f"spiral_{i:03d}.png" for i in range(3)]
        assert all(iio.imread(out / name)[..., 3].mean() > 200 for name in names)
    out = tmp_path / "test"
    assert main(["render", str(forward_run), "-o", str(out), "--path", "test"]) == 0
    assert len(list(out.iterdir())) == 2
    message = refused("render", forward_run, "-o", tmp_path / "no.png", "--path", "orbit")
    assert "expected --path spiral or --path test" in message


@pytest.mark.slow
def test_report_of_a_capture(
    forward_run: Path, capture: Path, tmp_path: Path, refused: Callable[..., str]
) -> None:
    """Held-out views, depths in scene units; a field file alone does not know its cameras."""
    options = ["--rays", "200", "--repeats", "1", "--samples", "8", "128", "--no-profile"]
    options += ["--resolutions", "--thresholds", "--stops"]
    assert main(["report", str(forward_run), "--out", str(tmp_path / "out"), *options]) == 0
    speed = json.loads((tmp_path / "out/report.json").read_text())["speed"]
    assert speed["views"]["split"] == "test" and speed["views"]["data"] == str(capture)
    rough, fine = (
        next(p for p in speed["points"] if (p["samples"], p["rule"]) == (n, "constant"))
        for n in (8, 128)
    )
    for name in ("color", "depth"):  # second order: 256 times
        assert 0 < fine["error"][name] < 0.1 * rough["error"][name]
    assert "expected --data" in refused(
        "report", forward_run / "field.safetensors", "--out", tmp_path / "none"
    )


def test_captures_that_look_around_are_refused(tmp_path: Path, refused: Callable[..., str]) -> None:
    images = np.zeros((8, 8, 8, 3), np.uint8)
    folder = write_llff_dataset(tmp_path / "around", images, orbit_poses(8), 8.0)
    message = refused("train", folder, "--out", tmp_path / "run")
    assert "poses_bounds.npy: expected a forward-facing capture" in message


def test_info_says_where_the_field_lives(
    forward_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["info", str(forward_run)]) == 0
    assert "normalised device coordinates" in capsys.readouterr().out
    assert main(["info", record_data(forward_run)]) == 0
    assert "2 views of 32x24" in capsys.readouterr().out


# ---- The spiral --------------------------------------------------------------


def test_forward_spiral_by_its_definition() -> None:
    poses = forward_poses(40, spread=0.5)
    spiral = forward_spiral(poses, 2.0, 30.0, 24)
    middle = average_pose(poses)
    local = np.linalg.inv(middle) @ spiral
    reach = np.abs((np.linalg.inv(middle) @ poses)[:, :3, 3])
    radii = np.array([np.percentile(r, 90) for r in reach.T])
    angle = 4 * np.pi * np.arange(24) / 24
    expected = radii * np.stack([np.cos(angle), -np.sin(angle), -np.sin(angle / 2)], axis=1)
    assert local[:, :3, 3] == pytest.approx(expected, abs=1e-12)
    focus = np.array([0, 0, -1 / (0.25 / 1.8 + 0.75 / 150)])
    for pose in local:
        ahead = unit([focus - pose[:3, 3]])[0]
        assert -pose[:3, 2] == pytest.approx(ahead)
        assert pose[0, 1] ** 2 < 0.05 and pose[1, 1] > 0.9  # upright
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)


def test_one_frame_of_a_spiral() -> None:
    assert forward_spiral(forward_poses(2), 2.0, 9.0, 1).shape == (1, 4, 4)
