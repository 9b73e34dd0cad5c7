"""Pictures without noise: what the library is given, and what is said where it is missing."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mi_nerf import InputError
from mi_nerf.cli import main
from mi_nerf.images.denoise import denoised, denoised_frames


def noisy(seed: int = 0, size: int = 48) -> np.ndarray:
    """A grey square on black, premultiplied, with noise in its colour but not in its alpha."""
    rng = np.random.default_rng(seed)
    image = np.zeros((size, size, 4), np.float32)
    image[12:-12, 12:-12] = (0.5, 0.5, 0.5, 1)
    image[..., :3] *= rng.gamma(4, 0.25, (size, size, 1)).astype(np.float32)
    return image


def test_colours_go_to_the_library_and_alpha_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[dict[str, Any]] = []

    def denoise(color: np.ndarray, **options: Any) -> np.ndarray:
        asked.append({"color": color, **options})
        return color * 0.5 - 0.1

    monkeypatch.setitem(sys.modules, "mitsuba_oidn", SimpleNamespace(denoise=denoise))
    image = noisy()
    normal = np.zeros((48, 48, 3))
    found = denoised(image, normal=normal)
    assert asked[0]["hdr"] is True and set(asked[0]) == {"color", "hdr", "normal"}
    assert asked[0]["color"].flags.c_contiguous and asked[0]["normal"].dtype == np.float32
    np.testing.assert_array_equal(found[..., 3], image[..., 3])
    np.testing.assert_allclose(found[..., :3], np.maximum(image[..., :3] * 0.5 - 0.1, 0))
    frames = ((f"view_{i}", noisy(i)) for i in range(2))
    assert [name for name, _ in denoised_frames(frames)] == ["view_0", "view_1"]  # type: ignore[arg-type]
    assert len(asked) == 3


def test_a_missing_library_is_named_before_anything_is_rendered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    with pytest.raises(InputError, match="denoise: the package 'mitsuba-oidn' is not installed"):
        denoised(noisy())
    out = tmp_path / "table.png"
    assert main(["render", "table", "-o", str(out), "--denoise"]) == 2
    said = capsys.readouterr().err.strip()
    assert said.endswith("pip install 'mi_nerf[denoise]'") and "\n" not in said
    assert "--denoise" in said and not out.exists()


def test_noise_goes() -> None:
    pytest.importorskip("mitsuba_oidn")
    image = noisy(size=96)
    inside = (slice(20, -20), slice(20, -20), slice(0, 3))
    before, after = image[inside], denoised(image)[inside]
    assert np.abs(after - 0.5).mean() < 0.3 * np.abs(before - 0.5).mean()
    assert after.mean() == pytest.approx(before.mean(), rel=3e-2)


@pytest.mark.parametrize(
    "rfilter", ['<rfilter type="gaussian"><float name="stddev" value="1"/></rfilter>', ""]
)
def test_pixels_of_scenes_do_not_share_noise(
    rfilter: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the film's filter is: a lamp that ends between two pixels does not leak."""
    import mi_nerf

    monkeypatch.setitem(
        sys.modules, "mitsuba_oidn", SimpleNamespace(denoise=lambda color, **_: color)
    )
    scene = tmp_path / "scene.xml"
    scene.write_text(
        """<scene version="3.0.0"><integrator type="path"/>
        <sensor type="orthographic"><film type="hdrfilm">
        <integer name="width" value="8"/><integer name="height" value="8"/>"""
        + rfilter
        + """</film><transform name="to_world"><lookat origin="0,0,3" target="0,0,0" up="0,1,0"/>
        </transform></sensor><shape type="rectangle"><transform name="to_world">
        <scale value="0.5"/></transform><emitter type="area"/></shape></scene>"""
    )
    (image,) = mi_nerf.render(scene, spp=4, denoise=True, variant="llvm_ad_rgb", show=False)
    lit = image[..., 0] > 0
    assert lit.sum() == 16 and image[..., 0].std() > 0.3
    (shared,) = mi_nerf.render(scene, spp=4, variant="llvm_ad_rgb", show=False)
    assert (shared[..., 0] > 0).sum() > 16
