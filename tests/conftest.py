"""Fixtures that several test files share, and how Hypothesis runs."""

from __future__ import annotations

import os
from importlib import import_module
from typing import Any

import drjit as dr
import pytest
from hypothesis import settings

import mi_nerf  # noqa: F401  (finds LLVM before Dr.Jit looks for it)

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
