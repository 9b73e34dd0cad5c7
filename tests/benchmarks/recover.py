"""Three things found from pictures that do not show them directly, by derivatives of light paths.

    python -m tests.benchmarks.recover
    python -m tests.benchmarks.recover --problem pose --seeds 3

*pose*: where a box of glowing fog is, and how it is turned, from its shadow and its mirror image
alone; it is out of the frame. *light*: the colour of a floor and the power of the lamp above it,
under an object that is a field; what the field sends to the floor tells one from the other.
*mirror*: the network of a field that is seen in a mirror only, from three sides.

Each starts from the stated values, moved at random by the seed, and follows mi.ad.Adam on the
squared error of pictures with new random numbers in each step. Prints, for each seed, what was
found and how far off it is, then how many of them converged, and the seconds they took.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerf.base.variants import choose_variant
from tests.benchmarks import machine
from tests.benchmarks.results import RENDERING, Figure, Row, add_options, median_of, save
from tests.support.composed import place, rgb, slab
from tests.support.fields import camera_dict, formula_dict, small_file, weight_keys

_SIZE = 32


class Problem(ABC):
    """A scene, what is to be found in it, and how near it must come."""

    iterations: int
    rate: float
    spp = 4
    views: tuple[Any, ...] = ()  # cameras that take turns; none: only the scene's own

    def __init__(self, truth: dict[str, Any], start: dict[str, Any], seed: int) -> None:
        """
        Args:
            truth, start: scenes.
        """
        self.rng = np.random.default_rng(seed)
        self._seed = seed * 100_000
        self.truth, self.scene = mi.load_dict(truth), mi.load_dict(start)
        self.params = mi.traverse(self.scene)
        self.optimizer = mi.ad.Adam(lr=self.rate)
        self.targets = [self._target(view) for view in self.views or (None,)]

    def _target(self, view: Any) -> Any:
        self._look(self.truth, mi.traverse(self.truth), view)
        image = mi.render(self.truth, spp=256, seed=self._seed)
        dr.eval(image)
        return image

    @staticmethod
    def _look(scene: Any, params: Any, view: Any) -> None:
        if view is not None:
            params["sensor.to_world"] = mi.Transform4f(view.matrix)
            params.update()

    @abstractmethod
    def apply(self) -> None:
        """Puts the variables of the optimiser into the scene."""

    @abstractmethod
    def errors(self) -> dict[str, float]:
        """How far off each number is, relative to what counts as found: at most 1 is."""

    def solve(self) -> dict[str, float]:
        """Follows the gradient to the end."""
        for step in range(self.iterations):
            turn = step % len(self.targets)
            if self.views:
                self._look(self.scene, self.params, self.views[turn])
            # The rate falls to a tenth, so that noise averages out.
            self.optimizer.set_learning_rate(self.rate * 0.1 ** (step / self.iterations))
            self.apply()
            seed = self._seed + 2 * step + 1
            image = mi.render(self.scene, self.params, spp=self.spp, seed=seed, seed_grad=seed + 1)
            dr.backward(dr.mean(dr.square(image - self.targets[turn]), axis=None))
            self.optimizer.step()
        self.apply()
        return self.errors()


def _room(camera: Any, fov: float, **objects: Any) -> dict[str, Any]:
    """A floor and a mirror behind it."""
    floor = {"type": "diffuse", "reflectance": rgb((0.6, 0.5, 0.4))}
    sensor = camera_dict(camera, size=(_SIZE, _SIZE), film={"pixel_format": "rgb"})
    mirror = {"type": "conductor", "material": "none"}
    return {
        "type": "scene",
        "integrator": {"type": "nerf_path", "max_depth": 3, "samples": 16},
        "sensor": {**sensor, "fov": fov},
        "floor": {
            "type": "rectangle",
            "to_world": place().translate([0, 0, -1]).scale(4),
            "bsdf": floor,
        },
        "mirror": {
            "type": "rectangle",
            "to_world": place().translate([0, 2.2, 0.5]).rotate([1, 0, 0], 90).scale(2.5),
            "bsdf": mirror,
        },
        **objects,
    }


class Pose(Problem):
    """Three numbers of a place and one of a turn."""

    # With 4 samples a pixel, noise decides where the falling rate leaves it.
    iterations, rate, spp = 120, 0.03, 16
    where, turn = (1.2, -0.75, 0.2), 20.0  # degrees

    def __init__(self, seed: int, folder: Path) -> None:
        camera = place().look_at(origin=[0, -1, 0.5], target=[0, 1, -0.3], up=[0, 0, 1])
        lamp = {"type": "point", "position": [2, -2, 2.5], "intensity": rgb((20, 20, 20))}
        box = place().scale([0.45, 0.2, 0.3])
        moved = place().translate(list(self.where)).rotate([0, 0, 1], self.turn)
        scenes = [
            _room(camera, 70.0, lamp=lamp, box=slab(at @ box, 2.0, (0.9, 0.5, 0.2)))
            for at in (moved, place())
        ]
        super().__init__(*scenes, seed)
        self._check_out_of_frame(scenes[0])
        # Numbers in the cube's own coordinates would be stretched: the world's are wanted.
        self._stretch = box
        off = self.rng.uniform(-0.25, 0.25, 3)
        self.optimizer["where"] = mi.Point3f(*(np.array(self.where) + off).tolist())
        self.optimizer["turn"] = mi.Float(np.radians(self.turn + self.rng.uniform(-25, 25)))

    @staticmethod
    def _check_out_of_frame(scene: dict[str, Any]) -> None:
        seen = {**scene, "integrator": {**scene["integrator"], "max_depth": 1, "aovs": "opacity"}}
        if np.array(mi.render(mi.load_dict(seen), spp=64, seed=1))[..., -1].max() > 0:
            raise SystemExit("recover: the object of problem 'pose' is in the frame")

    def apply(self) -> None:
        where, turn = self.optimizer["where"], self.optimizer["turn"]
        matrix = mi.Transform4f().translate(where).rotate([0, 0, 1], turn * (180 / dr.pi))
        inner = mi.Transform4f(self._stretch.inverse().matrix) @ matrix
        inner = inner @ mi.Transform4f(self._stretch.matrix)
        self.params["box.interior_medium.to_world"] = inner
        self.params.update()

    def errors(self) -> dict[str, float]:
        where = np.ravel(np.array(self.optimizer["where"]))
        turn = np.degrees(float(self.optimizer["turn"][0]))
        off = float(np.linalg.norm(where - self.where))
        return {"place within 0.03": off / 0.03, "turn within 3°": abs(turn - self.turn) / 3}


class Light(Problem):
    """A colour and a power."""

    iterations, rate = 250, 0.08
    color, power = (0.7, 0.35, 0.2), 20.0

    def __init__(self, seed: int, folder: Path) -> None:
        camera = place().look_at(origin=[0.5, -4, 1.5], target=[0, 0, -0.6], up=[0, 0, 1])
        at = place().translate([0, 0, -0.5]).scale(0.45)
        glow = mi.ScalarVector3f(12, 12, 12)
        scenes = []
        for _ in range(2):
            scene = _room(
                camera,
                40.0,
                lamp={"type": "point", "position": [1, -1, 2.5], "intensity": rgb((1, 1, 1))},
                field=formula_dict("gaussian", at, peak=8.0, width=0.4, extent=2.5, radiance=glow),
            )
            scenes.append(scene)
        scenes[0]["lamp"]["intensity"] = rgb([self.power] * 3)
        scenes[0]["floor"]["bsdf"]["reflectance"] = rgb(self.color)
        super().__init__(*scenes, seed)
        grey = float(self.rng.uniform(0.3, 0.6))
        self.optimizer["color"] = mi.Color3f(grey)
        self.optimizer["power"] = mi.Float(np.log(self.power * self.rng.uniform(0.3, 3.0)))

    def apply(self) -> None:
        self.optimizer["color"] = dr.clip(self.optimizer["color"], 0.01, 0.99)
        self.params["floor.bsdf.reflectance.value"] = self.optimizer["color"]
        self.params["lamp.intensity.value"] = mi.Color3f(dr.exp(self.optimizer["power"]))
        self.params.update()

    def errors(self) -> dict[str, float]:
        color = np.ravel(np.array(self.optimizer["color"]))
        power = float(dr.exp(self.optimizer["power"])[0])
        off = float(np.abs(color - self.color).max())
        return {
            "colour within 0.03": off / 0.03,
            "power within 5 %": abs(power / self.power - 1) / 0.05,
        }


class Mirror(Problem):
    """All weights of a small network."""

    iterations, rate, spp = 150, 0.01, 2

    def __init__(self, seed: int, folder: Path) -> None:
        self.views = tuple(
            place().look_at(origin=[x, -0.8, 0.7], target=[0.2 * x, 2.2, 0.2], up=[0, 0, 1])
            for x in (-0.9, 0.0, 0.9)
        )
        at = place().translate([0, -2.2, 0.1]).scale(0.8)  # behind the cameras
        lamp = {"type": "point", "position": [2, 0, 2.5], "intensity": rgb((15, 15, 15))}
        glow = mi.ScalarVector3f(0.9, 0.5, 0.2)
        file = small_file(folder, seed=seed, samples=32, color_space="linear")
        network = {"type": "nerfmedium", "filename": str(file)}
        cube = formula_dict("gaussian", at, peak=8.0, width=0.35, extent=2.8, radiance=glow)
        scenes = [
            _room(self.views[0], 50.0, lamp=lamp, box=box)
            for box in (cube, {**cube, "interior": network})
        ]
        super().__init__(*scenes, seed)
        self._keys = weight_keys(self.params)
        for key in self._keys:
            self.optimizer[key] = self.params[key]

    def apply(self) -> None:
        self.params.update(self.optimizer)

    def errors(self) -> dict[str, float]:
        """From a side that no picture was taken from."""
        view = place().look_at(origin=[0.45, -0.8, 0.9], target=[0.1, 2.2, 0.2], up=[0, 0, 1])
        images = []
        for scene in (self.truth, self.scene):
            self._look(scene, mi.traverse(scene), view)
            with dr.suspend_grad():
                images.append(np.array(mi.render(scene, spp=64, seed=self._seed + 7)))
        error = float(np.sqrt(np.mean(np.square(images[0] - images[1]))))
        return {"new view within 0.03": error / 0.03}


PROBLEMS: dict[str, type[Problem]] = {"pose": Pose, "light": Light, "mirror": Mirror}


def main() -> None:
    """Prints what was found."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--problem", choices=sorted(PROBLEMS))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--variant")
    add_options(parser)
    options = parser.parse_args()
    variant = choose_variant(options.variant)
    mi.set_variant(variant)
    print(f"{machine()}, {variant}, {_SIZE}x{_SIZE} pixels")
    names = [options.problem] if options.problem else list(PROBLEMS)
    rows = [_row(name, options.seeds) for name in names]
    save("recover", rows, options, variant, RENDERING)


def _row(name: str, seeds: int) -> Row:
    found, seconds = 0, []
    for seed in range(seeds):
        with tempfile.TemporaryDirectory() as folder:
            start = time.perf_counter()
            make: Any = PROBLEMS[name]
            problem = make(seed, Path(folder))
            errors = problem.solve()
            seconds.append(time.perf_counter() - start)
        found += bool(max(errors.values()) <= 1)  # of NumPy, JSON knows none
        said = ", ".join(f"{what}: {value:.2f} of it" for what, value in errors.items())
        print(f"{name}, seed {seed}: {said}; {seconds[-1]:.0f} s", flush=True)
    print(f"{name}: {found} of {seeds} seeds found it")
    return Row(
        {"what": name},
        {"found": Figure(found), "of": Figure(seeds), "time": median_of(seconds, "s")},
        seeds=tuple(range(seeds)),
    )


if __name__ == "__main__":
    main()
