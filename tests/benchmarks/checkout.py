"""Runs the same measurement with this checkout and with another one, back to back."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from mi_nerf.base.variants import choose_variant
from tests.benchmarks import data_folder, results
from tests.benchmarks.results import ROOT

_ANSWER = "answer: "


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of a benchmark that compares."""
    parser.add_argument("--against", type=Path, help="folder of another checkout")
    parser.add_argument("--against-name", default="0.1.0", help="what the tables call it")


def parsed(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """The options of a comparison on a dataset, ``folder`` and ``variant`` among them."""
    parser.add_argument("--variant")
    add_options(parser)
    results.add_options(parser)
    options = parser.parse_args()
    options.folder = data_folder(options.data).resolve()
    options.variant = choose_variant(options.variant)
    return options


def versions(options: argparse.Namespace) -> dict[str, Path]:
    """Checkouts by name, the other one first, so that what it reaches is known."""
    other = {} if options.against is None else {options.against_name: options.against.resolve()}
    for folder in other.values():
        if not (folder / "mi_nerf").is_dir():
            sys.exit(f"--against {options.against}: expected a checkout, with a folder mi_nerf")
    return {**other, "this": ROOT}


def measured(checkout: Path, program: str, **arguments: Any) -> dict[str, Any]:
    """What a program answers in a process of its own, which imports mi_nerf from ``checkout``.

    The program finds its ``arguments``, ``started`` (the monotonic clock at the start of the
    process) among them, and calls ``answer`` with a dictionary.
    """
    head = "import json, sys\narguments = json.loads(sys.argv[1])\n"
    head += f"def answer(values): print({_ANSWER!r} + json.dumps(values), flush=True)\n"
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    arguments["started"] = time.monotonic()
    command = [sys.executable, "-c", head + program, json.dumps(arguments)]
    done = subprocess.run(
        command, cwd=checkout, env=environment, stdout=subprocess.PIPE, text=True, check=True
    )
    answers = [line for line in done.stdout.splitlines() if line.startswith(_ANSWER)]
    found: dict[str, Any] = json.loads(answers[-1].removeprefix(_ANSWER))
    if Path(found["package"]).parents[1] != checkout:
        raise RuntimeError(f"{found['package']} was measured instead of {checkout}")
    return found
