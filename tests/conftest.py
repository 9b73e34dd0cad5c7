"""Fixtures that several test files share, and how Hypothesis runs."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import pytest
from hypothesis import settings

import mi_nerf  # noqa: F401  (finds LLVM before Dr.Jit looks for it)
from mi_nerf.cli import main
from mi_nerf.march import query
from tests.support.datasets import write_blob_dataset

# The first example of a property may have to wait for the compiler.
settings.register_profile("local", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "local")


@pytest.fixture(scope="session", params=["llvm", pytest.param("cuda", marks=pytest.mark.cuda)])
def ad(request: pytest.FixtureRequest) -> Any:
    """The array types of one backend."""
    if not dr.has_backend(getattr(dr.JitBackend, request.param.upper())):
        pytest.skip(f"no {request.param} on this machine")
    return import_module(f"drjit.{request.param}.ad")


@pytest.fixture(
    params=["llvm_ad_rgb", pytest.param("cuda_ad_rgb", marks=pytest.mark.cuda)],
)
def variant(request: pytest.FixtureRequest) -> str:
    """One of Mitsuba's variants, which is set."""
    backend = request.param.split("_")[0].upper()
    if not dr.has_backend(getattr(dr.JitBackend, backend)):
        pytest.skip(f"no {request.param} on this machine")
    mi.set_variant(request.param)
    return str(request.param)


# ---- The command line --------------------------------------------------------


@pytest.fixture(scope="session")
def blob(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny dataset: 8 training and 5 test views, 24x24. Not to be changed."""
    return write_blob_dataset(tmp_path_factory.mktemp("blob"))


@pytest.fixture(scope="session")
def blob_run(blob: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 20 steps on ``blob``. Not to be changed."""
    out = tmp_path_factory.mktemp("runs") / "run"
    settings = ["network.width=16", "network.view_width=16", "occupancy.resolution=16"]
    assert main(["train", str(blob), "--out", str(out), "--steps", "20", "--set", *settings]) == 0
    return out


@pytest.fixture
def data(blob: Path, tmp_path: Path) -> Path:
    """A copy of ``blob`` that a test may change."""
    return Path(shutil.copytree(blob, tmp_path / "data"))


@pytest.fixture
def run(blob_run: Path, tmp_path: Path) -> Path:
    """A copy of ``blob_run`` that a test may change."""
    return Path(shutil.copytree(blob_run, tmp_path / "run"))


@pytest.fixture
def refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Calls the command with bad input; returns the one line that it says.

    Whatever lies in the test's folder stays as it was, and nothing is added.
    """

    def files() -> dict[str, bytes | None]:
        return {
            str(path.relative_to(tmp_path)): path.read_bytes() if path.is_file() else None
            for path in tmp_path.rglob("*")
        }

    def call(*arguments: str | Path) -> str:
        before = files()
        capsys.readouterr()
        assert main([str(a) for a in arguments]) == 2
        out, err = capsys.readouterr()
        assert out == ""
        assert err.startswith("mi-nerf: ") and err.endswith("\n") and err.count("\n") == 1, err
        assert "Traceback" not in err and "\x1b" not in err
        assert files() == before
        return err.strip()

    return call


@pytest.fixture
def short_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few rays end early in as short rounds as many rays do."""
    monkeypatch.setattr(query, "_LEAST_QUERIES", 1)
