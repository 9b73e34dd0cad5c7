"""How pictures are divided: every sample once, no part too large, samplers as they are."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerf.base.variants import choose_variant
from mi_nerf.cameras.pinhole import Intrinsics
from mi_nerf.generation.passes import passes, sets, tiles

SAMPLERS = ("independent", "stratified", "multijitter", "orthogonal", "ldsampler")


class Squares:
    """A sampler that takes square numbers only, and rounds up."""

    def set_sample_count(self, count: int) -> None:
        self.count = int(np.ceil(np.sqrt(count))) ** 2

    def sample_count(self) -> int:
        return self.count


def test_passes_split_the_samples() -> None:
    for samples, pixels in ((1, 10), (64, 800 * 800), (509, 1 << 20), (7, 1 << 25)):
        parts = passes(samples, pixels)
        assert sum(parts) == samples and min(parts) >= 1
        assert max(parts) - min(parts) <= 1
        assert max(parts) == 1 or max(parts) * pixels <= 2 * (1 << 24)


@given(st.integers(1, 70), st.integers(1, 40), st.integers(1, 500), st.integers(1, 3000))
def test_tiles_cover_every_pixel(width: int, height: int, samples: int, limit: int) -> None:
    """Each sees, at its own pixels, in the directions in which the whole picture sees."""
    camera = Intrinsics(width, height, 50.0, 50.0, width / 2 + 3.25, height / 2)
    found = tiles(camera, samples, limit)
    seen = np.zeros((height, width), int)
    right = (np.arange(width) + 0.5 - camera.cx) / camera.fx
    down = (np.arange(height) + 0.5 - camera.cy) / camera.fy
    for tile in found:
        part = tile.intrinsics
        assert (part.width, part.height) == (found[0].intrinsics.width, found[0].intrinsics.height)
        assert tile.pixels == part.width * part.height
        assert tile.pixels == 1 or tile.pixels * samples <= limit
        seen[tile.place] += 1
        rows, columns = tile.place
        own = (np.arange(part.width) + 0.5 - part.cx) / part.fx
        assert np.allclose(own, right[columns], rtol=0, atol=1e-12)
        own = (np.arange(part.height) + 0.5 - part.cy) / part.fy
        assert np.allclose(own, down[rows], rtol=0, atol=1e-12)
    assert (seen >= 1).all()
    if width * height * samples <= limit:
        assert len(found) == 1


def test_whole_rows_first() -> None:
    """1080p at 4096 samples: two rows at a time, not pixels or columns."""
    found = tiles(Intrinsics(1920, 1080, 1.0, 1.0, 960.0, 540.0), 2048)
    assert (found[0].intrinsics.width, found[0].intrinsics.height) == (1920, 4)
    assert len(found) == 270
    found = tiles(Intrinsics(1920, 2, 1.0, 1.0, 960.0, 1.0), 1 << 16)
    assert (found[0].intrinsics.width, found[0].intrinsics.height) == (256, 1)
    assert len(found) == 16 and found[7].x == 1920 - 256


@given(st.integers(1, 5000), st.integers(1, 100), st.integers(1, 3000))
def test_sets_are_what_the_sampler_takes(samples: int, pixels: int, limit: int) -> None:
    parts = sets(samples, pixels, Squares(), limit)
    if samples * pixels <= limit:
        assert parts == [samples]
        return
    assert len(set(parts)) == 1 and int(np.sqrt(parts[0])) ** 2 == parts[0]
    assert parts[0] == 1 or parts[0] * pixels <= limit
    assert sum(parts) - parts[0] < samples <= sum(parts)


@pytest.mark.parametrize("name", SAMPLERS)
def test_sets_of_samplers_of_mitsuba(name: str) -> None:
    mi.set_variant(choose_variant())
    sampler = mi.load_dict({"type": name, "sample_count": 4})
    parts = sets(4096, 800 * 800, sampler)
    assert sum(parts) >= 4096 and sum(parts) <= 4096 * 1.1
    assert max(parts) * 800 * 800 <= 1 << 24
    sampler.set_sample_count(parts[0])
    assert sampler.sample_count() == parts[0]
