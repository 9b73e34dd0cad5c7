"""Pictures of scenes without fields, in sets of samples: the same mean, other noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mi_nerf.base.variants import choose_variant
from mi_nerf.generation import passes
from mi_nerf.tasks.render import scene_frames

SCENE = """<scene version="3.0.0"><integrator type="{integrator}"/>
<sensor type="perspective"><transform name="to_world">
    <lookat origin="0, -4, 2" target="0, 0, 0" up="0, 0, 1"/></transform>
    <sampler type="{sampler}"><integer name="sample_count" value="49"/></sampler>
    <film type="hdrfilm"><integer name="width" value="24"/><integer name="height" value="20"/>
    </film></sensor>
<emitter type="constant"/><shape type="sphere"/></scene>"""


@pytest.mark.slow
@pytest.mark.parametrize("sampler", ["independent", "stratified", "multijitter", "orthogonal"])
def test_sets_make_one_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sampler: str
) -> None:
    path = tmp_path / "scene.xml"
    path.write_text(SCENE.format(sampler=sampler, integrator="path"))
    _, frames = scene_frames(path, choose_variant())
    ((_, whole),) = list(frames)
    monkeypatch.setattr(passes, "SAMPLES_PER_PASS", 24 * 20 * 10)
    _, frames = scene_frames(path, choose_variant())
    ((_, parts),) = list(frames)
    assert whole.shape == parts.shape == (20, 24, 4)
    assert not np.array_equal(whole, parts)
    assert parts.mean((0, 1)) == pytest.approx(whole.mean((0, 1)), rel=0.02)
    assert np.sqrt(np.mean((whole - parts) ** 2)) < 0.1
