"""Training by Mitsuba's own parts: RayDataLoader, mi.render, dr.backward and mi.ad.Adam."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mi_nerf
from tests.support.fields import scene_dict, small_file

TINY = {"network.width": 16, "network.view_width": 16, "grid.log2_entries": 10, "grid.levels": 4}
TINY |= {"occupancy.resolution": 16}


class Loop:
    """The loop of docs/mitsuba.md on a dataset."""

    def __init__(self, data: Path, folder: Path, *, pixels: int = 64, **integrator: Any) -> None:
        views = mi_nerf.load_dataset(data, "train")
        self.start = folder / "start.safetensors"
        fresh = mi_nerf.fresh_field(views, preset="fast", settings=TINY, variant=mi.variant())
        mi_nerf.save_field(self.start, fresh)
        self.scene: Any = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "nerf", "encoded": True, "samples": 64, **integrator},
                "views": {"type": "nerfviews", "filename": str(data)},
                "box": {
                    "type": "cube",
                    "bsdf": {"type": "null"},
                    "interior": {
                        "type": "nerfmedium",
                        "filename": str(self.start),
                        "training": True,
                    },
                },
            }
        )
        self.views: Any = self.scene.sensors()[0]
        self.medium: Any = self.scene.shapes()[0].interior_medium()
        self.loader = mi.ad.loaders.RayDataLoader(
            self.views, self.views.images(), pixels, regular_reshuffle=True, tile_size=1 << 20
        )
        self.params: Any = mi.traverse(self.scene)
        self.params.keep("box.interior_medium.(?!to_world)")
        self.optimizer = mi.ad.Adam(lr=1e-2, beta_2=0.99, params=self.params)
        self.params.update(self.optimizer)

    def loss(self, seed: int) -> Any:
        """Of the next pixels."""
        target, sensor = self.loader.next()
        image = mi.render(self.scene, self.params, sensor=sensor, seed=seed)
        return dr.mean(dr.square(image - target), axis=None)

    def step(self, seed: int) -> None:
        dr.backward(self.loss(seed))
        self.optimizer.step()
        self.params.update(self.optimizer)


@pytest.fixture
def loop(variant: str, blob: Path, tmp_path: Path) -> Loop:
    return Loop(blob, tmp_path)


def test_the_film_of_all_views_shows_each_camera_where_its_image_is(
    variant: str, blob: Path
) -> None:
    """Rays through the middle of every pixel, against pinhole cameras in NumPy."""
    sensor: Any = mi.load_dict({"type": "nerfviews", "filename": str(blob)})
    images = np.array(sensor.images())
    assert len(sensor.dataset) == 8 and images.shape == (3 * 24, 3 * 24, 4)
    assert list(sensor.film().size()) == [72, 72]
    data, camera = sensor.dataset, sensor.dataset.intrinsics
    rng = np.random.default_rng(0)
    x, y = rng.integers(0, 72, (2, 300))
    inside = rng.uniform(0, 1, (2, 300))  # wherever in the pixel
    place = mi.Point2f(*(np.float32((v + u) / 72) for v, u in zip((x, y), inside, strict=True)))
    ray, weight = sensor.sample_ray(mi.Float(0), mi.Float(0), place, mi.Point2f(0))
    found_o, found_d = np.array(ray.o), np.array(ray.d)
    assert np.all(np.array(weight) == 1)
    for k in range(300):
        view = (y[k] // 24 * 3 + x[k] // 24) % len(data)
        px, py = x[k] % 24, y[k] % 24
        np.testing.assert_array_equal(images[y[k], x[k]], data.image(view)[py, px])
        local = (
            (px + 0.5 - camera.cx) / camera.fx,
            (camera.cy - py - 0.5) / camera.fy,
            -1.0,
        )
        d = data.cam_to_world[view][:3, :3] @ local
        np.testing.assert_allclose(found_d[:, k], d / np.linalg.norm(d), atol=1e-5)
        np.testing.assert_allclose(found_o[:, k], data.cam_to_world[view][:3, 3], atol=1e-5)


def test_without_centers_rays_pass_anywhere_in_a_pixel(variant: str, blob: Path) -> None:
    options = {"type": "nerfviews", "filename": str(blob), "split": "test", "downscale": 2}
    sensor: Any = mi.load_dict({**options, "centers": False})
    places = mi.Point2f(mi.Float(0.1, 0.11), mi.Float(0.2, 0.2))
    anywhere, _ = sensor.sample_ray(mi.Float(0), mi.Float(0), places, mi.Point2f(0))
    middle, _ = mi.load_dict(options).sample_ray(0.0, 0.0, places, mi.Point2f(0))  # type: ignore[attr-defined]
    assert np.ptp(np.array(anywhere.d), axis=1).max() > 1e-3
    assert np.ptp(np.array(middle.d), axis=1).max() == 0
    assert list(sensor.film().size()) == [3 * 12, 2 * 12]  # of five views


def test_a_forward_facing_capture_is_refused(variant: str, tmp_path: Path) -> None:
    from tests.support.datasets import forward_poses, random_images, write_llff_dataset

    write_llff_dataset(tmp_path, random_images(10, 6, 8, 3), forward_poses(10), 8.0)
    with pytest.raises((mi_nerf.InputError, RuntimeError), match="forward-facing"):
        mi.load_dict({"type": "nerfviews", "filename": str(tmp_path)})


def test_the_field_to_start_with_is_that_of_a_run(blob: Path, tmp_path: Path, loop: Loop) -> None:
    run = mi_nerf.start(
        blob, tmp_path / "run", preset="fast", steps=1, settings=TINY, variant=mi.variant()
    )
    expected, found = run.field_file(), mi_nerf.load_field(loop.start)
    assert found.config == expected.config and found.march == expected.march
    assert found.occupancy is not None and expected.occupancy is not None
    np.testing.assert_array_equal(found.occupancy, expected.occupancy)
    for name, weights in expected.weights.items():
        np.testing.assert_array_equal(found.weights[name], weights)


def test_a_step_has_the_derivative_of_the_picture_that_it_drew(loop: Loop) -> None:
    """Against central differences of the loss, with the same seed and so the same samples."""
    for step in range(20):
        loop.step(step)
    target, sensor = loop.loader.next()

    def loss() -> Any:
        image = mi.render(loop.scene, loop.params, sensor=sensor, seed=7)
        return dr.mean(dr.square(image - target), axis=None)

    dr.backward(loss())
    rng = np.random.default_rng(1)
    for key in ("color_bias", "density_weight", "view_0_weight", "grid_table"):
        name = f"box.interior_medium.{key}"
        gradient = np.array(dr.grad(loop.params[name]), np.float64)
        value = np.array(loop.params[name])
        along = gradient / np.linalg.norm(gradient) + 0.1 * rng.normal(size=value.shape) / np.sqrt(
            value.size
        )
        size = 0.02
        ends = []
        for sign in (1, -1):
            loop.params[name] = mi.TensorXf(np.float32(value + sign * size * along))
            loop.params.update()
            ends.append(float(loss().array[0]))
        loop.params[name] = mi.TensorXf(value)
        loop.params.update()
        slope = (ends[0] - ends[1]) / (2 * size)
        assert slope == pytest.approx(float((gradient * along).sum()), rel=2e-2), key


def test_other_seeds_for_derivatives_are_kept_to(loop: Loop) -> None:
    """The derivative is unbiased with a seed of its own, and another one than the picture's."""
    target, sensor = loop.loader.next()
    found = []
    for seed_grad in (0, 0, 5):
        image = mi.render(loop.scene, loop.params, sensor=sensor, seed=3, seed_grad=seed_grad)
        dr.backward(dr.mean(dr.square(image - target), axis=None))
        found.append(np.array(dr.grad(loop.params["box.interior_medium.grid_table"])))
        for _, value in loop.params:
            dr.clear_grad(value)
    np.testing.assert_allclose(found[0], found[1], atol=1e-6 * np.abs(found[0]).max())
    assert np.abs(found[0] - found[2]).max() > 1e-2 * np.abs(found[0]).max()


def test_jitter_follows_from_the_seed(loop: Loop, blob: Path, tmp_path: Path) -> None:
    _, sensor = loop.loader.next()

    def picture(of: Loop, seed: int) -> np.ndarray:
        with dr.suspend_grad():
            return np.array(mi.render(of.scene, sensor=sensor, seed=seed))

    assert np.array_equal(picture(loop, 1), picture(loop, 1))
    assert not np.array_equal(picture(loop, 1), picture(loop, 2))
    still = Loop(blob, tmp_path, jitter=False)
    assert np.array_equal(picture(still, 1), picture(still, 2))


def test_a_loop_compiles_nothing_after_its_first_steps(loop: Loop) -> None:
    missed, kernels = [], []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for step in range(40):
            dr.kernel_history_clear()
            loop.optimizer.set_learning_rate(1e-2 * 0.9**step)
            loop.step(step)
            history = dr.kernel_history()
            missed.append(sum(entry.get("cache_hit") == 0 for entry in history))
            kernels.append(len(history))
        dr.kernel_history_clear()
    assert missed[10:] == [0] * 30
    assert min(kernels) > 10  # that were looked at


def test_a_picture_is_asked_about_once(loop: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in training: samples are evaluated once for a picture and its derivatives together."""
    from mi_nerf.march.query import Evaluation

    counts, original = [], Evaluation.__init__

    def spy(self: Any, field: Any, samples: Any, *args: Any, **options: Any) -> None:
        counts.append(bool(options["keep"]))
        original(self, field, samples, *args, **options)

    monkeypatch.setattr(Evaluation, "__init__", spy)
    loop.step(0)
    assert counts == [True]
    assert loop.scene.integrator()._shown is None  # nor is it kept for longer


def test_cells_outside_the_hull_stay_empty(loop: Loop) -> None:
    hull = mi_nerf.load_field(loop.start).occupancy
    assert hull is not None and 0.05 < hull.mean() < 0.9
    for step in range(3):
        loop.step(step)
        loop.medium.occupancy.follow(loop.medium.field)
    for _ in range(400):
        loop.medium.occupancy.follow(loop.medium.field)
    mask = loop.medium.occupancy.mask()
    assert not (mask & ~hull).any()
    assert mask.sum() <= hull.sum()


def test_a_trained_field_is_saved(loop: Loop, tmp_path: Path) -> None:
    for step in range(3):
        loop.step(step)
    path = tmp_path / "after.safetensors"
    mi_nerf.save_field(path, loop.medium.field_file())
    options = {"size": (16, 12), "integrator": {"encoded": True}}
    after = np.array(mi.render(mi.load_dict(scene_dict(path, **options)), seed=0))
    before = np.array(mi.render(mi.load_dict(scene_dict(loop.start, **options)), seed=0))
    sensor: Any = mi.load_dict(scene_dict(path, **options)["sensor"])
    with dr.suspend_grad():
        found = np.array(mi.render(loop.scene, sensor=sensor, seed=0))
    assert found.shape == after.shape and np.abs(after - before).max() > 1e-3
    formula: Any = mi.load_dict({"type": "nerfmedium", "field": "slab"})
    with pytest.raises(mi_nerf.InputError, match="'slab' is a formula"):
        formula.field_file()


@pytest.mark.slow
def test_it_learns_a_path_traced_scene(variant: str, tmp_path: Path) -> None:
    data = tmp_path / "data"
    options = {"protocol": "realistic360", "size": (24, 24), "spp": 8, "show": False}
    mi_nerf.generate("arches", data, train=12, val=0, test=2, **options)
    loop = Loop(data, tmp_path, pixels=256)

    def psnr() -> float:
        mi_nerf.save_field(tmp_path / "now.safetensors", loop.medium.field_file())
        seen = mi_nerf.evaluate(
            tmp_path / "now.safetensors", data=data, split="test", variant=variant
        )
        return float(seen["mean"]["psnr"])

    before = psnr()
    for step in range(200):
        loop.step(step)
    after = psnr()
    assert after > before + 6 and after > 20, (before, after)


# dr.freeze looks at every plugin that there is; one that Python has taken apart ends the process.
FROZEN = """
import sys
import drjit as dr, mitsuba as mi, numpy as np
mi.set_variant(sys.argv[1])
import mi_nerf
from tests.support.fields import scene_dict
scene = mi.load_dict({**scene_dict(sys.argv[2]), "integrator": {"type": sys.argv[3]}})
before = np.array(mi.render(scene, seed=1))
frozen = dr.freeze(lambda scene, seed: mi.render(scene, seed=seed))
try:
    frozen(scene, mi.UInt32(1))
except RuntimeError as error:
    said = error
    while said is not None and not isinstance(said, mi_nerf.InputError):
        said = said.__cause__
    print(said)
assert np.array_equal(np.array(mi.render(scene, seed=1)), before)
"""


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["nerf", "nerf_path", "nerf_tracking"])
def test_a_frozen_function_refuses_a_picture_in_one_sentence(
    variant: str, tmp_path: Path, integrator: str
) -> None:
    path = small_file(tmp_path, color_space="linear", color_activation="softplus")
    command = [sys.executable, "-c", FROZEN, variant, str(path), integrator]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert done.stdout.startswith(f"{integrator}: inside dr.freeze"), done.stderr
    assert done.stdout.count("\n") == 1


def test_everything_around_a_picture_may_be_frozen(loop: Loop) -> None:
    """New values and seeds take effect: nothing of the picture is part of the recording."""

    @dr.freeze
    def loss(image: Any, target: Any) -> Any:
        return dr.mean(dr.square(image - target), axis=None)

    for seed in range(4):
        target, sensor = loop.loader.next()
        with dr.suspend_grad():
            image = mi.render(loop.scene, sensor=sensor, seed=seed)
            found = float(loss(image, target).array[0])
        expected = np.mean(np.square(np.array(image) - np.array(target)))
        assert found == pytest.approx(float(expected), rel=1e-5)
