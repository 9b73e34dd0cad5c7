"""The way of a ray as the package of plugins tells it: true, short, and the same for one ray."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
import textwrap
from pathlib import Path
from types import FrameType
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mi_nerf
from tests.support.fields import camera_dict, formula_dict

MOST_CALLS, MOST_FILES = 7, 4


@pytest.fixture(autouse=True)
def _variant(variant: str) -> None:
    """All tests here run with every variant."""


def scene(**integrator: Any) -> Any:
    view = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
    sensor = camera_dict(view, size=(8, 6))
    field = formula_dict("gaussian", peak=5.0, width=0.4)
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "nerf", **integrator},
            "sensor": sensor,
            "field": field,
            "sky": {"type": "constant"},
        }
    )


def drawings() -> list[str]:
    """The two of the docstring: forwards and backwards."""
    text = importlib.import_module("mi_nerf.plugins").__doc__ or ""
    found = re.findall(r"::\n\n((?:    .*\n|\n)+)", text)
    assert len(found) == 2
    return [textwrap.dedent(drawing).strip() for drawing in found]


def test_the_documents_show_the_same() -> None:
    page = Path(__file__).parents[2] / "docs/how-it-works.md"
    assert f"```text\n{drawings()[0]}\n```" in page.read_text()


def test_everything_on_the_way_exists() -> None:
    """A class whose file has been said once stands without it from then on."""
    names = re.findall(r"^ *((?:\w+\.)+\w+)", "\n".join(drawings()), flags=re.MULTILINE)
    classes = {"Traced": "field_scene"}
    assert len(names) > 14
    for name in names:
        parts = name.split(".")
        if parts[0][0].isupper():
            parts.insert(0, classes[parts[0]])
        package = "mi_nerf." if parts[0] == "march" else "mi_nerf.plugins."
        depth = 2 if parts[0] == "march" else 1
        value: Any = importlib.import_module(package + ".".join(parts[:depth]))
        classes[parts[depth]] = ".".join(parts[:depth])
        for part in parts[depth:]:
            value = getattr(value, part)
        assert callable(value)


def test_from_render_to_composite_in_few_calls() -> None:
    """Counted on the stack: our own frames from ``render`` to ``composite``."""
    from mi_nerf.march import quadrature

    loaded, stacks = scene(), []
    package = mi_nerf.__file__.rpartition("/")[0]

    def look(frame: FrameType, event: str, _: object) -> None:
        if event != "call" or frame.f_code is not quadrature.composite.__code__:
            return
        stack, here = [], frame
        while here is not None:
            if here.f_code.co_filename.startswith(package):
                stack.append((here.f_code.co_filename, here.f_code.co_name))
                if here.f_code.co_name == "render":
                    break
            here = here.f_back  # type: ignore[assignment]
        stacks.append(stack)

    sys.setprofile(look)
    try:
        mi.render(loaded, spp=1)
    finally:
        sys.setprofile(None)
    assert stacks and stacks[0][-1][1] == "render"
    assert len(stacks[0]) <= MOST_CALLS
    assert len({file for file, _ in stacks[0]}) <= MOST_FILES


def test_lanes_that_are_not_active_show_nothing() -> None:
    loaded = scene(aovs="depth,opacity")
    origin, count = mi.Point3f(0, 0, 3), 6
    ray = mi.Ray3f(
        origin, dr.normalize(mi.Vector3f(dr.linspace(mi.Float, -0.1, 0.1, count), 0, -1))
    )
    active = dr.arange(mi.UInt32, count) % 2 == 0
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, count)
    integrator = loaded.integrator()
    color, valid, aovs, _ = integrator.sample(dr.ADMode.Primal, loaded, sampler, ray, active=active)
    seen = np.array(active)
    for values in (*color, *aovs):
        assert (np.array(values)[~seen] == 0).all()
        assert (np.array(values)[seen] > 0).all()
    np.testing.assert_array_equal(np.array(valid), seen)


def test_the_first_variant_may_be_one_that_is_refused() -> None:
    """Mitsuba makes its own base classes again for the next one: ours must follow these."""
    program = """
import mitsuba as mi
import mi_nerf

for variant in ("llvm_ad_spectral", "llvm_ad_rgb", "scalar_rgb", "llvm_ad_rgb"):
    mi.set_variant(variant)
integrator = mi.load_dict({"type": "nerf", "nested": {"type": "prb"}})
assert isinstance(integrator, mi.CppADIntegrator), type(integrator).__mro__
"""
    subprocess.run([sys.executable, "-c", program], check=True)
