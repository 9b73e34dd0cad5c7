"""What is said before the first view: limits of precision, and memory."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.cameras.pinhole import Intrinsics
from mi_nerf.generation import notes
from mi_nerf.generation.passes import memory


class Planned:
    """As much of a plan as the notes read."""

    def __init__(self, size: float, away: float, width: int = 40, height: int = 30) -> None:
        half = size / 2 / 3**0.5
        self.box = ((away - half, -half, -half), (away + half, half, half))
        self.intrinsics = Intrinsics(width, height, 50.0, 50.0, width / 2, height / 2)
        self.pixels = width * height


def planned(*values: Any) -> Any:
    return Planned(*values)


@pytest.mark.parametrize("size", [0.1, 1.0, 1e3, 1e5])
@pytest.mark.parametrize("times", [0.0, 10.0, 500.0])
def test_usual_scenes_have_none(size: float, times: float) -> None:
    assert notes.notes(planned(size, size * times)) == []


def test_far_from_the_origin() -> None:
    (note,) = notes.notes(planned(1.0, 4.4e6))
    assert "lies 4.4e+06 from the origin" in note and "0.5 apart" in note
    assert np.spacing(np.float32(4.4e6)) == 0.5


def test_smaller_than_rays_can_tell() -> None:
    (note,) = notes.notes(planned(0.002, 0.0))
    assert "has a size of 0.002" in note and "9e-05" in note


def test_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = planned(1.0, 0.0, 1920, 1080)
    line = notes.memory_line(plan, 16_588_800)
    assert line == "about 1.0 GB of memory, 16,588,800 paths at a time"
    assert memory(1920 * 1080) < 2e9
    monkeypatch.setattr(notes, "available_memory", lambda: 500_000_000)
    expected = r"size=\(1920, 1080\): takes about 1.0 GB of memory, there are 0.5 GB"
    with pytest.raises(InputError, match=expected):
        notes.memory_line(plan, 1)
