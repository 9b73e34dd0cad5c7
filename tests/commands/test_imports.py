"""What starts soon imports little: heavy modules wait until somebody needs them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

# Of no use before training ends, or at all: each takes a good part of what a start may take.
PLOTS_AND_FILMS = {
    "OpenEXR",
    "matplotlib",
    "skimage",
    "scipy",
    "imageio",
    "imageio_ffmpeg",
    "torch",
}
OTHER_COMMANDS = {
    "mi_nerf.estimators",
    "mi_nerf.generation",
    "mi_nerf.report",
    "mi_nerf.tasks",
    "mi_nerf.images.write",
    "mi_nerf.formats.foreign_networks",
    "mi_nerf.fields.closed_form",
}

TRAINING = """
import mi_nerf.training.run
from mi_nerf.cli import main

def start(*_, **__):
    raise mi_nerf.InputError("as far as this")

mi_nerf.training.run.start = start
assert main(["train", "data", "--out", "run", "--preset", "fast"]) == 2
"""


def imported(program: str) -> set[str]:
    """The modules that a process holds after ``program``."""
    program += "\nimport json, sys\nprint(json.dumps(sorted(sys.modules)))"
    root = Path(__file__).parents[2]
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=root, capture_output=True, text=True, check=True
    )
    return set(json.loads(done.stdout.splitlines()[-1]))


def test_importing_the_package_is_for_scenes_alone() -> None:
    modules = imported("import mi_nerf")
    assert "mi_nerf.fields.neural" in modules
    heavy = {"tyro", "tqdm", "PIL", "mi_nerf.api", "mi_nerf.data", "mi_nerf.training"}
    assert modules & (heavy | PLOTS_AND_FILMS | OTHER_COMMANDS) == set()


def test_training_imports_no_other_command() -> None:
    modules = imported(TRAINING)
    assert {"tyro", "mi_nerf.commands.train", "mi_nerf.training.trainer"} <= modules
    notebooks = {"tqdm.auto", "tqdm.notebook", "ipywidgets"}
    assert modules & (PLOTS_AND_FILMS | OTHER_COMMANDS | notebooks) == set()
    commands = {name for name in modules if name.startswith("mi_nerf.commands.")}
    assert commands == {f"mi_nerf.commands.{name}" for name in ("shared", "train", "usage")}
