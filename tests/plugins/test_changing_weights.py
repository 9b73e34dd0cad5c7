"""The medium's occupancy grid while weights change through ``mi.traverse``."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mi_nerf
from mi_nerf import FieldFile, NeuralFieldConfig
from mi_nerf.fields.fourier import FourierEncoding
from mi_nerf.fields.network import NetworkConfig, initial_weights
from mi_nerf.march.occupancy import OccupancyGrid, greatest_around
from mi_nerf.march.query import Evaluation
from mi_nerf.march.settings import MarchSettings
from tests.support.fields import formula_dict, scene_dict, small_file, weight_keys

CONFIG = NeuralFieldConfig(
    position=FourierEncoding(frequencies=1, include_input=True),
    direction=FourierEncoding(frequencies=1),
    network=NetworkConfig(depth=1, width=8, skip=-1, view_width=8),
    density_activation="relu",
    density_shift=0.0,
)
MARCH = MarchSettings(samples=256)
SHEET, THIN = ((1.0, 0.0, 0.0), -0.5, 0.3, 30.0), ((0.6, 0.8, 0.0), 0.4, 0.01, 300.0)


def sheet(
    normal: tuple[float, float, float], place: float, half: float, peak: float, bias: float = 0.0
) -> dict[str, np.ndarray]:
    """Weights of σ = relu(peak · (1 − |n · x − place| / half) + bias), in a colour of its own."""
    weights = initial_weights(CONFIG.shapes(), 0)
    for name in ("trunk_0.weight", "trunk_0.bias", "density.weight", "density.bias"):
        weights[name] = np.zeros_like(weights[name])
    # The features of a position are sines and cosines, and the position itself among them.
    columns = _columns_of_the_position()
    weights["trunk_0.weight"][0, columns], weights["trunk_0.bias"][0] = normal, -place
    weights["trunk_0.weight"][1, columns], weights["trunk_0.bias"][1] = np.negative(normal), place
    weights["density.weight"][0, :2] = -peak / half
    weights["density.bias"][0] = peak + bias
    return weights


def _columns_of_the_position() -> list[int]:
    features = CONFIG.position.features(dr.llvm.Array3f(0.125, 0.25, 0.375))
    values = [float(f[0]) for f in features]
    return [values.index(v) for v in (0.125, 0.25, 0.375)]


def saved(
    folder: Path, weights: Mapping[str, np.ndarray], cells: np.ndarray | None, name: str = "field"
) -> Path:
    path = folder / f"{name}.safetensors"
    mi_nerf.save_field(path, FieldFile(CONFIG, dict(weights), cells, MARCH))
    return path


def cells_of(weights: Mapping[str, np.ndarray], n: int = 32) -> np.ndarray:
    """Cells that the field is seen to fill, and their neighbours."""
    field, _ = FieldFile(CONFIG, dict(weights)).build(mi)
    grid = OccupancyGrid.surveyed(field, np.ones((n, n, n), bool), mi.Float, looks=8)
    grid.draw_line(0.01)
    return greatest_around(grid.mask())


def scene_of(path: Path, occupancy: bool = True) -> Any:
    scene = scene_dict(path, size=(24, 18), spp=2)
    scene["box"]["interior"]["occupancy"] = occupancy
    return mi.load_dict(scene)


def medium_of(scene: Any) -> Any:
    return scene.shapes()[0].interior_medium()


def put(params: Any, weights: Mapping[str, np.ndarray]) -> None:
    for key in weight_keys(params):
        name = next(n for n in weights if n.replace(".", "_") == key.rpartition(".")[2])
        params[key] = mi.TensorXf(np.asarray(weights[name], np.float32))
    params.update()


def queries(monkeypatch: pytest.MonkeyPatch, scene: Any) -> int:
    """How many samples are evaluated, or would be if no ray ended early."""
    counts: list[int] = []
    original = Evaluation.__init__

    def spy(self: Any, field: Any, samples: Any, *args: Any, **options: Any) -> None:
        counts.append(len(samples.index))
        original(self, field, samples, *args, **options)

    with monkeypatch.context() as patch:
        patch.setattr(Evaluation, "__init__", spy)
        # A walk within one kernel asks about the same samples, but where no one sees it.
        patch.setattr(importlib.import_module("mi_nerf.plugins.integral"), "can_walk", _never)
        mi.render(scene, seed=0)
    return sum(counts)


def _never(_: Any) -> bool:
    return False


@pytest.fixture
def dense_behind_a_hull(variant: str, tmp_path: Path) -> Path:
    """Random weights, dense almost everywhere, of which the grid keeps an eighth."""
    contents = mi_nerf.load_field(small_file(tmp_path))
    cells = np.zeros((16, 16, 16), bool)
    cells[4:12, 4:12, 4:12] = True
    path = tmp_path / "hull.safetensors"
    mi_nerf.save_field(path, FieldFile(contents.config, contents.weights, cells, contents.march))
    return path


def test_a_small_change_costs_no_more_and_shows_no_leftovers(
    dense_behind_a_hull: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = scene_of(dense_behind_a_hull)
    held = queries(monkeypatch, scene)
    params = mi.traverse(scene)
    for _ in range(3):
        for key in weight_keys(params):
            params[key] = params[key] + 1e-3
        params.update()
        after = np.array(mi.render(scene, seed=0))
    assert held > 0 and queries(monkeypatch, scene) <= 1.05 * held
    contents = mi_nerf.load_field(dense_behind_a_hull)
    weights = {name: weight + np.float32(3e-3) for name, weight in contents.weights.items()}
    path = dense_behind_a_hull.with_name("changed.safetensors")
    mi_nerf.save_field(path, replace(contents, weights=weights))
    expected = np.array(mi.render(scene_of(path), seed=0))
    np.testing.assert_allclose(after, expected, atol=0.01)


def test_weights_of_another_field_show_as_that_field_does(variant: str, tmp_path: Path) -> None:
    """A thin oblique sheet where there was nothing, all at once."""
    scene = scene_of(saved(tmp_path, sheet(*SHEET), cells_of(sheet(*SHEET))))
    old = np.array(mi.render(scene, seed=0))
    params = mi.traverse(scene)
    put(params, sheet(*THIN))
    found = np.array(mi.render(scene, seed=0))
    whole = scene_of(saved(tmp_path, sheet(*THIN), None, "other"))
    expected = np.array(mi.render(whole, seed=0))
    assert np.abs(expected - old).max() > 0.3 and expected[..., 3].max() > 0.5
    np.testing.assert_allclose(found, expected, atol=0.02)
    assert medium_of(scene).occupancy.fraction() < 0.6
    for _ in range(140):  # and what was there before is forgotten in time
        put(params, sheet(*THIN))
        left = medium_of(scene).occupancy.fraction()
    assert left < 0.2
    np.testing.assert_allclose(np.array(mi.render(scene, seed=0)), expected, atol=0.02)


def test_a_field_that_moves_on_is_followed(variant: str, tmp_path: Path) -> None:
    scene = scene_of(saved(tmp_path, sheet(*SHEET), cells_of(sheet(*SHEET))))
    params, (normal, _, half, peak) = mi.traverse(scene), SHEET
    for place in np.linspace(-0.4, 0.6, 11):
        put(params, sheet(normal, float(place), half, peak))
        found = np.array(mi.render(scene, seed=0))
    whole = scene_of(saved(tmp_path, sheet(normal, 0.6, half, peak), None, "other"))
    np.testing.assert_allclose(found, np.array(mi.render(whole, seed=0)), atol=0.02)


def test_a_field_that_vanishes_and_comes_back(variant: str, tmp_path: Path) -> None:
    scene = scene_of(saved(tmp_path, sheet(*SHEET), cells_of(sheet(*SHEET))))
    before, params = np.array(mi.render(scene, seed=0)), mi.traverse(scene)
    put(params, sheet(*SHEET, bias=-1000.0))
    assert np.array(mi.render(scene, seed=0))[..., 3].max() == 0
    put(params, sheet(*SHEET))
    np.testing.assert_allclose(np.array(mi.render(scene, seed=0)), before, atol=0.02)


def test_weights_that_are_no_numbers_neither_crash_nor_empty_the_grid(
    variant: str, tmp_path: Path
) -> None:
    scene = scene_of(saved(tmp_path, sheet(*SHEET), cells_of(sheet(*SHEET))))
    params = mi.traverse(scene)
    put(params, {n: np.full_like(w, np.nan) for n, w in sheet(*SHEET).items()})
    mi.render(scene, seed=0)
    assert medium_of(scene).occupancy.fraction() == 1
    put(params, sheet(*SHEET))
    assert np.isfinite(np.array(mi.render(scene, seed=0))).all()


def test_a_loop_compiles_nothing_and_its_gradients_are_those_of_the_field(
    variant: str, tmp_path: Path
) -> None:
    scene = scene_of(saved(tmp_path, sheet(*SHEET), cells_of(sheet(*SHEET))))
    untouched = scene_of(saved(tmp_path, sheet(*SHEET), None, "other"))
    gradients = []
    for each in (scene, untouched):
        params = mi.traverse(each)
        for key in weight_keys(params):
            dr.enable_grad(params[key])
        params.update()
        dr.backward(dr.mean(mi.render(each, params, seed=0), axis=None))
        gradients.append({k: np.array(dr.grad(params[k])) for k in weight_keys(params)})
    for key, expected in gradients[1].items():
        scale = max(float(np.abs(expected).max()), 1e-6)
        np.testing.assert_allclose(gradients[0][key], expected, atol=0.02 * scale)

    optimizer = mi.ad.Adam(lr=1e-3)
    params = mi.traverse(scene)
    for key in weight_keys(params):
        optimizer[key] = dr.detach(params[key])
    missed = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for step in range(8):
            dr.kernel_history_clear()
            params.update(optimizer)
            image = mi.render(scene, params, seed=step)
            dr.backward(dr.mean(dr.square(image - 0.3), axis=None))
            optimizer.step()
            missed.append(sum(k.get("cache_hit") == 0 for k in dr.kernel_history()))
        dr.kernel_history_clear()
    assert missed[4:] == [0] * 4


def test_the_same_changes_give_the_same_picture(variant: str, tmp_path: Path) -> None:
    path = saved(tmp_path, sheet(*SHEET), cells_of(sheet(*SHEET)))
    images = []
    for _ in range(2):
        scene = scene_of(path)
        for weights in (sheet(*THIN), sheet(*SHEET)):
            put(mi.traverse(scene), weights)
            images.append(np.array(mi.render(scene, seed=0)))
    assert np.array_equal(images[:2], images[2:])


def test_without_a_grid_there_is_none_afterwards(variant: str, tmp_path: Path) -> None:
    weights = sheet(*SHEET)
    switched_off = scene_of(saved(tmp_path, weights, cells_of(weights)), occupancy=False)
    formula = mi.load_dict({"type": "scene", "box": formula_dict("gaussian")})
    for scene in (switched_off, scene_of(saved(tmp_path, weights, None, "bare")), formula):
        params = mi.traverse(scene)
        for key in weight_keys(params):
            params[key] = params[key] + 0.01
        params.update()
        assert medium_of(scene).occupancy is None
