"""The file that says that work goes on: seen, not seen, withdrawn, left behind."""

from __future__ import annotations

import pickle
import threading
import time
from pathlib import Path

import pytest

from mi_nerf.base.errors import InputError
from mi_nerf.jobs import Permit, permitted
from mi_nerf.jobs import permit as module


def test_it_lasts_as_long_as_the_block(tmp_path: Path) -> None:
    folder = tmp_path / "new/data"
    with permitted(folder) as permit:
        assert permit.path.parent == folder and permit.path.is_file()
        permit.require()
        copy: Permit = pickle.loads(pickle.dumps(permit))
        copy.require()
        with pytest.raises(ZeroDivisionError), permitted(tmp_path / "other") as other:
            raise ZeroDivisionError
        assert not other.path.exists()
    assert not list(folder.iterdir())
    with pytest.raises(InputError, match=f"{folder}: the worker on .* does not see what is there"):
        copy.require(patience=0)


def test_a_later_one_ends_those_of_killed_processes(tmp_path: Path) -> None:
    (tmp_path / ".working-0123").touch()
    (tmp_path / "mine").touch()
    with permitted(tmp_path) as permit:
        assert {p.name for p in tmp_path.iterdir()} == {permit.path.name, "mine"}
        started = time.monotonic()
        with pytest.raises(InputError):  # at once: the folder shows another one
            Permit(tmp_path / ".working-0123").require(patience=60)
        assert time.monotonic() - started < 10


def test_a_slow_file_system_is_waited_for(tmp_path: Path) -> None:
    permit = Permit(tmp_path / ".working-abc")
    threading.Timer(0.3, permit.path.touch).start()
    permit.require(patience=30)
    permit.withdraw()
    permit.withdraw()
    started = time.monotonic()
    with pytest.raises(InputError):  # it has been seen before, so nothing is slow
        permit.require(patience=30)
    assert time.monotonic() - started < 10


def test_a_watch_notices_within_a_second_or_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_SECONDS_BETWEEN_LOOKS", 0.05)
    with permitted(tmp_path) as permit:
        may_go_on = permit.watched()
        time.sleep(0.1)
        assert may_go_on()
        permit.withdraw()
        assert may_go_on()  # it does not look that often
        time.sleep(0.1)
        assert not may_go_on()
        permit.path.touch()
        time.sleep(0.1)
        assert not may_go_on()  # what is withdrawn stays so


def test_a_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="is a file"), permitted(tmp_path / "file"):
        pass
