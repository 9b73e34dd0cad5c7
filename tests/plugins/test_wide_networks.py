"""Wide networks, which march in waves, look as they do by the flattened path."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import mi_nerf  # noqa: F401
from mi_nerf.fields.network import NetworkConfig
from mi_nerf.march import walk
from tests.support.fields import scene_dict, small_file


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["nerf", "nerf_path"])
@pytest.mark.parametrize("stop", [0.0, 0.01])
def test_waves_show_the_same(
    kind: str, stop: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To rounding, or with rays that end early to what they leave out."""
    mi.set_variant("llvm_ad_rgb")
    field = small_file(tmp_path, network=NetworkConfig(depth=2, width=80, skip=-1, view_width=8))
    scene = mi.load_dict(scene_dict(field, integrator={"type": kind, "stop": stop}))
    asked: list[int] = []
    original = walk._in_waves

    def counted(*arguments: Any) -> Any:
        found = original(*arguments)
        asked.append(int(np.array(found[1]).sum()))
        return found

    monkeypatch.setattr(walk, "_in_waves", counted)
    fast = np.array(mi.render(scene, seed=3))
    assert sum(asked) > 0
    monkeypatch.setattr(
        importlib.import_module("mi_nerf.plugins.integral"), "can_walk", lambda _: False
    )
    slow = np.array(mi.render(scene, seed=3))
    assert slow[..., 3].max() > 0.5
    np.testing.assert_allclose(fast, slow, atol=2e-5 + 2 * stop)
